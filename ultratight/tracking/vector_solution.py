"""The vector solution between two updates: how it moves, and where it sends the replicas."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from signals.compiled import kernel
from signals.constants import C_MPS, CA_CHIP_RATE_HZ, GPS_L1_HZ
from signals.propagation import predict_channels
from ultratight.tracking.channel_state import CHIP_M, WAVELENGTH_M, Loops
from ultratight.tracking.rows import Fields

NODES, WEIGHTS = (0.5 * x for x in np.polynomial.legendre.leggauss(12))
NODES = NODES + 0.5
"""Gauss-Legendre on [0, 1]: rounding only, for updates up to 2 time constants"""


class VectorSettings(NamedTuple):
    """What the closure may be told; see `ultratight.tables.Vector` for the meanings."""

    carrier: bool = True
    states: int = 11
    acceleration_mps2_sqrt_hz: float = 3.0
    jerk_mps3_sqrt_hz: float = 20.0
    acceleration_sigma_mps2: float = 10.0
    acceleration_tau_s: float = 1.0
    update_s: float = 0.02
    search_bits: int = 2
    search_false_alarm: float = 1e-4
    fall_back: bool = True


UNITS = "products of m, m/s, m, m/s, m/s2"


def fields_of(n_channel: int, k: int) -> Fields:
    """What a vector closure of k states keeps of each row of the history."""
    channel = ((n_channel,), ("channel",))
    own: Fields = {"a_eb_e": ((3,), ("xyz",), "m/s2", "estimated acceleration, ECEF")}
    return {
        "r_eb_e": ((3,), ("xyz",), "m", "estimated antenna position, ECEF"),
        "v_eb_e": ((3,), ("xyz",), "m/s", "estimated antenna velocity, ECEF"),
        "clock_m": ((), (), "m", "estimated receiver clock bias"),
        "clock_rate": ((), (), "m/s", "estimated receiver clock drift"),
        **(own if k > 8 else {}),
        "covariance": ((k, k), ("vector_state", "vector_state_2"), UNITS,
                       "covariance of the vector solution after the update"),
        "nis": ((), (), "1", "normalised innovation squared (NIS) of the update"),
        "n_measurement": ((), (), "1", "how many numbers were measured in the update"),
        "lock_indicator": (*channel, "1", "running cosine of the turn in half a bit"),
        "member": (*channel, "1", "1 steered by the vector solution, 0 by its own loops"),
        "contributes": (*channel, "1", "1 where the channel counts in the solution"),
        "search_chips": (*channel, "chips", "replica minus solution, of who searches"),
        "search_hz": (*channel, "Hz", "replica minus solution, of who searches"),
        "cn0": (*channel, "dB-Hz", "estimated C/N0"),
        "prompt_i": (*channel, "standard deviations of the noise", "in-phase prompt, one bit"),
        "prompt_q": (*channel, "standard deviations of the noise", "quadrature prompt"),
    }  # fmt: skip


def transition(
    settings: VectorSettings, clock_sf: float, clock_sg: float
) -> tuple[np.ndarray, np.ndarray]:
    """Phi and Q of an update period; the clock's densities in m2/s and m2/s3.

    Q is exact, but for the quadrature's rounding: of an acceleration that is white, or of one that
    fades with a time constant and is driven by white jerk (first-order Gauss-Markov, as in Singer,
    IEEE TAES 6, 1970), and of the two-state clock.
    """
    T, n = settings.update_s, settings.states
    phi, q = np.eye(n), np.zeros((n, n))
    phi[6, 7] = T
    q[6, 6], q[7, 7] = clock_sf * T + clock_sg * T**3 / 3.0, clock_sg * T
    q[6, 7] = q[7, 6] = clock_sg * T**2 / 2.0
    for i in range(3):
        phi[i, 3 + i] = T
        if n == 8:
            own, density = [i, 3 + i], settings.acceleration_mps2_sqrt_hz
            gain = np.array([[T**3 / 3.0, T**2 / 2.0], [T**2 / 2.0, T]])
        else:
            own, density = [i, 3 + i, 8 + i], settings.jerk_mps3_sqrt_hz
            s, weight = NODES * T, WEIGHTS * T
            went = faded(s, settings.acceleration_tau_s)
            gain = (went * weight) @ went.T
            phi[own, 8 + i] = faded(np.array([T]), settings.acceleration_tau_s)[:, 0]
        q[np.ix_(own, own)] = density**2 * gain
    return phi, q


def faded(s: np.ndarray, tau_s: float) -> np.ndarray:
    """What an acceleration of 1 m/s2 has become after s (n,) seconds: r, v and itself (3, n)."""
    left = -np.expm1(-s / tau_s)
    return np.stack([tau_s * (s - tau_s * left), tau_s * left, 1.0 - left])


def uncertainty(
    t_s: float, tow_s: float, x: np.ndarray, sky: np.ndarray, cov: np.ndarray
) -> np.ndarray:
    """Covariance (n_channel, 2, 2) of the code phases [chips] and Dopplers [Hz] that x predicts."""
    n = sky.shape[2]
    rho, rate, u = np.empty(n), np.empty(n), np.empty((n, 3))
    predict_channels(sky, tow_s + t_s, x[0:3].copy(), x[3:6].copy(), x[6], x[7], rho, rate, u)
    rows = np.zeros((n, 2, x.size))
    rows[:, 0, 0:3], rows[:, 0, 6] = u / CHIP_M, -1.0 / CHIP_M
    rows[:, 1, 3:6], rows[:, 1, 7] = u / WAVELENGTH_M, -1.0 / WAVELENGTH_M
    return rows @ cov @ np.swapaxes(rows, 1, 2)


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def steer_members(
    t_s: float,
    tow_s: float,
    T: float,
    x: np.ndarray,
    ahead: np.ndarray,
    sky: np.ndarray,
    origin_chips: float,
    member: np.ndarray,
    carrier: bool,
    adrift: np.ndarray,
    off_chips: np.ndarray,
    off_hz: np.ndarray,
    loops: Loops,
    chips_per_s: np.ndarray,
) -> None:
    """Steer members so that they are where x expects them T seconds from t_s; no phase jumps.

    ahead is x at that time; off (n_channel,): so far from there are those that search.
    carrier: frequencies too; where it is False only those of the channels that are adrift.
    """
    n = member.size
    rho, rate, rho1, rate1 = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    u = np.empty((n, 3))
    r, v = x[0:3].copy(), x[3:6].copy()
    predict_channels(sky, tow_s + t_s, r, v, x[6], x[7], rho, rate, u)
    r1, v1 = ahead[0:3].copy(), ahead[3:6].copy()
    predict_channels(sky, tow_s + t_s + T, r1, v1, ahead[6], ahead[7], rho1, rate1, u)
    for i in range(n):
        if not member[i]:
            continue
        doppler, ramp = (
            off_hz[i] - rate[i] / WAVELENGTH_M,
            (rate[i] - rate1[i]) / (T * WAVELENGTH_M),
        )
        if carrier:
            loops.feed[i, 0], loops.feed[i, 1], loops.loop_hz[i] = doppler, ramp, 0.0
        elif adrift[i]:
            loops.carrier_memory[i, 0], loops.carrier_memory[i, 1] = ramp, doppler
            loops.loop_hz[i], loops.last_good_hz[i] = doppler + 0.5 * ramp * T, doppler
        cycles = T * (loops.loop_hz[i] + loops.feed[i, 0] + 0.5 * loops.feed[i, 1] * T)
        target = origin_chips + CA_CHIP_RATE_HZ * (t_s + T - rho1[i] / C_MPS) + off_chips[i]
        chip_rate = CA_CHIP_RATE_HZ * (1.0 + cycles / T / GPS_L1_HZ)
        chips_per_s[i] = (target - loops.code_chips[i]) / T - chip_rate
        loops.loop_chips_per_s[i] = chips_per_s[i]
    loops.feed_t_s[0] = t_s
