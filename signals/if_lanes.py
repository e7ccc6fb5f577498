"""The loops of `if_loops` in vector lanes: satellites summed in registers, noise and rounding.

Per satellite and vector of samples the sum takes one permuted look-up for the code and four fused
multiplications and additions: two for the sum and two for the carrier, by the leapfrog

    z_{v+1} = z_{v-1} + 2j sin(theta) z_v,       z_v = exp(j (phi + theta v))              (1)

which is half the work of a complex product.  Its errors grow with the number of steps (at worst,
where theta is an odd multiple of pi / 2, to 1e-5 rad after 16): z starts anew every 16 vectors.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from signals.lanes import (
    F64,
    I32,
    WINDOW,
    data_pointer,
    emit_fma,
    emit_lane_steps,
    emit_load,
    emit_look_up,
    emit_loop,
    emit_relative,
    emit_rotate,
    emit_splat,
    emit_store,
    emit_window,
    int64,
    vector,
)
from signals.noise import CELL
from signals.noise_lanes import emit_gaussians
from signals.vectors import Avx2, Avx512, Vector, cos_sin, fixed, load, sine_of_turns, splat

ROOM = 80
"""Room for the sub-blocks of a block, and for vectors that overrun them"""

_MAGIC = 12582912.0  # 1.5 x 2^23: added to |x| < 2^22 it leaves the nearest integer in the low bits


class _Layout(NamedTuple):
    """Pointers to arrays of `if_loops.Layout`."""

    chips: Any
    base: Any
    own: Any
    position: Any
    step: Any
    fine: Any
    carrier: Any


def _pointers(context: Any, builder: Any, kind: Any, packed: Any) -> _Layout:
    """The arrays of a layout that has them by these names."""
    found = [
        data_pointer(context, builder, kind[at], builder.extract_value(packed, at))
        for at in (kind.fields.index(name) for name in _Layout._fields)
    ]
    return _Layout(*found)


# ---- where a satellite starts ----------------------------------------------------------------


def _starts(width: int) -> Any:
    def define(
        typing_context: Any, x: Any, phase: Any, numbers: Any, layout: Any, row: Any, m: Any
    ) -> tuple[Any, Any]:
        """`if_loops._starts_plain` of sub-blocks m ... m + width - 1."""

        def generate(context: Any, b: Any, signature: Any, args: Any) -> None:
            kinds = signature.args
            x, phase = (data_pointer(context, b, kinds[k], args[k]) for k in (0, 1))
            numbers, packed, row, m = args[2:]
            whole, per_vector, middle, per_lane, size = (
                splat(b, b.extract_value(numbers, k), width) for k in range(5)
            )
            to = _pointers(context, b, kinds[3], packed)
            now, after = (load(b, phase, b.add(m, int64(k)), width, F64) for k in (0, 1))
            theta = (after - now) * per_vector
            at = fixed(load(b, x, m, width, F64) - whole)
            emit_store(b, at.value, to.position, b.add(b.mul(row, int64(ROOM)), m))
            size = size.to_float()
            values = [size * v for v in cos_sin(fixed(now).low(I32))]
            values += [size * v for v in cos_sin(fixed(now - theta).low(I32))]
            values += [(2.0 * sine_of_turns(theta)).to_float()]
            values += [((theta - middle) * per_lane).to_float()]
            start = b.add(b.mul(row, int64(6 * ROOM)), m)
            for k, value in enumerate(values):
                emit_store(b, value.value, to.carrier, b.add(start, int64(k * ROOM)))

        five = types.UniTuple(types.float64, 5)
        return types.void(x, phase, five, layout, types.int64, types.int64), generate

    return define


starts_16, starts_8 = intrinsic(_starts(16)), intrinsic(_starts(8))


# ---- the sum of satellites -------------------------------------------------------------------


class _Satellite:
    """What the loop over samples needs of one satellite."""

    def __init__(self, builder: Any, table: Any, arrays: _Layout, row: Any, lanes: int) -> None:
        self.builder, self.lanes = builder, lanes
        at, base = [row], builder.load(builder.gep(arrays.base, [row]))
        own = builder.icmp_signed("!=", builder.load(builder.gep(arrays.own, at)), int64(0))
        self.entries = builder.gep(builder.select(own, arrays.chips, table), [base])
        self.step = builder.load(builder.gep(arrays.step, at))
        self.ahead = [
            emit_lane_steps(builder, self.step, lanes, k) for k in range(0, WINDOW[lanes], lanes)
        ]
        self.position = builder.gep(arrays.position, [builder.mul(row, int64(ROOM))])
        self.carrier = builder.gep(arrays.carrier, [builder.mul(row, int64(6 * ROOM))])
        self.fine = builder.gep(arrays.fine, [builder.mul(row, int64(4 * lanes))])

    def start(self, m: Any) -> list[Any]:
        """Code phase, z_{v-1}, z_v and 2 sin(theta) at sub-block m."""
        b, lanes = self.builder, self.lanes
        sc, ss, tc, ts, twist, turn = (
            emit_splat(b, b.load(b.gep(self.carrier, [b.add(m, int64(k * ROOM))])), lanes)
            for k in range(6)
        )
        c, s, kc, ks = (emit_load(b, self.fine, int64(k * lanes), lanes) for k in range(4))
        c, s = emit_fma(b, b.fneg(turn), ks, c), emit_fma(b, turn, kc, s)
        before, now = emit_rotate(b, c, s, tc, ts), emit_rotate(b, c, s, sc, ss)
        return [b.load(b.gep(self.position, [m])), *before, *now, twist]

    def look_up(self, position: Any) -> tuple[list[Any], Any]:
        """Chips under two vectors of samples, and the code phase after them."""
        b, lanes = self.builder, self.lanes
        chips: list[Any] = []
        while len(chips) < 2:
            window = emit_window(b, self.entries, position, lanes)
            relative = emit_relative(b, position, lanes)
            chips += [emit_look_up(b, window, b.add(relative, k)) for k in self.ahead]
            position = b.add(position, b.mul(self.step, int64(WINDOW[lanes])))
        return chips, position


def _accumulate(lanes: int, group: int) -> Any:
    pairs_per_block = (Avx512() if lanes == 16 else Avx2()).vectors // 2

    def define(
        typing_context: Any, i: Any, q: Any, at: Any, pairs: Any, table: Any, layout: Any, row: Any
    ) -> tuple[Any, Any]:
        """Add satellites row ... row + group - 1 to ``pairs`` pairs of vectors from ``at`` on."""

        def generate(context: Any, b: Any, signature: Any, args: Any) -> None:
            kinds = signature.args
            i, q, table = (data_pointer(context, b, kinds[k], args[k]) for k in (0, 1, 4))
            at, pairs, packed, row = args[2], args[3], args[5], args[6]
            arrays = _pointers(context, b, kinds[5], packed)
            satellites = [
                _Satellite(b, table, arrays, b.add(row, int64(k)), lanes) for k in range(group)
            ]

            def sub_block(m: Any) -> list[Any]:
                done = b.mul(m, int64(pairs_per_block))
                left = b.sub(pairs, done)
                last = b.icmp_signed("<", left, int64(pairs_per_block))
                count = b.select(last, left, int64(pairs_per_block))
                first = b.add(at, b.mul(done, int64(2 * lanes)))
                states = [s.start(m) for s in satellites]

                def pair(v: Any, *state: Any) -> list[Any]:
                    n = b.add(first, b.mul(v, int64(2 * lanes)))
                    return _add_pair(b, satellites, [s[5] for s in states], i, q, n, state)

                emit_loop(b, count, [x for s in states for x in s[:5]], pair)
                return []

            sub_blocks = b.sdiv(b.add(pairs, int64(pairs_per_block - 1)), int64(pairs_per_block))
            emit_loop(b, sub_blocks, [], sub_block)

        n = types.int64
        return types.void(i, q, n, n, table, layout, n), generate

    return define


def _add_pair(
    b: Any, satellites: list[_Satellite], twists: list[Any], i: Any, q: Any, n: Any, state: Any
) -> list[Any]:
    """Two vectors of samples from sample n on; the state after them."""
    lanes = satellites[0].lanes
    places = [n, b.add(n, int64(lanes))]
    sums = [[emit_load(b, x, place, lanes) for x in (i, q)] for place in places]
    after: list[Any] = []
    for k, satellite in enumerate(satellites):
        position, c0, s0, c1, s1 = state[5 * k : 5 * k + 5]
        chips, position = satellite.look_up(position)
        minus = b.fneg(twists[k])
        for chip, total in zip(chips, sums, strict=True):
            total[:] = emit_fma(b, chip, c1, total[0]), emit_fma(b, chip, s1, total[1])
            c0, s0, c1, s1 = c1, s1, emit_fma(b, minus, s1, c0), emit_fma(b, twists[k], c1, s0)
        after += [position, c0, s0, c1, s1]
    for place, total in zip(places, sums, strict=True):
        emit_store(b, total[0], i, place)
        emit_store(b, total[1], q, place)
    return after


accumulate_16x2, accumulate_16x1 = intrinsic(_accumulate(16, 2)), intrinsic(_accumulate(16, 1))
accumulate_8x1 = intrinsic(_accumulate(8, 1))


# ---- noise and rounding ----------------------------------------------------------------------


def _finish(width: int, noisy: bool) -> Any:
    def define(
        typing_context: Any, i: Any, q: Any, at: Any, out: Any, counter: Any, noise: Any, j: Any
    ) -> tuple[Any, Any]:
        """The samples of a cell that counters j ... j + width - 1 belong to.

        Planar i, q from ``at[0]`` on go to ``out`` from ``at[1]`` on; ``counter`` is two words of
        the counter, two of the key; ``noise`` is its rms, then least level, most, shift, doubling.
        """

        def generate(context: Any, b: Any, signature: Any, args: Any) -> None:
            kinds = signature.args
            i, q, out = (data_pointer(context, b, kinds[k], args[k]) for k in (0, 1, 3))
            source, target = (b.extract_value(args[2], k) for k in (0, 1))
            low, high, *key = (b.extract_value(args[4], k) for k in range(4))
            scale, *levels = (b.extract_value(args[5], k) for k in range(5))
            j, kind = args[6], kinds[3].dtype
            components = kinds[3].ndim
            rows = [i] if components == 1 else [i, q]
            places = [b.add(j, int64(k)) for k in range(0, CELL, CELL * components // 4)]
            x = [load(b, row, b.add(source, p), width) for p in places for row in rows]
            if noisy:
                drawn = emit_gaussians(b, width, b.add(low, j), high, key, scale)
                x = [v + w for v, w in zip(x, drawn, strict=True)]
            if kind != types.float32:
                x = [_level(v, *levels) for v in x]
            for k, place in enumerate(places):
                parts = x[k * components : (k + 1) * components]
                _store(b, parts, out, b.add(target, place), kind)

        n = types.int64
        pair, words = types.UniTuple(n, 2), types.UniTuple(n, 4)
        numbers = types.UniTuple(types.float32, 5)
        return types.void(i, q, pair, out, words, numbers, n), generate

    return define


def _level(x: Vector, least: Any, most: Any, shift: Any, doubling: Any) -> Vector:
    """`if_loops._level`, in the low bits of int32."""
    b, width = x.builder, x.width
    bounded = (x - splat(b, shift, width)).at_least(splat(b, least, width))
    level = (bounded.at_most(splat(b, most, width)) + _MAGIC).bits(I32)
    twice = splat(b, b.fptosi(doubling, I32), width)
    return (level << twice) + twice


def _store(b: Any, parts: list[Vector], out: Any, at: Any, kind: Any) -> None:
    """One vector of real samples or two of I and Q to sample ``at`` of ``out``."""
    n, width = len(parts), parts[0].width
    at = b.mul(at, int64(n))
    if kind == types.float32:
        order = [k + width * part for k in range(width) for part in range(n)]
        value = b.shuffle_vector(parts[0].value, parts[-1].value, vector(I32, order))
        emit_store(b, value, out, at)
        return
    bits = kind.bitwidth
    sample = parts[0]
    if n == 2:
        mask = (1 << bits) - 1
        sample = (sample & mask) | ((parts[1] & mask) << bits)
    if n * bits < 32:
        sample = sample.low(ir.IntType(n * bits))
    pointer = b.bitcast(b.gep(out, [at]), sample.value.type.as_pointer())
    b.store(sample.value, pointer, align=1)


finish_64, finish_silent_64 = intrinsic(_finish(64, True)), intrinsic(_finish(64, False))
finish_16, finish_silent_16 = intrinsic(_finish(16, True)), intrinsic(_finish(16, False))
