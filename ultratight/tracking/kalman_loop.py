"""A Kalman filter per channel in place of the loop filters of code and carrier.

Four states, the loop's share of the incoming signal, i.e. without what is fed forward:

    code [chips], carrier phase [cycles], Doppler [Hz], Doppler rate [Hz/s]

Code runs with the carrier (chip rate over carrier frequency), but for a random walk of its own: the
divergence.  The Doppler rate is a random walk too, driven by white jerk, and the oscillator's two
noises act on phase and Doppler (Groves, 2nd ed., 9.3.3; Psiaki & Jung, ION GPS 2002).  A
measurement is the mean of the phase, or of the code, over an integration T that ends with the
state: H = (0, 1, -T/2, T^2/6), and the NCO's own mean over it is known.  Its noise is that of the
discriminator at the present C/N0, hence the bandwidth follows C/N0.  The NCO is steered to where
the estimate says the signal is, with the time constant of an integration.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.compiled import kernel
from signals.constants import CA_CHIP_RATE_HZ, GPS_L1_HZ

CODE, PHASE, DOPPLER, RATE = range(4)
CHIPS_PER_CYCLE = CA_CHIP_RATE_HZ / GPS_L1_HZ
FIRST_SIGMA = (0.2, 0.3, 5.0, 50.0)
"""Of the states, when the FLL hands over: chips, cycles, Hz, Hz/s"""


class KalmanLoop(NamedTuple):
    """What the filters of all channels remember; no channels where they are not in use."""

    mean: np.ndarray  # (n_channel, 4)
    cov: np.ndarray  # (n_channel, 4, 4)
    t_s: np.ndarray  # (n_channel,) time of the estimate, NaN for none
    nco: np.ndarray  # (n_channel, 2) what the loop has had the NCO run: chips, cycles
    rates: np.ndarray  # (n_channel, 2, 2) before and in the last command: chips/s, Hz
    span_s: np.ndarray  # (2,) start and end of the last command
    sums: np.ndarray  # (n_channel, 2) of the NCO's means over the code periods under way


def new_kalman_loop(n: int) -> KalmanLoop:
    """Filters of n channels without an estimate."""
    return KalmanLoop(
        np.zeros((n, 4)), np.zeros((n, 4, 4)), np.full(n, np.nan), np.zeros((n, 2)),
        np.zeros((n, 2, 2)), np.zeros(2), np.zeros((n, 2)),
    )  # fmt: skip


def densities(
    jerk: float, divergence: float, clock_sf: float, clock_sg: float, wavelength_m: float
) -> np.ndarray:
    """Power spectral densities (4,) for `predict_states`, of code, phase, Doppler and rate.

    jerk [m/s^3/sqrt(Hz)], divergence [m/sqrt(s)], clock S_f [m^2/s] and S_g [m^2/s^3].
    """
    chips_per_m = CHIPS_PER_CYCLE / wavelength_m
    own = np.array([(divergence * chips_per_m) ** 2, clock_sf, clock_sg, jerk**2])
    own[1:] /= wavelength_m**2
    return own


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def transition_into(dt: float, q: np.ndarray, F: np.ndarray, Q: np.ndarray) -> None:
    """Transition F (4, 4) and process noise Q (4, 4) over dt."""
    k = CHIPS_PER_CYCLE
    F[:] = 0.0
    for j in range(4):
        F[j, j] = 1.0
    F[1, 2], F[1, 3], F[2, 3] = dt, 0.5 * dt**2, dt
    F[0, 2], F[0, 3] = k * dt, 0.5 * k * dt**2
    Q[:] = 0.0
    # the oscillator's and the vehicle's, of phase, Doppler and rate
    Q[1, 1] = q[1] * dt + q[2] * dt**3 / 3.0 + q[3] * dt**5 / 20.0
    Q[1, 2] = q[2] * dt**2 / 2.0 + q[3] * dt**4 / 8.0
    Q[1, 3] = q[3] * dt**3 / 6.0
    Q[2, 2] = q[2] * dt + q[3] * dt**3 / 3.0
    Q[2, 3] = q[3] * dt**2 / 2.0
    Q[3, 3] = q[3] * dt
    # code does what phase does, and its own
    Q[0, 0] = k * k * Q[1, 1] + q[0] * dt
    for j in range(1, 4):
        Q[0, j] = k * Q[1, j]
    for j in range(4):
        for m in range(j):
            Q[j, m] = Q[m, j]


@kernel
def update_one(x: np.ndarray, P: np.ndarray, h: np.ndarray, nu: float, variance: float) -> None:
    """Take in a scalar innovation nu = z - h x with noise of that variance, in place."""
    Ph = P @ h
    S = variance
    for j in range(x.size):
        S += h[j] * Ph[j]
    for j in range(x.size):
        x[j] += Ph[j] / S * nu
        for m in range(x.size):
            P[j, m] -= Ph[j] * Ph[m] / S


@kernel
def start_estimate(i: int, doppler_hz: float, kalman: KalmanLoop) -> None:
    """Begin where the NCO is, with the Doppler that the FLL has found."""
    kalman.t_s[i] = kalman.span_s[1]
    kalman.mean[i, CODE], kalman.mean[i, PHASE] = kalman.nco[i, 0], kalman.nco[i, 1]
    kalman.mean[i, DOPPLER], kalman.mean[i, RATE] = doppler_hz, 0.0
    kalman.cov[i] = 0.0
    for j in range(4):
        kalman.cov[i, j, j] = FIRST_SIGMA[j] ** 2


@kernel
def add_period(i: int, t_end_s: float, period_s: float, first: bool, kalman: KalmanLoop) -> None:
    """Add the NCO's means over a code period that ended in the last command."""
    if first:
        kalman.sums[i, :] = 0.0
    start, end = kalman.span_s[0], kalman.span_s[1]
    inside = min(max(t_end_s - start, 0.0), period_s)  # of it, in the last command
    outside = period_s - inside
    for j in range(2):
        before, now = kalman.rates[i, 0, j], kalman.rates[i, 1, j]
        at_start = kalman.nco[i, j] - now * (end - start)
        middle = kalman.nco[i, j] - now * (end - t_end_s + 0.5 * inside)
        mean = inside * middle + outside * (at_start - 0.5 * before * outside)
        kalman.sums[i, j] += mean / period_s


@kernel
def close_filter(
    i: int,
    t_end_s: float,
    n_period: int,
    interval_s: float,
    errors: tuple[float, float],
    variances: tuple[float, float],
    turn: float,
    q: np.ndarray,
    kalman: KalmanLoop,
) -> None:
    """Take in the errors (code [chips], phase [cycles]) of an integration of n_period code periods.

    ``turn``: the phase error is known but for multiples of it.
    """
    if math.isnan(kalman.t_s[i]) or t_end_s <= kalman.t_s[i]:
        return  # the integration began before the estimate
    F, Q = np.empty((4, 4)), np.empty((4, 4))
    transition_into(t_end_s - kalman.t_s[i], q, F, Q)
    x, P = F @ kalman.mean[i], F @ kalman.cov[i] @ F.T + Q
    h = np.array([0.0, 1.0, -0.5 * interval_s, interval_s**2 / 6.0])
    nu = errors[1] + kalman.sums[i, 1] / n_period
    for j in range(4):
        nu -= h[j] * x[j]
    nu -= turn * round(nu / turn)
    update_one(x, P, h, nu, variances[1])
    h[CODE], h[PHASE] = 1.0, 0.0
    h[DOPPLER] *= CHIPS_PER_CYCLE
    h[RATE] *= CHIPS_PER_CYCLE
    nu = errors[0] + kalman.sums[i, 0] / n_period
    for j in range(4):
        nu -= h[j] * x[j]
    update_one(x, P, h, nu, variances[0])
    kalman.mean[i] = x
    kalman.cov[i] = 0.5 * (P + P.T)
    kalman.t_s[i] = t_end_s


@kernel
def command(i: int, t_s: float, dt: float, lag_s: float, kalman: KalmanLoop) -> tuple[float, float]:
    """Rates of the loop's share of the NCO [chips/s beside the carrier's, Hz] from t_s to t_s + dt.

    What it is off is made up for with the time constant lag_s.
    """
    x, ahead = kalman.mean[i], t_s - kalman.t_s[i]
    moved = ahead * (x[DOPPLER] + 0.5 * ahead * x[RATE])
    doppler = x[DOPPLER] + (ahead + 0.5 * dt) * x[RATE]
    hz = doppler + (x[PHASE] + moved - kalman.nco[i, 1]) / lag_s
    chips = (x[CODE] + CHIPS_PER_CYCLE * moved - kalman.nco[i, 0]) / lag_s
    return chips + CHIPS_PER_CYCLE * (doppler - hz), hz


@kernel
def ran(
    i: int, chips_per_s: float, hz: float, t0_s: float, t1_s: float, kalman: KalmanLoop
) -> None:
    """Remember what the loop's share of the NCO ran from t0_s to t1_s."""
    kalman.rates[i, 0] = kalman.rates[i, 1]
    kalman.rates[i, 1, 0] = chips_per_s + CHIPS_PER_CYCLE * hz
    kalman.rates[i, 1, 1] = hz
    for j in range(2):
        kalman.nco[i, j] += kalman.rates[i, 1, j] * (t1_s - t0_s)
    kalman.span_s[0], kalman.span_s[1] = t0_s, t1_s
