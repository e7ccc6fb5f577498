"""Building blocks of explicit vector code: functions that emit LLVM instructions.

LLVM does not vectorise a table look-up into an in-register permute, nor does it use 512-bit
registers unasked.  Loops that live from both are therefore written as numba intrinsics with the
blocks below.  Every ``emit_...`` takes an llvmlite ``IRBuilder`` first, and ``lanes``, 16
(AVX-512) or 8 (AVX2 and FMA), where it cannot be told from an operand; values are LLVM values.

How to write a kernel with them::

    def _twice(typingctx, x, n):  # arrays of float32, contiguous; n of them, whole vectors
        def codegen(context, builder, signature, args):
            src = data_pointer(context, builder, signature.args[0], args[0])
            def body(k, total):
                v = emit_load(builder, src, builder.mul(k, int64(lanes)), lanes)
                ...
            emit_loop(builder, count, carried, body)
        return signature, codegen

and ``twice_16 = intrinsic(...)`` at module level: in a closure numba's disk cache never hits.
Each intrinsic has a plain twin that serves every other machine and NUMBA_DISABLE_JIT=1, and a row
in `signals.cpu.check`, which holds the two together.

A *look-up* reads a table at an arithmetic sequence of indices.  It loads a window of
``WINDOW[lanes]`` entries from the index of the first sample on and permutes it: the index of a
lane relative to that start, with its fraction, is an unsigned 32-bit number whose full turn is
the window (`emit_relative`, `emit_lane_steps`, `emit_look_up`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils

from signals import elementary

F32, F64, I16, I32, I64 = (
    ir.FloatType(),
    ir.DoubleType(),
    ir.IntType(16),
    ir.IntType(32),
    ir.IntType(64),
)

WINDOW = {16: 32, 8: 8}
"""Table entries within reach of a look-up: vpermi2ps has two registers of 16, vpermps one of 8"""

_INDEX_SHIFT = {16: 27, 8: 29}
_GUARD = 2.0**-20


def reach(lanes: int, samples: int) -> float:
    """Largest index step per sample at which ``samples`` consecutive ones share a window."""
    return (WINDOW[lanes] - 1 - _GUARD) / (samples - 1)


# ---- values ----------------------------------------------------------------------------------


def int32(value: int) -> ir.Constant:
    return ir.Constant(I32, value)


def int64(value: int) -> ir.Constant:
    return ir.Constant(I64, value)


def vector(element: ir.Type, values: Sequence[Any]) -> ir.Constant:
    """Constant vector; floats are rounded to float32 first, as LLVM's text form demands."""
    if element == F32:
        values = [float(np.float32(v)) for v in values]
    return ir.Constant(ir.VectorType(element, len(values)), list(values))


def same(element: ir.Type, value: Any, lanes: int) -> ir.Constant:
    """Constant vector with the same value in every lane."""
    return vector(element, [value] * lanes)


def emit_splat(builder: Any, scalar: Any, lanes: int) -> Any:
    """Vector with ``scalar`` in every lane."""
    kind = ir.VectorType(scalar.type, lanes)
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, int32(0))
    return builder.shuffle_vector(one, ir.Constant(kind, ir.Undefined), same(I32, 0, lanes))


# ---- memory ----------------------------------------------------------------------------------


def data_pointer(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    """Pointer to the first element of a numba array argument."""
    return context.make_array(kind)(context, builder, array).data


def emit_address(builder: Any, pointer: Any, index: Any, lanes: int, element: Any = F32) -> Any:
    """Pointer to a vector that starts at element ``index``."""
    at = builder.gep(builder.bitcast(pointer, element.as_pointer()), [index])
    return builder.bitcast(at, ir.VectorType(element, lanes).as_pointer())


def emit_load(builder: Any, pointer: Any, index: Any, lanes: int, element: Any = F32) -> Any:
    """Vector from element ``index`` on, at any alignment."""
    at = emit_address(builder, pointer, index, lanes, element)
    return builder.load(at, align=_bytes(element))


def emit_store(builder: Any, value: Any, pointer: Any, index: Any) -> None:
    """Store a vector to element ``index`` on, at any alignment."""
    element = value.type.element
    at = emit_address(builder, pointer, index, value.type.count, element)
    builder.store(value, at, align=_bytes(element))


def emit_split_int8(builder: Any, pointer: Any, index: Any, lanes: int) -> tuple[Any, Any]:
    """I and Q as float32 of interleaved int8 samples ``index`` and on."""
    wide = ir.VectorType(I32, lanes)
    pairs = builder.sext(emit_load(builder, pointer, index, lanes, I16), wide)
    i = builder.ashr(builder.shl(pairs, same(I32, 24, lanes)), same(I32, 24, lanes))
    q = builder.ashr(pairs, same(I32, 8, lanes))
    floats = ir.VectorType(F32, lanes)
    return builder.sitofp(i, floats), builder.sitofp(q, floats)


def emit_split_float32(builder: Any, pointer: Any, index: Any, lanes: int) -> tuple[Any, Any]:
    """I and Q of interleaved float32 samples ``index`` and on."""
    at = builder.shl(index, int64(1))
    a = emit_load(builder, pointer, at, lanes)
    b = emit_load(builder, pointer, builder.add(at, int64(lanes)), lanes)
    i, q = (builder.shuffle_vector(a, b, vector(I32, range(k, 2 * lanes, 2))) for k in (0, 1))
    return i, q


def _bytes(element: ir.Type) -> int:
    return {F32: 4, F64: 8}.get(element) or element.width // 8


def emit_stack(builder: Any, element: ir.Type, count: int) -> Any:
    """Scratch memory of the function for ``count`` elements, 64-byte aligned."""
    memory = cgutils.alloca_once(builder, ir.ArrayType(element, count))
    memory.align = 64
    return builder.bitcast(memory, element.as_pointer())


# ---- control ---------------------------------------------------------------------------------


def emit_loop(
    builder: Any, count: Any, carried: Sequence[Any], body: Callable[..., Sequence[Any]]
) -> list[Any]:
    """``for k in range(count): carried = body(k, *carried)``; the last values (int64 count)."""
    before = builder.block
    head, done = (builder.append_basic_block(name) for name in ("loop", "done"))
    builder.cbranch(builder.icmp_signed(">", count, int64(0)), head, done)
    builder.position_at_end(head)
    k = builder.phi(I64)
    k.add_incoming(int64(0), before)
    now = [builder.phi(v.type) for v in carried]
    for phi, start in zip(now, carried, strict=True):
        phi.add_incoming(start, before)
    after = list(body(k, *now))
    end = builder.block
    next_k = builder.add(k, int64(1))
    k.add_incoming(next_k, end)
    builder.cbranch(builder.icmp_signed("<", next_k, count), head, done)
    builder.position_at_end(done)
    last = [builder.phi(v.type) for v in carried]
    for phi, out, start, value in zip(now, last, carried, after, strict=True):
        phi.add_incoming(value, end)
        out.add_incoming(start, before)
        out.add_incoming(value, end)
    return last


# ---- arithmetic ------------------------------------------------------------------------------


def emit_fma(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """a b + c of float32 vectors, rounded once."""
    return call(builder, f"llvm.fma.v{a.type.count}f32", a.type, [a, b, c])


def emit_rotate(builder: Any, i: Any, q: Any, c: Any, s: Any) -> tuple[Any, Any]:
    """(i + j q) (c + j s): the step of a phasor recurrence; with i, q samples a modulator."""
    re = emit_fma(builder, i, c, builder.fneg(builder.fmul(q, s)))
    return re, emit_fma(builder, i, s, builder.fmul(q, c))


def emit_rotate_back(builder: Any, i: Any, q: Any, c: Any, s: Any) -> tuple[Any, Any]:
    """(i + j q) (c - j s): carrier wipe-off."""
    re = emit_fma(builder, q, s, builder.fmul(i, c))
    return re, emit_fma(builder, q, c, builder.fneg(builder.fmul(i, s)))


def emit_cos_sin(builder: Any, phase: Any) -> tuple[Any, Any]:
    """cos and sin of int32 phases [2^-32 cycles] as float32; see `elementary.cos_sin`."""
    lanes, quarter = phase.type.count, same(I32, 0x40000000, phase.type.count)

    def sine_of_rest(p: Any) -> Any:
        negative = builder.icmp_signed("<", p, same(I32, 0, lanes))
        size = builder.select(negative, builder.sub(same(I32, 0, lanes), p), p)
        turn = builder.sitofp(builder.sub(quarter, size), ir.VectorType(F32, lanes))
        x = builder.fmul(turn, same(F32, elementary.RAD, lanes))
        z = builder.fmul(x, x)
        total = same(F32, elementary.SINE[-1], lanes)
        for c in elementary.SINE[-2::-1]:
            total = emit_fma(builder, total, z, same(F32, c, lanes))
        return emit_fma(builder, builder.fmul(x, z), total, x)

    return sine_of_rest(phase), sine_of_rest(builder.sub(phase, quarter))


def emit_sum(builder: Any, value: Any) -> Any:
    """Sum over the lanes of a float32 vector, pairwise."""
    while (lanes := value.type.count) > 1:
        none = ir.Constant(value.type, ir.Undefined)
        halves = (
            builder.shuffle_vector(value, none, vector(I32, range(start, start + lanes // 2)))
            for start in (0, lanes // 2)
        )
        value = builder.fadd(*halves)
    return builder.extract_element(value, int32(0))


def emit_first(builder: Any, value: Any, count: Any) -> Any:
    """The first ``count`` (int64) lanes of a float32 vector, zero in the others."""
    lanes = value.type.count
    wanted = emit_splat(builder, builder.trunc(count, I32), lanes)
    kept = builder.icmp_signed("<", vector(I32, range(lanes)), wanted)
    return builder.select(kept, value, same(F32, 0.0, lanes))


# ---- look-up ---------------------------------------------------------------------------------


def emit_relative(builder: Any, phase: Any, lanes: int) -> Any:
    """Fraction of an index phase (int64 [2^-32 entries]) as a number whose turn is a window."""
    fraction = builder.trunc(phase, I32)
    return emit_splat(builder, builder.lshr(fraction, int32(32 - _INDEX_SHIFT[lanes])), lanes)


def emit_lane_steps(builder: Any, step: Any, lanes: int, start: int = 0) -> Any:
    """What samples start ... start + lanes - 1 are ahead, for an int64 step [2^-32 entries]."""
    steps = builder.mul(emit_splat(builder, step, lanes), vector(I64, range(start, start + lanes)))
    bits = 32 - _INDEX_SHIFT[lanes]
    rounded = builder.add(steps, same(I64, 1 << (bits - 1), lanes))
    rounded = builder.lshr(rounded, same(I64, bits, lanes))
    return builder.trunc(rounded, ir.VectorType(I32, lanes))


def emit_window(builder: Any, table: Any, phase: Any, lanes: int) -> list[Any]:
    """Load the window that starts at the entry under ``phase`` (int64 [2^-32 entries])."""
    start = builder.lshr(phase, int64(32))
    starts = range(0, WINDOW[lanes], lanes)
    return [
        emit_load(builder, table, builder.add(start, int64(k)) if k else start, lanes)
        for k in starts
    ]


def emit_look_up(builder: Any, window: Sequence[Any], relative: Any) -> Any:
    """Entries of a window at relative indices (`emit_relative` plus `emit_lane_steps`)."""
    lanes = relative.type.count
    index = builder.lshr(relative, same(I32, _INDEX_SHIFT[lanes], lanes))
    if lanes == 16:
        name, args = "llvm.x86.avx512.vpermi2var.ps.512", [window[0], index, window[1]]
    else:
        name, args = "llvm.x86.avx2.permps", [window[0], index]
    return call(builder, name, window[0].type, args)


def call(builder: Any, name: str, result: ir.Type, args: list[Any]) -> Any:
    """Call of the LLVM intrinsic ``name``."""
    kind = ir.FunctionType(result, [a.type for a in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)
