"""The vector solution between two updates: how it moves, and where it sends the replicas."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from signals.compiled import kernel
from signals.constants import C_MPS, CA_CHIP_RATE_HZ, GPS_L1_HZ
from signals.propagation import predict_channels
from ultratight.tracking.channel_loops import WAVELENGTH_M, Loops


class VectorSettings(NamedTuple):
    """What the closure may be told; see `ultratight.tables.Vector` for the meanings."""

    carrier: bool = True
    states: int = 11
    acceleration_mps2_sqrt_hz: float = 3.0
    jerk_mps3_sqrt_hz: float = 20.0
    acceleration_sigma_mps2: float = 10.0
    update_s: float = 0.02
    fall_back: bool = True


def transition(
    settings: VectorSettings, clock_sf: float, clock_sg: float
) -> tuple[np.ndarray, np.ndarray]:
    """Phi and Q of an update period; the clock's densities in m2/s and m2/s3.

    Q is exact: of an acceleration or a jerk that is white, and of the two-state clock.
    """
    T, n = settings.update_s, settings.states
    phi, q = np.eye(n), np.zeros((n, n))
    phi[6, 7] = T
    q[6, 6], q[7, 7] = clock_sf * T + clock_sg * T**3 / 3.0, clock_sg * T
    q[6, 7] = q[7, 6] = clock_sg * T**2 / 2.0
    for i in range(3):
        phi[i, 3 + i] = T
        if n == 8:
            own, gain = [i, 3 + i], np.array([[T**3 / 3.0, T**2 / 2.0], [T**2 / 2.0, T]])
            density = settings.acceleration_mps2_sqrt_hz
        else:
            own, density = [i, 3 + i, 8 + i], settings.jerk_mps3_sqrt_hz
            phi[i, 8 + i], phi[3 + i, 8 + i] = 0.5 * T**2, T
            gain = np.array([
                [T**5 / 20.0, T**4 / 8.0, T**3 / 6.0],
                [T**4 / 8.0, T**3 / 3.0, T**2 / 2.0],
                [T**3 / 6.0, T**2 / 2.0, T],
            ])  # fmt: skip
        q[np.ix_(own, own)] = density**2 * gain
    return phi, q


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def steer_members(
    t_s: float,
    tow_s: float,
    T: float,
    x: np.ndarray,
    sky: np.ndarray,
    origin_chips: float,
    member: np.ndarray,
    carrier: bool,
    adrift: np.ndarray,
    loops: Loops,
    chips_per_s: np.ndarray,
) -> None:
    """Steer members so that they are where x expects them T seconds from t_s; no phase jumps.

    carrier: frequencies too; where it is False only those of the channels that are adrift.
    """
    n = member.size
    rho, rate, rho1, rate1 = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    u = np.empty((n, 3))
    r, v = x[0:3].copy(), x[3:6].copy()
    predict_channels(sky, tow_s + t_s, r, v, x[6], x[7], rho, rate, u)
    for k in range(3):
        a = x[8 + k] if x.size > 8 else 0.0
        r[k] += T * (x[3 + k] + 0.5 * T * a)
        v[k] += T * a
    predict_channels(sky, tow_s + t_s + T, r, v, x[6] + T * x[7], x[7], rho1, rate1, u)
    for i in range(n):
        if not member[i]:
            continue
        doppler, ramp = -rate[i] / WAVELENGTH_M, (rate[i] - rate1[i]) / (T * WAVELENGTH_M)
        if carrier:
            loops.feed[i, 0], loops.feed[i, 1], loops.loop_hz[i] = doppler, ramp, 0.0
        elif adrift[i]:
            loops.carrier_memory[i, 0], loops.carrier_memory[i, 1] = ramp, doppler
            loops.loop_hz[i], loops.last_good_hz[i] = doppler + 0.5 * ramp * T, doppler
        cycles = T * (loops.loop_hz[i] + loops.feed[i, 0] + 0.5 * loops.feed[i, 1] * T)
        target = origin_chips + CA_CHIP_RATE_HZ * (t_s + T - rho1[i] / C_MPS)
        chip_rate = CA_CHIP_RATE_HZ * (1.0 + cycles / T / GPS_L1_HZ)
        chips_per_s[i] = (target - loops.code_chips[i]) / T - chip_rate
        loops.loop_chips_per_s[i] = chips_per_s[i]
    loops.feed_t_s[0] = t_s
