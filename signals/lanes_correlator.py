"""The correlator's inner loops in explicit vectors, and the plain twin of each.

Per cell and channel 8 vector instructions per vector wipe the carrier off, 5 per tap and vector
look the code up and add.  All is float32, at any Doppler and any delay; `signals.exact` joins the
pieces, `signals.cpu` chooses between 16 lanes, 8 lanes and the twins.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from signals import lanes as v
from signals.compiled import FAST_SUM, kernel
from signals.elementary import cos_sin, wrap

STRIDE = 64
"""Samples that share a coarse carrier phasor: two short tables replace a sine per sample"""

SPAN = 2048
"""Most samples in a cell"""

PHASE_BITS = 48
"""A carrier phase of 2^48 is one cycle: a step of half a unit is 4e-12 cycles after a cell"""

_GROUP = {16: 4, 8: 2}  # vectors that share a window of the code
_COARSE = SPAN // STRIDE
_LOW = PHASE_BITS - 32
_F = np.float32


# ---- plain twins -----------------------------------------------------------------------------


@kernel
def planar_plain(block: np.ndarray, n: int, i: np.ndarray, q: np.ndarray) -> None:
    """n samples I, Q, I, Q ... (int8 or float32) to float32 i and q."""
    for j in range(n):
        i[j] = _F(block[2 * j])
        q[j] = _F(block[2 * j + 1])


@kernel(fastmath=FAST_SUM)
def wipe_plain(
    i: np.ndarray,
    q: np.ndarray,
    n: int,
    base: Any,
    step: Any,
    bend: Any,
    wi: np.ndarray,
    wq: np.ndarray,
) -> None:
    """n samples times the conjugate carrier into wi, wq; whole strides, the last overruns n.

    The phase of sample j is base + step j + bend j (n - j), the bend as in the middle of the
    stride; base and step are int64 [2^-48 cycles], bend is float32 [2^-32 cycles].
    """
    fine_c, fine_s = np.empty(STRIDE, np.float32), np.empty(STRIDE, np.float32)
    step_32 = np.int64(step) >> _LOW
    for k in range(STRIDE):
        fine_c[k], fine_s[k] = cos_sin(wrap(np.int64(np.int32(k)) * step_32))
    for m in range((n + STRIDE - 1) // STRIDE):
        start = np.uint64(m * STRIDE)
        j = _F(m * STRIDE + STRIDE // 2)
        bow = np.int64(np.int32(bend * j * (_F(n) - j)))
        c, s = cos_sin(wrap(((base + m * (STRIDE * step)) >> _LOW) + bow))
        for k in range(np.uint64(fine_c.shape[0])):
            u = i[start + k] * c + q[start + k] * s
            w = q[start + k] * c - i[start + k] * s
            wi[start + k] = u * fine_c[k] + w * fine_s[k]
            wq[start + k] = w * fine_c[k] - u * fine_s[k]


@kernel(fastmath=FAST_SUM)
def add_plain(
    wi: np.ndarray, wq: np.ndarray, a: int, b: int, table: np.ndarray, phase: Any, step: Any
) -> tuple[Any, Any]:
    """Sums of wi and wq over samples a ... b - 1 times the table under an index phase.

    ``phase``, at sample a, and ``step`` are int64 [2^-32 entries], neither negative.
    """
    x, y = wi[a:b], wq[a:b]
    si, sq = _F(0.0), _F(0.0)
    code, ahead = np.uint64(phase), np.uint64(step)  # a running sum: no fast 64-bit product
    for j in range(x.shape[0]):
        chip = table[code >> np.uint64(32)]
        si += x[j] * chip
        sq += y[j] * chip
        code += ahead
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
    kinds = (arrays, arrays, types.int64, types.int64, types.int64, types.float32, arrays, arrays)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        i, q, wi, wq = (
            v.data_pointer(context, builder, signature.args[k], args[k]) for k in (0, 1, 6, 7)
        )
        n, base, step, bend = args[2:6]
        strides = builder.sdiv(builder.add(n, v.int64(STRIDE - 1)), v.int64(STRIDE))
        coarse = [v.emit_stack(builder, v.F32, _COARSE) for _ in range(2)]
        _emit_coarse(builder, lanes, coarse, strides, (n, base, step, bend))
        fine_step = builder.trunc(builder.ashr(step, v.int64(_LOW)), v.I32)
        fine_step = v.emit_splat(builder, fine_step, lanes)
        fine = [
            v.emit_cos_sin(builder, builder.mul(fine_step, v.vector(v.I32, range(k, k + lanes))))
            for k in range(0, STRIDE, lanes)
        ]

        def stride(m: Any) -> list[Any]:
            c, s = (
                v.emit_splat(builder, builder.load(builder.gep(table, [m])), lanes)
                for table in coarse
            )
            at = builder.mul(m, v.int64(STRIDE))
            for k, (fine_c, fine_s) in enumerate(fine):
                here = builder.add(at, v.int64(k * lanes))
                turned = v.emit_rotate(builder, fine_c, fine_s, c, s)
                x, y = (v.emit_load(builder, source, here, lanes) for source in (i, q))
                re, im = v.emit_rotate_back(builder, x, y, *turned)
                v.emit_store(builder, re, wi, here)
                v.emit_store(builder, im, wq, here)
            return []

        v.emit_loop(builder, strides, [], stride)
        return context.get_dummy_value()

    return types.void(*kinds), codegen


def _emit_coarse(builder: Any, lanes: int, coarse: Any, strides: Any, line: Any) -> None:
    """Phasors at the first sample of each stride, with the bend of its middle."""
    n, base, step, bend = line
    ints, last = ir.VectorType(v.I32, lanes), builder.sitofp(n, v.F32)
    last, curve = v.emit_splat(builder, last, lanes), v.emit_splat(builder, bend, lanes)
    step = builder.mul(step, v.int64(STRIDE))
    ahead = v.emit_splat(builder, builder.mul(step, v.int64(lanes)), lanes)
    phase = builder.mul(v.emit_splat(builder, step, lanes), v.vector(v.I64, range(lanes)))
    phase = builder.add(v.emit_splat(builder, base, lanes), phase)
    middle = v.vector(v.F32, [STRIDE * k + STRIDE // 2 for k in range(lanes)])

    def some(k: Any, phase: Any, j: Any) -> list[Any]:
        turn = builder.trunc(builder.ashr(phase, v.same(v.I64, _LOW, lanes)), ints)
        bow = builder.fmul(builder.fmul(curve, j), builder.fsub(last, j))
        turn = builder.add(turn, builder.fptosi(bow, ints))
        at = builder.mul(k, v.int64(lanes))
        for value, table in zip(v.emit_cos_sin(builder, turn), coarse, strict=True):
            v.emit_store(builder, value, table, at)
        return [builder.add(phase, ahead), builder.fadd(j, v.same(v.F32, lanes * STRIDE, lanes))]

    count = builder.sdiv(builder.add(strides, v.int64(lanes - 1)), v.int64(lanes))
    v.emit_loop(builder, count, [phase, middle], some)


def _add(lanes: int, arrays: Any, table: Any, phases: Any) -> Any:
    """Typing and code of ``add_16`` and ``add_8``: `add_plain` of as many taps as phases."""
    taps = len(phases)
    whole = types.int64
    kinds = (arrays, arrays, whole, whole, table, whole, phases, whole)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointers = [v.data_pointer(context, builder, signature.args[k], args[k]) for k in (0, 1, 4)]
        pointers[2] = builder.gep(pointers[2], [args[5]])
        codes = [builder.extract_value(args[6], k) for k in range(taps)]
        sums = _emit_sums(builder, lanes, pointers, args[2:4], codes, args[7])
        return context.make_tuple(builder, signature.return_type, sums)

    return types.UniTuple(types.float32, 2 * taps)(*kinds), codegen


def _emit_sums(
    builder: Any, lanes: int, pointers: Any, span: Any, codes: list[Any], step: Any
) -> list[Any]:
    """Groups of vectors that share a window, then vectors one by one, the last one in part."""
    first, end = span
    group, taps = _GROUP[lanes], len(codes)
    chains = 2 if taps == 1 else 1  # a lone tap would wait for its own additions
    sums = [v.same(v.F32, 0.0, lanes)] * (2 * taps * chains)
    ahead = [v.emit_lane_steps(builder, step, lanes, k * lanes) for k in range(group)]

    def some(vectors: int, tail: bool) -> Any:
        jump = builder.mul(step, v.int64(vectors * lanes))

        def body(_: Any, at: Any, *state: Any) -> list[Any]:
            codes, sums = list(state[:taps]), list(state[taps:])
            relatives = [v.emit_relative(builder, code, lanes) for code in codes]
            windows = [v.emit_window(builder, pointers[2], code, lanes) for code in codes]
            for k in range(vectors):
                here = builder.add(at, v.int64(k * lanes))
                x, y = (v.emit_load(builder, source, here, lanes) for source in pointers[:2])
                if tail:
                    left = builder.sub(end, at)
                    x, y = (v.emit_first(builder, value, left) for value in (x, y))
                for tap in range(taps):
                    relative = builder.add(relatives[tap], ahead[k])
                    chip = v.emit_look_up(builder, windows[tap], relative)
                    s = 2 * (tap + k % chains)
                    sums[s] = v.emit_fma(builder, x, chip, sums[s])
                    sums[s + 1] = v.emit_fma(builder, y, chip, sums[s + 1])
            codes = [builder.add(code, jump) for code in codes]
            return [builder.add(at, v.int64(vectors * lanes)), *codes, *sums]

        return body

    together = v.int64(int(v.reach(lanes, group * lanes) * 2**32))
    groups = builder.sdiv(builder.sub(end, first), v.int64(group * lanes))
    groups = builder.select(builder.icmp_signed("<=", step, together), groups, v.int64(0))
    state = v.emit_loop(builder, groups, [first, *codes, *sums], some(group, tail=False))
    rest = builder.add(builder.sub(end, state[0]), v.int64(lanes - 1))
    rest = builder.sdiv(rest, v.int64(lanes))
    sums = v.emit_loop(builder, rest, state, some(1, tail=True))[1 + taps :]
    if chains == 2:
        sums = [builder.fadd(sums[k], sums[k + 2]) for k in range(2)]
    return [v.emit_sum(builder, s) for s in sums]


@intrinsic
def planar_16(typingctx: Any, block: Any, first: Any, n: Any, i: Any, q: Any) -> Any:
    return _planar(16, block, i)


@intrinsic
def planar_8(typingctx: Any, block: Any, first: Any, n: Any, i: Any, q: Any) -> Any:
    return _planar(8, block, i)


@intrinsic
def wipe_16(
    typingctx: Any, i: Any, q: Any, n: Any, base: Any, step: Any, bend: Any, wi: Any, wq: Any
) -> Any:
    return _wipe(16, i)


@intrinsic
def wipe_8(
    typingctx: Any, i: Any, q: Any, n: Any, base: Any, step: Any, bend: Any, wi: Any, wq: Any
) -> Any:
    return _wipe(8, i)


@intrinsic
def add_16(
    typingctx: Any,
    wi: Any,
    wq: Any,
    a: Any,
    b: Any,
    table: Any,
    origin: Any,
    phases: Any,
    step: Any,
) -> Any:
    return _add(16, wi, table, phases)


@intrinsic
def add_8(
    typingctx: Any,
    wi: Any,
    wq: Any,
    a: Any,
    b: Any,
    table: Any,
    origin: Any,
    phases: Any,
    step: Any,
) -> Any:
    return _add(8, wi, table, phases)
