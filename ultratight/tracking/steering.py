"""Steering: the INS and the clock model command every NCO, and remember what they commanded.

A piece of the command uses only increments that ended before it began.  When the increments of
the piece itself have arrived, the INS says what the replica should have been; the difference
(reference minus NCO) is known to the receiver, is kept here as a cubic per channel and piece,
and enters the expected taps (`measurements`).  It is never an error state.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.arcs import arcs
from signals.code_start import code_phase_origin
from signals.compiled import borrowing, kernel
from signals.constants import C_MPS, OMEGA_EARTH
from signals.propagation import predict_channels
from ultratight.ins.attitude import make_orthonormal, turn_left
from ultratight.ins.earth import gravity_at
from ultratight.ins.strapdown import strapdown_step
from ultratight.tracking.knows import Knows

HISTORY_S = 0.06
"""Commands are remembered for this long and an epoch: a bit may have begun two bits ago [s]"""
SKY_S = 600.0
"""Orbits are turned into arcs for this long at a time [s]"""


class Steering(NamedTuple):
    """The running INS, the clock and the command's memory; arrays are updated in place.

    All of them are views of ``buffer``: a compiled step is handed that one array, which is four
    microseconds less than all of them, and finds them again by `views`.
    """

    buffer: np.ndarray
    r_eb_e: np.ndarray  # (3,) IMU position [m]
    v_eb_e: np.ndarray  # (3,) [m/s]
    C_b_e: np.ndarray  # (3, 3)
    accel_bias: np.ndarray  # (3,) [m/s2]
    gyro_bias: np.ndarray  # (3,) [rad/s]
    clock: np.ndarray  # (2,) bias [m], drift [m/s]
    accel_scale_factor: np.ndarray  # (3,), stays zero without states for it
    last_alpha: np.ndarray  # (3,) bias-free angle increment of the last IMU interval [rad]
    last_nu: np.ndarray  # (3,) corrected velocity increment of the last IMU interval [m/s]
    last_dt: np.ndarray  # (1,) its length [s]
    mean_force: np.ndarray  # (2, 3) mean specific force, this epoch and the one before [m/s2]
    lever_arm_b: np.ndarray  # (3,) IMU to antenna [m]
    start: np.ndarray  # (1,) time of week at t_s = 0 [s]
    newest: np.ndarray  # (1,) slot of the memory that was written last
    rho: np.ndarray  # (n_channel,) predicted pseudorange now [m]
    rho_rate: np.ndarray  # (n_channel,) [m/s]
    u: np.ndarray  # (n_channel, 3) unit vectors antenna -> satellite
    phase_offset: np.ndarray  # (n_channel,) NCO carrier phase + rho / wavelength [cycles]
    before: np.ndarray  # (2, n_channel) rho and rho_rate before the step under way
    wavelength_m: np.ndarray  # (n_channel,) of the carrier
    chip_rate_hz: np.ndarray  # (n_channel,) nominal
    code_origin: np.ndarray  # (n_channel,) code phase at t_s = 0 [chips]
    known_t_s: np.ndarray  # (n_memory, 2) start and end of remembered pieces, a ring [s]
    known_carrier: np.ndarray  # (n_memory, n_channel, 4) reference - NCO, cubic [cycles]
    known_range: np.ndarray  # (n_memory, n_channel, 4) reference - NCO of the code, cubic [m]


N_NAVIGATION = 23
"""Numbers of a buffer that say where the receiver is: r, v, C, biases, clock, in this order; the
accelerometer scale factors follow"""
_FIXED = 44
_PER_CHANNEL = 11


class Sky:
    """The orbits that a receiver was told, as arcs (`signals.arcs`) of the minutes to come.

    Parameters
    ----------
    elements : (n_channel, N_ELEMENT)
    start_tow_s : time of week at t_s = 0 [s].
    """

    def __init__(self, elements: np.ndarray, start_tow_s: float) -> None:
        self.elements, self.start_tow_s = elements, start_tow_s
        self.end_s = -math.inf
        self.reach(0.0)

    def reach(self, t_s: float) -> None:
        """Have arcs up to receiver time t_s [s]."""
        if t_s > self.end_s:
            from_s = self.start_tow_s + t_s - HISTORY_S
            self.end_s = t_s + SKY_S
            self.arcs = arcs(self.elements, from_s, self.start_tow_s + self.end_s)


def new_steering(n_channel: int, piece_s: float, epoch_s: float = 0.02) -> Steering:
    """Zeroed arrays for ``n_channel`` channels and commands in pieces of ``piece_s`` seconds."""
    n_memory = int(np.ceil((HISTORY_S + epoch_s) / piece_s - 1e-9))
    size = _FIXED + _PER_CHANNEL * n_channel + n_memory * (2 + 8 * n_channel)
    s = _views(np.zeros(size), n_channel)
    s.C_b_e[:] = np.eye(3)
    s.last_dt[:] = piece_s
    s.known_t_s[:] = -np.inf
    return s


def start(knows: Knows, piece_s: float, epoch_s: float = 0.02) -> tuple[Steering, Sky]:
    """INS, clock and orbits as the receiver was told them."""
    s, k = new_steering(knows.prn.size, piece_s, epoch_s), knows
    s.r_eb_e[:], s.v_eb_e[:], s.C_b_e[:] = k.r_eb_e, k.v_eb_e, k.C_b_e
    s.clock[:] = k.clock_m, k.clock_rate_mps
    s.last_nu[:] = k.first_nu
    s.last_alpha[:] = k.first_alpha
    s.lever_arm_b[:] = k.lever_arm_b_m
    s.start[:] = k.start_tow_s
    s.wavelength_m[:] = k.channels.wavelength_m
    s.chip_rate_hz[:] = k.channels.chip_rate_hz
    s.code_origin[:] = code_phase_origin(k.start_tow_s, k.channels.nominal)
    sky = Sky(k.elements, k.start_tow_s)
    predict(s, sky.arcs, 0.0)
    return s, sky


# ---- kernels ---------------------------------------------------------------------------------


def _views(buffer: np.ndarray, n_channel: int) -> Steering:
    """The parts of a buffer."""
    n = n_channel
    n_memory = (buffer.size - _FIXED - _PER_CHANNEL * n) // (2 + 8 * n)
    channels = buffer[_FIXED : _FIXED + _PER_CHANNEL * n]
    memory = buffer[_FIXED + _PER_CHANNEL * n :]
    t_end = 2 * n_memory
    carrier_end = t_end + 4 * n * n_memory
    return Steering(
        buffer,
        buffer[0:3],
        buffer[3:6],
        buffer[6:15].reshape((3, 3)),
        buffer[15:18],
        buffer[18:21],
        buffer[21:23],
        buffer[23:26],
        buffer[26:29],
        buffer[29:32],
        buffer[32:33],
        buffer[33:39].reshape((2, 3)),
        buffer[39:42],
        buffer[42:43],
        buffer[43:44],
        channels[:n],
        channels[n : 2 * n],
        channels[2 * n : 5 * n].reshape((n, 3)),
        channels[5 * n : 6 * n],
        channels[6 * n : 8 * n].reshape((2, n)),
        channels[8 * n : 9 * n],
        channels[9 * n : 10 * n],
        channels[10 * n :],
        memory[:t_end].reshape((n_memory, 2)),
        memory[t_end:carrier_end].reshape((n_memory, n, 4)),
        memory[carrier_end:].reshape((n_memory, n, 4)),
    )


views = kernel(_views, inline="always")
"""`_views` for compiled steps"""


@kernel
def antenna(buffer: np.ndarray, n_channel: int) -> tuple[np.ndarray, np.ndarray]:
    """Antenna position and velocity (3,), (3,) from the INS [m, m/s]."""
    s = views(buffer, n_channel)
    x, y, z, vx, vy, vz = lever(s)
    return s.r_eb_e + np.array([x, y, z]), s.v_eb_e + np.array([vx, vy, vz])


@borrowing
def lever(s: Steering) -> tuple[float, float, float, float, float, float]:
    """Antenna relative to the IMU: position and velocity [m, m/s], ECEF (3 + 3)."""
    arm, rate, C = s.lever_arm_b, s.last_alpha, s.C_b_e
    x = C[0, 0] * arm[0] + C[0, 1] * arm[1] + C[0, 2] * arm[2]
    y = C[1, 0] * arm[0] + C[1, 1] * arm[1] + C[1, 2] * arm[2]
    z = C[2, 0] * arm[0] + C[2, 1] * arm[1] + C[2, 2] * arm[2]
    per_s = 1.0 / s.last_dt[0]
    p = (C[0, 0] * rate[0] + C[0, 1] * rate[1] + C[0, 2] * rate[2]) * per_s
    q = (C[1, 0] * rate[0] + C[1, 1] * rate[1] + C[1, 2] * rate[2]) * per_s
    w = (C[2, 0] * rate[0] + C[2, 1] * rate[1] + C[2, 2] * rate[2]) * per_s - OMEGA_EARTH
    return x, y, z, q * z - w * y, w * x - p * z, p * y - q * x


@borrowing
def predict(s: Steering, sky: np.ndarray, t_s: float) -> None:
    """Refresh rho, rho_rate and u for the receiver time t_s; sky: `signals.arcs.arcs`."""
    x, y, z, vx, vy, vz = lever(s)
    r = (s.r_eb_e[0] + x, s.r_eb_e[1] + y, s.r_eb_e[2] + z)
    v = (s.v_eb_e[0] + vx, s.v_eb_e[1] + vy, s.v_eb_e[2] + vz)
    predict_channels(sky, s.start[0] + t_s, r, v, s.clock[0], s.clock[1], s.rho, s.rho_rate, s.u)


@borrowing
def advance_ins(s: Steering, alpha: np.ndarray, nu: np.ndarray, dt: float) -> None:
    """Strapdown and clock over one IMU interval of raw increments (3,), (3,)."""
    # the increments span true time, the stamps are those of the receiver's clock
    elapsed = dt * (1.0 - s.clock[1] / C_MPS)
    turn = (
        alpha[0] - s.gyro_bias[0] * elapsed,
        alpha[1] - s.gyro_bias[1] * elapsed,
        alpha[2] - s.gyro_bias[2] * elapsed,
    )
    push = (
        (nu[0] - s.accel_bias[0] * elapsed) / (1.0 + s.accel_scale_factor[0]),
        (nu[1] - s.accel_bias[1] * elapsed) / (1.0 + s.accel_scale_factor[1]),
        (nu[2] - s.accel_bias[2] * elapsed) / (1.0 + s.accel_scale_factor[2]),
    )
    strapdown_step(s.r_eb_e, s.v_eb_e, s.C_b_e, turn, push, s.last_alpha, s.last_nu, elapsed)
    s.clock[0] += s.clock[1] * dt
    for i in range(3):
        s.last_alpha[i] = turn[i]
        s.last_nu[i] = push[i]
    s.last_dt[0] = dt


@borrowing
def _acceleration(s: Steering) -> tuple[float, float, float]:
    """d v_eb_e / dt under the specific force of the last interval [m/s2]."""
    C, nu = s.C_b_e, s.last_nu
    per_s = 1.0 / s.last_dt[0]
    g = gravity_at(s.r_eb_e[0], s.r_eb_e[1], s.r_eb_e[2])
    w2 = 2.0 * OMEGA_EARTH
    return (
        (C[0, 0] * nu[0] + C[0, 1] * nu[1] + C[0, 2] * nu[2]) * per_s + g[0] + w2 * s.v_eb_e[1],
        (C[1, 0] * nu[0] + C[1, 1] * nu[1] + C[1, 2] * nu[2]) * per_s + g[1] - w2 * s.v_eb_e[0],
        (C[2, 0] * nu[0] + C[2, 1] * nu[1] + C[2, 2] * nu[2]) * per_s + g[2],
    )


@borrowing
def steer_epoch(
    buffer: np.ndarray,
    sky: np.ndarray,
    t_s: np.ndarray,
    alpha: np.ndarray,
    nu: np.ndarray,
    command: np.ndarray,
) -> None:
    """Command the pieces t_s (m + 1,), taking in the increments (m, 3) one after the other.

    ``buffer`` of a `Steering`; ``command`` (5, m, n_channel) gets code phase, chip rate, carrier
    phase, frequency and its rate of an `Nco`.  Expects rho, rho_rate and u to be those of t_s[0];
    leaves those of t_s[m].
    """
    s = views(buffer, sky.shape[2])
    n_piece = t_s.size - 1
    length = t_s[n_piece] - t_s[0]
    for i in range(3):
        s.mean_force[1, i] = s.mean_force[0, i]
        s.mean_force[0, i] = 0.0
    for j in range(n_piece):
        _command(s, t_s[j], command[:, j])
        # after the piece: what the replica should have been
        advance_ins(s, alpha[j], nu[j], t_s[j + 1] - t_s[j])
        for i in range(3):
            s.mean_force[0, i] += s.last_nu[i] / length
        predict(s, sky, t_s[j + 1])
        _remember(s, t_s[j], t_s[j + 1], command[4, j])


@borrowing
def _command(s: Steering, t: float, out: np.ndarray) -> None:
    """One piece of the command (5, n_channel) from t on, and what was expected at its start."""
    # the acceleration of the last interval is the best guess for this one
    ax, ay, az = _acceleration(s)
    for i in range(s.rho.size):
        rho, rate = s.rho[i], s.rho_rate[i]
        s.before[0, i] = rho
        s.before[1, i] = rate
        wavelength_m = s.wavelength_m[i]
        out[0, i] = s.code_origin[i] + s.chip_rate_hz[i] * (t - rho / C_MPS)
        out[1, i] = s.chip_rate_hz[i] * (1.0 - rate / C_MPS)
        out[2, i] = s.phase_offset[i] - rho / wavelength_m
        out[3, i] = -rate / wavelength_m
        out[4, i] = (s.u[i, 0] * ax + s.u[i, 1] * ay + s.u[i, 2] * az) / wavelength_m


@borrowing
def _remember(s: Steering, t0: float, t1: float, carrier_rate: np.ndarray) -> None:
    """Keep reference - NCO of the piece [t0, t1): Hermite cubics, zero value and slope at t0."""
    slot = (int(s.newest[0]) + 1) % s.known_t_s.shape[0]
    s.newest[0] = slot
    s.known_t_s[slot, 0] = t0
    s.known_t_s[slot, 1] = t1
    dt = t1 - t0
    per_dt2 = 1.0 / (dt * dt)
    for i in range(s.rho.size):
        e = s.rho[i] - s.before[0, i] - s.before[1, i] * dt
        e_rate = s.rho_rate[i] - s.before[1, i]
        a2 = (3.0 * e - e_rate * dt) * per_dt2
        a3 = (e_rate * dt - 2.0 * e) * (per_dt2 / dt)
        length, carrier = s.known_range[slot, i], s.known_carrier[slot, i]
        length[0], length[1], length[2], length[3] = 0.0, 0.0, a2, a3
        carrier[0], carrier[1] = 0.0, 0.0
        carrier[2] = -a2 / s.wavelength_m[i] - 0.5 * carrier_rate[i]
        carrier[3] = -a3 / s.wavelength_m[i]


@borrowing
def feed_back(
    buffer: np.ndarray, sky: np.ndarray, x: np.ndarray, phase_m: np.ndarray, t_s: float
) -> None:
    """Correct INS, clock and NCO phases by an estimated error, and the memory with them.

    ``buffer`` of a `Steering` at receiver time t_s.  x (17,) or (20,): r v psi accel_bias
    gyro_bias cb cd, and accel_scale_factor where there are states for it.  phase_m
    (n_channel,): carrier-phase error in metres (zero in the differential model).
    The reference of past pieces is corrected too, so that an integration that began before the
    correction is still compared with one trajectory.
    """
    n_channel = sky.shape[2]
    s = views(buffer, n_channel)
    for i in range(n_channel):
        s.before[0, i] = s.rho[i]
        s.before[1, i] = s.rho_rate[i]
    for i in range(3):
        s.r_eb_e[i] += x[i]
        s.v_eb_e[i] += x[3 + i]
        s.accel_bias[i] += x[9 + i]
        s.gyro_bias[i] += x[12 + i]
    turn_left(x[6], x[7], x[8], s.C_b_e)
    make_orthonormal(s.C_b_e)
    s.clock[0] += x[15]
    s.clock[1] += x[16]
    for i in range(x.size - 17):
        s.accel_scale_factor[i] += x[17 + i]
    predict(s, sky, t_s)
    for i in range(n_channel):
        # the NCO's phase moves by the phase correction only, not by that of position and clock
        s.phase_offset[i] += (s.rho[i] - s.before[0, i] - phase_m[i]) / s.wavelength_m[i]
    for k in range(s.known_t_s.shape[0]):
        if s.known_t_s[k, 1] == -math.inf:
            continue
        back = s.known_t_s[k, 0] - t_s
        for i in range(n_channel):
            d_rho = s.rho[i] - s.before[0, i]
            d_rate = s.rho_rate[i] - s.before[1, i]
            s.known_range[k, i, 0] += d_rho + back * d_rate
            s.known_range[k, i, 1] += d_rate
            s.known_carrier[k, i, 0] -= (phase_m[i] + back * d_rate) / s.wavelength_m[i]
            s.known_carrier[k, i, 1] -= d_rate / s.wavelength_m[i]


@borrowing
def mean_known(known_t_s: np.ndarray, cubic: np.ndarray, t_start_s: float, t_end_s: float) -> float:
    """Mean over [t_start_s, t_end_s] of piecewise cubics (n_memory, 4), in any order."""
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
