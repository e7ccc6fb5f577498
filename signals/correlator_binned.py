"""The binned engine: prefix sums of int8 samples, shared by all channels, and a phasor per bin.

The delays of the taps, modulo an entry of the code table, cut each entry into *bins* of half an
entry at most; no tap changes its value inside one.  With P_n the sum of x_m and Q_n that of m x_m
over m < n, exact integers, the samples a <= m < b of a bin about its middle t contribute

    sum x_m exp(-j (phase(t) + w (m - t)))
        = exp(-j phase(t)) (P - j w (Q - t P)) / g,    P = P_b - P_a,  Q = Q_b - Q_a,          (1)

with w the carrier in radians per sample and g = 1 + (w L)^2 / 24 the gain, in a bin of L samples,
of what is in step with the carrier.  (1) leaves out (w (m - t))^2 / 2 less its mean, which is below
0.15 `_ANGLE`^2 = 5e-4 rms.  Edges are exact to the sample at any delay.

Prefix sums turn over in 16 bits, but neither P nor the moment about a sample next to t does in a
bin of at most `_MOST` samples.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from signals import cpu
from signals import lanes_binned as vectors
from signals.compiled import FAST_SUM, borrowing
from signals.elementary import TURN, cos_sin, wrap
from signals.lanes_correlator import PHASE_BITS
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
from signals.replica import Replicas, index_delays, index_phase

SPAN = 4096
"""Most samples in a cell"""

_LEAST, _MOST = 2.0, 30.0  # samples in a bin: in the mean, in the widest
_ANGLE = 0.058  # of the carrier in half a bin [rad]
_ENTRY = 1 << 32
_WIDEST = _ENTRY // 2
_LANES = cpu.LANES.get(cpu.path(), 0)
_VECTOR = _LANES or 1


class _Cuts(NamedTuple):
    """Where the taps cut the entries of the table."""

    cuts: np.ndarray  # (n_channel, n_cut) int64, rising within an entry [2^-32 entries]
    late: np.ndarray  # (n_channel, n_tap, n_cut) int64: entries that a tap is behind, by bin
    widest: np.ndarray  # (n_channel,) entries in the widest bin


class _Scratch(NamedTuple):
    """Of one thread; ``pitch`` is room for the entries of a cell."""

    prefix: np.ndarray  # (4 (SPAN + pad),) int16: I, Q of P_n and of Q_n
    edges: np.ndarray  # (4 n_cut pitch,) int16: the same at the edges
    bins: np.ndarray  # (2 n_cut pitch,) float32: (1) of each bin, I and Q
    starts: np.ndarray  # (n_tap n_cut,) int64: table index at the first bin
    facts: np.ndarray  # (4 n_cut,) float32: middle, gain cos and sin of a cut
    done: np.ndarray  # (n_channel,) int64: parts


def cut_up(fractions: np.ndarray) -> np.ndarray:
    """Rising fractions of an entry [2^-32] and what more it takes to leave no gap above a half."""
    own = np.unique(fractions)
    gaps = np.diff(own, append=own[0] + _ENTRY)
    more = [
        (cut + gap * np.arange(1, n) // n) % _ENTRY
        for cut, gap, n in zip(own, gaps, -(-gaps // _WIDEST), strict=True)
    ]
    return np.unique(np.concatenate([own, *more]))


def _plan(waveforms: Replicas, offset_chips: np.ndarray) -> _Cuts:
    n = waveforms.length.size
    delays = index_delays(waveforms, offset_chips)
    part = delays % _ENTRY
    own = [cut_up(row) if row.size else np.array([0, _WIDEST]) for row in part]
    size = max((cuts.size for cuts in own), default=1)
    # a channel with fewer has empty bins at the end
    cuts = np.array([np.pad(row, (0, size - row.size), mode="edge") for row in own], np.int64)
    cuts = cuts.reshape(n, size)
    late = (delays // _ENTRY)[:, :, None] + (cuts[:, None, :] < part[:, :, None])
    gaps = np.diff(cuts, axis=1, append=cuts[:, :1] + _ENTRY)
    return _Cuts(cuts, late, gaps.max(axis=1, initial=0) / _ENTRY)


class Binned:
    """Fills sums from int8 samples; an instance belongs to one thread; see `exact.Exact`."""

    span = SPAN

    def __init__(self, waveforms: Replicas, offset_chips: np.ndarray) -> None:
        plan = _plan(waveforms, offset_chips)
        size, n_tap = plan.cuts.shape[1], offset_chips.size
        pitch = int(SPAN / (_LEAST * size)) + 2 * 16 + 4
        memory = np.zeros(4 * (SPAN + 64), np.int16)
        scratch = _Scratch(
            memory[-(memory.ctypes.data // 2) % 32 :],
            np.zeros(4 * size * pitch, np.int16),
            np.zeros(2 * size * pitch, np.float32),
            np.zeros(n_tap * size, np.int64),
            np.zeros(4 * size, np.float32),
            np.zeros(waveforms.length.size, np.int64),
        )
        self._mine = waveforms, plan, scratch, pitch

    def __call__(
        self, c0: int, c1: int, narrow: np.ndarray, wide: np.ndarray, n_cell: int, work: Work,
        sums: np.ndarray,
    ) -> None:  # fmt: skip
        """Add the parts of channels c0 ... c1 - 1 to ``sums`` (n_channel, n_slot, n_tap, 2).

        Raises
        ------
        ValueError : samples that are not int8, too few or too many of them per chip for these
            taps, a carrier, intermediate frequency included, that turns too fast for (1).
        """
        if wide.size:
            raise ValueError('samples are not int8: expected int8 for method "binned"')
        waveforms, plan, *_ = self._mine
        channel, part, wrong = _refused(c0, c1, work, waveforms.per_chip, plan)
        if wrong:
            per_chip, widest = int(waveforms.per_chip[channel]), plan.widest[channel]
            length = 1.0 / work.real[channel, part, CHIPS_PER_SAMPLE]
            low, high = _LEAST * per_chip * plan.cuts.shape[1], _MOST * per_chip / widest
            if wrong == 1:
                raise ValueError(
                    f'{length:.4g} samples per chip: expected {low:.4g} to {high:.4g} for method '
                    '"binned" and these taps'
                )  # fmt: skip
            turn = abs(int(work.whole[channel, part, STEP])) * 2.0**-PHASE_BITS
            most = _ANGLE / math.pi * per_chip / (widest * length)
            raise ValueError(
                f"the carrier, intermediate frequency included, turns by {turn:.4g} cycles per "
                f'sample: expected at most {most:.4g} for method "binned" and these taps'
            )
        _accumulate(c0, c1, narrow, n_cell, work, sums.reshape(-1), sums.shape[1], *self._mine)


# ---- plain twins -----------------------------------------------------------------------------


@borrowing(inline="always")
def _word(x: Any) -> Any:
    """Low 16 bits as a signed number."""
    return ((x + 0x8000) & 0xFFFF) - 0x8000


@borrowing
def prefix_plain(samples: np.ndarray, first: int, m0: int, n: int, prefix: np.ndarray) -> None:
    """I, Q of P_m and of Q_m into prefix[4 m ...], m0 < m <= n, of int8 samples from ``first`` on.

    Those of m0 are there already if it is not 0.
    """
    if m0 == 0:
        prefix[:4] = 0
    for m in range(m0, n):
        for k in range(4):
            x = int(samples[2 * (first + m) + k % 2])
            prefix[4 * m + 4 + k] = _word(int(prefix[4 * m + k]) + (x if k < 2 else m * x))


@borrowing
def cut_plain(
    prefix: np.ndarray, first: Any, ahead: Any, last: int, edges: np.ndarray, start: int,
    inside: int, count: int,
) -> None:  # fmt: skip
    """Prefix sums at ``count`` edges into edge ``start`` and on.

    They are at first + k ahead [2^-32 samples] for k < inside, the others at ``last``.
    """
    for k in range(count):
        at = (first + k * ahead) >> 32 if k < inside else last
        for m in range(4):
            edges[4 * (start + k) + m] = prefix[4 * at + m]


@borrowing
def turn_plain(
    edges: np.ndarray, pitch: int, cuts: int, vectors: int, phase: Any, ahead: Any, t0: Any,
    dt: Any, w: Any, facts: np.ndarray, bins: np.ndarray,
) -> None:  # fmt: skip
    """(1) of all bins.

    Entry k has the carrier phase + k ahead [2^-48 cycles] and the time t0 + k dt [samples];
    ``facts`` are what the middle of each of its bins is ahead, and gain times its own phasor.
    """
    for k in range(vectors * _VECTOR):
        c, s = cos_sin(wrap((phase + k * ahead) >> (PHASE_BITS - 32)))
        for g in range(cuts):
            here = 4 * (g * pitch + k)
            there = 4 * (k + 1) if g + 1 == cuts else here + 4 * pitch
            t = t0 + np.float32(k) * dt + facts[4 * g]
            near = int(t + np.float32(0.5))
            i = _word(int(edges[there]) - int(edges[here]))
            q = _word(int(edges[there + 1]) - int(edges[here + 1]))
            mi = _word(int(edges[there + 2]) - int(edges[here + 2]))
            mq = _word(int(edges[there + 3]) - int(edges[here + 3]))
            u = _word(mi - near * i) - (t - near) * i
            v = _word(mq - near * q) - (t - near) * q
            x, y = i + w * v, q - w * u
            a = c * facts[4 * g + 1] - s * facts[4 * g + 2]
            b = s * facts[4 * g + 1] + c * facts[4 * g + 2]
            bins[2 * g * pitch + k] = x * a + y * b
            bins[(2 * g + 1) * pitch + k] = y * a - x * b


@borrowing(fastmath=FAST_SUM)
def add_plain(
    bins: np.ndarray, pitch: int, cuts: int, vectors: int, table: np.ndarray, starts: np.ndarray,
    taps: int, sums: np.ndarray, slot: int,
) -> None:  # fmt: skip
    """Bins times table, I and Q of each tap, added to ``sums`` from ``slot`` on."""
    for tap in range(taps):
        i, q = 0.0, 0.0
        for g in range(cuts):
            start = starts[tap * cuts + g]
            for k in range(vectors * _VECTOR):
                i += table[start + k] * bins[2 * g * pitch + k]
                q += table[start + k] * bins[(2 * g + 1) * pitch + k]
        sums[slot + 2 * tap] += i
        sums[slot + 2 * tap + 1] += q


# ---- kernels ---------------------------------------------------------------------------------

if _LANES:
    _vector_prefix = {16: vectors.prefix_16, 8: vectors.prefix_8}[_LANES]
    _turn = {16: vectors.turn_16, 8: vectors.turn_8}[_LANES]
    _add = {16: vectors.add_16, 8: vectors.add_8}[_LANES]
    _cut = vectors.cut

    @borrowing
    def _prefix(samples: Any, first: int, n: int, prefix: Any) -> None:
        whole = n - n % (_LANES // 2)
        _vector_prefix(samples, first, whole, prefix)
        prefix_plain(samples, first, whole, n, prefix)
else:
    _cut, _turn, _add = cut_plain, turn_plain, add_plain

    @borrowing
    def _prefix(samples: Any, first: int, n: int, prefix: Any) -> None:
        prefix_plain(samples, first, 0, n, prefix)


@borrowing
def _refused(c0: int, c1: int, work: Work, entries: Any, plan: Any) -> tuple[int, int, int]:
    """Channel and part that cannot be run; 1: its chips are too short or too long, 2: its carrier
    is too fast, 0: there is none."""
    for channel in range(c0, c1):
        per_chip, widest = entries[channel], plan.widest[channel]
        for part in range(work.parts[channel]):
            per_entry = 1.0 / (work.real[channel, part, CHIPS_PER_SAMPLE] * per_chip)
            if per_entry < _LEAST * plan.cuts.shape[1] or per_entry * widest > _MOST:
                return channel, part, 1
            turn = abs(work.whole[channel, part, STEP]) * 2.0**-PHASE_BITS
            if math.pi * turn * per_entry * widest > _ANGLE:
                return channel, part, 2
    return 0, 0, 0


@borrowing(inline="always")
def _part(
    channel: int, part: int, n: int, work: Work, waveforms: Replicas, plan: Any, scratch: Any,
    pitch: int, sums: Any, slot: int,
) -> None:  # fmt: skip
    """Add a part of a cell of n samples."""
    whole, real, cuts = work.whole, work.real, plan.cuts
    taps, n_cut = plan.late.shape[1], cuts.shape[1]
    a, b = whole[channel, part, START], whole[channel, part, END]
    per_chip, length = waveforms.per_chip[channel], waveforms.length[channel]
    phase = index_phase(real[channel, part, CHIPS], per_chip, length)
    per_entry = 1.0 / (real[channel, part, CHIPS_PER_SAMPLE] * per_chip)
    ahead, unit = np.int64(np.rint(per_entry * TURN)), per_entry / TURN
    carrier = whole[channel, part, STEP]
    w = 2.0 * math.pi * carrier * 2.0**-PHASE_BITS
    since = phase - cuts[channel, 0]
    entry = since >> 32
    size = int((since & 0xFFFFFFFF) / TURN + (b - a) / per_entry) + 2
    vectors = (size + _VECTOR - 1) // _VECTOR
    # samples from the start of the cell to where the entry begins, with phase and with cut 0
    zero = a + ((entry << 32) - phase) * unit
    cut_0 = cuts[channel, 0] * unit
    for g in range(n_cut):
        here = cuts[channel, g]
        there = cuts[channel, g + 1] if g + 1 < n_cut else cuts[channel, 0] + 0x100000000
        low = np.int64(math.floor((zero + here * unit) * TURN)) + 0xFFFFFFFF
        inside = max(np.int64(((b << 32) - low) / ahead), 0)
        _cut(
            scratch.prefix,
            min(max(low, a << 32), b << 32),
            ahead,
            b,
            scratch.edges,
            g * pitch,
            1,
            1,
        )
        _cut(scratch.prefix, low + ahead, ahead, b, scratch.edges, g * pitch + 1, inside,
             vectors * _VECTOR)  # fmt: skip
        middle = 0.5 * (here + there) * unit - cut_0
        gain = 1.0 / (1.0 + (w * (there - here) * unit) ** 2 / 24.0)
        scratch.facts[4 * g] = middle
        scratch.facts[4 * g + 1] = gain * math.cos(w * middle)
        scratch.facts[4 * g + 2] = gain * math.sin(w * middle)
        for tap in range(taps):
            at = (entry - plan.late[channel, tap, g]) % length
            scratch.starts[tap * n_cut + g] = waveforms.first[channel] + at
    t = zero + cut_0
    # the parabola of the carrier by its mean over the part
    bow = real[channel, part, BEND] * (n * (a + b) / 2.0 - (a * a + a * b + b * b) / 3.0)
    base = whole[channel, part, BASE] + np.int64(np.rint(t * carrier + bow * 65536.0))
    _turn(
        scratch.edges, pitch, n_cut, vectors, base, np.int64(np.rint(per_entry * carrier)),
        np.float32(t), np.float32(per_entry), np.float32(w), scratch.facts, scratch.bins,
    )  # fmt: skip
    _add(scratch.bins, pitch, n_cut, vectors, waveforms.table, scratch.starts, taps, sums,
         2 * taps * slot)  # fmt: skip


@borrowing
def _accumulate(
    c0: int, c1: int, narrow: Any, n_cell: int, work: Work, sums: Any, n_slot: int,
    waveforms: Replicas, plan: Any, scratch: Any, pitch: int,
) -> None:  # fmt: skip
    """Parts of channels c0 ... c1 - 1, cell by cell."""
    done = scratch.done
    done[c0:c1] = 0
    for cell in range(n_cell):
        n = work.cells[cell, SAMPLES]
        _prefix(narrow, work.cells[cell, FIRST], n, scratch.prefix)
        for channel in range(c0, c1):
            part = done[channel]
            while part < work.parts[channel] and work.whole[channel, part, CELL] == cell:
                slot = channel * n_slot + work.whole[channel, part, SLOT]
                _part(channel, part, n, work, waveforms, plan, scratch, pitch, sums, slot)
                part += 1
            done[channel] = part
