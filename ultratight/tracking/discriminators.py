"""Discriminators: what prompt, early and late say about phase, frequency and delay.

Every error is true - replica, with unit slope at zero: in cycles, Hz and chips.  A replica that
lags is pushed forward by a positive error.  Kaplan & Hegarty, 3rd ed., ch. 8.

A prompt of amplitude A turned by phi, with the replica off by e, has early and late ones
A R(e - s) and A R(e + s) for the spacing s.  With k = -2 R'(s), the slope of early minus late,

    coherent      Re (E - L) sign(Re P) / (A k)              needs phase lock
    dot-product   Re [(E - L) conj(P)] / (A^2 k)
    power         (|E|^2 - |L|^2) / (2 A^2 R(s) k)
    envelope      2 R(s) (|E| - |L|) / (k (|E| + |L|))       A cancels

have unit slope for any correlation function R: of any modulation, band limit and spacing
(`signal_peak`).  A is known from many prompts; with it coherent, dot product and power keep their
slope at any C/N0, but for the wrong signs of the coherent one; that of the envelopes falls, as
noise alone has an envelope.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.compiled import kernel
from signals.signal_row import Signal

COHERENT, DOT_PRODUCT, POWER, ENVELOPE = range(4)
CODE_DISCRIMINATORS = {
    "dot-product": DOT_PRODUCT,
    "coherent": COHERENT,
    "power": POWER,
    "envelope": ENVELOPE,
}
"""By name, for `delay_error`"""
ATAN, ATAN2, DECISION_DIRECTED, PRODUCT = range(4)
PHASE_DISCRIMINATORS = {
    "atan": ATAN,
    "atan2": ATAN2,
    "decision-directed": DECISION_DIRECTED,
    "product": PRODUCT,
}
"""By name, for `phase_error`; atan2 alone is not blind to data bits"""
CROSS = 3
FREQUENCY_DISCRIMINATORS = {"atan2": ATAN2, "decision-directed": DECISION_DIRECTED, "cross": CROSS}
"""By name, for `frequency_error`"""
LEAST_SLOPE = 0.05
"""Of R(s) and of k [1/chip]: below, a discriminator would be noise alone"""


class Peak(NamedTuple):
    """What discriminators need of a correlation function with R(0) = 1."""

    slope: float  # of R(s - e) - R(s + e) at e = 0 [1/chip]: k
    level: float  # R(s)


def delay_slope(autocorrelation: np.ndarray, spacing_chips: float, per_chip: int = 1) -> float:
    """Slope of R(s - e) - R(s + e) at e = 0 for the spacing s [1/chip].

    Parameters
    ----------
    autocorrelation : (length,)
        The code's own at delays of 1 / per_chip chips, R(0) = 1; linear in between.  An ideal code
        has the slope 2 for every s < 1; a C/A code has 2 (1 - R(1)), and 1 - R(2) at s = 1, where
        the late replica stands at the foot of the peak.
    spacing_chips
        From the prompt to the early and to the late replica.
    per_chip
        Steps in a chip.

    Raises
    ------
    ValueError
        The spacing is not in (0, 1].
    """
    if not 0.0 < spacing_chips <= 1.0:
        raise ValueError(f"spacing_chips is {spacing_chips}: expected more than 0 and at most 1")
    steps = spacing_chips * per_chip
    below, above = math.ceil(steps) - 1, math.floor(steps)
    left = autocorrelation[below + 1] - autocorrelation[below]
    right = autocorrelation[above + 1] - autocorrelation[above]
    return -float(left + right) * per_chip


def signal_peak(
    signal: Signal, prn: int, spacing_chips: float, bandwidth_hz: float | None = None
) -> Peak:
    """Slope and level of a signal's own correlation, through an ideal filter where one is given.

    The spectrum of a replica is lines f_j; the filter keeps those within +- bandwidth_hz / 2, as in
    `signals.correlations`, and R(d) = sum_j S_j cos(2 pi f_j d / f_c) / sum_j S_j.

    Raises
    ------
    ValueError
        No such code, a spacing outside (0, 1], a bandwidth that is not positive, or a flat peak.
    """
    if bandwidth_hz is None:
        values = signal.autocorrelation(prn)
        slope = delay_slope(values, spacing_chips, signal.per_chip)
        at = np.arange(signal.per_chip + 1) / signal.per_chip
        return Peak(slope, float(np.interp(spacing_chips, at, values[: at.size])))
    if not 0.0 < spacing_chips <= 1.0:
        raise ValueError(f"spacing_chips is {spacing_chips}: expected more than 0 and at most 1")
    replica = signal.subchips(prn).astype(np.float64)
    n = replica.size
    line_hz = signal.sub_chip_rate_hz / n
    if not (math.isfinite(bandwidth_hz) and bandwidth_hz > 2.0 * line_hz):
        raise ValueError(
            f"bandwidth_hz is {bandwidth_hz}: expected more than {2.0 * line_hz:g}, the first lines"
        )
    j = np.arange(math.floor(0.5 * bandwidth_hz / line_hz) + 1)
    power = np.abs(np.fft.fft(replica)) ** 2
    share = power[j % n] * np.sinc(j / n) ** 2
    share[1:] *= 2.0  # and the line at -f
    share /= share.sum()
    turn = 2.0 * np.pi * j * signal.per_chip / n  # rad per chip
    falls = share @ (turn * np.sin(turn * spacing_chips))
    return Peak(2.0 * float(falls), float(share @ np.cos(turn * spacing_chips)))


def check_peak(discriminator: str, peak: Peak) -> None:
    """Raise ValueError where a code discriminator of that name has no slope to speak of."""
    if discriminator not in CODE_DISCRIMINATORS:
        names = ", ".join(CODE_DISCRIMINATORS)
        raise ValueError(f"code_discriminator is {discriminator!r}: expected one of {names}")
    if abs(peak.slope) < LEAST_SLOPE:
        raise ValueError(
            f"spacing_chips: early minus late grows by {peak.slope:.3g} per chip, expected a "
            f"spacing on a flank of the correlation, {LEAST_SLOPE} or more"
        )
    if discriminator in ("power", "envelope") and abs(peak.level) < LEAST_SLOPE:
        raise ValueError(
            f"spacing_chips: the correlation is {peak.level:.3g} there, expected {LEAST_SLOPE} or "
            f'more for the discriminator "{discriminator}"'
        )


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def costas_phase(prompt: complex) -> float:
    """Phase error in (-1/4, 1/4] cycles, blind to the sign of the data bit: atan(Q / I)."""
    return math.atan2(math.copysign(1.0, prompt.real) * prompt.imag, abs(prompt.real)) / (
        2.0 * math.pi
    )


@kernel
def phase_error(kind: int, prompt: complex, amplitude2: float) -> float:
    """Phase error [cycles] of a prompt whose squared amplitude without noise is A^2.

    atan: (-1/4, 1/4]; atan2: (-1/2, 1/2], no data; decision-directed: Q sign(I) / A; product: I Q
    / A^2, the classic Costas loop.  The last two are in rad / 2 pi near zero only.
    """
    if kind == ATAN:
        return costas_phase(prompt)
    if kind == ATAN2:
        return math.atan2(prompt.imag, prompt.real) / (2.0 * math.pi)
    if kind == DECISION_DIRECTED:
        sine = math.copysign(1.0, prompt.real) * prompt.imag / math.sqrt(amplitude2)
    else:
        sine = prompt.real * prompt.imag / amplitude2
    return sine / (2.0 * math.pi)


@kernel
def frequency(products: complex, lag_s: float) -> float:
    """Frequency error [Hz], |f| < 1 / (2 lag), from the sum of P(t + lag) conj(P(t)).

    The prompts of a product belong to the same data bit.
    """
    return math.atan2(products.imag, products.real) / (2.0 * math.pi * lag_s)


@kernel
def frequency_error(kind: int, products: complex, lag_s: float, amplitude2: float) -> float:
    """Frequency error [Hz] from ``products`` as of `frequency`, whose sum without noise is A^2.

    With cross + j dot = A^2 (sin + j cos)(2 pi f lag): atan2(cross, dot), cross sign(dot), cross.
    """
    if kind == ATAN2:
        return frequency(products, lag_s)
    cross = products.imag / amplitude2
    if kind == DECISION_DIRECTED:
        cross *= math.copysign(1.0, products.real)
    return cross / (2.0 * math.pi * lag_s)


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


@kernel
def delay_error(
    kind: int,
    early: complex,
    prompt: complex,
    late: complex,
    amplitude2: float,
    slope: float,
    level: float,
) -> float:
    """Delay error [chips] by one of `CODE_DISCRIMINATORS`; slope and level of a `Peak`."""
    if kind == DOT_PRODUCT:
        return dot_product_delay(early, prompt, late, amplitude2, slope)
    if kind == COHERENT:
        sign = math.copysign(1.0, prompt.real)
        return sign * (early - late).real / (math.sqrt(amplitude2) * slope)
    if kind == POWER:
        power = early.real**2 + early.imag**2 - late.real**2 - late.imag**2
        return power / (2.0 * amplitude2 * level * slope)
    both = abs(early) + abs(late)
    return 2.0 * level * (abs(early) - abs(late)) / (slope * max(both, 1e-30))
