"""Branch-free single-precision sin, cos and log that LLVM can put into vector lanes.

numba from a package index has no vector mathematics library: ``math.sin`` in a loop stays scalar.
The coefficients are Chebyshev interpolants, rounded to float32; the errors below were measured
against float64 over the whole range.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from signals.compiled import kernel

TURN = 4294967296.0
"""2^32: an integer phase of this many units is one cycle"""

_F = np.float32
_HALF, _ONE = _F(0.5), _F(1.0)
RAD = _F(2.0 * np.pi / TURN)
QUARTER = 0x40000000
# (sin x / x - 1) / x^2 as a polynomial of x^2, |x| <= pi / 2
SINE = _F(-0.16666666), _F(0.0083332425), _F(-0.00019822740), _F(2.6347564e-06)
_S0, _S1, _S2, _S3 = SINE
# (log(1 + t) - t + t^2 / 2) / t^3, sqrt(1/2) - 1 <= t <= sqrt(2) - 1
LOGARITHM = (
    *(_F(0.33333415), _F(-0.25000703), _F(0.19984223), _F(-0.16602719)),
    *(_F(0.147039), _F(-0.14030892), _F(0.090487845)),
)
_L0, _L1, _L2, _L3, _L4, _L5, _L6 = LOGARITHM
LN2 = _F(0.6931472)
SQRT_HALF_BITS = 0x3F3504F3
WHOLE = 1.5 * 2.0**52
"""Added to a float64 below 2^51 it leaves the nearest integer in the low bits"""
WHOLE_BITS = 0x4338000000000000
TWO_PI = 2.0 * math.pi
SINE_OF_TURNS = 1 / 6, 1 / 20, 1 / 42, 1 / 72, 1 / 110, 1 / 156
_T1, _T2, _T3, _T4, _T5, _T6 = SINE_OF_TURNS


@kernel(inline="always")
def wrap(phase: Any) -> Any:
    """Low 32 bits of an int64 as a signed int32: a phase in [-1/2, 1/2) cycle.

    Integers that only reach a result through this are multiplied in 32-bit lanes.
    """
    return np.int32(((phase + 0x80000000) & 0xFFFFFFFF) - 0x80000000)


@kernel(inline="always")
def _sin(quarter: Any) -> Any:
    """Sine of an int32 phase within a quarter cycle."""
    x = _F(quarter) * RAD
    z = x * x
    return x + x * z * (_S0 + z * (_S1 + z * (_S2 + z * _S3)))


@kernel(inline="always")
def cos_sin(phase: Any) -> tuple[Any, Any]:
    """cos and sin of 2 pi phase / 2^32, int32 to float32; error below 2e-7.

    Without a branch: cos(a) = sin(pi / 2 - |a|), sin(a) = cos(a - pi / 2).
    """
    lagged = wrap(np.int64(phase) - QUARTER)
    cosine = _sin(np.int32(QUARTER - abs(np.int64(phase))))
    return cosine, _sin(np.int32(QUARTER - abs(np.int64(lagged))))


@kernel(inline="always")
def log(u: Any) -> Any:
    """Natural logarithm of a positive, normal float32; relative error below 3e-7."""
    bits = _F(u).view(np.int32) - SQRT_HALF_BITS
    t = np.int32((bits & 0x7FFFFF) + SQRT_HALF_BITS).view(np.float32) - _ONE
    p = _L0 + t * (_L1 + t * (_L2 + t * (_L3 + t * (_L4 + t * (_L5 + t * _L6)))))
    return _F(np.int32(bits >> 23)) * LN2 + (t - _HALF * t * t + t * t * t * p)


@kernel(inline="always")
def fixed(x: float) -> Any:
    """Nearest integer to x 2^32, |x| < 2^18, as int64, by the bits of a sum: no conversion."""
    return np.float64(x * TURN + WHOLE).view(np.int64) - WHOLE_BITS


@kernel(inline="always")
def sine_of_turns(turns: float) -> float:
    """sin(2 pi turns) in float64, error below 1e-9: Taylor's series in the first quadrant."""
    x = turns - np.rint(turns)
    y = (0.25 - abs(abs(x) - 0.25)) * TWO_PI
    z = y * y
    p = 1.0 - z * _T3 * (1.0 - z * _T4 * (1.0 - z * _T5 * (1.0 - z * _T6 * 1.0)))
    s = y * (1.0 - z * _T1 * (1.0 - z * _T2 * p))
    return s if x >= 0.0 else -s
