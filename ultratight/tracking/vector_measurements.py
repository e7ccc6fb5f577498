"""What the discriminators of all channels say to the vector solution: one range and one rate each.

Every channel sums its code periods (1 ms) over the halves of a data bit, E, P, L for each, P1 and
P2 the prompts, scaled to unit noise per component.  With A^2 the squared amplitude of such a half
(T_h = 10 ms), R the code's correlation, s the spacing and V = 2 (1 - R(2 s)) the variance of E - L
per component, an update over n bits has

    code       e = mean Re[(E - L) conj P] / (A^2 slope)           [chips]
               var e = V (A^2 + 2) / (2 n A^4 slope^2)
    frequency  f = arg(sum P2 conj P1) / (2 pi T_h)                [Hz]
               var f = (2 / A^2 + 2 / A^4) / (n (2 pi T_h)^2)

(`discriminators`; the first is the dot product of Kaplan & Hegarty, 3rd ed., ch. 8, with its
squaring loss.)  Both are added to what the NCO did meanwhile: pseudorange and rate so measured do
not depend on who steers, nor on how well, and their noises are white from bit to bit.  White
frequency noise S_f of the oscillator is in every rate with 2 S_f / (3 T_h); common to all
channels, it is taken for each one's own, as in the differential taps (`measurements`).

A^2 is a low pass of Re(P2 conj P1), whose mean needs no noise floor; it is what a channel is worth.
Two bits in a row that differ from it by more than a signal's noise allows set it anew: a satellite
that goes behind a building does not count for another second, one that returns counts at once.

A signal that goes is noticed by Page's test (Biometrika 41, 1954) on |P1 P2|, which does not depend
on the frequency: the sum, never below zero, of log-likelihood ratios of noise alone against A^2.
While it is in doubt nothing is measured, lest the solution should follow noise, nor in a bit of
which half is missing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.arcs import arc_index
from signals.codes import GPS_L1CA
from signals.compiled import kernel
from signals.constants import C_MPS, CA_CHIP_RATE_HZ
from signals.propagation import pseudorange_by_arc
from ultratight.tracking.channel_state import (
    BIT_CODES,
    BIT_S,
    CHIP_M,
    HALF_BIT_S,
    WAVELENGTH_M,
)
from ultratight.tracking.discriminators import delay_slope, dot_product_delay, frequency

POWER_GAIN = BIT_S / 1.0
"""A^2: low pass of 1 s"""
STEP_SIGMAS = 3.0
"""Two bits so far from the low pass, on the same side, set it anew"""
NOISE_MEAN, NOISE_VARIANCE = 0.5 * math.pi, 4.0 - 0.25 * math.pi**2
"""Of |P1 P2| without a signal: a product of two Rayleigh amplitudes"""
DOUBT, GONE = 2.0, 12.0
"""Log-likelihood ratios at which a bit is left out, and at which the signal is gone"""
WEAK_SIGMAS, WEAK_SHARE = 3.0, 0.5
"""Half a bit so far below A, and below this share of it, is not whole"""
TESTED_ABOVE = 3.0
"""A^2 (22 dB-Hz) below which too little speaks for either; Gaussian densities are good above"""
CN0_FLOOR_DBHZ = 10.0
ARCTANGENT_ABOVE = 8.0
"""A^2 (26 dB-Hz) below which sin stands for the angle: noise alone would saturate the arctangent"""
HALF_CODES = BIT_CODES // 2


class CodeFacts(NamedTuple):
    """Of each channel's code at the spacing in use."""

    slope: np.ndarray  # (n_channel,) of early minus late [1/chip]
    noise: np.ndarray  # (n_channel,) V, variance of early minus late per component


class Bits(NamedTuple):
    """Sums of the bit under way, and over the bits since the last update; (n_channel, ...)."""

    next_index: np.ndarray  # (n_channel,) int64, of the code period to come
    n_in_bit: np.ndarray  # (n_channel,) int64, negative in a bit that is not whole
    taps: np.ndarray  # (n_channel, 2, 3) early, prompt, late of both halves
    mid_s: np.ndarray  # (n_channel, 2) sums of the middles of the code periods
    mid_chips: np.ndarray  # (n_channel, 2) of the NCO's code phase there
    mid_cycles: np.ndarray  # (n_channel, 2) of its carrier phase there
    n_bit: np.ndarray  # (n_channel,) int64, whole bits since the last update
    delay: np.ndarray  # (n_channel,) sum of Re[(E - L) conj P], both halves
    turn: np.ndarray  # (n_channel,) complex, sum of P2 conj P1
    t_s: np.ndarray  # (n_channel,) sum of the bits' middles
    chips: np.ndarray  # (n_channel,) of the NCO's code phase there
    nco_hz: np.ndarray  # (n_channel,) of the NCO's frequency, middle of half to middle of half
    amplitude2: np.ndarray  # (n_channel,) A^2, may be negative without a signal
    step: np.ndarray  # (n_channel,) what the last bit was above it
    doubt: np.ndarray  # (n_channel,) Page's sum
    coherence: np.ndarray  # (n_channel,) low pass of cos(turn in half a bit), noise included
    prompt: np.ndarray  # (n_channel,) complex, last whole bit, unit noise per component


def code_facts(prn: np.ndarray, spacing_chips: float) -> CodeFacts:
    """Slope and noise of early minus late for GPS L1 C/A; ValueError for a bad spacing."""
    correlation = [GPS_L1CA.autocorrelation(int(p)) for p in prn]
    return CodeFacts(
        np.array([delay_slope(r, spacing_chips) for r in correlation]),
        np.array([2.0 * (1.0 - np.interp(2.0 * spacing_chips, range(3), r[:3]))
                  for r in correlation]),
    )  # fmt: skip


def new_bits(cn0_dbhz: np.ndarray) -> Bits:
    """Nothing heard yet, C/N0 (n_channel,) expected."""
    n, whole, turning = cn0_dbhz.size, np.int64, np.complex128
    real = np.zeros
    return Bits(
        np.full(n, -1, whole), np.full(n, -BIT_CODES, whole), real((n, 2, 3), turning),
        real((n, 2)), real((n, 2)), real((n, 2)), real(n, whole), real(n), real(n, turning),
        real(n), real(n), real(n), amplitude2_of(cn0_dbhz), real(n), real(n), np.ones(n),
        real(n, turning),
    )  # fmt: skip


def amplitude2_of(cn0_dbhz: np.ndarray | float) -> np.ndarray:
    """A^2 of half a bit's prompt."""
    return np.asarray(2.0 * HALF_BIT_S * 10.0 ** (np.asarray(cn0_dbhz) / 10.0))


def cn0_of(amplitude2: np.ndarray) -> np.ndarray:
    """Its inverse [dB-Hz], not below the floor."""
    floor = amplitude2_of(CN0_FLOOR_DBHZ)
    return np.asarray(10.0 * np.log10(np.maximum(amplitude2, floor) / (2.0 * HALF_BIT_S)))


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def take_in(
    channel: np.ndarray,
    index: np.ndarray,
    t_start_s: np.ndarray,
    t_end_s: np.ndarray,
    iq: np.ndarray,
    noise_var: np.ndarray,
    code_chips: tuple[np.ndarray, np.ndarray],
    carrier_cycles: tuple[np.ndarray, np.ndarray],
    bits: Bits,
) -> None:
    """Add dumps of one code period, iq (n_dump, 3); code and carrier phase at start and end."""
    for k in range(channel.size):
        i = channel[k]
        code = index[k] % BIT_CODES
        if index[k] != bits.next_index[i]:  # dumps are missing: the bit is not whole
            bits.n_in_bit[i] = -2 * BIT_CODES
        bits.next_index[i] = index[k] + 1
        if code == 0:
            bits.n_in_bit[i] = 0
            bits.taps[i] = 0.0
            bits.mid_s[i] = 0.0
            bits.mid_chips[i] = 0.0
            bits.mid_cycles[i] = 0.0
        half = code // HALF_CODES
        scale = 1.0 / math.sqrt(noise_var[k] * HALF_CODES)
        for m in range(3):
            bits.taps[i, half, m] += iq[k, m] * scale
        bits.mid_s[i, half] += 0.5 * (t_start_s[k] + t_end_s[k]) / HALF_CODES
        bits.mid_chips[i, half] += 0.5 * (code_chips[0][k] + code_chips[1][k]) / HALF_CODES
        bits.mid_cycles[i, half] += 0.5 * (carrier_cycles[0][k] + carrier_cycles[1][k]) / HALF_CODES
        bits.n_in_bit[i] += 1
        if bits.n_in_bit[i] == BIT_CODES:
            _end_bit(i, bits)


@kernel
def _end_bit(i: int, bits: Bits) -> None:
    """The bit of channel i is whole: add it to the update under way, renew what it is worth."""
    first, second = bits.taps[i, 0], bits.taps[i, 1]
    turn = second[1] * first[1].conjugate()
    bits.doubt[i] = doubted(bits.doubt[i], bits.amplitude2[i], abs(turn))
    if bits.doubt[i] > GONE:
        bits.amplitude2[i] = bits.step[i] = bits.doubt[i] = 0.0
    elif bits.doubt[i] < DOUBT and not _is_weak(bits.amplitude2[i], abs(first[1]), abs(second[1])):
        bits.n_bit[i] += 1
        bits.turn[i] += turn
        for h in range(2):
            # with unit amplitude and slope: both are put in at the update
            early, prompt, late = bits.taps[i, h]
            bits.delay[i] += dot_product_delay(early, prompt, late, 1.0, 1.0)
        bits.t_s[i] += 0.5 * (bits.mid_s[i, 0] + bits.mid_s[i, 1])
        bits.chips[i] += 0.5 * (bits.mid_chips[i, 0] + bits.mid_chips[i, 1])
        bits.nco_hz[i] += (bits.mid_cycles[i, 1] - bits.mid_cycles[i, 0]) / (
            bits.mid_s[i, 1] - bits.mid_s[i, 0]
        )
    bits.prompt[i] = (first[1] + second[1]) / math.sqrt(2.0)
    bits.amplitude2[i], bits.step[i] = renewed(
        bits.amplitude2[i], bits.step[i], turn.real, POWER_GAIN
    )
    power = 0.5 * (abs(first[1]) ** 2 + abs(second[1]) ** 2)
    bits.coherence[i] += 2.5 * POWER_GAIN * (turn.real / max(power, 1e-30) - bits.coherence[i])


@kernel
def _is_weak(amplitude2: float, first: float, second: float) -> bool:
    """Whether one of the halves lacks its signal; their amplitudes have the variance 1."""
    a = math.sqrt(max(amplitude2, 0.0))
    return min(first, second) < min(a - WEAK_SIGMAS, WEAK_SHARE * a)


@kernel
def doubted(before: float, amplitude2: float, product: float) -> float:
    """Page's sum after a bit with product = |P1 P2|, ``before`` it, of a signal of A^2."""
    if amplitude2 < TESTED_ABOVE:
        return 0.0
    off, without = product - (amplitude2 + 1.0), product - NOISE_MEAN
    variance = 2.0 * amplitude2 + 2.0
    ratio = 0.5 * (off * off / variance - without * without / NOISE_VARIANCE)
    return max(0.0, before + ratio + 0.5 * math.log(variance / NOISE_VARIANCE))


@kernel
def renewed(amplitude2: float, before: float, now: float, gain: float) -> tuple[float, float]:
    """A^2 after a bit with Re(P2 conj P1) = now, and what that bit was above it.

    ``before``: what the bit before was above it.  now has the variance 2 A^2 + 2.
    """
    step = now - amplitude2
    limit = STEP_SIGMAS * math.sqrt(2.0 * max(amplitude2, 0.0) + 2.0)
    if min(abs(before), abs(step)) > limit and before * step > 0.0:
        return amplitude2 + 0.5 * (before + step), 0.0
    return amplitude2 + gain * step, (1.0 - gain) * step


@kernel
def observe(
    t_s: float,
    tow_s: float,
    x: np.ndarray,
    sky: np.ndarray,
    origin_chips: float,
    clock_sf: float,
    code: CodeFacts,
    bits: Bits,
    z: np.ndarray,
    A: np.ndarray,
    R: np.ndarray,
    channel: np.ndarray,
) -> int:
    """Measured minus expected range and rate of every channel with a whole bit; starts new sums.

    x (8,) or (11,) is the solution at receiver time t_s, week time tow_s + t_s; sky its arcs.
    Into z (n, 2) [m, m/s], A (n, 2, n_state), R (n, 2, 2), channel (n,); returns how many.
    """
    nb = 0
    n_state = x.size
    r, v = np.empty(3), np.empty(3)
    for i in range(bits.n_bit.size):
        n = bits.n_bit[i]
        if n == 0:
            continue
        a2 = max(bits.amplitude2[i], 2.0 * HALF_BIT_S * 10.0 ** (CN0_FLOOR_DBHZ / 10.0))
        now = bits.turn[i].real / n
        if now > a2 + STEP_SIGMAS * math.sqrt((2.0 * a2 + 2.0) / n):
            a2 = now  # the signal is back, and the low pass does not know it yet
        t_mid = bits.t_s[i] / n
        back = t_mid - t_s
        for k in range(3):
            a = x[8 + k] if n_state > 8 else 0.0
            r[k] = x[k] + back * (x[3 + k] + 0.5 * back * a)
            v[k] = x[3 + k] + back * a
        tow = tow_s + t_mid
        expected, rate, ux, uy, uz = pseudorange_by_arc(
            sky[arc_index(sky, tow)], i, tow, r, v, x[6] + back * x[7], x[7]
        )
        slope = code.slope[i]
        chips = bits.chips[i] / n + bits.delay[i] / (2 * n * a2 * slope)
        hertz = bits.nco_hz[i] / n
        angle = 2.0 * math.pi * HALF_BIT_S
        if a2 > ARCTANGENT_ABOVE:
            hertz += frequency(bits.turn[i], HALF_BIT_S)
        else:
            hertz += bits.turn[i].imag / (n * a2 * angle)
        z[nb, 0] = C_MPS * (t_mid - (chips - origin_chips) / CA_CHIP_RATE_HZ) - expected
        z[nb, 1] = -WAVELENGTH_M * hertz - rate
        R[nb] = 0.0
        R[nb, 0, 0] = code.noise[i] * (a2 + 2.0) / (2.0 * n) * (CHIP_M / (a2 * slope)) ** 2
        R[nb, 1, 1] = (2.0 / a2 + 2.0 / a2**2) / n * (WAVELENGTH_M / angle) ** 2
        R[nb, 1, 1] += 2.0 * clock_sf / (3.0 * HALF_BIT_S * n)
        _geometry(A[nb], (ux, uy, uz), back)
        channel[nb] = i
        nb += 1
        bits.n_bit[i] = 0
        bits.delay[i] = 0.0
        bits.turn[i] = 0.0
        bits.t_s[i] = 0.0
        bits.chips[i] = 0.0
        bits.nco_hz[i] = 0.0
    return nb


@kernel
def _geometry(A: np.ndarray, u: tuple[float, float, float], back: float) -> None:
    """Range and rate (2, n_state) at ``back`` seconds after the time of the state, to first order.

    u points from the antenna to the satellite.
    """
    A[:] = 0.0
    for k in range(3):
        A[0, k] = -u[k]
        A[0, 3 + k] = -u[k] * back
        A[1, 3 + k] = -u[k]
        if A.shape[1] > 8:
            A[0, 8 + k] = -0.5 * u[k] * back * back
            A[1, 8 + k] = -u[k] * back
    A[0, 6] = 1.0
    A[0, 7] = back
    A[1, 7] = 1.0
