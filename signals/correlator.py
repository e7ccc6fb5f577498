"""Correlation at sample level: carrier wipe-off, delayed replicas, integrate and dump.

Over an integration of N samples the tap at offset d (chips) is

    X_d = 1 / (sigma sqrt(N)) sum_n z_n exp(-j 2 pi (f_IF n / fs + carrier(n / fs)))
                                    C(floor(code(n / fs) - d) mod length)                     (1)

with carrier and code as the `Nco` commands them.  An integration begins and ends at the first
sample whose NCO code phase is not below a multiple of ``dump_chips``; bounds are thus exact to
the sample at any ratio of sampling and chip rate (4 MHz is 4000 samples per 1023 chips).

The work is done in cells of at most `CELL` samples from the start of each piece of the command:
phases come anew in float64, sums inside a cell are float32, across cells float64.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from signals.compiled import FAST_SUM, kernel
from signals.front_end import GUARD_SAMPLES, first_sample_at
from signals.nco import Nco, Taps
from signals.noise import CELL
from signals.recording import IfSource
from signals.replica import STRIDE, carrier_phasors, carrier_steps, code_steps, replica_table

_NCO_TYPES = (np.float64,) * 6 + (np.int64, np.bool_)
_BLOCK = 64 * CELL  # samples taken from the source at a time


class SampleCorrelator:
    """Taps of equation (1) from the samples of ``source``; a `Correlator`.

    Open sums persist between calls.  A command that does not begin where the last one ended, an
    invalid channel, a change of ``dump_chips`` and a code phase that leaves the integration under
    way by more than half its length drop them; smaller steps of the code phase neither repeat nor
    skip an integration.  The first integration begins at the first multiple of ``dump_chips``.

    Parameters
    ----------
    source : samples, see `IfSource`.
    chips : (n_channel, length) int8 of +-1, length >= 1023.
    offset_chips : (n_tap,) delay of each replica: negative is early, positive is late.
    workers : threads, each with its share of the channels; the bits do not depend on them.

    Raises
    ------
    ValueError : shapes that disagree; when called, a command outside the samples, a chip rate that
        is not positive or above the sampling rate, an integration below one chip.
    """

    def __init__(
        self, source: IfSource, chips: np.ndarray, offset_chips: np.ndarray, *, workers: int = 1
    ) -> None:
        self.offset_chips = np.ascontiguousarray(offset_chips, dtype=np.float64)
        if self.offset_chips.ndim != 1 or not np.all(np.isfinite(self.offset_chips)):
            raise ValueError(f"offset_chips is {offset_chips}: expected finite (n_tap,)")
        if np.ndim(chips) != 2 or chips.shape[1] < CELL - 1:
            raise ValueError(
                f"chips are {np.shape(chips)}: expected (n_channel, length), length >= {CELL - 1}"
            )
        self._source, self._length = source, int(chips.shape[1])
        self._table = replica_table(chips)
        n_channel, n_tap = len(chips), self.offset_chips.size
        self._position = np.zeros((n_channel, 5), np.int64)
        self._start = np.zeros((n_channel, 2))
        self._sums = np.zeros((n_channel, n_tap, 2))
        self._end_sample = -1
        self._shares = np.linspace(0, n_channel, workers + 1).astype(int).tolist()
        self._pool = ThreadPoolExecutor(workers) if workers > 1 else None

    def __call__(self, nco: Nco) -> Taps:
        """Correlate over all pieces of the command; return the integrations that ended."""
        fs = self._source.sample_rate_hz
        nco = Nco(*(np.ascontiguousarray(a, t) for a, t in zip(nco, _NCO_TYPES, strict=True)))
        self._check(nco)
        edge = first_sample_at(nco.t_s, fs).tolist()
        if edge[0] != self._end_sample:
            self._position[:, 0] = 0
        self._end_sample = edge[-1]
        room = _room(nco, fs)
        if room < 0:
            raise ValueError(_what_is_wrong(nco, fs))
        rows = self._rows(room)
        for p, (first, end) in enumerate(zip(edge[:-1], edge[1:], strict=True)):
            for a in range(first, end, _BLOCK):
                self._run(a, min(a + _BLOCK, end), p, nco, rows)
        return _taps(*rows, fs)

    def _rows(self, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Room for n integrations per channel: index, phases, iq, and their count."""
        n_channel, n_tap = len(self._table), self.offset_chips.size
        whole, count = np.empty((n_channel, n), np.int64), np.zeros(n_channel, np.int64)
        iq = np.empty((n_channel, n, n_tap), np.complex128)
        return whole, np.empty((n_channel, n, 6)), iq, count

    def _run(self, a: int, b: int, p: int, nco: Nco, rows: Any) -> None:
        """Correlate samples a ... b - 1 of piece p, all channels."""
        arguments: tuple[Any, ...] = (
            np.ascontiguousarray(self._source.samples(a, b)).reshape(-1),
            (a, p, self._source.sample_rate_hz, self._source.if_hz, self._source.sigma),
            nco,
            self._table,
            self._length,
            self.offset_chips,
            (self._position, self._start, self._sums),
            rows,
        )
        if self._pool is None:
            _correlate(0, len(self._table), *arguments)
            return
        parts = [
            self._pool.submit(_correlate, c0, c1, *arguments)
            for c0, c1 in zip(self._shares[:-1], self._shares[1:], strict=True)
        ]
        for part in parts:
            part.result()

    def _check(self, nco: Nco) -> None:
        n_channel = len(self._table)
        shape = (nco.t_s.size - 1, n_channel)
        if nco.dump_chips.shape != (n_channel,) or nco.valid.shape != (n_channel,):
            raise ValueError(f"nco.dump_chips and nco.valid: expected ({n_channel},) each")
        if nco.t_s.ndim != 1 or nco.t_s.size < 2 or not np.all(nco.t_s[1:] > nco.t_s[:-1]):
            raise ValueError(f"nco.t_s is {nco.t_s.tolist()}: expected two or more, rising")
        for name in Nco._fields[1:6]:
            if getattr(nco, name).shape != shape:
                raise ValueError(f"nco.{name} is {getattr(nco, name).shape}: expected {shape}")


def _what_is_wrong(nco: Nco, fs: float) -> str:
    """Say which number of a valid channel cannot be run."""
    for name in Nco._fields[1:6]:
        if not np.isfinite(getattr(nco, name)[:, nco.valid]).all():
            return f"nco.{name} of a valid channel is not finite"
    if np.any(nco.dump_chips[nco.valid] < 1):
        return f"nco.dump_chips is {nco.dump_chips}: expected at least one chip"
    rate = nco.chip_rate_hz[:, nco.valid]
    limits = f"> 0 and at most the sampling rate, {fs} Hz"
    return f"nco.chip_rate_hz is {rate.min()} to {rate.max()}: expected {limits}"


# ---- kernels ---------------------------------------------------------------------------------

_F = np.float32
_32 = np.uint64(32)
_PAD = 144  # keeps the rows of a buffer off a common address modulo 4096
# columns of a channel's position: is the index known, is a sum open, index, first sample, length
_KNOWN, _OPEN, _INDEX, _FIRST, _DUMP = 0, 1, 2, 3, 4


@kernel
def _room(nco: Nco, fs: float) -> int:
    """Integrations that can end in a channel; -1: a number of a valid channel cannot be run."""
    most = 0
    for channel in range(nco.valid.size):
        if nco.valid[channel]:
            chips = 0.0
            for p in range(nco.t_s.size - 1):
                rate = nco.chip_rate_hz[p, channel]
                sum_ = nco.code_phase_chips[p, channel] + nco.carrier_phase_cycles[p, channel]
                sum_ += nco.carrier_freq_hz[p, channel] + nco.carrier_rate_hz_per_s[p, channel]
                if not (math.isfinite(sum_) and 0.0 < rate <= fs):
                    return -1
                chips += rate * (nco.t_s[p + 1] - nco.t_s[p])
            if nco.dump_chips[channel] < 1:
                return -1
            most = max(most, int(chips / nco.dump_chips[channel]) + 3 * (nco.t_s.size - 1))
    return most


@kernel
def _deinterleave(block: np.ndarray, i: np.ndarray, q: np.ndarray) -> None:
    """I, Q, I, Q ... (2 n,) of any type to float32 (n,) each."""
    for j in range(block.shape[0] // 2):
        i[j] = _F(block[2 * j])
        q[j] = _F(block[2 * j + 1])


@kernel(fastmath=FAST_SUM)
def _wipe(
    i: np.ndarray,
    q: np.ndarray,
    n: int,
    coarse: np.ndarray,
    fine: np.ndarray,
    wi: np.ndarray,
    wq: np.ndarray,
) -> None:
    """n samples times the conjugate carrier into wi, wq; whole strides, the last overruns n."""
    fine_c, fine_s = fine[0], fine[1]
    for m in range((n + STRIDE - 1) // STRIDE):
        start = np.uint64(m * STRIDE)
        c, s = coarse[0, m], coarse[1, m]
        for k in range(np.uint64(fine_c.shape[0])):
            u = i[start + k] * c + q[start + k] * s
            v = q[start + k] * c - i[start + k] * s
            wi[start + k] = u * fine_c[k] + v * fine_s[k]
            wq[start + k] = v * fine_c[k] - u * fine_s[k]


@kernel(fastmath=FAST_SUM)
def _sum_tap(wi: np.ndarray, wq: np.ndarray, base: Any, step: Any, table: np.ndarray) -> Any:
    """Sum of wi, wq (n,) times the code."""
    si, sq = _F(0.0), _F(0.0)
    code = base  # a running sum, as LLVM has no fast 64-bit product
    for j in range(wi.shape[0]):
        chip = table[code >> _32]
        si += wi[j] * chip
        sq += wq[j] * chip
        code += step
    return si, sq


@kernel(inline="always")
def _code(line: Any, dt: float) -> float:
    """NCO code phase [chips]; ``line`` is the command of one channel in one piece."""
    return line[0] + line[1] * dt


@kernel(inline="always")
def _carrier(line: Any, dt: float) -> float:
    """NCO carrier phase [cycles]."""
    return line[2] + dt * (line[3] + 0.5 * line[4] * dt)


@kernel
def _begin(position: np.ndarray, x: float, dump: int, chips_per_sample: float) -> None:
    """Find the integration under way at code phase x; open it if x is its first sample."""
    tolerance = GUARD_SAMPLES * chips_per_sample
    index = math.floor((x + tolerance) / dump)
    position[_KNOWN] = 1
    position[_INDEX] = index
    position[_OPEN] = 1 if x - index * dump < chips_per_sample - tolerance else 0
    position[_DUMP] = dump


@kernel
def _align(position: np.ndarray, x: float, dump: int, chips_per_sample: float) -> bool:
    """At the first sample of a cell: True if a new integration opens here."""
    if position[_KNOWN] and position[_DUMP] == dump:
        middle = (position[_INDEX] + 0.5) * dump
        if abs(x - middle) <= dump:
            return False
    _begin(position, x, dump, chips_per_sample)
    return position[_OPEN] == 1


@kernel
def _finish(
    channel: int, n: int, x: float, carrier: float, sigma: float, state: Any, rows: Any
) -> None:
    """Write the open sums of a channel, which end before sample n, as its next row."""
    position, start, sums = state
    whole, real, iq, count = rows
    row = count[channel]
    scale = 1.0 / (sigma * math.sqrt(n - position[channel, _FIRST]))
    whole[channel, row] = position[channel, _INDEX]
    real[channel, row, 0] = position[channel, _FIRST]
    real[channel, row, 1] = n
    real[channel, row, 2] = start[channel, 0]
    real[channel, row, 3] = x
    real[channel, row, 4] = start[channel, 1]
    real[channel, row, 5] = carrier
    for k in range(sums.shape[1]):
        iq[channel, row, k] = complex(sums[channel, k, 0] * scale, sums[channel, k, 1] * scale)
    count[channel] = row + 1


@kernel
def _taps(
    whole: np.ndarray, real: np.ndarray, iq: np.ndarray, count: np.ndarray, fs: float
) -> Taps:
    """Rows of all channels, one after the other."""
    n = count.sum()
    channel, number = np.empty(n, np.int64), np.empty(n, np.int64)
    taps, r = np.empty((n, iq.shape[2]), np.complex128), np.empty((6, n))
    k = 0
    for c in range(count.size):
        for row in range(count[c]):
            channel[k], number[k] = c, whole[c, row]
            taps[k] = iq[c, row]
            r[:, k] = real[c, row]
            k += 1
    r[:2] /= fs
    return Taps(channel, number, r[0], r[1], taps, np.ones(n), r[2], r[3], r[4], r[5])


@kernel
def _open(channel: int, n: int, x: float, carrier: float, state: Any) -> None:
    """Empty the sums of a channel; sample n is their first."""
    position, start, sums = state
    position[channel, _OPEN] = 1
    position[channel, _FIRST] = n
    start[channel, 0] = x
    start[channel, 1] = carrier
    sums[channel] = 0.0


@kernel
def _correlate(
    c0: int,
    c1: int,
    block: np.ndarray,
    span: tuple[int, int, float, float, float],
    nco: Nco,
    table: np.ndarray,
    length: int,
    offset_chips: np.ndarray,
    state: Any,
    rows: Any,
) -> None:
    """Channels c0 ... c1 - 1 over a block of samples (2 n,) within piece p of the command."""
    a, p, fs, if_hz, sigma = span
    buffers = np.zeros((4, CELL + _PAD), np.float32)
    coarse, fine = np.empty((2, CELL // STRIDE), np.float32), np.empty((2, STRIDE), np.float32)
    i, q, wi, wq = buffers[0], buffers[1], buffers[2], buffers[3]
    b = a + block.shape[0] // 2
    for start in range(a, b, CELL):
        n = min(CELL, b - start)
        _deinterleave(block[2 * (start - a) : 2 * (start - a + n)], i, q)
        dt = start / fs - nco.t_s[p]
        for channel in range(c0, c1):
            if nco.valid[channel]:
                line = (
                    nco.code_phase_chips[p, channel],
                    nco.chip_rate_hz[p, channel],
                    nco.carrier_phase_cycles[p, channel],
                    nco.carrier_freq_hz[p, channel],
                    nco.carrier_rate_hz_per_s[p, channel],
                )
                base, step, bend = _phases(line, dt, n, fs, start * (if_hz / fs), if_hz / fs)
                carrier_phasors(base, step, bend, n, coarse, fine)
                _wipe(i, q, n, coarse, fine, wi, wq)
                _cell(channel, start, n, nco.t_s[p], fs, sigma, line, nco.dump_chips[channel],
                      wi, wq, table[channel], length, offset_chips, state, rows)  # fmt: skip
            else:
                state[0][channel, _KNOWN] = 0


@kernel
def _cell(
    channel: int,
    start: int,
    n: int,
    t0_s: float,
    fs: float,
    sigma: float,
    line: Any,
    dump: int,
    wi: np.ndarray,
    wq: np.ndarray,
    table: np.ndarray,
    length: int,
    offset_chips: np.ndarray,
    state: Any,
    rows: Any,
) -> None:
    """Sum the n wiped samples of a cell, in the piece that begins at t0_s; cut at ends of dumps."""
    position, _, sums = state
    dt = start / fs - t0_s
    x, slope = _code(line, dt), line[1] / fs
    if _align(position[channel], x, dump, slope):
        _open(channel, start, x, _carrier(line, dt), state)
    a = 0
    while a < n:
        # first sample at or past the end of the integration under way
        to_go = (position[channel, _INDEX] + 1) * dump - x
        bound = max(a, math.ceil(to_go / slope - GUARD_SAMPLES))
        b = min(bound, n)
        if position[channel, _OPEN] and b > a:
            for k in range(offset_chips.shape[0]):
                code, step = code_steps(x + slope * a - offset_chips[k], slope, length)
                si, sq = _sum_tap(wi[a:b], wq[a:b], code, step, table)
                sums[channel, k, 0] += si
                sums[channel, k, 1] += sq
        if bound >= n:
            break
        a = bound
        dt_a = (start + a) / fs - t0_s
        if position[channel, _OPEN]:
            _finish(channel, start + a, _code(line, dt_a), _carrier(line, dt_a), sigma, state, rows)
        position[channel, _INDEX] += 1
        _open(channel, start + a, _code(line, dt_a), _carrier(line, dt_a), state)


@kernel
def _phases(line: Any, dt: float, n: int, fs: float, if_start: float, if_ratio: float) -> Any:
    """`carrier_steps` of carrier and intermediate frequency over n samples from dt."""
    if_start -= math.floor(if_start)
    return carrier_steps(
        _carrier(line, dt) + if_start,
        _carrier(line, dt + 0.5 * n / fs) + if_start + 0.5 * n * if_ratio,
        _carrier(line, dt + n / fs) + if_start + n * if_ratio,
        n,
    )
