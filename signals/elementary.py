"""Branch-free single-precision sin, cos and log that LLVM can put into vector lanes.

numba from a package index has no vector mathematics library: ``math.sin`` in a loop stays scalar.
The coefficients are Chebyshev interpolants, rounded to float32; the errors below were measured
against float64 over the whole range.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from signals.compiled import kernel

TURN = 4294967296.0
"""2^32: an integer phase of this many units is one cycle"""

_F = np.float32
_HALF, _ONE = _F(0.5), _F(1.0)
_RAD = _F(2.0 * np.pi / TURN)
# (sin x / x - 1) / x^2 and (cos x - 1 + x^2 / 2) / x^4 as polynomials of x^2, |x| <= pi / 4
_S0, _S1, _S2 = _F(-0.16666664), _F(0.008332746), _F(-0.00019587387)
_C0, _C1, _C2 = _F(0.041666664), _F(-0.00138883), _F(2.4547437e-05)
# (log(1 + t) - t + t^2 / 2) / t^3, sqrt(1/2) - 1 <= t <= sqrt(2) - 1
_L0, _L1, _L2, _L3 = _F(0.33333415), _F(-0.25000703), _F(0.19984223), _F(-0.16602719)
_L4, _L5, _L6 = _F(0.147039), _F(-0.14030892), _F(0.090487845)
_LN2 = _F(0.6931472)
_SQRT_HALF_BITS = 0x3F3504F3


@kernel(inline="always")
def cos_sin(phase: Any, extra: Any) -> tuple[Any, Any]:
    """cos and sin of 2 pi phase / 2^32 + extra; error below 1e-7.

    ``phase`` is an integer of which the low 32 bits count, ``extra`` a small float32 angle [rad].
    """
    quadrant = ((phase + 0x20000000) >> 30) & 3
    remainder = np.int32(((phase + 0x20000000) & 0x3FFFFFFF) - 0x20000000)
    x = _F(remainder) * _RAD + extra
    z = x * x
    s = x + x * z * (_S0 + z * (_S1 + z * _S2))
    c = _ONE - _HALF * z + z * z * (_C0 + z * (_C1 + z * _C2))
    cosine = s if quadrant & 1 else c
    sine = c if quadrant & 1 else s
    return (-cosine if (quadrant + 1) & 2 else cosine), (-sine if quadrant & 2 else sine)


@kernel(inline="always")
def log(u: Any) -> Any:
    """Natural logarithm of a positive, normal float32; relative error below 3e-7."""
    bits = _F(u).view(np.int32) - _SQRT_HALF_BITS
    t = np.int32((bits & 0x7FFFFF) + _SQRT_HALF_BITS).view(np.float32) - _ONE
    p = _L0 + t * (_L1 + t * (_L2 + t * (_L3 + t * (_L4 + t * (_L5 + t * _L6)))))
    return _F(np.int32(bits >> 23)) * _LN2 + (t - _HALF * t * t + t * t * t * p)
