"""The pre-filter of a channel in the federated form: taps in, code, phase and Doppler error out.

Each channel has a Kalman filter of its own, of errors (true - what the INS says) along the line of
sight at the time of its last integration:

    code r [m],  carrier phase p [m],  Doppler v [m/s]

    r' = p' = v + white S_f,     v' = white (S_g + S_a)

S_f and S_g are the oscillator's; S_a stands for what the INS may get wrong until the next
hand-over: its velocity random walk, and the acceleration error that the central filter's
covariance predicts (accelerometer bias, tilt times specific force), sigma_a^2 T over T seconds.
There is no Doppler rate: the INS has taken it out of the NCO, and of the residual acceleration a
the phase keeps a T^2 / 12 against a straight line, 0.25 mm for 0.3 m/s^2 over 100 ms, a tenth of
the noise of a data bit at 35 dB-Hz.

Integrations of half a data bit (10 ms for GPS L1 C/A) are measured one after the other, once the
bit is whole.  With the amplitude A of their prompts in units of the noise, k the slope of early
minus late and V the variance of L - E per component,

    code    dot product          variance (V / A^2 + 2 V / A^4) / k^2                   [chips^2]
    phase   arctangent           (1 + 1 / A^2) / A^2 from A^2 = 8 on (26 dB-Hz)         [rad^2]
            sine                 1 / A^2 where data bits are known, 1 / (A erf A)^2 else

Where data bits are not known, the bit's sign is that of its prompt turned back by the predicted
phase: p is known but for multiples of half a wavelength, of which the Doppler is free; wrong signs
take erf A off the slope.  A phase that is open (sigma above 0.15 wavelengths) begins at the angle
of the first half.

What is measured is kept as it came, predicted phase plus discriminator, until the next hand-over
(`pre_filter_hand_over`): that does not depend on the filter's gains, nor on what it knew before.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.compiled import kernel
from ultratight.tracking.code_model import CHIP, SPACING, WAVELENGTH, correlation, slope
from ultratight.tracking.discriminators import dot_product_delay
from ultratight.tracking.half_bits import EARLY, HALF, LATE, PROMPT, RANGE, T_MID
from ultratight.tracking.kalman_loop import update_one
from ultratight.tracking.vector_measurements import renewed

CODE, PHASE, DOPPLER = range(3)
T_S, CODE_M, PHASE_M, CODE_VARIANCE, PHASE_VARIANCE = range(5)
"""Columns of what is kept of an integration"""
OPEN = 0.15
"""Sigma of the phase [wavelengths] above which it says nothing of a data bit's sign"""
UNKNOWN = 100.0
"""Sigma of a phase that begins [wavelengths]"""
AMPLITUDE2_FLOOR = 0.5
ARCTANGENT_ABOVE = 8.0
POWER_S = 1.0
"""A^2: time constant of its low pass"""


class PreFilters(NamedTuple):
    """What the filters of all channels remember."""

    mean: np.ndarray  # (n_channel, 3) code [m], phase [m], Doppler [m/s]
    cov: np.ndarray  # (n_channel, 3, 3)
    t_s: np.ndarray  # (n_channel,) time of the estimate, NaN for a filter that begins
    power: np.ndarray  # (n_channel,) A^2 of half a bit; near zero, either sign, without a signal
    surplus: np.ndarray  # (n_channel,) what the last bit was above it
    in_phase: np.ndarray  # (n_channel, 3) sums over bits: in-phase, its variance, how many
    kept: np.ndarray  # (n_channel, most, 5) of each integration since the last hand-over
    n_kept: np.ndarray  # (n_channel,) int64


class ChannelFacts(NamedTuple):
    """What discriminators need to know of each channel, (n_channel,) each."""

    wavelength_m: np.ndarray
    chip_m: np.ndarray
    slope: np.ndarray  # of early minus late [1/chip]
    noise: np.ndarray  # variance of late minus early per component
    pilot: np.ndarray  # bool: no data


def new_pre_filters(amplitude2: np.ndarray, most: int) -> PreFilters:
    """Filters that have not begun; A^2 (n_channel,) expected, room for ``most`` integrations."""
    n = amplitude2.size
    return PreFilters(
        np.zeros((n, 3)), np.zeros((n, 3, 3)), np.full(n, np.nan), amplitude2.copy(), np.zeros(n),
        np.zeros((n, 3)), np.zeros((n, most, 5)), np.zeros(n, dtype=np.int64),
    )  # fmt: skip


def channel_facts(codes: np.ndarray, pilot: np.ndarray, spacing_chips: float) -> ChannelFacts:
    """Facts from `code_model.code_rows`.

    Raises
    ------
    ValueError
        A spacing at which early minus late says nothing of the delay.
    """
    n = len(codes)
    found = np.empty((2, n))
    _early_minus_late(codes, spacing_chips, found)
    if not (found[0] > 0.0).all():
        raise ValueError(f"spacing_chips is {spacing_chips:g}: early minus late has no slope")
    return ChannelFacts(
        codes[:, WAVELENGTH].copy(), codes[:, CHIP].copy(), found[0], found[1], pilot
    )


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def _early_minus_late(codes: np.ndarray, spacing: float, found: np.ndarray) -> None:
    """Slope [1/chip] and noise (2, n_channel)."""
    for i in range(codes.shape[0]):
        params = codes[i].copy()
        params[SPACING] = spacing
        found[0, i] = slope(-spacing, params) - slope(spacing, params)
        found[1, i] = 2.0 * (1.0 - correlation(2.0 * spacing, params))


@kernel
def begin(i: int, code_variance: float, doppler_variance: float, wavelength_m: float,
          pre: PreFilters) -> None:  # fmt: skip
    """Channel i begins where the INS says that it is, with no idea of the phase."""
    pre.mean[i] = 0.0
    pre.cov[i] = 0.0
    pre.cov[i, CODE, CODE] = code_variance
    pre.cov[i, PHASE, PHASE] = (UNKNOWN * wavelength_m) ** 2
    pre.cov[i, DOPPLER, DOPPLER] = doppler_variance
    pre.t_s[i] = np.nan


@kernel
def advance(i: int, t_s: float, clock_sf: float, unrest: float, pre: PreFilters) -> None:
    """Predict channel i to t_s; ``unrest`` S_g + S_a [m2/s3]."""
    dt = t_s - pre.t_s[i]
    pre.t_s[i] = t_s
    if math.isnan(dt):
        return
    x, P = pre.mean[i], pre.cov[i]
    for j in range(2):
        x[j] += dt * x[DOPPLER]
        for m in range(3):
            P[j, m] += dt * P[DOPPLER, m]
    for j in range(2):
        for m in range(3):
            P[m, j] += dt * P[m, DOPPLER]
    both = clock_sf * dt + unrest * dt**3 / 3.0
    for j in range(2):
        for m in range(2):
            P[j, m] += both
        P[j, DOPPLER] += 0.5 * unrest * dt * dt
        P[DOPPLER, j] += 0.5 * unrest * dt * dt
    P[DOPPLER, DOPPLER] += unrest * dt


@kernel
def absorb(
    t_s: float,
    before: np.ndarray,
    rho: np.ndarray,
    rho_rate: np.ndarray,
    phase_m: np.ndarray,
    pre: PreFilters,
) -> None:
    """Take out of the estimates what INS and NCOs have taken in at t_s.

    before (2, n_channel): pseudorange and rate as predicted before the correction, rho and
    rho_rate after it; phase_m (n_channel,): by how much each NCO's phase was moved.
    """
    for i in range(pre.t_s.size):
        rate = rho_rate[i] - before[1, i]
        moved = (pre.t_s[i] - t_s) * rate
        if math.isnan(moved):
            continue
        pre.mean[i, CODE] -= rho[i] - before[0, i] + moved
        pre.mean[i, PHASE] -= phase_m[i] + moved
        pre.mean[i, DOPPLER] -= rate


@kernel
def take_in(
    channel: np.ndarray,
    number: np.ndarray,
    span: np.ndarray,
    iq: np.ndarray,
    facts: ChannelFacts,
    data_bits: np.ndarray,
    first_bit: int,
    clock_sf: float,
    unrest: np.ndarray,
    pre: PreFilters,
) -> int:
    """Let whole bits (`half_bits.Bits`) act on the filters; ``unrest`` (n_channel,) as `advance`.

    data_bits (n_channel, 0): none are known.  Returns the row whose bit is missing, -1 for none.
    """
    known = data_bits.shape[1] > 0
    for b in range(channel.size):
        i = channel[b]
        data = 1.0 if facts.pilot[i] else 0.0
        if known and data == 0.0:
            column = number[b] - first_bit
            if not 0 <= column < data_bits.shape[1]:
                return b
            data = float(data_bits[i, column])
        _take_in_bit(i, data, span[b], iq[b], facts, clock_sf, unrest[i], pre)
        turn = (iq[b, 1, PROMPT] * iq[b, 0, PROMPT].conjugate()).real
        gain = min(1.0, 2.0 * span[b, HALF] / POWER_S)
        pre.power[i], pre.surplus[i] = renewed(pre.power[i], pre.surplus[i], turn, gain)
    return -1


@kernel
def _take_in_bit(
    i: int,
    data: float,
    span: np.ndarray,
    iq: np.ndarray,
    facts: ChannelFacts,
    clock_sf: float,
    unrest: float,
    pre: PreFilters,
) -> None:
    """Both halves of a bit of channel i; data 0: its sign is not known."""
    a2 = max(pre.power[i], AMPLITUDE2_FLOOR)
    radian_m = facts.wavelength_m[i] / (2.0 * math.pi)
    is_open = not pre.cov[i, PHASE, PHASE] < (OPEN * facts.wavelength_m[i]) ** 2
    sign = 1.0 if data == 0.0 else data
    if not is_open:
        sign = _in_phase(i, data, span, iq, a2, radian_m, pre)
    chip_m, k, noise = facts.chip_m[i], facts.slope[i], facts.noise[i]
    code_variance = (chip_m / k) ** 2 * noise * (1.0 / a2 + 2.0 / a2**2)
    share = 1.0 if data != 0.0 else math.erf(math.sqrt(a2))
    h, x, P = np.zeros(3), pre.mean[i], pre.cov[i]
    for half in range(2):
        t_s = span[T_MID] + (half - 0.5) * span[HALF]
        advance(i, t_s, clock_sf, unrest, pre)
        early, prompt, late = iq[half, EARLY], iq[half, PROMPT], iq[half, LATE]
        # a longer range delays the code: the replica's error in chips has the other sign
        code = -chip_m * dot_product_delay(early, prompt, late, a2, k) - span[RANGE]
        h[CODE], h[PHASE] = 1.0, 0.0
        update_one(x, P, h, code - x[CODE], code_variance)
        turned = sign * prompt * _turn(x[PHASE] / radian_m)
        if a2 >= ARCTANGENT_ABOVE or (is_open and half == 0):
            angle = -math.atan2(turned.imag, turned.real)
            variance = (1.0 + 1.0 / a2) / a2
        else:
            angle = -turned.imag / (math.sqrt(a2) * share)
            variance = 1.0 / (a2 * share**2)
        row = pre.kept[i, pre.n_kept[i]]
        row[T_S], row[CODE_M], row[PHASE_M] = t_s, code, x[PHASE] + radian_m * angle
        row[CODE_VARIANCE], row[PHASE_VARIANCE] = code_variance, variance * radian_m**2
        pre.n_kept[i] += 1
        h[CODE], h[PHASE] = 0.0, 1.0
        update_one(x, P, h, radian_m * angle, variance * radian_m**2)


@kernel
def _turn(angle: float) -> complex:
    """exp(j angle)."""
    return complex(math.cos(angle), math.sin(angle))


@kernel
def _in_phase(
    i: int,
    data: float,
    span: np.ndarray,
    iq: np.ndarray,
    a2: float,
    radian_m: float,
    pre: PreFilters,
) -> float:
    """Add what part of the bit's prompt is where the phase was expected; returns the bit's sign.

    cos(error) where the data are known, else cos(2 error): (I^2 - Q^2) / (2 A)^2 holds no noise
    floor.
    """
    total = complex(0.0, 0.0)
    for half in range(2):
        ahead = span[T_MID] + (half - 0.5) * span[HALF] - pre.t_s[i]
        phase = pre.mean[i, PHASE] + ahead * pre.mean[i, DOPPLER]
        total += iq[half, PROMPT] * _turn(phase / radian_m)
    if data != 0.0:
        sums, variance = data * total.real / (2.0 * math.sqrt(a2)), 0.5 / a2
    else:
        sums, variance = (total.real**2 - total.imag**2) / (4.0 * a2), 2.0 / a2 + 1.0 / a2**2
        data = 1.0 if total.real >= 0.0 else -1.0
    pre.in_phase[i, 0] += sums
    pre.in_phase[i, 1] += variance
    pre.in_phase[i, 2] += 1.0
    return data
