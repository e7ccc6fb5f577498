"""Steering: the INS and the clock model command every NCO, and remember what they commanded.

A piece of the command uses only increments that ended before it began.  When the increments of
the piece itself have arrived, the INS says what the replica should have been; the difference
(reference minus NCO) is known to the receiver, is kept here as a cubic per channel and piece,
and enters the expected taps (`measurements`).  It is never an error state.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from signals.compiled import kernel
from signals.constants import C_MPS, CA_CHIP_RATE_HZ, GPS_L1_HZ, OMEGA_EARTH
from signals.propagation import predict_channels
from ultratight.ins.attitude import orthonormalise, product, rotation_from_vector
from ultratight.ins.earth import gravity
from ultratight.ins.strapdown import strapdown_step

WAVELENGTH_M = C_MPS / GPS_L1_HZ
HISTORY_S = 0.06
"""Commands are remembered for this long and an epoch: a bit may have begun two bits ago [s]"""


class Steering(NamedTuple):
    """The running INS, the clock and the command's memory; arrays are updated in place."""

    r_eb_e: np.ndarray  # (3,) IMU position [m]
    v_eb_e: np.ndarray  # (3,) [m/s]
    C_b_e: np.ndarray  # (3, 3)
    gyro_bias: np.ndarray  # (3,) [rad/s]
    accel_bias: np.ndarray  # (3,) [m/s2]
    clock: np.ndarray  # (2,) bias [m], drift [m/s]
    last_alpha: np.ndarray  # (3,) bias-free angle increment of the last IMU interval [rad]
    last_nu: np.ndarray  # (3,) bias-free velocity increment of the last IMU interval [m/s]
    last_dt: np.ndarray  # (1,) its length [s]
    mean_force: np.ndarray  # (2, 3) mean specific force, this epoch and the one before [m/s2]
    rho: np.ndarray  # (n_channel,) predicted pseudorange now [m]
    rho_rate: np.ndarray  # (n_channel,) [m/s]
    u: np.ndarray  # (n_channel, 3) unit vectors antenna -> satellite
    phase_offset: np.ndarray  # (n_channel,) NCO carrier phase + rho / wavelength [cycles]
    known_t_s: np.ndarray  # (n_memory, 2) start and end of remembered pieces [s]
    known_carrier: np.ndarray  # (n_memory, n_channel, 4) reference - NCO, cubic [cycles]
    known_range: np.ndarray  # (n_memory, n_channel, 4) reference - NCO of the code, cubic [m]


def new_steering(n_channel: int, piece_s: float, epoch_s: float = 0.02) -> Steering:
    """Zeroed arrays for ``n_channel`` channels and commands in pieces of ``piece_s`` seconds."""
    n_memory = int(np.ceil((HISTORY_S + epoch_s) / piece_s))
    z = np.zeros
    return Steering(
        z(3), z(3), np.eye(3), z(3), z(3), z(2), z(3), z(3), np.full(1, piece_s), z((2, 3)),
        z(n_channel), z(n_channel), z((n_channel, 3)), z(n_channel),
        np.full((n_memory, 2), -np.inf), z((n_memory, n_channel, 4)), z((n_memory, n_channel, 4)),
    )  # fmt: skip


@kernel
def antenna(s: Steering, lever_arm_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Antenna position and velocity (3,), (3,) from the INS [m, m/s]."""
    arm = s.C_b_e @ lever_arm_b
    omega_ib_e = s.C_b_e @ (s.last_alpha / s.last_dt[0])
    omega_ib_e[2] -= OMEGA_EARTH
    return s.r_eb_e + arm, s.v_eb_e + np.cross(omega_ib_e, arm)


@kernel
def predict_now(s: Steering, rows: np.ndarray, tow_s: float, lever_arm_b: np.ndarray) -> None:
    """Refresh rho, rho_rate and u for the receiver time of week tow_s [s]."""
    r, v = antenna(s, lever_arm_b)
    predict_channels(rows, tow_s, r, v, s.clock[0], s.clock[1], s.rho, s.rho_rate, s.u)


@kernel
def advance_ins(s: Steering, alpha: np.ndarray, nu: np.ndarray, dt: float) -> None:
    """Strapdown and clock over one IMU interval of raw increments (3,), (3,)."""
    # the increments span true time, the stamps are those of the receiver's clock
    elapsed = dt * (1.0 - s.clock[1] / C_MPS)
    corrected_alpha = alpha - s.gyro_bias * elapsed
    corrected_nu = nu - s.accel_bias * elapsed
    r, v, C = strapdown_step(
        s.r_eb_e, s.v_eb_e, s.C_b_e, corrected_alpha, corrected_nu, s.last_alpha, s.last_nu, elapsed
    )
    s.r_eb_e[:] = r
    s.v_eb_e[:] = v
    s.C_b_e[:] = C
    s.clock[0] += s.clock[1] * dt
    s.last_alpha[:] = corrected_alpha
    s.last_nu[:] = corrected_nu
    s.last_dt[0] = dt


@kernel
def steer_epoch(
    s: Steering,
    t_s: np.ndarray,
    alpha: np.ndarray,
    nu: np.ndarray,
    rows: np.ndarray,
    start_tow_s: float,
    code_zero_chips: float,
    lever_arm_b: np.ndarray,
    code_phase: np.ndarray,
    chip_rate: np.ndarray,
    carrier_phase: np.ndarray,
    carrier_freq: np.ndarray,
    carrier_rate: np.ndarray,
) -> None:
    """Command the pieces t_s (m + 1,), taking in the increments (m, 3) one after the other.

    Fills the five (m, n_channel) arrays of an `Nco` and the memory of known differences.
    Expects rho, rho_rate and u to be those of t_s[0]; leaves those of t_s[m].
    """
    n_piece = t_s.size - 1
    n_channel = s.rho.size
    s.known_t_s[:-n_piece] = s.known_t_s[n_piece:].copy()
    s.known_carrier[:-n_piece] = s.known_carrier[n_piece:].copy()
    s.known_range[:-n_piece] = s.known_range[n_piece:].copy()
    s.mean_force[1] = s.mean_force[0]
    s.mean_force[0] = 0.0
    rho = np.empty(n_channel)
    rate = np.empty(n_channel)
    for j in range(n_piece):
        dt = t_s[j + 1] - t_s[j]
        # before the piece: the acceleration of the last interval is the best guess for this one
        accel = s.C_b_e @ (s.last_nu / s.last_dt[0]) + gravity(s.r_eb_e)
        accel[0] += 2.0 * OMEGA_EARTH * s.v_eb_e[1]
        accel[1] -= 2.0 * OMEGA_EARTH * s.v_eb_e[0]
        for i in range(n_channel):
            rho[i] = s.rho[i]
            rate[i] = s.rho_rate[i]
            along = s.u[i, 0] * accel[0] + s.u[i, 1] * accel[1] + s.u[i, 2] * accel[2]
            code_phase[j, i] = code_zero_chips + CA_CHIP_RATE_HZ * (t_s[j] - rho[i] / C_MPS)
            chip_rate[j, i] = CA_CHIP_RATE_HZ * (1.0 - rate[i] / C_MPS)
            carrier_phase[j, i] = s.phase_offset[i] - rho[i] / WAVELENGTH_M
            carrier_freq[j, i] = -rate[i] / WAVELENGTH_M
            carrier_rate[j, i] = along / WAVELENGTH_M
        # after the piece: what the replica should have been
        advance_ins(s, alpha[j], nu[j], dt)
        s.mean_force[0] += s.last_nu / (t_s[n_piece] - t_s[0])
        predict_now(s, rows, start_tow_s + t_s[j + 1], lever_arm_b)
        slot = s.known_t_s.shape[0] - n_piece + j
        s.known_t_s[slot, 0] = t_s[j]
        s.known_t_s[slot, 1] = t_s[j + 1]
        for i in range(n_channel):
            # Hermite cubic through zero value and slope at the start
            e = s.rho[i] - rho[i] - rate[i] * dt
            e_rate = s.rho_rate[i] - rate[i]
            a2 = (3.0 * e - e_rate * dt) / dt**2
            a3 = (e_rate * dt - 2.0 * e) / dt**3
            s.known_range[slot, i, 0] = 0.0
            s.known_range[slot, i, 1] = 0.0
            s.known_range[slot, i, 2] = a2
            s.known_range[slot, i, 3] = a3
            s.known_carrier[slot, i, 0] = 0.0
            s.known_carrier[slot, i, 1] = 0.0
            s.known_carrier[slot, i, 2] = -a2 / WAVELENGTH_M - 0.5 * carrier_rate[j, i]
            s.known_carrier[slot, i, 3] = -a3 / WAVELENGTH_M


@kernel
def feed_back(
    s: Steering,
    x: np.ndarray,
    phase_m: np.ndarray,
    rows: np.ndarray,
    tow_s: float,
    t_now_s: float,
    lever_arm_b: np.ndarray,
) -> None:
    """Correct INS, clock and NCO phases by an estimated error, and the memory with them.

    x (>= 17,): r v psi accel_bias gyro_bias cb cd.  phase_m (n_channel,): carrier-phase error in
    metres (zero in the differential model).  The reference of past pieces is corrected too, so
    that an integration that began before the correction is still compared with one trajectory.
    """
    rho = s.rho.copy()
    rate = s.rho_rate.copy()
    s.r_eb_e[:] += x[0:3]
    s.v_eb_e[:] += x[3:6]
    s.C_b_e[:] = orthonormalise(product(rotation_from_vector(x[6:9].copy()), s.C_b_e))
    s.accel_bias[:] += x[9:12]
    s.gyro_bias[:] += x[12:15]
    s.clock[0] += x[15]
    s.clock[1] += x[16]
    predict_now(s, rows, tow_s, lever_arm_b)
    for i in range(rho.size):
        d_rho = s.rho[i] - rho[i]
        d_rate = s.rho_rate[i] - rate[i]
        # the NCO's phase moves by the phase correction only, not by that of position and clock
        s.phase_offset[i] += (d_rho - phase_m[i]) / WAVELENGTH_M
        for k in range(s.known_t_s.shape[0]):
            if s.known_t_s[k, 1] == -np.inf:
                continue
            back = s.known_t_s[k, 0] - t_now_s
            s.known_range[k, i, 0] += d_rho + back * d_rate
            s.known_range[k, i, 1] += d_rate
            s.known_carrier[k, i, 0] -= (phase_m[i] + back * d_rate) / WAVELENGTH_M
            s.known_carrier[k, i, 1] -= d_rate / WAVELENGTH_M


@kernel
def mean_known(known_t_s: np.ndarray, cubic: np.ndarray, t_start_s: float, t_end_s: float) -> float:
    """Mean over [t_start_s, t_end_s] of piecewise cubics (n_memory, 4)."""
    total = 0.0
    for k in range(known_t_s.shape[0]):
        if known_t_s[k, 1] <= t_start_s:
            continue
        a = max(t_start_s, known_t_s[k, 0]) - known_t_s[k, 0]
        b = min(t_end_s, known_t_s[k, 1]) - known_t_s[k, 0]
        if b > a:
            c = cubic[k]
            upper = b * (c[0] + b * (c[1] / 2.0 + b * (c[2] / 3.0 + b * c[3] / 4.0)))
            lower = a * (c[0] + a * (c[1] / 2.0 + a * (c[2] / 3.0 + a * c[3] / 4.0)))
            total += upper - lower
    return total / (t_end_s - t_start_s)
