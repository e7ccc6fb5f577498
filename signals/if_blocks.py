"""Kernels of `front_end`: satellites summed over blocks of samples, noise added, rounded.

A block of `BLOCK` samples is fixed to the absolute sample number; where a piece of the truth ends
inside, it is summed in parts.  The float64 cubics of code and carrier are evaluated at the edges of
sub-blocks (256 samples on the avx512 path); in between both go on evenly, at 10 g and 4 MHz 3e-7
cycles off at most.  Data symbols change at the very sample: a symbol is a run of chips.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from signals.compiled import kernel
from signals.elementary import TURN, TWO_PI, cos_sin, wrap
from signals.if_lanes import ROOM
from signals.if_loops import Layout, Quantiser, accumulate, finish, starts
from signals.noise import CELL
from signals.replica import LONGEST_CELL, Replicas
from signals.vectors import Body

BLOCK = 4096
"""Samples that share what is worked out once per satellite"""

_WINDOW = 34  # entries that a vector may load from the one under its first sample on
_F = np.float32


class Truth(NamedTuple):
    """What arrives, and how it is sampled."""

    edge: np.ndarray  # (n_piece + 1,) int64: first sample of each piece, end of the last
    t_s: np.ndarray  # (n_piece + 1,)
    code: np.ndarray  # (n_channel, n_piece, 4) code_phase_chips
    carrier: np.ndarray  # (n_channel, n_piece, 4) carrier_phase_cycles
    amplitude: np.ndarray  # (n_channel, n_piece) in units of a level, 0: silent
    symbols: np.ndarray  # (n_channel, n_symbol) int8
    first_symbol: np.ndarray  # (n_channel,) int64
    symbol_chips: np.ndarray  # (n_channel,) int64
    sample_rate_hz: float
    if_ratio: float  # intermediate frequency / sampling rate


def layout(n_channel: int, body: Body) -> Layout:
    """Room for one thread."""
    sums = _aligned(2 * BLOCK)
    return Layout(
        np.zeros(n_channel * (BLOCK + 64), _F),
        np.zeros(n_channel, np.int64),
        np.zeros(n_channel, np.int64),
        np.zeros((n_channel, ROOM), np.int64),
        np.zeros(n_channel, np.int64),
        np.zeros((n_channel, 4, body.lanes), _F),
        np.zeros((n_channel, 6, ROOM), _F),
        np.zeros((2, ROOM)),
        sums[:BLOCK],
        sums[BLOCK:],
        np.zeros((4, 32), _F),
        np.zeros((4, CELL // 2), _F),
    )


def _aligned(n: int) -> np.ndarray:
    """float32 zeros from the start of a cache line on."""
    room = np.zeros(n + 16, _F)
    skip = -(room.ctypes.data // 4) % 16
    return room[skip : skip + n]


# ---- one satellite ---------------------------------------------------------------------------


@kernel
def _edges(
    code: np.ndarray,
    carrier: np.ndarray,
    dt: float,
    interval_s: float,
    per_chip: float,
    turn: float,
    if_step: float,
    x: np.ndarray,
    phase: np.ndarray,
) -> None:
    """Code [sub-chips] and carrier [cycles, less a whole number] at the edges of sub-blocks."""
    a0, a1, a2, a3 = code[0], code[1], code[2], code[3]
    b0, b1, b2, b3 = carrier[0], carrier[1], carrier[2], carrier[3]
    less = math.floor(b0 + dt * (b1 + dt * (b2 + dt * b3)))
    for m in range(x.shape[0]):
        d = dt + float(m) * interval_s
        x[m] = per_chip * (a0 + d * (a1 + d * (a2 + d * a3)))
        phase[m] = (b0 + d * (b1 + d * (b2 + d * b3)) - less) + (turn + float(m) * if_step)


@kernel
def _lane_phasors(cycles_per_sample: float, fine: np.ndarray) -> None:
    """exp(j w k) for each lane k, and k times that."""
    step = np.int64(np.rint((cycles_per_sample - math.floor(cycles_per_sample)) * TURN))
    for k in range(fine.shape[1]):
        c, s = cos_sin(wrap(np.int64(np.int32(k)) * step))
        lane = _F(np.int32(k))
        fine[0, k], fine[1, k] = c, s
        fine[2, k], fine[3, k] = lane * c, lane * s


@kernel
def _fill(
    chips: np.ndarray,
    start: int,
    table: np.ndarray,
    length: int,
    symbol_chips: int,
    symbols: np.ndarray,
    first_symbol: int,
) -> None:
    """Entries start, start + 1 ... of a replica, each times the data symbol it belongs to."""
    done, n = 0, chips.shape[0]
    while done < n:
        at = start + done
        symbol, r = at // symbol_chips, at % length
        end = min(n, (symbol + 1) * symbol_chips - start, done + length - r)
        # the first sample may lie a rounding error before the first symbol
        data = _F(symbols[min(max(symbol - first_symbol, 0), symbols.shape[0] - 1)])
        run, source = chips[done:end], table[r : r + end - done]
        for k in range(run.shape[0]):
            run[k] = data * source[k]
        done = end


@kernel
def _prepare(
    body: Body, p: int, n: int, count: int, truth: Truth, replicas: Replicas, room: Layout
) -> int:
    """Lay out ``count`` samples from sample ``n`` of piece ``p``; the number of satellites."""
    size = body.lanes * body.vectors
    blocks = (count + size - 1) // size
    x, phase = room.edges[0, : blocks + 1], room.edges[1, : blocks + 1]
    dt = n / truth.sample_rate_hz - truth.t_s[p]
    turn = n * truth.if_ratio
    turn -= math.floor(turn)
    row = 0
    for channel in range(truth.amplitude.shape[0]):
        amplitude = truth.amplitude[channel, p]
        if not amplitude > 0.0:
            continue
        per_chip = replicas.per_chip[channel]
        _edges(
            truth.code[channel, p],
            truth.carrier[channel, p],
            dt,
            size / truth.sample_rate_hz,
            float(per_chip),
            turn,
            size * truth.if_ratio,
            x,
            phase,
        )
        whole, length = math.floor(x[0]), float(replicas.length[channel])
        span = np.int64(x[blocks] - whole) + _WINDOW
        symbols, first = truth.symbols[channel], replicas.first[channel]
        symbol = float(truth.symbol_chips[channel] * per_chip)
        number = math.floor(whole / symbol)
        if number == math.floor((whole + span) / symbol) and span <= per_chip * LONGEST_CELL:
            room.own[row] = 0
            room.base[row] = first + np.int64(whole - length * math.floor(whole / length))
            at = min(max(np.int64(number) - truth.first_symbol[channel], 0), symbols.shape[0] - 1)
            amplitude *= symbols[at]
        else:
            room.own[row], room.base[row] = 1, row * (BLOCK + 64)
            _fill(
                room.chips[room.base[row] : room.base[row] + span],
                np.int64(whole),
                replicas.table[first : first + replicas.length[channel]],
                replicas.length[channel],
                truth.symbol_chips[channel] * per_chip,
                symbols,
                truth.first_symbol[channel],
            )
        room.step[row] = np.int64(np.rint((x[blocks] - x[0]) / (blocks * size) * TURN))
        mean = (phase[blocks] - phase[0]) / (blocks * size)
        _lane_phasors(mean, room.fine[row])
        numbers = (whole, 1.0 / body.vectors, mean * body.lanes, TWO_PI / body.lanes, amplitude)
        starts(body, room.edges[0], room.edges[1], numbers, room, row, blocks)
        row += 1
    return row


# ---- blocks ----------------------------------------------------------------------------------


@kernel(inline="always")
def _piece_at(edge: np.ndarray, n: int) -> int:
    """Last piece that begins at sample n or before, the first if none does."""
    low, high = 0, edge.shape[0]
    while high - low > 1:
        middle = (low + high) // 2
        if edge[middle] <= n:
            low = middle
        else:
            high = middle
    return low


@kernel
def generate(
    body: Body,
    first_block: int,
    out: np.ndarray,
    key: Any,
    levels: Quantiser,
    truth: Truth,
    replicas: Replicas,
    room: Layout,
) -> None:
    """Whole blocks from ``first_block`` on into ``out``, (n BLOCK, 2) or (n BLOCK,)."""
    for block in range(out.shape[0] // BLOCK):
        start = (first_block + block) * BLOCK
        _sum(body, start, truth, replicas, room)
        for at in range(0, BLOCK, CELL):
            counter = (start + at) // 4 * out.ndim
            words = (counter & 0xFFFFFFFF, counter >> 32, key[0], key[1])
            finish(body, at, out, block * BLOCK + at, words, levels, room)


@kernel
def _sum(body: Body, start: int, truth: Truth, replicas: Replicas, room: Layout) -> None:
    """Satellites over the block that begins at sample ``start``: ``i`` and ``q`` of ``room``."""
    room.i[:] = _F(0.0)
    room.q[:] = _F(0.0)
    p = _piece_at(truth.edge, start)
    while p < truth.t_s.shape[0] - 1 and truth.edge[p] < start + BLOCK:
        a, b = max(truth.edge[p] - start, 0), min(truth.edge[p + 1] - start, BLOCK)
        if b > a:
            _add_piece(body, start, a, b, p, truth, replicas, room)
        p += 1


@kernel
def _add_piece(
    body: Body, start: int, a: int, b: int, p: int, truth: Any, replicas: Any, room: Any
) -> None:
    """Add samples a ... b - 1 of a block, all of piece p; whole vectors, neighbours put back."""
    first, end = a - a % body.grain, b + (-b) % body.grain
    i, q, kept = room.i, room.q, room.kept
    for k in range(a - first):
        kept[0, k], kept[1, k] = i[first + k], q[first + k]
    for k in range(end - b):
        kept[2, k], kept[3, k] = i[b + k], q[b + k]
    n = _prepare(body, p, start + first, end - first, truth, replicas, room)
    accumulate(body, first, end - first, n, replicas.table, room)
    for k in range(a - first):
        i[first + k], q[first + k] = kept[0, k], kept[1, k]
    for k in range(end - b):
        i[b + k], q[b + k] = kept[2, k], kept[3, k]
