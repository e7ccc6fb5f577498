"""The loops of `if_blocks`: each has vector bodies in `if_lanes` and a plain twin here.

Which one runs is told at compile time by the type of ``body`` (`vectors.Body`).  Sums of satellites
agree to float32 rounding; noise has the same bits in all.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload

from signals.compiled import FAST_SUM, kernel
from signals.elementary import cos_sin, fixed, sine_of_turns, wrap
from signals.if_lanes import (
    accumulate_8x1,
    accumulate_16x1,
    accumulate_16x2,
    finish_16,
    finish_64,
    finish_silent_16,
    finish_silent_64,
    starts_8,
    starts_16,
)
from signals.noise import CELL, gaussian_rows, interleave
from signals.vectors import Avx2, Avx512, Body, Portable

_F = np.float32


class Layout(NamedTuple):
    """Room for one thread: a row for each satellite that is received."""

    chips: np.ndarray  # (n_channel (BLOCK + 64),) chips times symbols, where these change
    base: np.ndarray  # (n_channel,) int64: first entry, in ``chips`` or in the replicas' table
    own: np.ndarray  # (n_channel,) int64: 1 for ``chips``
    position: np.ndarray  # (n_channel, ROOM) int64: code phase from there [2^-32 sub-chips]
    step: np.ndarray  # (n_channel,) int64: per sample [2^-32 sub-chips]
    fine: np.ndarray  # (n_channel, 4, lanes): cos, sin of lanes, and lane number times these
    carrier: np.ndarray  # (n_channel, 6, ROOM): z, z one vector before, 2 sin(theta), drift
    edges: np.ndarray  # (2, ROOM) code and carrier at the edges of sub-blocks
    i: np.ndarray  # (BLOCK,) float32
    q: np.ndarray  # (BLOCK,) float32
    kept: np.ndarray  # (4, 32) float32
    rows: np.ndarray  # (4, CELL // 2) float32


# ---- where a satellite starts ----------------------------------------------------------------


def starts(
    body: Body, x: np.ndarray, phase: np.ndarray, numbers: Any, room: Layout, row: int, n: int
) -> None:
    """What each of n sub-blocks starts from, into ``position`` and ``carrier``.

    ``numbers``: whole part of x[0], 1 / vectors per sub-block, mean advance per vector [cycles],
    2 pi / lanes, amplitude.
    """
    _starts_plain(x, phase, numbers, room, row, n)


@overload(starts, strict=False, inline="always")
def _starts_of(body: Any, x: Any, phase: Any, numbers: Any, room: Any, row: Any, n: Any) -> Any:
    if body.instance_class is Avx512:
        return lambda body, x, phase, numbers, room, row, n: _starts_avx512(
            x, phase, numbers, room, row, n
        )
    if body.instance_class is Avx2:
        return lambda body, x, phase, numbers, room, row, n: _starts_avx2(
            x, phase, numbers, room, row, n
        )
    return lambda body, x, phase, numbers, room, row, n: _starts_plain(
        x, phase, numbers, room, row, n
    )


@kernel
def _starts_avx512(x: Any, phase: Any, numbers: Any, room: Any, row: int, n: int) -> None:
    for m in range(0, n, 16):
        starts_16(x, phase, numbers, room, row, m)


@kernel
def _starts_avx2(x: Any, phase: Any, numbers: Any, room: Any, row: int, n: int) -> None:
    for m in range(0, n, 8):
        starts_8(x, phase, numbers, room, row, m)


@kernel
def _starts_plain(x: Any, phase: Any, numbers: Any, room: Any, row: int, n: int) -> None:
    whole, per_vector, middle, per_lane, amplitude = numbers
    position, carrier, size = room.position[row], room.carrier[row], _F(amplitude)
    for m in range(n):
        theta = (phase[m + 1] - phase[m]) * per_vector
        position[m] = fixed(x[m] - whole)
        c, s = cos_sin(wrap(fixed(phase[m])))
        carrier[0, m], carrier[1, m] = size * c, size * s
        c, s = cos_sin(wrap(fixed(phase[m] - theta)))
        carrier[2, m], carrier[3, m] = size * c, size * s
        carrier[4, m] = _F(2.0 * sine_of_turns(theta))
        carrier[5, m] = _F((theta - middle) * per_lane)


# ---- the sum of satellites -------------------------------------------------------------------


def accumulate(body: Body, at: int, count: int, n: int, table: np.ndarray, room: Layout) -> None:
    """Add the n satellites laid out to samples at ... at + count - 1 of the block."""
    _accumulate_plain(at, count, n, table, room)


@overload(accumulate, strict=False, inline="always")
def _accumulate_of(body: Any, at: Any, count: Any, n: Any, table: Any, room: Any) -> Any:
    if body.instance_class is Avx512:
        return lambda body, at, count, n, table, room: _accumulate_avx512(at, count, n, table, room)
    if body.instance_class is Avx2:
        return lambda body, at, count, n, table, room: _accumulate_avx2(at, count, n, table, room)
    return lambda body, at, count, n, table, room: _accumulate_plain(at, count, n, table, room)


@kernel
def _accumulate_avx512(at: int, count: int, n: int, table: np.ndarray, room: Layout) -> None:
    for row in range(0, n - 1, 2):
        accumulate_16x2(room.i, room.q, at, count // 32, table, room, row)
    if n % 2:
        accumulate_16x1(room.i, room.q, at, count // 32, table, room, n - 1)


@kernel
def _accumulate_avx2(at: int, count: int, n: int, table: np.ndarray, room: Layout) -> None:
    for row in range(n):
        accumulate_8x1(room.i, room.q, at, count // 16, table, room, row)


@kernel
def _accumulate_plain(at: int, count: int, n: int, table: np.ndarray, room: Layout) -> None:
    lanes = room.fine.shape[2]
    chip = np.empty(lanes, _F)
    for row in range(n):
        entries = room.chips[room.base[row] :] if room.own[row] else table[room.base[row] :]
        for m in range((count + lanes - 1) // lanes):
            a = at + m * lanes
            b = min(a + lanes, at + count)
            _look_up(room.position[row, m], room.step[row], entries, chip)
            start = room.carrier[row]
            c, s, turn = start[0, m], start[1, m], start[5, m]
            _add(room.i[a:b], room.q[a:b], chip, room.fine[row], c, s, turn)


@kernel
def _look_up(position: int, step: int, entries: np.ndarray, chip: np.ndarray) -> None:
    """Entries under consecutive samples.  Alone, as LLVM keeps a look-up loop scalar."""
    at, by = np.uint64(position), np.uint64(step)
    for k in range(chip.shape[0]):
        chip[k] = entries[at >> np.uint64(32)]
        at += by


@kernel(fastmath=FAST_SUM)
def _add(
    i: np.ndarray, q: np.ndarray, chip: np.ndarray, fine: np.ndarray, c: Any, s: Any, turn: Any
) -> None:
    """Add chips times the carrier of a sub-block that starts at c + j s."""
    fc, fs, kc, ks = fine[0], fine[1], fine[2], fine[3]
    for k in range(i.shape[0]):
        x, y = fc[k] - turn * ks[k], fs[k] + turn * kc[k]
        i[k] += chip[k] * (c * x - s * y)
        q[k] += chip[k] * (s * x + c * y)


# ---- noise and rounding ----------------------------------------------------------------------


class Quantiser(NamedTuple):
    """Levels of the samples: level = rint(x - shift) within bounds, written (level << d) + d."""

    noise: Any  # float32: rms of what is drawn, 0: none
    least: Any  # float32
    most: Any  # float32
    shift: Any  # float32
    doubling: Any  # float32: d, 0 or 1


def finish(
    body: Body, at: int, out: np.ndarray, to: int, counter: Any, levels: Quantiser, room: Layout
) -> None:
    """Noise and rounding of the cell that begins at ``at`` of the block, into ``out`` at ``to``.

    ``out`` is (n, 2) or (n,); ``counter`` is two words of the counter, two of the key.  A counter
    makes two complex samples, half a cell apart, or four real ones.
    """
    _finish_plain(at, out, to, counter, levels, room)


@overload(finish, strict=False, inline="always")
def _finish_of(body: Any, at: Any, out: Any, to: Any, counter: Any, levels: Any, room: Any) -> Any:
    if body.instance_class is Avx512:
        return lambda body, at, out, to, counter, levels, room: _finish_avx512(
            at, out, to, counter, levels, room
        )
    if body.instance_class is Avx2:
        return lambda body, at, out, to, counter, levels, room: _finish_avx2(
            at, out, to, counter, levels, room
        )
    return lambda body, at, out, to, counter, levels, room: _finish_plain(
        at, out, to, counter, levels, room
    )


@kernel
def _finish_avx512(at: int, out: Any, to: int, counter: Any, levels: Any, room: Any) -> None:
    numbers = (levels.noise, levels.least, levels.most, levels.shift, levels.doubling)
    if levels.noise > 0.0:
        for j in range(0, CELL * out.ndim // 4, 64):
            finish_64(room.i, room.q, (at, to), out, counter, numbers, j)
    else:
        for j in range(0, CELL * out.ndim // 4, 64):
            finish_silent_64(room.i, room.q, (at, to), out, counter, numbers, j)


@kernel
def _finish_avx2(at: int, out: Any, to: int, counter: Any, levels: Any, room: Any) -> None:
    numbers = (levels.noise, levels.least, levels.most, levels.shift, levels.doubling)
    if levels.noise > 0.0:
        for j in range(0, CELL * out.ndim // 4, 16):
            finish_16(room.i, room.q, (at, to), out, counter, numbers, j)
    else:
        for j in range(0, CELL * out.ndim // 4, 16):
            finish_silent_16(room.i, room.q, (at, to), out, counter, numbers, j)


@kernel
def _finish_plain(at: int, out: Any, to: int, counter: Any, levels: Any, room: Any) -> None:
    components = out.ndim
    n = CELL * components // 4
    i, q = room.i[at : at + CELL], room.q[at : at + CELL]
    if levels.noise > 0.0:
        first, key = (counter[1] << 32) + counter[0], (counter[2], counter[3])
        a, b, c, d = room.rows[0, :n], room.rows[1, :n], room.rows[2, :n], room.rows[3, :n]
        gaussian_rows(Portable(), first, key, levels.noise, (a, b, c, d))
        for k in range(4):
            sums = q if components == 2 and k % 2 else i
            start = k // components * n
            _add_row(sums[start : start + n], room.rows[k, :n])
    flat = out.reshape(-1)[components * to : components * (to + CELL)]
    if flat.itemsize != 4:
        _write_levels(i, q, components, levels, flat)
    elif components == 2:
        interleave(i, q, flat)
    else:
        for k in range(CELL):
            flat[k] = i[k]


@kernel
def _add_row(sums: np.ndarray, row: np.ndarray) -> None:
    for k in range(sums.shape[0]):
        sums[k] += row[k]


@kernel(inline="always")
def _level(x: Any, levels: Any) -> Any:
    """Level of a sample: int32."""
    bounded = min(max(x - levels.shift, levels.least), levels.most)
    level, double = np.int32(np.rint(bounded)), np.int32(levels.doubling)
    return (level << double) + double


@kernel
def _write_levels(
    i: np.ndarray, q: np.ndarray, components: int, levels: Any, flat: np.ndarray
) -> None:
    for k in range(i.shape[0]):
        flat[components * k] = _level(i[k], levels)
        if components == 2:
            flat[2 * k + 1] = _level(q[k], levels)
