"""The correlator's inner loops in explicit vectors, and the plain twin of each.

Per cell and channel 5 vector instructions per vector wipe the carrier off, 5 more per tap and
vector look the code up and add.  All is float32, at any Doppler and any delay.  The carrier of a
sample is a phasor of its place in its stride, the same for all strides, times one of the stride:
samples meet the first, sums the second.  `signals.exact` joins the pieces, `signals.cpu` chooses
between 16 lanes, 8 lanes and the twins.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from signals import lanes as v
from signals.compiled import FAST_SUM, borrowing
from signals.elementary import cos_sin, wrap

SPAN = 2048
"""Most samples in a cell"""

STRIDE = 256
"""Samples that are turned by the same phasors, whatever the stride's own phase"""

STRIDES = SPAN // STRIDE
TURNS = 4 * STRIDES + 2 * STRIDE

PHASE_BITS = 48
"""A carrier phase of 2^48 is one cycle: a step of half a unit is 4e-12 cycles after a cell"""

_GROUP = {16: 4, 8: 2}  # vectors that share a window of the code
_LOW = PHASE_BITS - 32
_F = np.float32


# ---- plain twins -----------------------------------------------------------------------------


@borrowing
def planar_plain(block: np.ndarray, n: int, i: np.ndarray, q: np.ndarray) -> None:
    """n samples I, Q, I, Q ... (int8 or float32) to float32 i and q."""
    for j in range(n):
        i[j] = _F(block[2 * j])
        q[j] = _F(block[2 * j + 1])


@borrowing(fastmath=FAST_SUM)
def wipe_plain(
    i: np.ndarray,
    q: np.ndarray,
    n: int,
    base: Any,
    step: Any,
    bend: Any,
    wi: np.ndarray,
    wq: np.ndarray,
    turns: np.ndarray,
) -> None:
    """n samples times the conjugate carrier of their stride into wi, wq; the last overruns n.

    The phase of sample j is base + step j + bend j (n - j), the bend as in the middle of the
    stride; base and step are int64 [2^-48 cycles], bend is float32 [2^-32 cycles].  What the sums
    are still to be turned by goes to ``turns`` (`TURNS`,): cos of the phase of each stride's first
    sample, cos of the way from there to the next stride's, the sines of both; then scratch.
    """
    base, step = np.int64(base), np.int64(step)
    then = np.int64(0)
    for m in range(STRIDES + 1):
        j = _F(np.int32(m * STRIDE + STRIDE // 2))
        bow = np.int64(np.int32(bend * j * (_F(np.int32(n)) - j)))
        now = ((base + m * (STRIDE * step)) >> _LOW) + bow
        if m > 0:
            turns[STRIDES + m - 1], turns[3 * STRIDES + m - 1] = cos_sin(wrap(now - then))
        if m < STRIDES:
            turns[m], turns[2 * STRIDES + m] = cos_sin(wrap(now))
        then = now
    c, s = turns[4 * STRIDES : 4 * STRIDES + STRIDE], turns[4 * STRIDES + STRIDE :]
    for k in range(STRIDE):
        c[k], s[k] = cos_sin(wrap((k * step) >> _LOW))
    for m in range((n + STRIDE - 1) // STRIDE):
        start = np.uint64(m * STRIDE)
        for k in range(np.uint64(c.shape[0])):
            wi[start + k] = i[start + k] * c[k] + q[start + k] * s[k]
            wq[start + k] = q[start + k] * c[k] - i[start + k] * s[k]


@borrowing(fastmath=FAST_SUM)
def add_plain(
    wi: np.ndarray,
    wq: np.ndarray,
    a: int,
    b: int,
    table: np.ndarray,
    phase: Any,
    step: Any,
    turns: np.ndarray,
) -> tuple[Any, Any]:
    """Sums over samples a ... b - 1, a < b, of `wipe_plain` times the table under an index phase.

    ``phase``, at sample a, and ``step`` are int64 [2^-32 entries], neither negative.
    """
    si, sq = _F(0.0), _F(0.0)
    code, ahead = np.uint64(phase), np.uint64(step)  # a running sum: no fast 64-bit product
    last = (b - 1) // STRIDE
    for m in range(a // STRIDE, last + 1):
        start, end = max(a, m * STRIDE), min(b, (m + 1) * STRIDE)
        x, y = wi[start:end], wq[start:end]
        for j in range(x.shape[0]):
            chip = table[code >> np.uint64(32)]
            si += x[j] * chip
            sq += y[j] * chip
            code += ahead
        if m < last:
            c, s = turns[STRIDES + m], turns[3 * STRIDES + m]
        else:
            c, s = turns[m], -turns[2 * STRIDES + m]
        si, sq = si * c - sq * s, si * s + sq * c
    return si, sq


# ---- in vectors ------------------------------------------------------------------------------


def _planar(lanes: int, block: Any, planes: Any) -> Any:
    """Typing and code of ``planar_16`` and ``planar_8``: whole vectors of `planar_plain`."""
    kinds = (block, types.int64, types.int64, planes, planes)
    narrow = block.dtype == types.int8

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source, i, q = (
            v.data_pointer(context, builder, signature.args[k], args[k]) for k in (0, 3, 4)
        )

        def some(k: Any) -> list[Any]:
            at = builder.mul(k, v.int64(lanes))
            here = builder.add(args[1], at)
            split = v.emit_split_int8 if narrow else v.emit_split_float32
            for value, plane in zip(split(builder, source, here, lanes), (i, q), strict=True):
                v.emit_store(builder, value, plane, at)
            return []

        v.emit_loop(builder, builder.sdiv(args[2], v.int64(lanes)), [], some)
        return context.get_dummy_value()

    return types.void(*kinds), codegen


def _wipe(lanes: int, arrays: Any) -> Any:
    """Typing and code of ``wipe_16`` and ``wipe_8``: `wipe_plain`."""
    whole = types.int64
    kinds = (arrays, arrays, whole, whole, whole, types.float32, arrays, arrays, arrays)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        i, q, wi, wq, turns = (
            v.data_pointer(context, builder, signature.args[k], args[k]) for k in (0, 1, 6, 7, 8)
        )
        n, step = args[2], args[4]
        _emit_turns(builder, lanes, turns, args[2:6])
        coarse = _emit_multiples(builder, lanes, step)
        low = builder.trunc(builder.ashr(step, v.int64(_LOW)), v.I32)
        fine = builder.mul(v.emit_splat(builder, low, lanes), v.vector(v.I32, range(lanes)))
        fine_c, fine_s = v.emit_cos_sin(builder, fine)
        strides = builder.sdiv(builder.add(n, v.int64(STRIDE - 1)), v.int64(STRIDE))

        def place(k: Any) -> list[Any]:
            c, s = (
                v.emit_splat(builder, builder.load(builder.gep(table, [k])), lanes)
                for table in coarse
            )
            c, s = v.emit_rotate(builder, fine_c, fine_s, c, s)
            first = builder.mul(k, v.int64(lanes))

            def stride(m: Any) -> list[Any]:
                at = builder.add(first, builder.mul(m, v.int64(STRIDE)))
                x, y = (v.emit_load(builder, source, at, lanes) for source in (i, q))
                re, im = v.emit_rotate_back(builder, x, y, c, s)
                v.emit_store(builder, re, wi, at)
                v.emit_store(builder, im, wq, at)
                return []

            return v.emit_loop(builder, strides, [], stride)

        v.emit_loop(builder, v.int64(STRIDE // lanes), [], place)
        return context.get_dummy_value()

    return types.void(*kinds), codegen


def _emit_multiples(builder: Any, lanes: int, step: Any) -> list[Any]:
    """Phasors of the first samples of a stride's vectors, on the stack: cos and sin."""
    count = STRIDE // lanes
    tables = [v.emit_stack(builder, v.F32, count) for _ in range(2)]
    steps = v.emit_splat(builder, step, lanes)
    for k in range(0, count, lanes):
        ahead = builder.mul(steps, v.vector(v.I64, range(k * lanes, (k + lanes) * lanes, lanes)))
        for value, table in zip(
            v.emit_cos_sin(builder, _emit_low(builder, ahead)), tables, strict=True
        ):
            v.emit_store(builder, value, table, v.int64(k))
    return tables


def _emit_low(builder: Any, phase: Any) -> Any:
    """int64 phases [2^-48 cycles] as int32 [2^-32 cycles]."""
    lanes = phase.type.count
    low = builder.ashr(phase, v.same(v.I64, _LOW, lanes))
    return builder.trunc(low, ir.VectorType(v.I32, lanes))


def _emit_turns(builder: Any, lanes: int, turns: Any, line: Any) -> None:
    """Phasors of the strides, and from each to the next."""
    n, base, step, bend = line
    last = v.emit_splat(builder, builder.sitofp(n, v.F32), lanes)
    curve, bases = v.emit_splat(builder, bend, lanes), v.emit_splat(builder, base, lanes)
    steps = v.emit_splat(builder, builder.mul(step, v.int64(STRIDE)), lanes)

    def phases(strides: list[int]) -> Any:
        ahead = builder.mul(steps, v.vector(v.I64, strides))
        j = v.vector(v.F32, [STRIDE * m + STRIDE // 2 for m in strides])
        bow = builder.fmul(builder.fmul(curve, j), builder.fsub(last, j))
        low = _emit_low(builder, builder.add(bases, ahead))
        return builder.add(low, builder.fptosi(bow, low.type))

    for k in range(0, 2 * STRIDES, lanes):
        own = range(k, k + lanes)
        here = phases([m if m < STRIDES else m - STRIDES + 1 for m in own])
        there = phases([max(m - STRIDES, 0) for m in own])
        second = v.vector(ir.IntType(1), [int(m >= STRIDES) for m in own])
        here = builder.sub(here, builder.select(second, there, v.same(v.I32, 0, lanes)))
        for row, value in enumerate(v.emit_cos_sin(builder, here)):
            v.emit_store(builder, value, turns, v.int64(2 * STRIDES * row + k))


def _add(lanes: int, arrays: Any, table: Any, phases: Any) -> Any:
    """Typing and code of ``add_16`` and ``add_8``: `add_plain` of as many taps as phases."""
    taps, whole = len(phases), types.int64
    kinds = (arrays, arrays, whole, whole, table, whole, phases, whole, arrays)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        wi, wq, chips, turns = (
            v.data_pointer(context, builder, signature.args[k], args[k]) for k in (0, 1, 4, 8)
        )
        codes = [builder.extract_value(args[6], k) for k in range(taps)]
        pointers = wi, wq, builder.gep(chips, [args[5]])
        sums = _emit_sums(builder, lanes, pointers, turns, args[2:4], codes, args[7])
        return context.make_tuple(builder, signature.return_type, sums)

    return types.UniTuple(types.float32, 2 * taps)(*kinds), codegen


def _emit_sums(
    builder: Any, lanes: int, pointers: Any, turns: Any, span: Any, codes: list[Any], step: Any
) -> list[Any]:
    """Stride by stride: groups of vectors that share a window, single vectors, the turn."""
    first, end = span
    group, taps = _GROUP[lanes], len(codes)
    sums = [v.same(v.F32, 0.0, lanes)] * (2 * taps)
    ahead = [v.emit_lane_steps(builder, step, lanes, k * lanes) for k in range(group)]
    together = v.int64(int(v.reach(lanes, group * lanes) * 2**32))
    near = builder.icmp_signed("<=", step, together)
    final = builder.sdiv(builder.sub(end, v.int64(1)), v.int64(STRIDE))
    begin = builder.sdiv(first, v.int64(STRIDE))

    def stride(k: Any, at: Any, *state: Any) -> list[Any]:
        m = builder.add(begin, k)
        whole = builder.icmp_signed("<", m, final)
        border = builder.mul(builder.add(m, v.int64(1)), v.int64(STRIDE))
        stop = builder.select(whole, border, end)
        ways = builder.mul(step, builder.sub(stop, at))  # a partial vector ends before its lanes do
        codes = [builder.add(code, ways) for code in state[:taps]]
        groups = builder.sdiv(builder.sub(stop, at), v.int64(group * lanes))
        groups = builder.select(near, groups, v.int64(0))
        some = _emit_vectors(builder, pointers, step, ahead, None)
        now = v.emit_loop(builder, groups, [at, *state], some)
        rest = builder.add(builder.sub(stop, now[0]), v.int64(lanes - 1))
        rest = builder.sdiv(rest, v.int64(lanes))
        some = _emit_vectors(builder, pointers, step, ahead[:1], stop)
        now = v.emit_loop(builder, rest, now, some)
        row = builder.select(whole, builder.add(m, v.int64(STRIDES)), m)
        c, s = (
            builder.load(builder.gep(turns, [builder.add(row, v.int64(k))]))
            for k in (0, 2 * STRIDES)
        )
        s = builder.select(whole, s, builder.fneg(s))
        c, s = (v.emit_splat(builder, value, lanes) for value in (c, s))
        sums = now[1 + taps :]
        for tap in range(taps):
            i, q = sums[2 * tap : 2 * tap + 2]
            sums[2 * tap : 2 * tap + 2] = v.emit_rotate(builder, i, q, c, s)
        return [stop, *codes, *sums]

    count = builder.add(builder.sub(final, begin), v.int64(1))
    state = v.emit_loop(builder, count, [first, *codes, *sums], stride)
    return [v.emit_sum(builder, value) for value in state[1 + taps :]]


def _emit_vectors(builder: Any, pointers: Any, step: Any, ahead: list[Any], stop: Any) -> Any:
    """Body of a loop over groups of as many vectors as ``ahead`` has; up to ``stop`` if given."""
    lanes = ahead[0].type.count
    samples = len(ahead) * lanes
    jump = builder.mul(step, v.int64(samples))

    def body(_: Any, at: Any, *state: Any) -> list[Any]:
        taps = len(state) // 3
        codes, sums = list(state[:taps]), list(state[taps:])
        relatives = [v.emit_relative(builder, code, lanes) for code in codes]
        windows = [v.emit_window(builder, pointers[2], code, lanes) for code in codes]
        for k, lane_steps in enumerate(ahead):
            here = builder.add(at, v.int64(k * lanes))
            x, y = (v.emit_load(builder, source, here, lanes) for source in pointers[:2])
            if stop is not None:
                left = builder.sub(stop, at)
                x, y = (v.emit_first(builder, value, left) for value in (x, y))
            for tap in range(taps):
                relative = builder.add(relatives[tap], lane_steps)
                chip = v.emit_look_up(builder, windows[tap], relative)
                sums[2 * tap] = v.emit_fma(builder, x, chip, sums[2 * tap])
                sums[2 * tap + 1] = v.emit_fma(builder, y, chip, sums[2 * tap + 1])
        codes = [builder.add(code, jump) for code in codes]
        return [builder.add(at, v.int64(samples)), *codes, *sums]

    return body


@intrinsic
def planar_16(typingctx: Any, block: Any, first: Any, n: Any, i: Any, q: Any) -> Any:
    return _planar(16, block, i)


@intrinsic
def planar_8(typingctx: Any, block: Any, first: Any, n: Any, i: Any, q: Any) -> Any:
    return _planar(8, block, i)


@intrinsic
def wipe_16(
    typingctx: Any, i: Any, q: Any, n: Any, base: Any,
    step: Any, bend: Any, wi: Any, wq: Any, turns: Any,
) -> Any:  # fmt: skip
    return _wipe(16, i)


@intrinsic
def wipe_8(
    typingctx: Any, i: Any, q: Any, n: Any, base: Any,
    step: Any, bend: Any, wi: Any, wq: Any, turns: Any,
) -> Any:  # fmt: skip
    return _wipe(8, i)


@intrinsic
def add_16(
    typingctx: Any, wi: Any, wq: Any, a: Any, b: Any,
    table: Any, origin: Any, phases: Any, step: Any, turns: Any,
) -> Any:  # fmt: skip
    return _add(16, wi, table, phases)


@intrinsic
def add_8(
    typingctx: Any, wi: Any, wq: Any, a: Any, b: Any,
    table: Any, origin: Any, phases: Any, step: Any, turns: Any,
) -> Any:  # fmt: skip
    return _add(8, wi, table, phases)
