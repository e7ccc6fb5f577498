"""Intermediate-frequency samples: the sum of all satellites and thermal noise, quantised.

With sample n taken at t = n / fs,

    z_n = sum_i sqrt(2 C_i / (N0 fs)) sigma D_i C_i(code_phase_i)
              exp(j 2 pi (f_IF t + carrier_phase_cycles_i)) + sigma (w_I + j w_Q)           (1)

with w of unit variance, so that the noise density is N0 over the complex band fs (Kaplan &
Hegarty, 3rd ed., ch. 8).  The band is unfiltered: chips have infinitely steep edges.

The work is done in cells of `CELL` samples that are fixed to the absolute sample number; in each
the phases come anew from the float64 cubics of the truth.  The carrier follows them to second
order inside the cell, the code to first (at 10 g the rest is below 1e-7 chips), data symbols
change at the very sample.  Hence the same bits for any block or number of threads.  A reader that
goes on where it was gets whole cells ahead: commands of 1 ms would compute every cell twice.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from signals.compiled import FAST_SUM, kernel
from signals.noise import CELL, complex_gaussian_cell, stream_key
from signals.propagation import SignalState
from signals.recording import Recording, SampleFormat, check_range
from signals.replica import STRIDE, carrier_phasors, carrier_steps, code_steps, replica_table

GUARD_SAMPLES = 1e-5
"""Instants this little after a sample still include it: float64 resolves 2e-6 samples at 1 h"""

_INT8_SIGMA = 24.0
_ROUNDING_VAR = 1.0 / 12.0
_CELLS_PER_BLOCK = 1024
_CELLS_AHEAD = 64


def first_sample_at(t_s: float | np.ndarray, sample_rate_hz: float) -> np.ndarray:
    """Number of the first sample that is not before ``t_s``, int64."""
    return np.ceil(np.asarray(t_s) * sample_rate_hz - GUARD_SAMPLES).astype(np.int64)


class SyntheticIf:
    """Samples of equation (1), computed when asked for; an `IfSource`.

    Parameters
    ----------
    state : truth at the antenna; samples exist from its first to its last instant.
    chips : (n_channel, length) int8 of +-1.
    sample_rate_hz : complex sampling rate, not below the chip rate.
    seed : of the run; the noise is its stream "thermal".
    if_hz : frequency at which the nominal carrier appears.
    sample_format : "int8" (rounded, clipped at +-127; sigma 24) or "float32" (sigma 1).
    noise : False leaves the satellites only, at the same scale.
    symbol_chips : length of a data symbol in chips.
    workers : threads; the bits do not depend on them.

    Raises
    ------
    ValueError : shapes that disagree, symbols that do not cover the truth, a sampling rate below
        the chip rate; from `samples`, a range outside the truth.
    """

    def __init__(
        self,
        state: SignalState,
        chips: np.ndarray,
        sample_rate_hz: float,
        seed: int,
        *,
        if_hz: float = 0.0,
        sample_format: SampleFormat = "int8",
        noise: bool = True,
        symbol_chips: int = 20_460,
        workers: int = 1,
    ) -> None:
        if sample_format not in ("int8", "float32"):
            raise ValueError(f'sample_format is {sample_format!r}: expected "int8" or "float32"')
        _check_state(state, chips, sample_rate_hz, symbol_chips)
        self.sample_rate_hz, self.if_hz = float(sample_rate_hz), float(if_hz)
        self.dtype = np.dtype(sample_format)
        self.sigma = _INT8_SIGMA if sample_format == "int8" else 1.0
        edge = first_sample_at(state.t_s, sample_rate_hz)
        self.first_sample, self.end_sample = int(edge[0]), int(edge[-1])
        self._workers = workers
        self._kept = -1, np.empty((0, 2), self.dtype)  # last computed: number of the first, samples
        # rounding adds its own variance: what is drawn leaves room for it, the sum has `sigma`
        rounding = _ROUNDING_VAR if sample_format == "int8" else 0.0
        cn0_hz = np.where(state.valid, 10.0 ** (np.asarray(state.cn0_dbhz) / 10.0), 0.0)
        self._arguments: tuple[Any, ...] = (
            stream_key(seed, "thermal"),
            math.sqrt(self.sigma**2 - rounding) if noise else 0.0,
            self.sample_rate_hz,
            self.if_hz / self.sample_rate_hz,
            edge,
            np.ascontiguousarray(state.t_s, np.float64),
            np.ascontiguousarray(state.code_phase_chips, np.float64),
            np.ascontiguousarray(state.carrier_phase_cycles, np.float64),
            np.sqrt(2.0 * cn0_hz / self.sample_rate_hz) * self.sigma,
            np.ascontiguousarray(state.symbols, np.int8),
            int(state.first_symbol),
            int(symbol_chips),
            replica_table(chips),
            int(chips.shape[1]),
        )

    def samples(self, n0: int, n1: int) -> np.ndarray:
        """Samples n0 <= n < n1 as (n1 - n0, 2) of the sample format: I, Q."""
        check_range(n0, n1, self.first_sample, self.end_sample, "the truth")
        first, kept = self._kept
        if not first <= n0 <= n1 <= first + len(kept):
            first, kept = self._kept = n0, self._more(n0, n1)
        return kept[n0 - first : n1 - first].copy()

    def _more(self, n0: int, n1: int) -> np.ndarray:
        """At least samples n0 ... n1 - 1, what is kept of them included."""
        first, kept = self._kept
        goes_on = first <= n0 <= first + len(kept)
        known = kept[n0 - first :] if goes_on else kept[:0]
        start = n0 + len(known)
        end = max(n1, start + _CELLS_AHEAD * CELL) if goes_on else n1
        more = np.empty((min(-(-end // CELL) * CELL, self.end_sample) - start, 2), self.dtype)
        self._generate(start, more)
        return np.concatenate([known, more])

    def _generate(self, n0: int, out: np.ndarray) -> None:
        if self._workers == 1:
            _generate(n0, out, *self._arguments)
            return
        limits = np.linspace(n0, n0 + len(out), self._workers + 1).astype(np.int64)
        limits[1:-1] -= limits[1:-1] % CELL  # no cell is computed twice
        limits = np.maximum(limits, n0)
        with ThreadPoolExecutor(self._workers) as pool:
            parts = [
                pool.submit(_generate, a, out[a - n0 : b - n0], *self._arguments)
                for a, b in itertools.pairwise(limits.tolist())
                if b > a
            ]
            for part in parts:
                part.result()

    def record(
        self,
        n_samples: int | None = None,
        path: str | Path | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Recording:
        """Compute ``n_samples`` (None: all) once, into memory or into a raw file at ``path``.

        ``progress`` is called with the number of samples done and to be done.
        """
        n = self.end_sample - self.first_sample if n_samples is None else n_samples
        check_range(
            self.first_sample,
            self.first_sample + n,
            self.first_sample,
            self.end_sample,
            "the truth",
        )
        out: np.ndarray
        if path is None:
            out = np.empty((n, 2), self.dtype)
        else:
            out = np.memmap(path, self.dtype, "w+", shape=(n, 2))
        step = _CELLS_PER_BLOCK * CELL
        for start in range(0, n, step):
            block = out[start : start + step]
            self._generate(self.first_sample + start, block)
            if progress is not None:
                progress(start + len(block), n)
        if isinstance(out, np.memmap):
            out.flush()
        return Recording(
            out if path is None else path,
            self.sample_rate_hz,
            self.if_hz,
            self.sigma,
            sample_format="int8" if self.dtype == np.int8 else "float32",
            first_sample=self.first_sample,
        )


def _check_state(
    state: SignalState, chips: np.ndarray, sample_rate_hz: float, symbol_chips: int
) -> None:
    n_channel, n_piece = state.valid.shape
    if chips.ndim != 2 or chips.shape[0] != n_channel or chips.shape[1] < CELL - 1:
        raise ValueError(
            f"chips are {chips.shape}: expected ({n_channel}, length), length >= {CELL - 1}"
        )
    if len(state.t_s) != n_piece + 1 or state.t_s[0] < 0.0:
        raise ValueError(f"t_s is {state.t_s}: expected {n_piece + 1} instants >= 0")
    if not state.valid.any():
        return
    rate_hz = state.code_phase_chips[..., 1][state.valid].max()
    if not sample_rate_hz >= rate_hz:
        raise ValueError(f"sample_rate_hz is {sample_rate_hz}: expected >= chip rate {rate_hz:.0f}")
    dt = np.diff(state.t_s)
    c0, c1, c2, c3 = np.moveaxis(state.code_phase_chips, -1, 0)
    ends = c0 + dt * (c1 + dt * (c2 + dt * c3))
    need = math.floor(c0[state.valid].min() / symbol_chips)
    need_end = math.floor(ends[state.valid].max() / symbol_chips) + 1
    have, have_end = state.first_symbol, state.first_symbol + state.symbols.shape[1]
    if need < have or need_end > have_end:
        raise ValueError(
            f"symbols {have} to {have_end} do not cover the truth: expected {need} to {need_end}"
        )


# ---- kernels ---------------------------------------------------------------------------------

_F = np.float32
_32 = np.uint64(32)


@kernel
def _cubic(c: np.ndarray, dt: float) -> float:
    return c[0] + dt * (c[1] + dt * (c[2] + dt * c[3]))


@kernel
def _fill_chips(chip: np.ndarray, code_base: Any, code_step: Any, table: np.ndarray) -> None:
    """Chips under n samples into ``chip`` (n,).  Alone, as LLVM keeps a lookup loop scalar."""
    for j in range(chip.shape[0]):
        chip[j] = table[(code_base + np.uint64(j) * code_step) >> _32]


@kernel(fastmath=FAST_SUM)
def _add_carrier(
    i: np.ndarray, q: np.ndarray, chip: np.ndarray, size: Any, coarse: np.ndarray, fine: np.ndarray
) -> None:
    """Add size x chip x carrier to float32 i, q (n,); see `carrier_phasors`."""
    n = np.uint64(i.shape[0])
    fine_c, fine_s = fine[0], fine[1]
    for m in range((i.shape[0] + STRIDE - 1) // STRIDE):
        start = np.uint64(m * STRIDE)
        c, s = size * coarse[0, m], size * coarse[1, m]
        for k in range(min(np.uint64(STRIDE), n - start)):
            i[start + k] += chip[start + k] * (c * fine_c[k] - s * fine_s[k])
            q[start + k] += chip[start + k] * (s * fine_c[k] + c * fine_s[k])


@kernel
def _add_piece(
    i: np.ndarray,
    q: np.ndarray,
    chip: np.ndarray,
    coarse: np.ndarray,
    fine: np.ndarray,
    n: int,
    t0_s: float,
    sample_rate_hz: float,
    if_ratio: float,
    code: np.ndarray,
    carrier: np.ndarray,
    amplitude: float,
    symbols: np.ndarray,
    first_symbol: int,
    symbol_chips: int,
    table: np.ndarray,
    length: int,
) -> None:
    """Add samples n ... n + len(i) - 1 of one satellite, all of one piece of its truth."""
    count = i.shape[0]
    x0 = _cubic(code, n / sample_rate_hz - t0_s)
    slope = (_cubic(code, (n + count) / sample_rate_hz - t0_s) - x0) / count
    a = 0
    while a < count:
        x_a = x0 + slope * a
        symbol = math.floor(x_a / symbol_chips)
        b = min(count, max(a + 1, math.ceil(((symbol + 1) * symbol_chips - x0) / slope)))
        dt_a, dt_b = (n + a) / sample_rate_hz - t0_s, (n + b) / sample_rate_hz - t0_s
        if_a = (n + a) * if_ratio
        if_a -= math.floor(if_a)
        if_step = (b - a) * if_ratio
        base, step, bend = carrier_steps(
            _cubic(carrier, dt_a) + if_a,
            _cubic(carrier, 0.5 * (dt_a + dt_b)) + if_a + 0.5 * if_step,
            _cubic(carrier, dt_b) + if_a + if_step,
            b - a,
        )
        code_base, code_step = code_steps(x_a, slope, length)
        # the first sample may lie a rounding error before the first symbol
        data = symbols[min(max(symbol - first_symbol, 0), symbols.shape[0] - 1)]
        chips = chip[: b - a]
        _fill_chips(chips, code_base, code_step, table)
        carrier_phasors(base, step, bend, b - a, coarse, fine)
        _add_carrier(i[a:b], q[a:b], chips, _F(amplitude * data), coarse, fine)
        a = b


@kernel
def _store(i: np.ndarray, q: np.ndarray, out: np.ndarray) -> None:
    """Planar float32 (n,) to interleaved float32 or int8 (2 n,)."""
    for j in range(i.shape[0]):
        if out.itemsize == 1:
            out[2 * j] = np.int8(min(max(np.rint(i[j]), _F(-127.0)), _F(127.0)))
            out[2 * j + 1] = np.int8(min(max(np.rint(q[j]), _F(-127.0)), _F(127.0)))
        else:
            out[2 * j] = i[j]
            out[2 * j + 1] = q[j]


@kernel
def _generate(
    n0: int,
    out: np.ndarray,
    key: np.ndarray,
    noise: float,
    sample_rate_hz: float,
    if_ratio: float,
    edge: np.ndarray,
    t_s: np.ndarray,
    code: np.ndarray,
    carrier: np.ndarray,
    amplitude: np.ndarray,
    symbols: np.ndarray,
    first_symbol: int,
    symbol_chips: int,
    table: np.ndarray,
    length: int,
) -> None:
    """Samples n0 ... n0 + n - 1 into ``out`` (n, 2), by whole cells."""
    n1 = n0 + out.shape[0]
    i, q, chip = np.empty(CELL, _F), np.empty(CELL, _F), np.empty(CELL, _F)
    coarse, fine = np.empty((2, CELL // STRIDE), _F), np.empty((2, STRIDE), _F)
    flat = out.reshape(-1)
    piece = 0
    for cell in range(n0 // CELL, (n1 + CELL - 1) // CELL):
        start = cell * CELL
        i[:] = _F(0.0)
        q[:] = _F(0.0)
        if noise > 0.0:
            complex_gaussian_cell(key, cell, i, q)
            i *= _F(noise)
            q *= _F(noise)
        while piece < t_s.shape[0] - 2 and edge[piece + 1] <= start:
            piece += 1
        p = piece
        while p < t_s.shape[0] - 1 and edge[p] < start + CELL:
            a, b = max(edge[p], start) - start, min(edge[p + 1], start + CELL) - start
            for channel in range(table.shape[0]):
                if b > a and amplitude[channel, p] > 0.0:
                    _add_piece(
                        i[a:b],
                        q[a:b],
                        chip,
                        coarse,
                        fine,
                        start + a,
                        t_s[p],
                        sample_rate_hz,
                        if_ratio,
                        code[channel, p],
                        carrier[channel, p],
                        amplitude[channel, p],
                        symbols[channel],
                        first_symbol,
                        symbol_chips,
                        table[channel],
                        length,
                    )
            p += 1
        a, b = max(n0, start), min(n1, start + CELL)
        _store(
            i[a - start : b - start], q[a - start : b - start], flat[2 * (a - n0) : 2 * (b - n0)]
        )
