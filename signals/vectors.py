"""Vector arithmetic in LLVM written as mathematics, on top of the blocks of `lanes`.

A `Vector` is a value <W x type> under construction: ``a * b + c`` appends a multiplication and an
addition to the builder's block, in that order and never contracted, so that a formula has the
same bits here and in its plain twin.  W may be several registers wide: LLVM splits the operations
and so interleaves chains that would wait for their own results.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from llvmlite import ir

from signals.elementary import (
    LN2,
    LOGARITHM,
    QUARTER,
    RAD,
    SINE,
    SINE_OF_TURNS,
    SQRT_HALF_BITS,
    TURN,
    TWO_PI,
    WHOLE,
    WHOLE_BITS,
)
from signals.lanes import F32, F64, I32, I64, call, emit_load, emit_splat, same


class Avx512(NamedTuple):
    """Body of a loop, told at compile time by its type: 16 lanes, explicit vectors."""

    lanes: int = 16
    vectors: int = 16
    grain: int = 32


class Avx2(NamedTuple):
    """8 lanes, explicit vectors."""

    lanes: int = 8
    vectors: int = 16
    grain: int = 16


class Portable(NamedTuple):
    """The plain twins, compiled or not; ``lanes`` is then the length of their inner loops."""

    lanes: int = 256
    vectors: int = 1
    grain: int = 1


Body = Avx512 | Avx2 | Portable


def body(path: str) -> Body:
    """Body for a path of `signals.cpu`."""
    bodies: dict[str, Body] = {"avx512": Avx512(), "avx2": Avx2()}
    return bodies.get(path, Portable())


class Vector:
    """A value <W x type>; Python numbers among the operands are constants of all lanes."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    @property
    def width(self) -> int:
        """Number of lanes."""
        return self.value.type.count

    def __add__(self, other: Any) -> Vector:
        return self._do("add", self, other)

    def __radd__(self, other: Any) -> Vector:
        return self._do("add", other, self)

    def __sub__(self, other: Any) -> Vector:
        return self._do("sub", self, other)

    def __rsub__(self, other: Any) -> Vector:
        return self._do("sub", other, self)

    def __mul__(self, other: Any) -> Vector:
        return self._do("mul", self, other)

    def __rmul__(self, other: Any) -> Vector:
        return self._do("mul", other, self)

    def __and__(self, other: Any) -> Vector:
        return self._do("and_", self, other)

    def __or__(self, other: Any) -> Vector:
        return self._do("or_", self, other)

    def __xor__(self, other: Any) -> Vector:
        return self._do("xor", self, other)

    def __lshift__(self, other: Any) -> Vector:
        return self._do("shl", self, other)

    def __rshift__(self, other: Any) -> Vector:
        """Shift that brings in zeros."""
        return self._do("lshr", self, other)

    def signed_shift(self, bits: int) -> Vector:
        """Shift to the right that keeps the sign."""
        return self._do("ashr", self, bits)

    def _do(self, name: str, a: Any, b: Any) -> Vector:
        a, b = (self._operand(x) for x in (a, b))
        if self.value.type.element in (F32, F64):
            name = f"f{name}"
        return Vector(self.builder, getattr(self.builder, name)(a, b))

    def _operand(self, x: Any) -> Any:
        return x.value if isinstance(x, Vector) else same(self.value.type.element, x, self.width)

    def at_least(self, bound: Vector) -> Vector:
        """``self`` where it is the greater, else ``bound``; of floats."""
        return self._choose(">", bound)

    def at_most(self, bound: Vector) -> Vector:
        """``self`` where it is the less, else ``bound``; of floats."""
        return self._choose("<", bound)

    def _choose(self, relation: str, bound: Vector) -> Vector:
        kept = self.builder.fcmp_ordered(relation, self.value, bound.value)
        return Vector(self.builder, self.builder.select(kept, self.value, bound.value))

    def size(self) -> Vector:
        """Absolute value, of int32 modulo 2^32."""
        zero = same(self.value.type.element, 0, self.width)
        if self.value.type.element == F64:
            negative = self.builder.fcmp_ordered("<", self.value, zero)
            opposite = self.builder.fneg(self.value)
        else:
            negative = self.builder.icmp_signed("<", self.value, zero)
            opposite = self.builder.sub(zero, self.value)
        return Vector(self.builder, self.builder.select(negative, opposite, self.value))

    def signed_as(self, other: Vector) -> Vector:
        """``self`` where ``other`` >= 0, else -``self``; of floats."""
        zero = same(other.value.type.element, 0, self.width)
        kept = self.builder.fcmp_ordered(">=", other.value, zero)
        opposite = self.builder.fneg(self.value)
        return Vector(self.builder, self.builder.select(kept, self.value, opposite))

    def sqrt(self) -> Vector:
        """Square root of float32, correctly rounded."""
        name = f"llvm.sqrt.v{self.width}f32"
        return Vector(self.builder, call(self.builder, name, self.value.type, [self.value]))

    def to_float(self, signed: bool = True) -> Vector:
        """Nearest float32 of int32, of uint32 or of float64."""
        target = ir.VectorType(F32, self.width)
        if self.value.type.element == F64:
            return Vector(self.builder, self.builder.fptrunc(self.value, target))
        convert = self.builder.sitofp if signed else self.builder.uitofp
        return Vector(self.builder, convert(self.value, target))

    def low(self, kind: Any) -> Vector:
        """The low bits of integers."""
        return Vector(self.builder, self.builder.trunc(self.value, ir.VectorType(kind, self.width)))

    def bits(self, kind: Any, width: int = 0) -> Vector:
        """The same bits as another type, in as many lanes or ``width``."""
        target = ir.VectorType(kind, width or self.width)
        return Vector(self.builder, self.builder.bitcast(self.value, target))


def splat(builder: Any, scalar: Any, width: int) -> Vector:
    """``scalar`` in all lanes."""
    return Vector(builder, emit_splat(builder, scalar, width))


def load(builder: Any, pointer: Any, index: Any, width: int, kind: Any = F32) -> Vector:
    """Elements index ... index + width - 1, at any alignment."""
    return Vector(builder, emit_load(builder, pointer, index, width, kind))


# ---- functions of `elementary`, operation by operation ---------------------------------------


def log(u: Vector) -> Vector:
    """`elementary.log`."""
    bits = u.bits(I32) - SQRT_HALF_BITS
    t = ((bits & 0x7FFFFF) + SQRT_HALF_BITS).bits(F32) - 1.0
    z = t * t
    p: Any = LOGARITHM[-1]
    for c in LOGARITHM[-2::-1]:
        p = c + t * p
    return bits.signed_shift(23).to_float() * LN2 + (t - 0.5 * z + z * t * p)


def cos_sin(phase: Vector) -> tuple[Vector, Vector]:
    """`elementary.cos_sin`."""
    return _sin(QUARTER - phase.size()), _sin(QUARTER - (phase - QUARTER).size())


def _sin(quarter: Vector) -> Vector:
    x = quarter.to_float() * RAD
    z = x * x
    p: Any = SINE[-1]
    for c in SINE[-2::-1]:
        p = c + z * p
    return x + x * z * p


def fixed(x: Vector) -> Vector:
    """`elementary.fixed`."""
    return (x * TURN + WHOLE).bits(I64) - WHOLE_BITS


def sine_of_turns(turns: Vector) -> Vector:
    """`elementary.sine_of_turns`."""
    x = turns - ((turns + WHOLE) - WHOLE)
    y = (0.25 - (x.size() - 0.25).size()) * TWO_PI
    z = y * y
    p: Any = 1.0
    for c in SINE_OF_TURNS[::-1]:
        p = 1.0 - z * c * p
    return (y * p).signed_as(x)
