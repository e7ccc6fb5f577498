"""The ends of an epoch's filter step: the transition before it, and the estimate fed back."""

from __future__ import annotations

import math

import numpy as np

from signals.compiled import FAST_SUM, borrowing
from ultratight.ins.error_state import clock_step_into, transition_into
from ultratight.tracking.steering import feed_back, lever, views

ABSURD_SPEED_MPS = 2e4
ABSURD_DRIFT_MPS = 4e4
"""Beyond what a scenario may ask for: an estimate there has nothing to do with a receiver"""
FINE, NOT_FINITE, ABSURD = range(3)
"""What may come of an estimate"""


# ---- kernels ---------------------------------------------------------------------------------


@borrowing
def transition_of(
    buffer: np.ndarray,
    T: float,
    u_before: np.ndarray,
    n_scale: int,
    n_phase: int,
    clock_lag_s: float,
    density: np.ndarray,
    is_first: bool,
    work: np.ndarray,
    Phi: np.ndarray,
    Q: np.ndarray,
    force: np.ndarray,
) -> None:
    """Phi and Q of the epoch of T seconds that ends now; force (2, 3): its mean and its change.

    u_before (n_channel, 3) comes with the lines of sight of the epoch before, leaves with these.
    The first epoch has no change of force.
    """
    s = views(buffer, u_before.shape[0])
    _, _, _, vx, vy, vz = lever(s)
    for i in range(u_before.shape[0]):
        for k in range(3):
            u_before[i, k] = (s.u[i, k] - u_before[i, k]) / T
    transition_into(
        s.r_eb_e, s.C_b_e, s.mean_force[0], T, s.u, u_before, (vx, vy, vz), n_scale, n_phase,
        density, work, Phi, Q,
    )  # fmt: skip
    if n_phase:
        clock_step_into(T, clock_lag_s, n_scale, n_phase, density, Phi, Q)
    for i in range(u_before.shape[0]):
        for k in range(3):
            u_before[i, k] = s.u[i, k]
    for k in range(3):
        force[0, k] = s.mean_force[0, k]
        force[1, k] = 0.0 if is_first else s.mean_force[0, k] - s.mean_force[1, k]


@borrowing
def settle(
    buffer: np.ndarray,
    sky: np.ndarray,
    mean: np.ndarray,
    cov: np.ndarray,
    n: int,
    no_phase: np.ndarray,
    t_s: float,
) -> int:
    """Feed back an estimate of n states and phases, if any, where it is finite; is it absurd?"""
    if not (_is_finite(mean) and _is_finite(cov.reshape(-1))):
        return NOT_FINITE
    feed_back(buffer, sky, mean[:n], mean[n:] if mean.size > n else no_phase, t_s)
    s = views(buffer, no_phase.size)
    v = s.v_eb_e
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return ABSURD if speed > ABSURD_SPEED_MPS or abs(s.clock[1]) > ABSURD_DRIFT_MPS else FINE


@borrowing(fastmath=FAST_SUM)
def _is_finite(x: np.ndarray) -> bool:
    total = 0.0
    for i in range(x.size):
        total += 0.0 * x[i]
    return total == 0.0
