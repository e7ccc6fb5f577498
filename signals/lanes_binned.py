"""The binned engine's inner loops in explicit vectors; twins in `signals.correlator_binned`.

Edges come in whole vectors: those beyond the end of a part lie on it, and their bins are empty.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from signals import lanes as v


def _pointers(context: Any, b: Any, signature: Any, args: Any, *which: int) -> list[Any]:
    return [v.data_pointer(context, b, signature.args[k], args[k]) for k in which]


def _prefix(lanes: int, samples: Any, prefix: Any) -> Any:
    """Typing and code of ``prefix_16`` and ``prefix_8``: `prefix_plain` in whole vectors.

    A vector is lanes / 2 samples of four words each.
    """
    per, words = lanes // 2, 2 * lanes

    def shuffled(b: Any, x: Any, y: Any, order: Any) -> Any:
        return b.shuffle_vector(x, y, v.vector(v.I32, order))

    def codegen(context: Any, b: Any, signature: Any, args: Any) -> Any:
        source, target = _pointers(context, b, signature, args, 0, 3)
        source = b.gep(source, [b.shl(args[1], v.int64(1))])
        zero = v.same(v.I16, 0, words)
        twice = [2 * (j // 4) + j % 2 for j in range(words)]
        factor = v.vector(v.I16, [x for k in range(per) for x in (1, 1, k, k)])
        further = v.vector(v.I16, [0, 0, per, per] * per)

        def some(k: Any, total: Any, factor: Any) -> list[Any]:
            x = v.emit_load(b, source, b.mul(k, v.int64(2 * per)), 2 * per, ir.IntType(8))
            x = b.sext(shuffled(b, x, x, twice), zero.type)
            x, ahead = b.mul(x, factor), 4
            while ahead < words:
                x = b.add(x, shuffled(b, zero, x, range(words - ahead, 2 * words - ahead)))
                ahead *= 2
            x = b.add(x, total)
            v.emit_store(b, x, target, b.mul(b.add(b.mul(k, v.int64(per)), v.int64(1)), v.int64(4)))
            last = [words - 4 + j % 4 for j in range(words)]
            return [shuffled(b, x, x, last), b.add(factor, further)]

        v.emit_store(b, v.same(v.I16, 0, 4), target, v.int64(0))
        vectors = b.sdiv(b.add(args[2], v.int64(per - 1)), v.int64(per))
        v.emit_loop(b, vectors, [zero, factor], some)
        return context.get_dummy_value()

    return types.void(samples, types.int64, types.int64, prefix), codegen


@intrinsic
def cut(
    typingctx: Any, prefix: Any, first: Any, ahead: Any, last: Any, edges: Any, start: Any,
    inside: Any, count: Any,
) -> Any:  # fmt: skip
    """`cut_plain`: the four sums of an edge in one move."""
    three = (types.int64,) * 3
    signature = types.void(prefix, *three, edges, *three)

    def codegen(context: Any, b: Any, signature: Any, args: Any) -> Any:
        source, target = (
            b.bitcast(p, v.I64.as_pointer()) for p in _pointers(context, b, signature, args, 0, 4)
        )
        _, first, ahead, last, _, start, inside, count = args

        def one(k: Any, low: Any) -> list[Any]:
            sums = b.load(b.gep(source, [b.lshr(low, v.int64(32))]))
            b.store(sums, b.gep(target, [b.add(start, k)]))
            return [b.add(low, ahead)]

        v.emit_loop(b, inside, [first], one)
        sums, rest = b.load(b.gep(source, [last])), b.add(start, inside)

        def empty(k: Any) -> list[Any]:
            b.store(sums, b.gep(target, [b.add(rest, k)]))
            return []

        v.emit_loop(b, b.sub(count, inside), [], empty)
        return context.get_dummy_value()

    return signature, codegen


def _words(b: Any, pairs: Any) -> list[Any]:
    """Lower and upper half of int32 lanes as floats."""
    lanes = pairs.type.count
    half, floats = v.same(v.I32, 16, lanes), ir.VectorType(v.F32, lanes)
    low, high = b.ashr(b.shl(pairs, half), half), b.ashr(pairs, half)
    return [b.sitofp(x, floats) for x in (low, high)]


def _emit_bins(b: Any, edges: Any, here: Any, there: Any, t: Any, w: Any) -> list[Any]:
    """I and Q of a vector of bins, (1) of `correlator_binned` but for phase and gain."""
    lanes = t.type.count
    ints, words = ir.VectorType(v.I32, lanes), ir.VectorType(v.I16, 2 * lanes)
    some = []
    for k in (0, 2 * lanes):
        now, later = (
            v.emit_load(b, edges, b.add(b.shl(x, v.int64(2)), v.int64(k)), 2 * lanes, v.I16)
            for x in (here, there)
        )
        some.append(b.bitcast(b.sub(later, now), ints))
    sums, moments = (
        b.shuffle_vector(*some, v.vector(v.I32, range(k, 2 * lanes, 2))) for k in (0, 1)
    )
    # words turn over, but not the moment about the nearest sample
    near = b.fptosi(b.fadd(t, v.same(v.F32, 0.5, lanes)), ints)
    both = b.or_(b.shl(near, v.same(v.I32, 16, lanes)), b.and_(near, v.same(v.I32, 0xFFFF, lanes)))
    turned = b.mul(b.bitcast(sums, words), b.bitcast(both, words))
    moments = b.bitcast(b.sub(b.bitcast(moments, words), turned), ints)
    rest = b.fsub(t, b.sitofp(near, t.type))
    (i, q), (moment_i, moment_q) = _words(b, sums), _words(b, moments)
    moment_i, moment_q = (b.fsub(m, b.fmul(rest, x)) for m, x in ((moment_i, i), (moment_q, q)))
    return [v.emit_fma(b, w, moment_q, i), b.fsub(q, b.fmul(w, moment_i))]


def _turn(lanes: int, edges: Any, facts: Any, bins: Any) -> Any:
    """Typing and code of ``turn_16`` and ``turn_8``: `turn_plain`."""
    kinds = (edges, *(types.int64,) * 5, *(types.float32,) * 3, facts, bins)
    ints = ir.VectorType(v.I32, lanes)

    def codegen(context: Any, b: Any, signature: Any, args: Any) -> Any:
        edges, fact, out = _pointers(context, b, signature, args, 0, 9, 10)
        _, pitch, cuts, vectors, phase, ahead = args[:6]
        t0, dt, w = (v.emit_splat(b, x, lanes) for x in args[6:9])
        time = v.emit_fma(b, v.vector(v.F32, range(lanes)), dt, t0)
        lead = b.fmul(dt, v.same(v.F32, lanes, lanes))
        steps = b.mul(v.emit_splat(b, ahead, lanes), v.vector(v.I64, range(lanes)))
        jump = v.emit_splat(b, b.mul(ahead, v.int64(lanes)), lanes)
        (c, s), (jump_c, jump_s) = (
            v.emit_cos_sin(b, b.trunc(b.lshr(x, v.same(v.I64, 16, lanes)), ints))
            for x in (b.add(v.emit_splat(b, phase, lanes), steps), jump)
        )

        def block(m: Any, c: Any, s: Any) -> list[Any]:
            at = b.mul(m, v.int64(lanes))
            here = v.emit_fma(b, v.emit_splat(b, b.sitofp(m, v.F32), lanes), lead, time)

            def one(g: Any) -> list[Any]:
                row = b.mul(g, pitch)
                final = b.icmp_signed("==", b.add(g, v.int64(1)), cuts)
                other = b.select(final, v.int64(1), b.add(row, pitch))
                own = [
                    b.load(b.gep(fact, [b.add(b.shl(g, v.int64(2)), v.int64(k))])) for k in range(3)
                ]
                middle, own_c, own_s = (v.emit_splat(b, x, lanes) for x in own)
                z = _emit_bins(b, edges, b.add(row, at), b.add(other, at), b.fadd(here, middle), w)
                turned = v.emit_rotate(b, c, s, own_c, own_s)
                for k, value in enumerate(v.emit_rotate_back(b, z[0], z[1], *turned)):
                    place = b.mul(b.add(b.shl(g, v.int64(1)), v.int64(k)), pitch)
                    v.emit_store(b, value, out, b.add(place, at))
                return []

            v.emit_loop(b, cuts, [], one)
            return list(v.emit_rotate(b, c, s, jump_c, jump_s))

        v.emit_loop(b, vectors, [c, s], block)
        return context.get_dummy_value()

    return types.void(*kinds), codegen


def _add(lanes: int, bins: Any, table: Any, starts: Any, sums: Any) -> Any:
    """Typing and code of ``add_16`` and ``add_8``: `add_plain`."""
    kinds = (bins, *(types.int64,) * 3, table, starts, types.int64, sums, types.int64)

    def codegen(context: Any, b: Any, signature: Any, args: Any) -> Any:
        source, code, start, out = _pointers(context, b, signature, args, 0, 4, 5, 7)
        _, pitch, cuts, vectors, _, _, taps, _, slot = args

        def together(first: Any, size: int) -> list[Any]:
            """Taps first ... first + size - 1."""
            numbers = [b.add(first, v.int64(j)) for j in range(size)]

            def one(g: Any, *totals: Any) -> list[Any]:
                begin = [b.load(b.gep(start, [b.add(b.mul(k, cuts), g)])) for k in numbers]
                rows = [b.mul(b.add(b.shl(g, v.int64(1)), v.int64(m)), pitch) for m in (0, 1)]

                def some(m: Any, *totals: Any) -> list[Any]:
                    at = b.mul(m, v.int64(lanes))
                    z = [v.emit_load(b, source, b.add(row, at), lanes) for row in rows]
                    chips = [v.emit_load(b, code, b.add(x, at), lanes) for x in begin]
                    pairs = [(x, chip) for chip in chips for x in z]
                    return [v.emit_fma(b, *p, t) for p, t in zip(pairs, totals, strict=True)]

                return v.emit_loop(b, vectors, list(totals), some)

            zero = v.same(v.F32, 0.0, lanes)
            at = b.add(slot, b.shl(first, v.int64(1)))
            for j, total in enumerate(v.emit_loop(b, cuts, [zero] * (2 * size), one)):
                place = b.gep(out, [b.add(at, v.int64(j))])
                more = b.fpext(v.emit_sum(b, total), ir.DoubleType())
                b.store(b.fadd(b.load(place), more), place)
            return []

        threes = b.sdiv(taps, v.int64(3))
        v.emit_loop(b, threes, [], lambda k: together(b.mul(k, v.int64(3)), 3))
        done = b.mul(threes, v.int64(3))
        v.emit_loop(b, b.sub(taps, done), [], lambda k: together(b.add(done, k), 1))
        return context.get_dummy_value()

    return types.void(*kinds), codegen


@intrinsic
def prefix_16(typingctx: Any, samples: Any, first: Any, n: Any, prefix: Any) -> Any:
    """`prefix_plain` in 16 lanes."""
    return _prefix(16, samples, prefix)


@intrinsic
def prefix_8(typingctx: Any, samples: Any, first: Any, n: Any, prefix: Any) -> Any:
    """`prefix_plain` in 8 lanes."""
    return _prefix(8, samples, prefix)


@intrinsic
def turn_16(
    typingctx: Any, edges: Any, pitch: Any, cuts: Any, vectors: Any, phase: Any, ahead: Any,
    t0: Any, dt: Any, w: Any, facts: Any, bins: Any,
) -> Any:  # fmt: skip
    """`turn_plain` in 16 lanes."""
    return _turn(16, edges, facts, bins)


@intrinsic
def turn_8(
    typingctx: Any, edges: Any, pitch: Any, cuts: Any, vectors: Any, phase: Any, ahead: Any,
    t0: Any, dt: Any, w: Any, facts: Any, bins: Any,
) -> Any:  # fmt: skip
    """`turn_plain` in 8 lanes."""
    return _turn(8, edges, facts, bins)


@intrinsic
def add_16(
    typingctx: Any, bins: Any, pitch: Any, cuts: Any, vectors: Any, table: Any, starts: Any,
    taps: Any, sums: Any, slot: Any,
) -> Any:  # fmt: skip
    """`add_plain` in 16 lanes."""
    return _add(16, bins, table, starts, sums)


@intrinsic
def add_8(
    typingctx: Any, bins: Any, pitch: Any, cuts: Any, vectors: Any, table: Any, starts: Any,
    taps: Any, sums: Any, slot: Any,
) -> Any:  # fmt: skip
    """`add_plain` in 8 lanes."""
    return _add(8, bins, table, starts, sums)
