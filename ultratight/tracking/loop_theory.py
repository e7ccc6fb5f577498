"""Closed forms of tracking loops: thermal jitter, oscillator, dynamic stress, slips, thresholds.

Sources: Kaplan & Hegarty, "Understanding GPS/GNSS", 3rd ed., ch. 8 (K&H); Betz & Kolodziejski,
"Generalized theory of code tracking with an early-late discriminator", IEEE TAES 45(4), 2009
(B&K); Viterbi, "Principles of Coherent Communication", 1966, ch. 4.

Bn is the one-sided noise bandwidth of the loop as it runs, sampled every T: sigma^2 = 2 Bn T times
the variance of one discriminator output.  (The factor 1 - Bn T / 2 in B&K belongs to loops whose
Bn is that of an analogue prototype; `loop_filters` solves for the digital one.)  C/N0 in dB-Hz,
phases in cycles, frequencies in Hz, delays in chips of the code, spacing from prompt to early and
to late (half of the D of these authors).

Small errors are assumed throughout.  Near threshold the discriminator bends, its slope falls with
C/N0 (`noisy_phase`), and loops are noisier than this says; `studies/loop_theory.py` measures where.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from signals.clock import Oscillator
from signals.constants import GPS_L1_HZ
from signals.modulation import Modulation
from signals.signal_row import Signal
from ultratight.tracking.discriminators import CODE_DISCRIMINATORS, delay_slope

COSTAS_LIMIT_CYCLES, PILOT_LIMIT_CYCLES = 0.125, 0.25
"""3 sigma + stress of a phase loop with data bits and without (K&H 8.9.1: 45 and 90 deg)"""
FLL_LIMIT = 0.25
"""3 sigma + stress of a frequency loop, in 1 / T (K&H 8.9.2)"""
LOWEST_DBHZ, HIGHEST_DBHZ = 0.0, 80.0
"""Thresholds are sought in between"""
_ERROR_POLES = {1: (1.0, 1.0), 2: (1.0, 1.414, 1.0), 3: (1.0, 2.4, 1.1, 1.0)}
"""Denominator of 1 - H in s / w, by order (K&H, table of loop filters)"""


def ratio_hz(cn0_dbhz: float) -> float:
    """C/N0 [Hz]."""
    return float(10.0 ** (0.1 * cn0_dbhz))


# -- code ----------------------------------------------------------------------------------------


class Flank(NamedTuple):
    """What the jitter of a code loop needs of a correlation function with R(0) = 1."""

    slope: float  # of R(s - e) - R(s + e) at e = 0 [1/chip]
    level: float  # R(s)
    apart: float  # R(2 s)
    power: float = 1.0  # share of the signal's power that the front end leaves


def flank(
    modulation: Modulation,
    spacing_chips: float,
    chip_rate_hz: float,
    bandwidth_hz: float | None = None,
) -> Flank:
    """Of independent chips; through an ideal filter of +- bandwidth_hz / 2 where one is given.

    The filter shapes signal and noise alike, hence the integrals of B&K: level and apart are those
    of S cos(2 pi f d) over the band, the slope that of 4 pi f S sin(2 pi f s).
    """
    if not 0.0 < spacing_chips <= 1.0:
        raise ValueError(f"spacing_chips is {spacing_chips}: expected more than 0 and at most 1")
    step = 1e-4
    at = np.array([0.0, 1.0, 2.0, 1.0 - step / spacing_chips, 1.0 + step / spacing_chips])
    delay = spacing_chips * at
    if bandwidth_hz is None:
        r = modulation.correlation(delay)
    else:
        r = modulation.band_limited_correlation(delay, chip_rate_hz, bandwidth_hz)
    kept = float(r[0])
    slope = float(r[3] - r[4]) / step / kept
    return Flank(slope, float(r[1]) / kept, float(r[2]) / kept, kept)


def flank_of_code(signal: Signal, prn: int, spacing_chips: float) -> Flank:
    """Of a code's own correlation, side lobes included, without any filter."""
    values = signal.autocorrelation(prn)[: 2 * signal.per_chip + 1]
    delays = np.array([spacing_chips, 2.0 * spacing_chips])
    level, apart = np.interp(delays, np.arange(values.size) / signal.per_chip, values)
    return Flank(delay_slope(values, spacing_chips, signal.per_chip), float(level), float(apart))


def code_variance(discriminator: str, of: Flank, integration_s: float, cn0_dbhz: float) -> float:
    """Variance of one output of a code discriminator [chips^2].

    With A^2 = 2 T C/N0, V = 2 (1 - R(2 s)) and W = 2 (1 + R(2 s)) the variances of early minus and
    plus late, k the slope:

        coherent, envelope   V / (A k)^2
        dot-product          V / (A k)^2 (1 + 2 / A^2)
        power                V / (A k)^2 (1 + W / (2 A^2 R(s)^2))

    For a triangle, D = 2 s: D / (4 T C/N0), [1 + 1 / (T C/N0)], [1 + 2 / ((2 - D) T C/N0)] (B&K).
    The envelopes are those of many prompts' noise: high C/N0 only.
    """
    if discriminator not in CODE_DISCRIMINATORS:
        names = ", ".join(CODE_DISCRIMINATORS)
        raise ValueError(f"discriminator is {discriminator!r}: expected one of {names}")
    a2 = 2.0 * integration_s * of.power * ratio_hz(cn0_dbhz)
    variance = 2.0 * (1.0 - of.apart) / (a2 * of.slope**2)
    if discriminator == "dot-product":
        variance *= 1.0 + 2.0 / a2
    elif discriminator == "power":
        variance *= 1.0 + (1.0 + of.apart) / (a2 * of.level**2)
    return variance


def dll_jitter_chips(
    discriminator: str, of: Flank, bandwidth_hz: float, integration_s: float, cn0_dbhz: float
) -> float:
    """Thermal jitter of a code loop [chips]: B&K for any flank, K&H for a triangle."""
    one = code_variance(discriminator, of, integration_s, cn0_dbhz)
    return math.sqrt(2.0 * bandwidth_hz * integration_s * one)


def dll_bound_chips(
    modulation: Modulation,
    chip_rate_hz: float,
    front_end_hz: float,
    bandwidth_hz: float,
    cn0_dbhz: float,
) -> float:
    """Least jitter of any code loop in that band [chips]: Bn / ((2 pi)^2 C/N0 int f^2 S) (B&K)."""
    second = modulation.power_kept(chip_rate_hz, front_end_hz)
    second *= modulation.gabor_bandwidth_hz(chip_rate_hz, front_end_hz) ** 2
    seconds = math.sqrt(bandwidth_hz / (ratio_hz(cn0_dbhz) * second)) / (2.0 * math.pi)
    return seconds * chip_rate_hz


def dll_jitter_piecewise_chips(
    spacing_chips: float, band_chips: float, bandwidth_hz: float, integration_s: float,
    cn0_dbhz: float,
) -> float:  # fmt: skip
    """K&H's fit for BPSK, early minus late power [chips]; ``band_chips``: front end / chip rate."""
    d, b = 2.0 * spacing_chips, 1.0 / band_chips
    if d >= math.pi * b:
        width = d
    elif d > b:
        width = b + (d - b) ** 2 / (b * (math.pi - 1.0))
    else:
        width = b
    t_cn0 = integration_s * ratio_hz(cn0_dbhz)
    squaring = 1.0 + 2.0 / ((2.0 - d) * t_cn0)
    return math.sqrt(0.5 * bandwidth_hz / ratio_hz(cn0_dbhz) * width * squaring)


# -- carrier -------------------------------------------------------------------------------------


def pll_jitter_cycles(
    bandwidth_hz: float, integration_s: float, cn0_dbhz: float, costas: bool = True
) -> float:
    """Thermal jitter of a phase loop [cycles], K&H 8.9.1: with the squaring loss of data or not."""
    c = ratio_hz(cn0_dbhz)
    squaring = 1.0 + 1.0 / (2.0 * integration_s * c) if costas else 1.0
    return math.sqrt(bandwidth_hz / c * squaring) / (2.0 * math.pi)


def fll_jitter_hz(
    bandwidth_hz: float, lag_s: float, cn0_dbhz: float, factor: float = 1.0, own: bool = False
) -> float:
    """Thermal jitter of a frequency loop on two prompts of ``lag_s`` each [Hz].

    K&H 8.9.2, ``factor`` F: 1, or 2 near threshold:

        sigma = 1 / (2 pi T) sqrt(4 F Bn / (C/N0) (1 + 1 / (T C/N0)))

    ``own``: with 1 / (2 T C/N0) instead.  That is the variance of Im(P2 conj P1) itself, for pairs
    of prompts that do not overlap and an update every 2 T, as `channel_loops` has them in lock.
    """
    c = ratio_hz(cn0_dbhz)
    squaring = 1.0 + (0.5 if own else 1.0) / (lag_s * c)
    return math.sqrt(4.0 * factor * bandwidth_hz / c * squaring) / (2.0 * math.pi * lag_s)


def _phase_loop_response(
    order: int, w: float, integration_s: float, f_hz: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """1 - H, and the integrators' frequency for an error of one cycle [Hz], at f_hz (n,).

    H is the loop with bilinear integrators and a delay of T; of order 2 the frequency is that of
    the NCO, of order 3 that of the filter's integrators (`Scalar.doppler_hz`).
    """
    back = np.exp(-2j * np.pi * f_hz * integration_s)
    integrated = 0.5 * integration_s * (1.0 + back) / (1.0 - back)
    shape = _ERROR_POLES[order][1:]
    terms = [k * w**n * integrated ** (n - 1) for n, k in enumerate(shape, start=1)]
    frequency = sum(terms[1:] if order == 3 else terms, np.zeros(f_hz.size))
    return 1.0 / (1.0 + integrated * back * sum(terms, np.zeros(f_hz.size))), frequency


def doppler_jitter_hz(
    order: int, w: float, integration_s: float, bandwidth_hz: float, jitter_cycles: float
) -> float:
    """Thermal jitter of the Doppler that a phase loop knows [Hz], from its thermal phase jitter.

    The phase noise of one output, jitter^2 / (2 Bn T), is white up to 1 / (2 T).
    """
    f = np.geomspace(1e-3, 0.5 / integration_s, 4000)
    error, frequency = _phase_loop_response(order, w, integration_s, f)
    density = jitter_cycles**2 / bandwidth_hz
    return math.sqrt(density * float(np.trapezoid(np.abs(error * frequency) ** 2, f)))


def oscillator_jitter_cycles(
    oscillator: Oscillator,
    order: int,
    w: float,
    integration_s: float,
    carrier_hz: float = GPS_L1_HZ,
) -> float:
    """r.m.s. phase error that an oscillator causes in a loop of natural frequency w [cycles].

    The integral of |1 - H|^2 S_phi over f up to 1 / (2 T), S_phi = (f_L / 2 pi f)^2 S_y(f)
    one-sided.  K&H's 144 or 160 sigma_A f_L / Bn stands for the same with one Allan deviation.
    """
    f = np.geomspace(1e-3, 0.5 / integration_s, 4000)
    error, _ = _phase_loop_response(order, w, integration_s, f)
    s_y = oscillator.h0 + oscillator.h_minus1 / f + oscillator.h_minus2 / f**2
    power = float(np.trapezoid(np.abs(error) ** 2 * s_y / f**2, f))
    return carrier_hz / (2.0 * math.pi) * math.sqrt(power)


def mean_time_to_slip_s(loop_snr: float, bandwidth_hz: float) -> float:
    """Of a first-order loop with a sine discriminator [s]: pi^2 rho I0(rho)^2 / (2 Bn), Viterbi.

    rho = 1 / sigma^2, sigma in rad; of a Costas loop the doubled angle counts: 1 / (2 sigma)^2.
    """
    return math.pi**2 * loop_snr * float(np.i0(loop_snr)) ** 2 / (2.0 * bandwidth_hz)


# -- dynamics ------------------------------------------------------------------------------------


def steady_error(order: int, w: float, size: float) -> float:
    """Error of a loop of that order under a constant ``order``-th derivative: size / w^order.

    K&H 8.9.1: range rate, acceleration, jerk for orders 1, 2, 3; unit of the input's integral.
    """
    return size / w**order


@cache
def peak_factor(order: int, derivative: int) -> float:
    """Largest error after a unit step of a derivative of the input, in 1 / w^derivative.

    1: rate, 2: acceleration, 3: jerk.  The step response of the error's transfer function
    s^order / (s^order + ...) over s^(derivative + 1), by its poles; infinite where the loop cannot
    follow.  A constant jerk at order 3 has 1.47 here where `steady_error` has 1: overshoot.
    """
    if derivative > order:
        return math.inf
    poles = np.roots(_ERROR_POLES[order])
    others = np.array([np.prod(p - np.delete(poles, i)) for i, p in enumerate(poles)])
    t = np.linspace(0.0, 60.0, 60_001)
    if derivative == order:
        residues = 1.0 / (others * poles)
        response = float(np.real(1.0 / np.prod(-poles))) + np.zeros(t.size)
    else:
        residues = poles ** (order - derivative - 1) / others
        response = np.zeros(t.size)
    response = response + np.real(np.exp(np.outer(t, poles)) @ residues)
    return float(np.abs(response).max())


# -- thresholds ----------------------------------------------------------------------------------


def threshold_dbhz(three_sigma: Callable[[float], float], limit: float) -> float:
    """C/N0 at which a quantity that falls with C/N0 comes down to the limit, by bisection [dB-Hz].

    Between `LOWEST_DBHZ` and `HIGHEST_DBHZ`; inf where it is above the limit even there.
    """
    low, high = LOWEST_DBHZ, HIGHEST_DBHZ
    if three_sigma(high) > limit:
        return math.inf
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if three_sigma(middle) <= limit else (middle, high)
    return high


def pll_threshold_dbhz(
    bandwidth_hz: float,
    integration_s: float,
    costas: bool = True,
    stress_cycles: float = 0.0,
    other_cycles: float = 0.0,
) -> float:
    """C/N0 below which 3 sigma + stress passes 45 deg (Costas) or 90 deg [dB-Hz], K&H 8.9.1.

    ``other_cycles``: r.m.s. phase of oscillator and vibration, added to the thermal one in power.
    """

    def three_sigma(cn0: float) -> float:
        thermal = pll_jitter_cycles(bandwidth_hz, integration_s, cn0, costas)
        return 3.0 * math.hypot(thermal, other_cycles) + stress_cycles

    return threshold_dbhz(three_sigma, COSTAS_LIMIT_CYCLES if costas else PILOT_LIMIT_CYCLES)


def fll_threshold_dbhz(
    bandwidth_hz: float, lag_s: float, stress_hz: float = 0.0, factor: float = 1.0
) -> float:
    """C/N0 below which 3 sigma + stress passes 1 / (4 T) [dB-Hz], K&H 8.9.2."""
    return threshold_dbhz(
        lambda cn0: 3.0 * fll_jitter_hz(bandwidth_hz, lag_s, cn0, factor) + stress_hz,
        FLL_LIMIT / lag_s,
    )


def dll_threshold_dbhz(
    discriminator: str,
    of: Flank,
    bandwidth_hz: float,
    integration_s: float,
    spacing_chips: float,
    stress_chips: float = 0.0,
) -> float:
    """C/N0 below which 3 sigma + stress passes the spacing, D / 2 [dB-Hz], K&H 8.9.3."""
    return threshold_dbhz(
        lambda cn0: (
            3.0 * dll_jitter_chips(discriminator, of, bandwidth_hz, integration_s, cn0)
            + stress_chips
        ),
        spacing_chips,
    )
