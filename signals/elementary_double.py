"""Branch-free double-precision log, cos and sin that LLVM can put into vector lanes.

The twin of `signals.elementary`, where float32 does not do.  Coefficients are Chebyshev
interpolants computed in extended precision; what is left is the rounding of double.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from signals.compiled import kernel

_TWO_52 = 2.0**52
_TWO_52_BITS = np.int64(0x4330000000000000)  # 2^52 as a double: below it lie the integers
_MANTISSA = np.int64(0x000FFFFFFFFFFFFF)
_SQRT_HALF_BITS = np.int64(0x3FE6A09E667F3BCD)
_LN2 = math.log(2.0)
_UNIT = 2.0**-32
# (atanh(s) / s - 1) / s^2 in s^2, |s| <= (sqrt(2) - 1) / (sqrt(2) + 1): below 6e-18
_L0, _L1, _L2, _L3 = 0.3333333333333333, 0.19999999999969997, 0.14285714307262998, 0.111111062485516
_L4, _L5, _L6 = 0.09091405487795386, 0.07666932023939782, 0.07296959382866208
# (sin(x) / x - 1) / x^2 and (cos(x) - 1 + x^2 / 2) / x^4 in x^2, |x| <= pi / 4: below 9e-18
_S0, _S1, _S2 = -0.16666666666666657, 0.008333333333328056, -0.00019841269834023928
_S3, _S4, _S5 = 2.7557315065882914e-06, -2.505096130840732e-08, 1.590797313912054e-10
_C0, _C1, _C2 = 0.041666666666666644, -0.0013888888888880175, 2.4801587291939532e-05
_C3, _C4, _C5 = -2.755731468449419e-07, 2.087572071111304e-09, -1.1357290878159458e-11


@kernel(inline="always")
def real(word: Any) -> Any:
    """A non-negative integer below 2^52 as a double, without the conversion that lanes lack."""
    return np.int64(np.int64(word) | _TWO_52_BITS).view(np.float64) - _TWO_52


@kernel(inline="always")
def log(u: Any) -> Any:
    """Natural logarithm of a positive, normal double; relative error below 4e-16."""
    bits = np.float64(u).view(np.int64) - _SQRT_HALF_BITS
    m = np.int64((bits & _MANTISSA) + _SQRT_HALF_BITS).view(np.float64)
    exponent = real((bits >> np.int64(52)) + np.int64(2048)) - 2048.0
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    p = _L0 + z * (_L1 + z * (_L2 + z * (_L3 + z * (_L4 + z * (_L5 + z * _L6)))))
    return exponent * _LN2 + 2.0 * (s + s * z * p)


@kernel(inline="always")
def _cos_sin(x: Any, quarter: Any) -> tuple[Any, Any]:
    """cos and sin of x + quarter pi / 2, |x| <= pi / 4, quarter an int64."""
    z = x * x
    c = 1.0 - 0.5 * z
    c += z * z * (_C0 + z * (_C1 + z * (_C2 + z * (_C3 + z * (_C4 + z * _C5)))))
    s = x + x * z * (_S0 + z * (_S1 + z * (_S2 + z * (_S3 + z * (_S4 + z * _S5)))))
    odd = (quarter & np.int64(1)) != 0
    cosine, sine = (s, c) if odd else (c, s)
    cosine = -cosine if ((quarter + np.int64(1)) & np.int64(2)) != 0 else cosine
    sine = -sine if (quarter & np.int64(2)) != 0 else sine
    return cosine, sine


@kernel(inline="always")
def cos_sin(cycles: Any) -> tuple[Any, Any]:
    """cos and sin of 2 pi cycles; error below 4e-16 and that of the argument."""
    part = cycles - np.floor(cycles)
    quarter = np.floor(4.0 * part + 0.5)
    return _cos_sin((part - 0.25 * quarter) * (2.0 * math.pi), np.int64(quarter))


@kernel(inline="always")
def normal_pair(word0: Any, word1: Any) -> tuple[Any, Any]:
    """Two standard normals of two 32-bit words (Box and Muller 1958); they reach 6.7 sigma."""
    radius = math.sqrt(-2.0 * log((real(word0) + 0.5) * _UNIT))
    turned = np.int64(word1) + np.int64(0x20000000)
    x = (real(turned & np.int64(0x3FFFFFFF)) - 536870912.0) * (2.0 * math.pi * _UNIT)
    c, s = _cos_sin(x, turned >> np.int64(30))
    return radius * c, radius * s
