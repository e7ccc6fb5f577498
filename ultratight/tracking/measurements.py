"""What the taps of a data bit say about range, rate and phase: models D and C.

Both work on the two half-bit dumps (10 ms each for GPS L1 C/A) of one data bit, at the receiver
time t_mid in its middle, and on errors (true - estimate) in metres and m/s along the line of
sight.  Writing P, E, L for prompt, early, late, A^2 for the squared amplitude of one half-bit
prompt in units of the noise variance, R for the correlation function of the code, T_h for the
half bit, f = dv / wavelength and d = (dr + known code offset) / chip:

* model D (differential, no data bits needed), y = (dr, dv), z = (Re D, Im D, S),
  D = P1 conj(P2) / A^2, S = mean_h Re((L_h - E_h) conj P_h) / A^2:

      h_I + j h_Q = R(d)^2 sinc^2(f T_h) exp(j 2 pi f T_h)
      h_S = sinc^2(f T_h) R(d) (R(d - spacing) - R(d + spacing))

* model C (coherent, data bits known), y = (dr, p, dv), z = (Re P, -Im P, S) with
  P = bit (P1 + P2) / (2 A), p the carrier-phase error in metres at t_mid:

      h_I + j h_Q = R(d) sinc(2 f T_h) exp(j 2 pi p / wavelength),   h_S as in D.

Receding faster than predicted (dv > 0) turns P2 clockwise against P1, hence Im D > 0.
A known rotation between NCO and reference (`steering`) is taken out of the taps before.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from signals.compiled import kernel
from ultratight.filters.gaussian import Measurement
from ultratight.tracking.half_bits import EARLY, LATE, PROMPT, Bits
from ultratight.tracking.steering import WAVELENGTH_M
from ultratight.tracking.tap_model import TapModel, correlation


class LineOfSight(NamedTuple):
    """Geometry of the epoch and where the error state keeps what."""

    t_s: float
    u: np.ndarray  # (n_channel, 3) antenna -> satellite
    arm_e: np.ndarray  # (3,) lever arm in ECEF [m]
    arm_rate_e: np.ndarray  # (3,) velocity of the antenna with respect to the IMU [m/s]
    C_b_e: np.ndarray  # (3, 3)
    force_e: np.ndarray  # (3,) mean specific force in ECEF [m/s2]


def differential(
    bits: Bits,
    los: LineOfSight,
    n_state: int,
    lag1: np.ndarray,
    spacing_chips: float,
    amplitude2: np.ndarray,
    clock_sf: float,
) -> Measurement:
    """Model D.  lag1 (n_channel,): R at one chip; amplitude2 (n_channel,): A^2; clock_sf: S_f."""
    nb = bits.channel.size
    z, R, A = np.empty((nb, 3)), np.zeros((nb, 3, 3)), np.zeros((nb, 2, n_state))
    params = np.empty((nb, 4))
    _build(bits, los, lag1, spacing_chips, params, A, 1)
    _z_differential(bits.iq, bits.channel, params, amplitude2, clock_sf, z, R)
    model = TapModel(params)
    return Measurement(z, A, R, model, model.jacobian, bits.channel)


def coherent(
    bits: Bits,
    los: LineOfSight,
    n_state: int,
    phase_start: int,
    data: np.ndarray,
    lag1: np.ndarray,
    spacing_chips: float,
    amplitude2: np.ndarray,
    clock_sf: float = 0.0,
) -> Measurement:
    """Model C.  phase_start: first row of the channel phases; data (nb,): known bits of +-1."""
    nb = bits.channel.size
    z, R, A = np.empty((nb, 3)), np.zeros((nb, 3, 3)), np.zeros((nb, 3, n_state))
    params = np.empty((nb, 4))
    _build(bits, los, lag1, spacing_chips, params, A, 2)
    _phase_rows(bits.channel, bits.t_mid_s - los.t_s, los.u, los.arm_e, phase_start, A)
    _z_coherent(bits.iq, bits.channel, data, params, amplitude2, z, R)
    # The covariance holds the clock's white frequency noise up to t; a bit that was centred at
    # t_mid has not met the last of it, and met its own share as a mean over two halves.
    unmet = clock_sf * (los.t_s - bits.t_mid_s - bits.half_s / 6.0)
    R[:, 1, 1] -= np.minimum((2.0 * np.pi / WAVELENGTH_M) ** 2 * unmet, 0.5 * R[:, 1, 1])
    model = TapModel(params)
    return Measurement(z, A, R, model, model.jacobian, bits.channel)


@kernel
def _build(
    bits: Bits,
    los: LineOfSight,
    lag1: np.ndarray,
    spacing: float,
    params: np.ndarray,
    A: np.ndarray,
    rate_row: int,
) -> None:
    """Rows of range (0) and rate (rate_row) of each bit, and the parameters of h."""
    accel = los.force_e
    for b in range(bits.channel.size):
        i = bits.channel[b]
        params[b, 0] = lag1[i]
        params[b, 1] = bits.range_offset_m[b]
        params[b, 2] = bits.half_s[b]
        params[b, 3] = spacing
        u = los.u[i]
        dt = bits.t_mid_s[b] - los.t_s
        # error at t_mid from the state at t: y = A Phi(dt) x, gravity gradient left out
        tilt = np.cross(accel, u)  # d/d psi of -u.(psi x f) is -(f x u)
        arm = np.cross(los.arm_e, u)
        arm_rate = np.cross(los.arm_rate_e, u)
        for k in range(3):
            A[b, 0, k] = -u[k]
            A[b, 0, 3 + k] = -u[k] * dt
            A[b, 0, 6 + k] = -arm[k] - dt * arm_rate[k] - 0.5 * dt * dt * tilt[k]
            A[b, rate_row, 3 + k] = -u[k]
            A[b, rate_row, 6 + k] = -arm_rate[k] - dt * tilt[k]
            lever = los.C_b_e[0, k] * u[0] + los.C_b_e[1, k] * u[1] + los.C_b_e[2, k] * u[2]
            A[b, 0, 9 + k] = 0.5 * dt * dt * lever
            A[b, rate_row, 9 + k] = dt * lever
        A[b, 0, 15] = 1.0
        A[b, 0, 16] = dt
        A[b, rate_row, 16] = 1.0


@kernel
def _phase_rows(
    channel: np.ndarray, dt: np.ndarray, u: np.ndarray, arm: np.ndarray, first: int, A: np.ndarray
) -> None:
    """Row 1: the carrier-phase error at t_mid; it moves like the range, without its level."""
    for b in range(channel.size):
        A[b, 1, 3:12] = A[b, 0, 3:12]
        A[b, 1, 6:9] += np.cross(arm, u[channel[b]])
        A[b, 1, 16] = dt[b]
        A[b, 1, first + channel[b]] = 1.0


@kernel
def _split(
    first: np.ndarray, second: np.ndarray, params: np.ndarray, a2: float
) -> tuple[float, float]:
    """S of two halves and its variance; L - E has 2 (1 - R(2 spacing)) per component and half."""
    s1 = ((first[LATE] - first[EARLY]) * np.conj(first[PROMPT])).real
    s2 = ((second[LATE] - second[EARLY]) * np.conj(second[PROMPT])).real
    half = 1.0 - correlation(2.0 * params[3], params[0])
    return 0.5 * (s1 + s2) / a2, half * (1.0 / a2 + 2.0 / a2**2)


@kernel
def _z_differential(
    iq: np.ndarray,
    channel: np.ndarray,
    params: np.ndarray,
    amplitude2: np.ndarray,
    clock_sf: float,
    z: np.ndarray,
    R: np.ndarray,
) -> None:
    for b in range(channel.size):
        a2 = amplitude2[channel[b]]
        first, second = iq[b, 0], iq[b, 1]
        d = first[PROMPT] * np.conj(second[PROMPT]) / a2
        z[b, 0] = d.real
        z[b, 1] = d.imag
        z[b, 2], R[b, 2, 2] = _split(first, second, params[b], a2)
        r = 2.0 / a2 + 2.0 / a2**2
        R[b, 0, 0] = r
        # white frequency noise of the oscillator turns one half against the other
        R[b, 1, 1] = r + (2.0 * np.pi / WAVELENGTH_M) ** 2 * clock_sf * (2.0 / 3.0) * params[b, 2]


@kernel
def _z_coherent(
    iq: np.ndarray,
    channel: np.ndarray,
    data: np.ndarray,
    params: np.ndarray,
    amplitude2: np.ndarray,
    z: np.ndarray,
    R: np.ndarray,
) -> None:
    for b in range(channel.size):
        a2 = amplitude2[channel[b]]
        first, second = iq[b, 0], iq[b, 1]
        p = data[b] * (first[PROMPT] + second[PROMPT]) / (2.0 * np.sqrt(a2))
        z[b, 0] = p.real
        z[b, 1] = -p.imag
        z[b, 2], R[b, 2, 2] = _split(first, second, params[b], a2)
        R[b, 0, 0] = 0.5 / a2
        R[b, 1, 1] = 0.5 / a2
