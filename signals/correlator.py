"""Correlation at sample level: carrier wipe-off, delayed replicas, integrate and dump.

Over an integration of N samples the tap at offset d (chips) is

    X_d = 1 / (sigma sqrt(N)) sum_n z_n exp(-j 2 pi (f_IF n / fs + carrier(n / fs)))
                                    C(floor(code(n / fs) - d) mod length)                     (1)

with carrier and code as the `Nco` commands them.  An integration begins and ends at the first
sample whose NCO code phase is not below a multiple of ``dump_chips``; bounds are thus exact to
the sample at any ratio of sampling and chip rate (4 MHz is 4000 samples per 1023 chips).

The work is done in cells of samples that end at multiples of the engine's span and at the ends of
the pieces of the command: phases come anew in float64, sums inside a cell are float32, across
cells float64.
`signals.plan` says what is summed, an engine such as `signals.exact` fills the sums.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Literal

import numpy as np

from signals.compiled import seal
from signals.nco import Nco, Taps
from signals.plan import (
    LARGEST,
    NO_ROOM,
    NOWHERE,
    REFUSED,
    Planned,
    Rows,
    State,
    Work,
    collect,
    plan,
)
from signals.recording import IfSource
from signals.replica import Replicas, replicas
from signals.threads import Threads

Method = Literal["exact", "integer", "binned"]

_ENGINES = {
    "exact": ("signals.exact", "Exact"),
    "integer": ("signals.correlator_integer", "Integer"),
    "binned": ("signals.correlator_binned", "Binned"),
}
_NCO_TYPES = (np.float64,) * 6 + (np.int64, np.bool_)
_BLOCK = 1 << 17  # samples taken from the source at a time
_BLOCK_OF_THREADS = 1 << 19  # worth a thread's waking
_UNKNOWN: Planned = 0, 0, 0, REFUSED, 0
_INT8 = np.dtype(np.int8)
_NO_INT8, _NO_FLOAT32 = np.empty(0, np.int8), np.empty(0, np.float32)


class SampleCorrelator:
    """Taps of equation (1) from the samples of ``source``; a `Correlator`.

    Open sums persist between calls.  A command that does not begin where the last one ended, an
    invalid channel, a change of ``dump_chips`` and a code phase that leaves the integration under
    way by more than half its length drop them; smaller steps of the code phase neither repeat nor
    skip an integration.  The first integration begins at the first multiple of ``dump_chips``.

    Parameters
    ----------
    source : samples, see `IfSource`.
    chips : (n_channel, length) of +-1, or the `Replicas` of waveforms that change within a chip.
    offset_chips : (n_tap,) delay of each replica: negative is early, positive is late.
    method : how the sums are made, see below.
    workers : threads, each with its share of the channels; the bits do not depend on them.

    Notes
    -----
    ``exact``
        float32; |error| / |tap| of noise-like taps 2e-6.  Everything else is measured against it.
    ``integer``
        int8 samples only, in 16-bit arithmetic: no overflow whatever they are, no bias.  The error
        is noise of 0.6 % (45 dB below the tap's own), whatever the Doppler and the intermediate
        frequency.  Twice as fast with AVX-512 VNNI, else slower than ``exact``: for long runs
        where 2e-4 dB of C/N0 do not matter.
    ``binned``
        int8 samples only; the error is below 5e-4, by the carrier alone.  For high sampling
        rates: its work grows with chips and distinct delays (modulo a chip), not with samples
        and taps.  Takes 2 samples per bin and more, where the delays and half a chip cut a chip
        into bins, at most 30 in the widest; and a carrier, intermediate frequency included, that
        turns by 0.018 of a cycle in the widest bin (38 kHz for half a chip of C/A).  With half-chip
        delays faster than ``exact`` from some 10 MHz on.

    Raises
    ------
    ValueError : shapes that disagree; when called, a command outside the samples, a chip rate that
        is not positive or above the sampling rate, an integration below one chip, samples that the
        method does not take.
    """

    def __init__(
        self,
        source: IfSource,
        chips: np.ndarray | Replicas,
        offset_chips: np.ndarray,
        *,
        method: Method = "exact",
        workers: int = 1,
    ) -> None:
        self.offset_chips = np.ascontiguousarray(offset_chips, dtype=np.float64)
        if self.offset_chips.ndim != 1 or not np.all(np.isfinite(self.offset_chips)):
            raise ValueError(f"offset_chips is {offset_chips}: expected finite (n_tap,)")
        if workers < 1:
            raise ValueError(f"workers is {workers}: expected at least 1")
        if method not in _ENGINES:
            raise ValueError(f"method is {method!r}: expected one of {', '.join(_ENGINES)}")
        if not isinstance(chips, Replicas):
            if np.ndim(chips) != 2:
                raise ValueError(f"chips are {np.shape(chips)}: expected (n_channel, length)")
            chips = replicas(list(chips))
        n_channel, n_tap = chips.first.size, self.offset_chips.size
        self._source, self._n_channel = source, n_channel
        module, name = _ENGINES[method]
        engine = getattr(import_module(module), name)  # where it is used: kernels take time to load
        self._engines = [engine(chips, self.offset_chips) for _ in range(workers)]
        limits = np.linspace(0, n_channel, workers + 1).astype(int).tolist()
        self._shares = list(zip(self._engines, limits[:-1], limits[1:], strict=True))
        self._threads = Threads(workers)
        self._span = self._engines[0].span
        block = _BLOCK if workers == 1 else _BLOCK_OF_THREADS
        self._block = max(block // self._span, 1) * self._span
        self._end_sample = NOWHERE
        self._state = State(np.zeros((n_channel, 6), np.int64), np.zeros((n_channel, 2)))
        self._sums = np.zeros((n_channel, 1, n_tap, 2))
        self._most = 0, 0, 0
        self._grow(2, 0, self._span)
        self._is_sealed = False

    def __call__(self, nco: Nco) -> Taps:
        """Correlate over all pieces of the command; return the integrations that ended."""
        source = self._source
        setting = self._block, self._span, float(source.sample_rate_hz), float(source.if_hz)
        planned = _UNKNOWN
        try:
            if self._is_sealed:
                planned = plan(NOWHERE, self._end_sample, *setting, *nco, *self._memory)
        except TypeError:  # arrays that the kernel does not take as they are
            planned = _UNKNOWN
        if planned[3] < 0:
            nco = self._checked(nco)
            planned = self._begin(nco, setting)
        first, stop, end, n_cell, n_row = planned
        self._end_sample = NOWHERE  # until all went well
        while n_cell > 0:
            self._fill(source.samples(first, stop), n_cell)
            if stop == end:
                break
            first, stop, end, n_cell, n_row = plan(stop, NOWHERE, *setting, *nco, *self._memory)
        whole, real = np.empty((2, n_row), np.int64), np.empty((7, n_row))
        iq = np.empty((n_row, self.offset_chips.size), np.complex128)
        collect(setting[2], float(source.sigma), *self._ended, whole, real, iq)
        self._end_sample = end
        channel, number = whole
        t_start_s, t_end_s, variance, code, code_end, carrier, carrier_end = real
        return Taps(
            channel, number, t_start_s, t_end_s, iq, variance, code, code_end, carrier, carrier_end
        )

    def _begin(self, nco: Nco, setting: tuple[int, int, float, float]) -> Planned:
        """Plan the first block of a command of the right shapes, make room where there is none."""
        while True:
            planned = plan(NOWHERE, self._end_sample, *setting, *nco, *self._memory)
            first, stop, _, n_cell, n_row = planned
            if n_cell == REFUSED:
                raise ValueError(_what_is_wrong(nco, setting[2]))
            if n_cell != NO_ROOM:
                self._is_sealed = seal(plan)
                return planned
            self._grow(nco.t_s.size, n_row, min(stop - first, self._block))

    def _grow(self, n_edge: int, n_row: int, n_samples: int) -> None:
        """Room for a command and its blocks, never less than before; open sums are kept."""
        n_cell = n_samples // self._span + 1 + n_edge
        asked = n_edge, n_row, n_cell
        n_edge, n_row, n_cell = self._most = (*map(max, asked, self._most),)
        n, before = self._n_channel, self._sums
        rows = Rows(
            np.zeros(n, np.int64), np.empty((n, n_row, 4), np.int64), np.empty((n, n_row, 4))
        )
        self._sums = np.zeros((n, n_row + n_edge + 1, *before.shape[2:]))
        self._sums[:, 0] = before[:, 0]
        self._work = Work(
            np.empty((n_cell, 3), np.int64),
            np.empty(n, np.int64),
            np.empty((n, n_cell + n_row, 6), np.int64),
            np.empty((n, n_cell + n_row, 3)),
        )
        edge = np.empty(n_edge, np.int64)
        self._memory = edge, *self._state, *rows, *self._work, self._sums
        self._ended = self._state.position, *rows, self._sums

    def _fill(self, block: np.ndarray, n_cell: int) -> None:
        """Correlate a block of samples, all channels."""
        if block.dtype == _INT8:
            narrow, wide = np.asarray(block).ravel(), _NO_FLOAT32
        else:
            narrow, wide = _NO_INT8, np.ascontiguousarray(block, np.float32).ravel()
        work, sums = self._work, self._sums
        given = narrow, wide, n_cell, work, sums

        def share(engine: Callable[..., None], c0: int, c1: int) -> None:
            engine(c0, c1, *given)

        self._threads(share, self._shares)

    def _checked(self, nco: Nco) -> Nco:
        """A copy of the command with the kernel's types; ValueError: shapes that disagree."""
        nco = Nco(
            *(np.array(a, t, order="C", ndmin=1) for a, t in zip(nco, _NCO_TYPES, strict=True))
        )
        n_channel = self._n_channel
        shape = (nco.t_s.size - 1, n_channel)
        if nco.dump_chips.shape != (n_channel,) or nco.valid.shape != (n_channel,):
            raise ValueError(f"nco.dump_chips and nco.valid: expected ({n_channel},) each")
        if nco.t_s.ndim != 1 or nco.t_s.size < 2:
            raise ValueError(f"nco.t_s is {nco.t_s.tolist()}: expected two or more, rising")
        for name in Nco._fields[1:6]:
            if getattr(nco, name).shape != shape:
                raise ValueError(f"nco.{name} is {getattr(nco, name).shape}: expected {shape}")
        return nco


def _what_is_wrong(nco: Nco, fs: float) -> str:
    """Say which number of the command, of a valid channel, cannot be run."""
    if not np.all(nco.t_s[1:] > nco.t_s[:-1]):
        return f"nco.t_s is {nco.t_s.tolist()}: expected two or more, rising"
    for name in Nco._fields[1:6]:
        values = getattr(nco, name)[:, nco.valid]
        if not np.all(np.abs(values) < LARGEST):
            at = values[~(np.abs(values) < LARGEST)][0]
            return f"nco.{name} of a valid channel is {at}: expected below {LARGEST:g}"
    if np.any(nco.dump_chips[nco.valid] < 1):
        return f"nco.dump_chips is {nco.dump_chips}: expected at least one chip"
    rate = nco.chip_rate_hz[:, nco.valid]
    limits = f"> 0 and at most the sampling rate, {fs} Hz"
    return f"nco.chip_rate_hz is {rate.min()} to {rate.max()}: expected {limits}"
