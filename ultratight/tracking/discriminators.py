"""Discriminators: what prompt, early and late say about phase, frequency and delay.

Every error is true - replica, with unit slope at zero: in cycles, Hz and chips.  A replica that
lags is pushed forward by a positive error.  Kaplan & Hegarty, 3rd ed., ch. 8.
"""

from __future__ import annotations

import math

import numpy as np

from signals.compiled import kernel


def delay_slope(autocorrelation: np.ndarray, spacing_chips: float) -> float:
    """Slope of R(s - e) - R(s + e) at e = 0 for the spacing s [1/chip].

    Parameters
    ----------
    autocorrelation : (length,)
        The code's own at delays of whole chips, R(0) = 1; linear in between.  An ideal code has
        the slope 2 for every s < 1; a C/A code has 2 (1 - R(1)), and 1 - R(2) at s = 1, where the
        late replica stands at the foot of the peak.
    spacing_chips
        From the prompt to the early and to the late replica.

    Raises
    ------
    ValueError
        The spacing is not in (0, 1].
    """
    if not 0.0 < spacing_chips <= 1.0:
        raise ValueError(f"spacing_chips is {spacing_chips}: expected more than 0 and at most 1")
    below, above = math.ceil(spacing_chips) - 1, math.floor(spacing_chips)
    left = autocorrelation[below + 1] - autocorrelation[below]
    right = autocorrelation[above + 1] - autocorrelation[above]
    return -float(left + right)


@kernel
def costas_phase(prompt: complex) -> float:
    """Phase error in (-1/4, 1/4] cycles, blind to the sign of the data bit: atan(Q / I)."""
    return math.atan2(math.copysign(1.0, prompt.real) * prompt.imag, abs(prompt.real)) / (
        2.0 * math.pi
    )


@kernel
def frequency(products: complex, lag_s: float) -> float:
    """Frequency error [Hz], |f| < 1 / (2 lag), from the sum of P(t + lag) conj(P(t)).

    The prompts of a product belong to the same data bit.
    """
    return math.atan2(products.imag, products.real) / (2.0 * math.pi * lag_s)


@kernel
def dot_product_delay(
    early: complex, prompt: complex, late: complex, amplitude2: float, slope: float
) -> float:
    """Delay error [chips]: Re[(E - L) conj(P)] / (A^2 slope), see `delay_slope`.

    A^2 is the squared amplitude of such a prompt without noise.  Taken from many of them it leaves
    slope and noise of a single dot product alone, at any C/N0: with D = 2 s <= 1 the variance is
    D / (4 (1 - R(1)) T C/N0) (1 + 1 / (T C/N0)).
    """
    return ((early - late) * prompt.conjugate()).real / (amplitude2 * slope)
