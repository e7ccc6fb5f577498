"""Intermediate-frequency samples: the sum of all satellites and thermal noise, quantised.

With sample n taken at t = n / fs,

    z_n = sum_i sqrt(2 C_i / (N0 fs)) sigma D_i C_i(code_phase_i)
              exp(j 2 pi (f_IF t + carrier_phase_cycles_i)) + sigma (w_I + j w_Q)           (1)

with w of unit variance, so that the noise density is N0 over the complex band fs (Kaplan &
Hegarty, 3rd ed., ch. 8).  A real sampler takes

    x_n = sum_i 2 sqrt(C_i / (N0 fs)) sigma D_i C_i(code_phase_i)
              cos(2 pi (f_IF t + carrier_phase_cycles_i)) + sigma w                         (2)

as its noise fills fs / 2: sigma^2 = N0 fs / 2, C = amplitude^2 / 2.  The band is unfiltered: chips
have infinitely steep edges.

The work is done by `if_blocks` in blocks that are fixed to the absolute sample number: the same
bits for any block or number of threads.  A reader that goes on where it was gets blocks ahead:
commands of 1 ms would compute every block several times.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from signals.cpu import path as cpu_path
from signals.if_blocks import BLOCK, Truth, generate, layout
from signals.if_loops import Layout, Quantiser
from signals.noise import stream_key
from signals.propagation import SignalState
from signals.recording import Recording, check_range
from signals.replica import Replicas, replicas
from signals.threads import Threads
from signals.vectors import body

GUARD_SAMPLES = 1e-5
"""Instants this little after a sample still include it: float64 resolves 2e-6 samples at 1 h"""

IfFormat = Literal["int8", "int16", "float32", "bits1", "bits2", "bits4"]

_AHEAD = 16  # blocks made ahead per thread for a reader that goes on
_ROUNDING_VAR = 1.0 / 12.0
_STEPS = {"bits1": 1.0, "bits2": 0.9957, "bits4": 0.3352}
"""In sigma, between the thresholds of the levels +-1, +-3 ...: Max, IRE Trans. IT-6 (1960); the one
of a single bit is at 0, whatever the step"""


class _Scale(NamedTuple):
    """What a sample format can hold."""

    dtype: str
    sigma: float  # as long as none is asked for
    most: float  # highest level, least is -most
    least_sigma: float
    most_sigma: float


_SCALES = {
    "int8": _Scale("int8", 24.0, 127.0, 1.0, 40.0),
    "int16": _Scale("int16", 1000.0, 32767.0, 1.0, 8000.0),
    "float32": _Scale("float32", 1.0, math.inf, 0.0, math.inf),
    **{name: _Scale("int8", 0.0, 0.0, 0.0, 0.0) for name in _STEPS},
}


def first_sample_at(t_s: float | np.ndarray, sample_rate_hz: float) -> np.ndarray:
    """Number of the first sample that is not before ``t_s``, int64."""
    return np.ceil(np.asarray(t_s) * sample_rate_hz - GUARD_SAMPLES).astype(np.int64)


class SyntheticIf:
    """Samples of equation (1) or (2), computed when asked for; where complex an `IfSource`.

    Parameters
    ----------
    state : truth at the antenna; samples exist from its first to its last instant.
    chips : (n_channel, length) of +-1, or `Replicas`: any periods, values and sub-chips.
    sample_rate_hz : complex (or real) sampling rate, not below the sub-chip rate.
    seed : of the run; the noise is its stream "thermal".
    if_hz : frequency at which the nominal carrier appears; above 0 and below fs / 2 if real.
    sample_format : "int8", "int16" (rounded), "float32", or the odd numbers between -2^b and 2^b as
        int8, "bits1", "bits2" (thresholds at 0 and 0.9957 rms), "bits4" (every 0.3352 rms).
    noise : False leaves the satellites only, at the same scale.
    symbol_chips : length of a data symbol in chips, of all channels or of each.
    workers : threads; the bits do not depend on them.
    real : a real sampler: samples are (n,).
    sigma : rms of the noise of I, Q or x in units of the samples, rounding included; None: 24 of
        int8, 1000 of int16, 1 of float32.  int8 takes 1 to 40 and clips at +-127 (24: 5.3 sigma,
        32: 4.0, 40: 3.2), int16 takes 1 to 8000 and clips at +-32767.

    ``sigma`` of the source is that of `IfSource`: what it was given, of few bits the rms of the
    samples without satellites (1, 1.8855, 5.932), and that over sqrt(2) if real.

    Raises
    ------
    ValueError : shapes that disagree, symbols that do not cover the truth, a sampling rate below
        the sub-chip rate, a frequency or sigma out of range; from `samples`, a range outside the
        truth.
    """

    def __init__(
        self,
        state: SignalState,
        chips: np.ndarray | Replicas,
        sample_rate_hz: float,
        seed: int,
        *,
        if_hz: float = 0.0,
        sample_format: IfFormat = "int8",
        noise: bool = True,
        symbol_chips: int | np.ndarray = 20_460,
        workers: int = 1,
        real: bool = False,
        sigma: float | None = None,
    ) -> None:
        self.sample_rate_hz, self.if_hz = float(sample_rate_hz), float(if_hz)
        self.sample_format, self.real = sample_format, real
        _check_sampler(self.sample_rate_hz, self.if_hz, sample_format, real, sigma, workers)
        table = _replicas(chips, len(state.valid))
        length = np.broadcast_to(np.asarray(symbol_chips, np.int64), (len(state.valid),))
        _check_state(state, table, self.sample_rate_hz, length)
        self.dtype = np.dtype(_SCALES[sample_format].dtype)
        rms, unit, levels = _levels(sample_format, sigma, noise)
        self.sigma = rms / math.sqrt(2.0) if real else rms
        edge = first_sample_at(state.t_s, self.sample_rate_hz)
        self.first_sample, self.end_sample = int(edge[0]), int(edge[-1])
        cn0_hz = np.where(state.valid, 10.0 ** (np.asarray(state.cn0_dbhz) / 10.0), 0.0)
        truth = Truth(
            edge,
            np.ascontiguousarray(state.t_s, np.float64),
            np.ascontiguousarray(state.code_phase_chips, np.float64),
            np.ascontiguousarray(state.carrier_phase_cycles, np.float64),
            np.sqrt((4.0 if real else 2.0) / self.sample_rate_hz * cn0_hz) * unit,
            np.ascontiguousarray(state.symbols, np.int8),
            np.full(len(length), state.first_symbol, np.int64),
            np.ascontiguousarray(length),
            self.sample_rate_hz,
            self.if_hz / self.sample_rate_hz,
        )
        key = stream_key(seed, "thermal")
        self._arguments = (int(key[0]), int(key[1])), levels, truth, table
        self._body = body(cpu_path())
        self._rooms = [layout(len(length), self._body) for _ in range(workers)]
        self._threads = Threads(workers)
        self._ahead = _AHEAD * workers
        self._kept = -1, np.empty(self._shape(0), self.dtype)  # number of the first, samples

    def _shape(self, n: int) -> tuple[int, ...]:
        return (n,) if self.real else (n, 2)

    def samples(self, n0: int, n1: int) -> np.ndarray:
        """Samples n0 <= n < n1 of the sample format: (n1 - n0, 2) as I, Q, or (n1 - n0,) if real.

        The array is the caller's own.
        """
        check_range(n0, n1, self.first_sample, self.end_sample, "the truth")
        out = np.empty(self._shape(n1 - n0), self.dtype)
        self._read(n0, out)
        return out

    def stream(self, size: int = 1 << 18) -> Iterator[np.ndarray]:
        """All samples in order, in arrays of ``size``; the last may be shorter."""
        for n in range(self.first_sample, self.end_sample, size):
            yield self.samples(n, min(n + size, self.end_sample))

    def _read(self, n0: int, out: np.ndarray) -> None:
        """Samples from n0 on: what is kept, whole blocks straight away, the rest by way of it."""
        n, end = n0, n0 + len(out)
        while n < end:
            first, kept = self._kept
            known = min(end, first + len(kept)) if first <= n else n
            whole = (end - n) // BLOCK * BLOCK
            if known > n:
                out[n - n0 : known - n0] = kept[n - first : known - first]
                n = known
            elif n % BLOCK == 0 and whole >= self._ahead * BLOCK:
                self._generate(n, out[n - n0 : n - n0 + whole])
                n += whole
            else:
                self._keep(n, end)

    def _keep(self, n: int, end: int) -> None:
        """Keep blocks from that of sample n on, ahead of ``end`` if n goes on from what was."""
        first, kept = self._kept
        goes_on = n == first + len(kept)
        start = n - n % BLOCK
        wanted = self.end_sample if goes_on else end
        blocks = min(-(-(wanted - start) // BLOCK), self._ahead)
        if len(kept) != blocks * BLOCK:
            kept = np.empty(self._shape(blocks * BLOCK), self.dtype)
        self._kept = -1, kept[:0]  # not half new, if this is interrupted
        self._generate(start, kept)
        self._kept = start, kept

    def _generate(self, n0: int, out: np.ndarray) -> None:
        """Whole blocks from sample n0 on, shared among the threads."""
        first, blocks = n0 // BLOCK, len(out) // BLOCK
        key, levels, truth, table = self._arguments
        limits = np.linspace(0, blocks, len(self._rooms) + 1).astype(int).tolist()

        def share(a: int, b: int, room: Layout) -> None:
            part = out[a * BLOCK : b * BLOCK]
            generate(self._body, first + a, part, key, levels, truth, table, room)

        self._threads(share, list(zip(limits[:-1], limits[1:], self._rooms, strict=True)))

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
            out = np.empty(self._shape(n), self.dtype)
        else:
            out = np.memmap(path, self.dtype, "w+", shape=self._shape(n))
        step = 16 * _AHEAD * BLOCK
        for start in range(0, n, step):
            block = out[start : start + step]
            self._read(self.first_sample + start, block)
            if progress is not None:
                progress(start + len(block), n)
        if isinstance(out, np.memmap):
            out.flush()
        kind = {"int8": "i8", "int16": "i16", "float32": "f32"}[self.dtype.name]
        return Recording(
            out if path is None else path,
            self.sample_rate_hz,
            self.if_hz,
            self.sigma,
            sample_format=("r" if self.real else "c") + kind,
            first_sample=self.first_sample,
        )


def _levels(sample_format: str, sigma: float | None, noise: bool) -> tuple[float, float, Quantiser]:
    """Rms of the samples, rms before rounding in steps between levels, and the levels."""
    scale = _SCALES[sample_format]
    if sample_format in _STEPS:
        step, n = _STEPS[sample_format], 1 << (int(sample_format[4:]) - 1)
        # E q^2 by parts: (2 k + 1)^2 - (2 k - 1)^2 = 8 k more beyond each threshold k
        rms = math.sqrt(
            1.0 + sum(8 * k * math.erfc(k * step / math.sqrt(2.0)) for k in range(1, n))
        )
        drawn = unit = 1.0 / step
        bounds = -float(n), n - 1.0, 0.5, 1.0
    else:
        rms = unit = scale.sigma if sigma is None else float(sigma)
        # rounding adds its own variance: what is drawn leaves room for it
        drawn = math.sqrt(rms**2 - (0.0 if sample_format == "float32" else _ROUNDING_VAR))
        bounds = -scale.most, scale.most, 0.0, 0.0
    return rms, unit, Quantiser(*(np.float32(v) for v in (drawn if noise else 0.0, *bounds)))


def _replicas(chips: np.ndarray | Replicas, n_channel: int) -> Replicas:
    if isinstance(chips, Replicas):
        if len(chips.first) != n_channel:
            raise ValueError(f"chips has {len(chips.first)} rows: expected {n_channel}")
        return chips
    if np.ndim(chips) != 2 or len(chips) != n_channel:
        raise ValueError(f"chips are {np.shape(chips)}: expected ({n_channel}, length)")
    return replicas(list(chips))


def _check_sampler(
    rate_hz: float, if_hz: float, sample_format: str, real: bool, sigma: float | None, workers: int
) -> None:
    if sample_format not in _SCALES:
        names = ", ".join(f'"{name}"' for name in _SCALES)
        raise ValueError(f"sample_format is {sample_format!r}: expected one of {names}")
    if not (math.isfinite(rate_hz) and rate_hz > 0.0):
        raise ValueError(f"sample_rate_hz is {rate_hz}: expected a positive rate")
    if real and not 0.0 < if_hz < rate_hz / 2.0:
        raise ValueError(f"if_hz is {if_hz}: expected above 0 and below {rate_hz / 2.0:g}, as real")
    if not abs(if_hz) <= rate_hz / 2.0:
        raise ValueError(f"if_hz is {if_hz}: expected at most half of {rate_hz:g} Hz")
    scale = _SCALES[sample_format]
    if sigma is not None and sample_format in _STEPS:
        raise ValueError(
            f'sigma is {sigma}: expected none, the thresholds of "{sample_format}" follow it'
        )
    if sigma is not None and not (
        math.isfinite(sigma) and sigma > 0.0 and scale.least_sigma <= sigma <= scale.most_sigma
    ):
        raise ValueError(
            f"sigma is {sigma}: expected {scale.least_sigma:g} to {scale.most_sigma:g} "
            f"of {sample_format}"
        )
    if workers < 1:
        raise ValueError(f"workers is {workers}: expected >= 1")


def _check_state(
    state: SignalState, table: Replicas, sample_rate_hz: float, symbol_chips: np.ndarray
) -> None:
    _, n_piece = state.valid.shape
    if len(state.t_s) != n_piece + 1 or state.t_s[0] < 0.0:
        raise ValueError(f"t_s is {state.t_s}: expected {n_piece + 1} instants >= 0")
    if not np.all(np.diff(state.t_s) > 0.0):
        raise ValueError("t_s: expected instants that rise")
    for name in ("code_phase_chips", "carrier_phase_cycles", "cn0_dbhz"):
        if not np.isfinite(getattr(state, name)[state.valid]).all():
            raise ValueError(f"{name} of a valid channel is not finite")
    if symbol_chips.size and not symbol_chips.min() >= 1:
        raise ValueError(f"symbol_chips is {symbol_chips.min()}: expected >= 1")
    dt = np.diff(state.t_s)
    have, have_end = state.first_symbol, state.first_symbol + state.symbols.shape[1]
    for i in np.flatnonzero(state.valid.any(axis=1)):
        on = state.valid[i]
        c0, c1, c2, c3 = state.code_phase_chips[i, on].T
        end = c0 + dt[on] * (c1 + dt[on] * (c2 + dt[on] * c3))
        rate_hz = max(c1.max(), (c1 + dt[on] * (2.0 * c2 + dt[on] * 3.0 * c3)).max())
        if not sample_rate_hz >= rate_hz * table.per_chip[i]:
            what, n = ("chip", 1) if table.per_chip[i] == 1 else ("sub-chip", table.per_chip[i])
            raise ValueError(
                f"sample_rate_hz is {sample_rate_hz}: expected >= {what} rate {n * rate_hz:.0f}"
            )
        need = math.floor(c0.min() / symbol_chips[i])
        need_end = math.floor(end.max() / symbol_chips[i]) + 1
        if need < have or need_end > have_end:
            raise ValueError(
                f"symbols {have} to {have_end} do not cover the truth: expected {need} to "
                f"{need_end}"
            )
