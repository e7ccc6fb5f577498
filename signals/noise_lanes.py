"""The Gaussian noise of `noise` in vector lanes: Philox, then Box and Muller, on many samples.

Each lane does the operations of the plain twins in `noise` and `elementary` in their order and
never contracts a product with a sum: the bits are the same on every machine.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.extending import intrinsic

from signals.lanes import I32, I64, data_pointer, emit_store, int64, vector
from signals.vectors import Vector, cos_sin, log, splat

_LOW = 0xFFFFFFFF
_M0, _M1 = 0xD2511F53, 0xCD9E8D57
_W0, _W1 = 0x9E3779B9, 0xBB67AE85


def _philox(c0: Vector, c1: Vector, k0: Any, k1: Any) -> list[Vector]:
    """`noise.philox` of counters (c0, c1, 0, 0): words in the low halves of int64, waste above.

    A counter in a 64-bit lane costs two multiplications, two shifts and two three-way xors a
    round: the multiplier reads low halves only, so that the upper ones need no clearing.
    """
    builder, width = c0.builder, c0.width
    c2 = c3 = c0 & 0
    for _ in range(10):
        p0, p1 = (c0 & _LOW) * _M0, (c2 & _LOW) * _M1
        c0, c1 = (p1 >> 32) ^ c1 ^ splat(builder, k0, width), p1
        c2, c3 = (p0 >> 32) ^ c3 ^ splat(builder, k1, width), p0
        k0, k1 = builder.add(k0, int64(_W0)), builder.add(k1, int64(_W1))
    return [c0, c1, c2, c3]


def _box_muller(w0: Vector, w1: Vector, scale: Vector) -> tuple[Vector, Vector]:
    """`noise._box_muller`."""
    u = (w0.to_float(signed=False) + 0.5) * 2.0**-32
    radius = scale * (-2.0 * log(u)).sqrt()
    c, s = cos_sin(w1)
    return radius * c, radius * s


def emit_gaussians(
    builder: Any, width: int, counter: Any, high: Any, key: Any, scale: Any
) -> list[Vector]:
    """`noise.gaussian_rows` of counters counter ... counter + width - 1: four vectors.

    ``counter`` and ``high`` are the counter's low words, ``key`` two words, all int64 below 2^32;
    ``scale`` is float32.
    """
    half = width // 2
    words = []
    for parity in (0, 1):
        first = splat(builder, counter, half) + Vector(
            builder, vector(I64, range(parity, width, 2))
        )
        words.append(_philox(first, splat(builder, high, half), *key))
    # even counters to the even int32 lanes, odd ones to the odd
    w = [((even & _LOW) | (odd << 32)).bits(I32, width) for even, odd in zip(*words, strict=True)]
    size = splat(builder, scale, width)
    return [*_box_muller(w[0], w[1], size), *_box_muller(w[2], w[3], size)]


def _rows(width: int) -> Any:
    def define(
        typing_context: Any, counter: Any, key: Any, scale: Any, rows: Any, j: Any
    ) -> tuple[Any, Any]:
        """Elements j ... j + width - 1 of the four rows."""

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> None:
            counter, key, scale, rows, j = args
            low, high = (builder.extract_value(counter, k) for k in (0, 1))
            words = [builder.extract_value(key, k) for k in (0, 1)]
            x = emit_gaussians(builder, width, builder.add(low, j), high, words, scale)
            for k, kind in enumerate(signature.args[3]):
                row = data_pointer(context, builder, kind, builder.extract_value(rows, k))
                emit_store(builder, x[k].value, row, j)

        pair = types.UniTuple(types.int64, 2)
        return types.void(pair, pair, types.float32, rows, types.int64), generate

    return define


rows_64, rows_16 = intrinsic(_rows(64)), intrinsic(_rows(16))
"""On the avx512 and the avx2 path: several registers at once hide the latency of each chain"""
