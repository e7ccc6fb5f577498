"""The exact engine: float32 arithmetic, carrier and code of every sample at their own phase."""

from __future__ import annotations

from typing import Any

import numpy as np

from signals import cpu
from signals import lanes_correlator as vectors
from signals.compiled import borrowing
from signals.lanes import reach
from signals.lanes_correlator import SPAN, TURNS, add_plain, planar_plain, wipe_plain
from signals.plan import (
    BASE,
    BEND,
    CELL,
    CHIPS,
    CHIPS_PER_SAMPLE,
    END,
    FIRST,
    SAMPLES,
    SLOT,
    START,
    STEP,
    Work,
)  # fmt: skip
from signals.replica import Replicas, behind, index_delays, index_phase, index_step

_PAD = 32  # overrun of a vector; rows 128 bytes apart modulo a page: a load never waits for a store


class Exact:
    """Fills sums from samples; an instance belongs to one thread.

    Parameters
    ----------
    waveforms : of all channels.
    offset_chips : (n_tap,) delay of each replica.
    """

    span = SPAN

    def __init__(self, waveforms: Replicas, offset_chips: np.ndarray) -> None:
        # a cell's wiped I and Q, its I and Q; no vector lies across two cache lines
        size = 4 * (SPAN + _PAD)
        memory = np.zeros(size + 16, np.float32)
        start = -(memory.ctypes.data // memory.itemsize) % 16
        planes = memory[start : start + size].reshape(4, -1)
        turns = np.zeros(TURNS, np.float32)
        done = np.zeros(waveforms.first.size, np.int64)
        self._mine = planes, turns, done, *waveforms, index_delays(waveforms, offset_chips)

    def __call__(
        self, c0: int, c1: int, narrow: np.ndarray, wide: np.ndarray, n_cell: int, work: Work,
        sums: np.ndarray,
    ) -> None:  # fmt: skip
        """Add the parts of channels c0 ... c1 - 1 to ``sums`` (n_channel, n_slot, n_tap, 2).

        The samples are interleaved I, Q: int8 in ``narrow`` or, where that is empty, float32 in
        ``wide``.
        """
        _accumulate(c0, c1, narrow, wide, n_cell, *work, sums, *self._mine)


# ---- kernels ---------------------------------------------------------------------------------

_LANES = cpu.LANES.get(cpu.path(), 0)
# largest step of a table index [2^-32 entries] at which a vector can look up
_ALONE = np.int64(reach(_LANES, _LANES) * 2**32) if _LANES else 0


@borrowing
def _load_plain(narrow: Any, wide: Any, first: int, n: int, i: Any, q: Any) -> None:
    """Samples of a block as float32: interleaved int8 or, where there are none, float32."""
    if narrow.size:
        planar_plain(narrow[2 * first :], n, i, q)
    else:
        planar_plain(wide[2 * first :], n, i, q)


@borrowing
def _add_plain(
    x: Any, y: Any, a: int, b: int, table: Any, phase: Any, step: Any, delays: Any, period: Any,
    sums: Any, turns: Any,
) -> None:  # fmt: skip
    """All taps of a part, one by one: ``table`` of the channel, ``sums`` of its slot."""
    for k in range(delays.shape[0]):
        si, sq = add_plain(x, y, a, b, table, behind(phase, delays[k], period), step, turns)
        sums[k, 0] += si
        sums[k, 1] += sq


if _LANES:
    _planar = {16: vectors.planar_16, 8: vectors.planar_8}[_LANES]
    _wipe = {16: vectors.wipe_16, 8: vectors.wipe_8}[_LANES]
    _add_taps = {16: vectors.add_16, 8: vectors.add_8}[_LANES]

    @borrowing
    def _load(narrow: Any, wide: Any, first: int, n: int, i: Any, q: Any) -> None:
        """Samples of a block as float32: whole vectors, then the rest."""
        whole = n // _LANES * _LANES
        if narrow.size:
            _planar(narrow, first, whole, i, q)
        else:
            _planar(wide, first, whole, i, q)
        if n > whole:
            _load_plain(narrow, wide, first + whole, n - whole, i[whole:], q[whole:])

    @borrowing
    def _add(
        x: Any, y: Any, a: int, b: int, table: Any, origin: int, phase: Any, step: Any,
        delays: Any, channel: int, period: Any, sums: Any, slot: int, turns: Any,
    ) -> None:  # fmt: skip
        """All taps of a part, by threes as far as they go; no array is sliced (references)."""
        k, taps = 0, delays.shape[1]
        if step > _ALONE:
            _add_plain(
                x,
                y,
                a,
                b,
                table[origin:],
                phase,
                step,
                delays[channel],
                period,
                sums[channel, slot],
                turns,
            )
            return
        while k < taps:
            p = behind(phase, delays[channel, k], period)
            if taps - k == 1:
                one = _add_taps(x, y, a, b, table, origin, (p,), step, turns)
                sums[channel, slot, k, 0] += one[0]
                sums[channel, slot, k, 1] += one[1]
                return
            q = behind(phase, delays[channel, k + 1], period)
            if taps - k == 2 or taps - k == 4:
                two = _add_taps(x, y, a, b, table, origin, (p, q), step, turns)
                for m in range(4):
                    sums[channel, slot, k + m // 2, m % 2] += two[m]
                k += 2
            else:
                r = behind(phase, delays[channel, k + 2], period)
                three = _add_taps(x, y, a, b, table, origin, (p, q, r), step, turns)
                for m in range(6):
                    sums[channel, slot, k + m // 2, m % 2] += three[m]
                k += 3
else:
    _load, _wipe = _load_plain, wipe_plain

    @borrowing
    def _add(
        x: Any, y: Any, a: int, b: int, table: Any, origin: int, phase: Any, step: Any,
        delays: Any, channel: int, period: Any, sums: Any, slot: int, turns: Any,
    ) -> None:  # fmt: skip
        _add_plain(
            x,
            y,
            a,
            b,
            table[origin:],
            phase,
            step,
            delays[channel],
            period,
            sums[channel, slot],
            turns,
        )


@borrowing
def _accumulate(
    c0: int, c1: int, narrow: Any, wide: Any, n_cell: int, cells: Any, count: Any, whole: Any,
    real: Any, sums: Any, planes: Any, turns: Any, done: Any, table: Any, origin: Any,
    length: Any, per_chip: Any, delays: Any,
) -> None:  # fmt: skip
    """Parts of channels c0 ... c1 - 1, cell by cell; `Work` and `Replicas` field by field."""
    x, y, i, q = planes[0], planes[1], planes[2], planes[3]
    done[c0:c1] = 0
    for cell in range(n_cell):
        n, loaded = cells[cell, SAMPLES], False
        for channel in range(c0, c1):
            part = done[channel]
            if part < count[channel] and whole[channel, part, CELL] == cell:
                if not loaded:
                    _load(narrow, wide, cells[cell, FIRST], n, i, q)
                    loaded = True
                bend = np.float32(real[channel, part, BEND])
                _wipe(
                    i,
                    q,
                    n,
                    whole[channel, part, BASE],
                    whole[channel, part, STEP],
                    bend,
                    x,
                    y,
                    turns,
                )
            while part < count[channel] and whole[channel, part, CELL] == cell:
                a, b = whole[channel, part, START], whole[channel, part, END]
                phase = index_phase(real[channel, part, CHIPS], per_chip[channel], length[channel])
                step = index_step(real[channel, part, CHIPS_PER_SAMPLE], per_chip[channel])
                _add(
                    x, y, a, b, table, origin[channel], phase, step, delays, channel,
                    length[channel] << 32, sums, whole[channel, part, SLOT], turns,
                )  # fmt: skip
                part += 1
            done[channel] = part
