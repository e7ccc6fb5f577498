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

from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from typing import Literal

import numpy as np

from signals.nco import Nco, Taps
from signals.plan import Rows, State, Work, collect, plan, room
from signals.recording import IfSource
from signals.replica import Replicas, replicas

Method = Literal["exact", "integer", "binned"]

_ENGINES = {
    "exact": ("signals.exact", "Exact"),
    "integer": ("signals.correlator_integer", "Integer"),
}
_NCO_TYPES = (np.float64,) * 6 + (np.int64, np.bool_)
_BLOCK = 1 << 17  # samples taken from the source at a time
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
        if method not in _ENGINES:
            raise ValueError(f"method is {method!r}: expected one of {', '.join(_ENGINES)}")
        if not isinstance(chips, Replicas):
            if np.ndim(chips) != 2:
                raise ValueError(f"chips are {np.shape(chips)}: expected (n_channel, length)")
            chips = replicas(list(chips))
        n_channel, n_tap = chips.first.size, self.offset_chips.size
        self._source = source
        self._state = State(
            np.zeros((n_channel, 6), np.int64),
            np.zeros((n_channel, 2)),
            np.zeros((n_channel, n_tap, 2)),
        )
        self._work = Work(*(np.empty(0, np.int64),) * 4)
        self._end_sample = -1
        self._shares = np.linspace(0, n_channel, workers + 1).astype(int).tolist()
        module, name = _ENGINES[method]
        engine = getattr(import_module(module), name)  # where it is used: kernels take time to load
        self._engines = [engine(chips, self.offset_chips) for _ in range(workers)]
        self._span = self._engines[0].span
        self._block = max(_BLOCK // self._span, 1) * self._span
        self._pool = ThreadPoolExecutor(workers) if workers > 1 else None

    def __call__(self, nco: Nco) -> Taps:
        """Correlate over all pieces of the command; return the integrations that ended."""
        source, state = self._source, self._state
        fs = source.sample_rate_hz
        nco = Nco(*(np.ascontiguousarray(a, t) for a, t in zip(nco, _NCO_TYPES, strict=True)))
        self._check(nco)
        edge = np.empty(nco.t_s.size, np.int64)
        most = room(nco, fs, edge)
        if most < 0:
            raise ValueError(_what_is_wrong(nco, fs))
        first, end = int(edge[0]), int(edge[-1])
        if first != self._end_sample:
            state.position[:, 0] = 0
        self._end_sample = -1  # until all went well
        rows, sums = self._room(most, edge.size)
        while first < end:
            b = min(first - first % self._span + self._block, end)
            block = source.samples(first, b)
            work = self._work_for(b - first, most, edge.size)
            n_cell = plan(first, b, self._span, fs, source.if_hz, nco, edge, state, rows, work)
            self._fill(block, n_cell, work, sums)
            first = b
        self._end_sample = end
        return collect(rows, sums, state, fs, source.sigma)

    def _room(self, most: int, n_edge: int) -> tuple[Rows, np.ndarray]:
        """Room for what ends; sums for all that is begun, the first of which goes on."""
        n_channel, n_tap, _ = self._state.sums.shape
        rows = Rows(
            np.zeros(n_channel, np.int64),
            np.empty((n_channel, most, 4), np.int64),
            np.empty((n_channel, most, 4)),
        )
        sums = np.zeros((n_channel, most + n_edge + 1, n_tap, 2))
        sums[:, 0] = self._state.sums
        return rows, sums

    def _work_for(self, n_samples: int, most: int, n_edge: int) -> Work:
        """Room for the parts of a block, the last one's if it is enough."""
        n_channel, n_cell = len(self._state.sums), n_samples // self._span + 1 + n_edge
        n_part = n_cell + most
        if self._work.whole.shape[1:2] < (n_part,) or len(self._work.cells) < n_cell:
            self._work = Work(
                np.empty((n_cell, 3), np.int64),
                np.empty(n_channel, np.int64),
                np.empty((n_channel, n_part, 6), np.int64),
                np.empty((n_channel, n_part, 3)),
            )
        return self._work

    def _fill(self, block: np.ndarray, n_cell: int, work: Work, sums: np.ndarray) -> None:
        """Correlate a block of samples, all channels."""
        if block.dtype == np.int8:
            narrow, wide = np.ascontiguousarray(block).reshape(-1), _NO_FLOAT32
        else:
            narrow, wide = _NO_INT8, np.ascontiguousarray(block, np.float32).reshape(-1)
        if self._pool is None:
            self._engines[0](0, len(sums), narrow, wide, n_cell, work, sums)
            return
        parts = [
            self._pool.submit(engine, c0, c1, narrow, wide, n_cell, work, sums)
            for c0, c1, engine in zip(
                self._shares[:-1], self._shares[1:], self._engines, strict=True
            )
        ]
        for part in parts:
            part.result()

    def _check(self, nco: Nco) -> None:
        n_channel = len(self._state.sums)
        shape = (nco.t_s.size - 1, n_channel)
        if nco.dump_chips.shape != (n_channel,) or nco.valid.shape != (n_channel,):
            raise ValueError(f"nco.dump_chips and nco.valid: expected ({n_channel},) each")
        if nco.t_s.ndim != 1 or nco.t_s.size < 2:
            raise ValueError(f"nco.t_s is {nco.t_s.tolist()}: expected two or more, rising")
        for name in Nco._fields[1:6]:
            if getattr(nco, name).shape != shape:
                raise ValueError(f"nco.{name} is {getattr(nco, name).shape}: expected {shape}")


def _what_is_wrong(nco: Nco, fs: float) -> str:
    """Say which number of the command, of a valid channel, cannot be run."""
    if not np.all(nco.t_s[1:] > nco.t_s[:-1]):
        return f"nco.t_s is {nco.t_s.tolist()}: expected two or more, rising"
    for name in Nco._fields[1:6]:
        if not np.isfinite(getattr(nco, name)[:, nco.valid]).all():
            return f"nco.{name} of a valid channel is not finite"
    if np.any(nco.dump_chips[nco.valid] < 1):
        return f"nco.dump_chips is {nco.dump_chips}: expected at least one chip"
    rate = nco.chip_rate_hz[:, nco.valid]
    limits = f"> 0 and at most the sampling rate, {fs} Hz"
    return f"nco.chip_rate_hz is {rate.min()} to {rate.max()}: expected {limits}"
