"""Eight doubles as one value, for kernels whose rows are too short for LLVM's own vectorisation.

A loop over seven, seventeen or forty-nine numbers that may overlap costs more in checks and
remainders than in arithmetic.  Here ``x = load(row, j)`` is eight neighbours in one register (or
two, or four, as the CPU has it), ``a * x + y`` one instruction, and a row is padded to a multiple
of `WIDTH`.  In plain Python (``NUMBA_DISABLE_JIT=1``) the same code works on arrays of eight.

An operation takes the fast-math flags of the kernel in which it stands.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.datamodel import models
from numba.core.imputils import lower_builtin
from numba.core.typing import signature
from numba.core.typing.templates import ConcreteTemplate, infer_global
from numba.extending import register_model, type_callable

from signals.compiled import borrowing
from signals.lanes import (
    F64,
    I32,
    call,
    data_pointer,
    emit_address,
    emit_load,
    emit_splat,
    emit_store,
    int32,
    same,
    vector,
)

WIDTH = 8


@borrowing
def padded(n: int) -> int:
    """The next multiple of `WIDTH` from n on."""
    return (n + WIDTH - 1) // WIDTH * WIDTH


class EightType(types.Type):  # type of numba's, for a register of doubles
    """<8 x double>."""

    def __init__(self) -> None:
        super().__init__(name="float64x8")


EIGHT = EightType()


@register_model(EightType)
class _EightModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, ir.VectorType(F64, WIDTH))


# ---- the functions, in plain Python ----------------------------------------------------------


def load(x: np.ndarray, i: int) -> Any:
    """Numbers i ... i + 7 of a contiguous float64 array of any shape, read as one row."""
    return x.reshape(-1)[i : i + WIDTH].copy()


def store(x: np.ndarray, i: int, value: Any) -> None:
    """Write numbers i ... i + 7."""
    x.reshape(-1)[i : i + WIDTH] = value


def load_part(x: np.ndarray, i: int, n: int) -> Any:
    """`load` of the first n <= 8 numbers, zeros after them; nothing else is read."""
    part = np.zeros(WIDTH)
    part[:n] = x.reshape(-1)[i : i + n]
    return part


def store_part(x: np.ndarray, i: int, n: int, value: Any) -> None:
    """`store` of the first n <= 8."""
    x.reshape(-1)[i : i + n] = value[:n]


def fill(value: float) -> Any:
    """The same number eight times."""
    return np.full(WIDTH, value)


def total(x: Any) -> float:
    """Sum of the eight, always in the same order."""
    four = x[:4] + x[4:]
    return float((four[0] + four[2]) + (four[1] + four[3]))


def least(x: Any, y: Any) -> Any:
    """The lesser of each pair; NaN in x gives y."""
    return np.where(x < y, x, y)


def greatest(x: Any, y: Any) -> Any:
    """The greater of each pair; NaN in x gives y."""
    return np.where(x > y, x, y)


def size(x: Any) -> Any:
    """Absolute values."""
    return np.abs(x)


def floor(x: Any) -> Any:
    """Largest integers not above."""
    return np.floor(x)


def root(x: Any) -> Any:
    """Square roots."""
    return np.sqrt(x)


# ---- and compiled ----------------------------------------------------------------------------


def _splat(builder: Any, value: Any) -> Any:
    return value if isinstance(value.type, ir.VectorType) else emit_splat(builder, value, WIDTH)


def _arithmetic(function: Any, name: str) -> None:
    class Template(ConcreteTemplate):
        cases = [  # noqa: RUF012
            signature(EIGHT, EIGHT, EIGHT),
            signature(EIGHT, EIGHT, types.float64),
            signature(EIGHT, types.float64, EIGHT),
        ]

    infer_global(function)(Template)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        a, b = (_splat(builder, x) for x in args)
        return getattr(builder, name)(a, b)

    for pair in ((EIGHT, EIGHT), (EIGHT, types.float64), (types.float64, EIGHT)):
        lower_builtin(function, *pair)(emit)


for _function, _name in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _arithmetic(_function, _name)
    _arithmetic(getattr(operator, f"i{_function.__name__}"), _name)


@infer_global(operator.neg)
class _Negative(ConcreteTemplate):
    cases = [signature(EIGHT, EIGHT)]  # noqa: RUF012


@lower_builtin(operator.neg, EightType)
def _emit_negative(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fneg(args[0])


def _is_row(x: Any) -> bool:
    return isinstance(x, types.Array) and x.dtype == types.float64 and x.layout == "C"


@type_callable(load)
def _type_load(context: Any) -> Any:
    return lambda x, i: EIGHT if _is_row(x) and isinstance(i, types.Integer) else None


@lower_builtin(load, types.Array, types.Integer)
def _emit_load(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    index = context.cast(builder, args[1], sig.args[1], types.int64)
    row = data_pointer(context, builder, sig.args[0], args[0])
    return emit_load(builder, row, index, WIDTH, F64)


@type_callable(store)
def _type_store(context: Any) -> Any:
    return lambda x, i, value: (
        types.none if _is_row(x) and isinstance(i, types.Integer) and value == EIGHT else None
    )


@lower_builtin(store, types.Array, types.Integer, EightType)
def _emit_store(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    index = context.cast(builder, args[1], sig.args[1], types.int64)
    emit_store(builder, args[2], data_pointer(context, builder, sig.args[0], args[0]), index)
    return context.get_dummy_value()


def _mask(builder: Any, n: Any) -> Any:
    """Lanes below n."""
    lanes = ir.Constant(ir.VectorType(I32, WIDTH), list(range(WIDTH)))
    return builder.icmp_signed("<", lanes, emit_splat(builder, builder.trunc(n, I32), WIDTH))


@type_callable(load_part)
def _type_load_part(context: Any) -> Any:
    return lambda x, i, n: EIGHT if _is_row(x) and isinstance(i, types.Integer) else None


@lower_builtin(load_part, types.Array, types.Integer, types.Integer)
def _emit_load_part(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    index, n = (context.cast(builder, args[k], sig.args[k], types.int64) for k in (1, 2))
    at = emit_address(
        builder, data_pointer(context, builder, sig.args[0], args[0]), index, WIDTH, F64
    )
    kind = ir.VectorType(F64, WIDTH)
    name = f"llvm.masked.load.v{WIDTH}f64.p0"
    return call(builder, name, kind, [at, int32(8), _mask(builder, n), same(F64, 0.0, WIDTH)])


@type_callable(store_part)
def _type_store_part(context: Any) -> Any:
    return lambda x, i, n, value: types.none if _is_row(x) and value == EIGHT else None


@lower_builtin(store_part, types.Array, types.Integer, types.Integer, EightType)
def _emit_store_part(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    index, n = (context.cast(builder, args[k], sig.args[k], types.int64) for k in (1, 2))
    at = emit_address(
        builder, data_pointer(context, builder, sig.args[0], args[0]), index, WIDTH, F64
    )
    name = f"llvm.masked.store.v{WIDTH}f64.p0"
    call(builder, name, ir.VoidType(), [args[3], at, int32(8), _mask(builder, n)])
    return context.get_dummy_value()


@type_callable(fill)
def _type_fill(context: Any) -> Any:
    return lambda value: EIGHT if isinstance(value, types.Number) else None


@lower_builtin(fill, types.Number)
def _emit_fill(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return _splat(builder, context.cast(builder, args[0], sig.args[0], types.float64))


@type_callable(total)
def _type_total(context: Any) -> Any:
    return lambda x: types.float64 if x == EIGHT else None


@lower_builtin(total, EightType)
def _emit_total(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    part, half = args[0], WIDTH
    while half > 1:
        half //= 2
        low, high = (
            builder.shuffle_vector(part, part, vector(I32, range(k, k + half))) for k in (0, half)
        )
        part = builder.fadd(low, high)
    return builder.extract_element(part, int32(0))


def _of_two(function: Any, relation: str) -> None:
    @type_callable(function)
    def typed(context: Any) -> Any:
        return lambda x, y: EIGHT if EIGHT in (x, y) else None

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x, y = (_splat(builder, a) for a in args)
        return builder.select(builder.fcmp_ordered(relation, x, y), x, y)

    for pair in ((EightType, EightType), (EightType, types.Float), (types.Float, EightType)):
        lower_builtin(function, *pair)(emit)


def _of_one(function: Any, name: str) -> None:
    @type_callable(function)
    def typed(context: Any) -> Any:
        return lambda x: EIGHT if x == EIGHT else None

    @lower_builtin(function, EightType)
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return call(builder, f"llvm.{name}.v{WIDTH}f64", args[0].type, [args[0]])


_of_two(least, "<")
_of_two(greatest, ">")
_of_one(size, "fabs")
_of_one(floor, "floor")
_of_one(root, "sqrt")


@borrowing(fastmath={"contract"})
def sin_cos(x: Any) -> tuple[Any, Any]:
    """Sine and cosine of eight, without branches or tables.

    x = k pi + r, |r| <= pi/2, and Taylor polynomials of r whose remainders are below 2e-17.  The
    second part of pi needs the sums as they stand, hence no reassociation; |x| < 1e6.
    """
    k = floor(x * (1.0 / np.pi) + 0.5)
    r = (x - k * np.pi) - k * 1.2246467991473532e-16
    sign = 1.0 - 2.0 * (k - 2.0 * floor(0.5 * k))
    q = r * r
    u = q * (1.0 / 51090942171709440000.0) - 1.0 / 121645100408832000.0
    u = u * q + 1.0 / 355687428096000.0
    u = u * q - 1.0 / 1307674368000.0
    u = u * q + 1.0 / 6227020800.0
    u = u * q - 1.0 / 39916800.0
    u = u * q + 1.0 / 362880.0
    u = u * q - 1.0 / 5040.0
    u = u * q + 1.0 / 120.0
    u = u * q - 1.0 / 6.0
    s = sign * (r + r * q * u)
    u = q * (1.0 / 2432902008176640000.0) - 1.0 / 6402373705728000.0
    u = u * q + 1.0 / 20922789888000.0
    u = u * q - 1.0 / 87178291200.0
    u = u * q + 1.0 / 479001600.0
    u = u * q - 1.0 / 3628800.0
    u = u * q + 1.0 / 40320.0
    u = u * q - 1.0 / 720.0
    u = u * q + 1.0 / 24.0
    return s, sign * (1.0 - 0.5 * q + q * q * u)
