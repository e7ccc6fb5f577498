"""What noise does to discriminators of phase and to lock indicators: their means, in closed form.

A prompt is A + n with n of unit variance in I and in Q; A^2 = 2 T C/N0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from ultratight.tracking.discriminators import PHASE_DISCRIMINATORS
from ultratight.tracking.loop_theory import ratio_hz, threshold_dbhz

_HARMONICS = 400
"""Of a saw-tooth: the rest is below 1e-3 cycles, and only where it is steep"""


def phase_moment(k: np.ndarray | int, amplitude2: float) -> np.ndarray:
    """E cos(k theta) of the angle theta of A + n, n of unit variance in I and in Q.

    sqrt(pi r) / 2 exp(-r / 2) [I_(k-1)/2 (r / 2) + I_(k+1)/2 (r / 2)] with r = A^2 / 2, from the
    density of that angle (Middleton, "Statistical Communication Theory", 1960, ch. 9).
    """
    from scipy.special import ive  # slow to import, and seldom needed

    half = 0.25 * amplitude2
    order = 0.5 * (np.asarray(k, dtype=np.float64) - 1.0)
    return np.asarray(math.sqrt(0.5 * math.pi * half) * (ive(order, half) + ive(order + 1.0, half)))


def mean_phase_error(kind: str, phase_cycles: np.ndarray, amplitude2: float) -> np.ndarray:
    """Mean output of a phase discriminator in noise [cycles], any shape; A^2 = 2 T C/N0.

    atan2 and atan are saw-teeth, sums of 2 (-1)^(k+1) sin(k phi) / k over all k and over the even
    ones; noise takes `phase_moment` off each term.  The sine of decision-directed loops shrinks by
    erf(A cos(phi) / sqrt 2), wrong signs of I; that of the product of I and Q stays what it is.
    """
    from scipy.special import erf

    if kind not in PHASE_DISCRIMINATORS:
        names = ", ".join(PHASE_DISCRIMINATORS)
        raise ValueError(f"kind is {kind!r}: expected one of {names}")
    phi = 2.0 * np.pi * np.asarray(phase_cycles, dtype=np.float64)
    if kind == "product":
        return np.sin(2.0 * phi) / (4.0 * np.pi)
    if kind == "decision-directed":
        wrong = erf(np.sqrt(0.5 * amplitude2) * np.cos(phi))
        return np.asarray(np.sin(phi) * wrong / (2.0 * np.pi))
    turns = 1 if kind == "atan2" else 2
    j = np.arange(1, _HARMONICS + 1)
    terms = phase_moment(turns * j, amplitude2) * -((-1.0) ** j) / (np.pi * turns * j)
    return np.asarray(np.sin(turns * phi[..., None] * j) @ terms)


# -- lock indicators -----------------------------------------------------------------------------


class Indicator(NamedTuple):
    """Mean and standard deviation of one value of a lock indicator."""

    mean: float
    sigma: float


def phase_indicator(cn0_dbhz: float, bit_s: float, sigma_cycles: float = 0.0) -> Indicator:
    """(I^2 - Q^2) / (I^2 + Q^2) = cos 2 theta of a bit's prompt (`channel_lock`).

    Noise takes `phase_moment` off it, phase jitter of the loop exp(-2 (2 pi sigma)^2).
    """
    a2 = 2.0 * bit_s * ratio_hz(cn0_dbhz)
    spread = 2.0 * (2.0 * math.pi * sigma_cycles) ** 2
    twice, four = (float(phase_moment(k, a2)) * math.exp(-spread * k * k / 4.0) for k in (2, 4))
    return Indicator(twice, math.sqrt(max(0.5 * (1.0 + four) - twice**2, 0.0)))


def frequency_indicator(cn0_dbhz: float, half_s: float) -> Indicator:
    """Re(H2 conj H1) over the mean power of two halves H of a bit (`channel_lock`).

    It is 2 b - 1 with b = |H1 + H2|^2 / (|H1 + H2|^2 + |H1 - H2|^2), and b has the beta
    distribution (1 + j, 1), j Poisson of mean A^2.
    """
    mean = 2.0 * half_s * ratio_hz(cn0_dbhz)
    j = np.arange(max(60, int(mean + 12.0 * math.sqrt(mean) + 20.0)))
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log(j[1:]))])
    weight = np.exp(j * math.log(mean) - mean - log_factorial)
    first = float(weight @ ((1.0 + j) / (2.0 + j)))
    second = float(weight @ ((1.0 + j) / (3.0 + j)))
    return Indicator(2.0 * first - 1.0, 2.0 * math.sqrt(max(second - first**2, 0.0)))


def indicator_threshold_dbhz(
    of: Callable[[float], Indicator], lost_below: float, gain: float, looks: float, loss: float
) -> float:
    """C/N0 at which noise alone takes a low-passed indicator below its limit [dB-Hz].

    ``gain`` of the low pass, whose variance is gain / (2 - gain) of one value's; ``loss``: in that
    share of all runs, each of ``looks`` values that are independent.
    """
    each = 1.0 - (1.0 - loss) ** (1.0 / max(looks, 1.0))
    sigmas = NormalDist().inv_cdf(1.0 - each)
    shrink = math.sqrt(gain / (2.0 - gain))

    def short(cn0: float) -> float:
        value = of(cn0)
        return lost_below - (value.mean - sigmas * shrink * value.sigma)

    return threshold_dbhz(short, 0.0)
