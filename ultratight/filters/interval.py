"""Interval ideas: the printed intersection (40)-(42), its statistical form, and interval-Q.

Xu, Zeng & Huang (2017), section 4.  Their posterior interval is the prior interval shifted by
d = K nu; the intersection of [x - w/2, x + w/2] and [x + d - w/2, x + d + w/2] is centred on
x + d/2 and empty when |d| > w.  So (40)-(42) halves the gain while |K nu| < w, and does nothing
otherwise.  Both intersections are kept as documented negative results.  What an interval is good
for is interval-Q: bounds on model parameters become a covariance, and no innovation is used.
Its plain rival is a velocity noise that is larger at all times (`VelocityQ`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from signals.compiled import kernel
from signals.constants import C_MPS, STANDARD_GRAVITY
from ultratight.filters.gaussian import Gaussian, Prediction, Update

HALF_WIDTH_SIGMAS = 3.0
"""Intervals reach this many standard deviations to each side (the paper names no width)"""


def intersect_printed(prior: Gaussian, update: Update) -> Update:
    """Equations (40)-(42): state by state the midpoint of prior and shifted prior interval.

    Width w = 6 sigma of the prior.  Where the intersection is empty the filter's own mean
    stands.  The covariance is the filter's.
    """
    shift = update.mean - prior.mean
    width = 2.0 * HALF_WIDTH_SIGMAS * np.sqrt(np.maximum(np.diag(prior.cov), 0.0))
    mean = np.where(np.abs(shift) <= width, prior.mean + 0.5 * shift, update.mean)
    return update._replace(mean=mean)


def intersect_boxes(prior: Gaussian, update: Update) -> Update:
    """Midpoint of the 3-sigma boxes of prior and posterior; the posterior where they are apart."""
    half0 = HALF_WIDTH_SIGMAS * np.sqrt(np.maximum(np.diag(prior.cov), 0.0))
    half1 = HALF_WIDTH_SIGMAS * np.sqrt(np.maximum(np.diag(update.cov), 0.0))
    low = np.maximum(prior.mean - half0, update.mean - half1)
    high = np.minimum(prior.mean + half0, update.mean + half1)
    return update._replace(mean=np.where(low <= high, 0.5 * (low + high), update.mean))


@dataclass(frozen=True)
class IntervalQ:
    """Bounds on what the error model leaves out, turned into covariance.

        Q_v  += C diag((sbar f_i)^2) C' 2 tau_c T        accelerometer scale factor in +-sbar
        P_v  += C diag((taubar df_i)^2) C'               IMU latency in [0, taubar], before
        P_cd += (c Gbar)^2 |df|^2                        oscillator g-sensitivity, propagation

    f mean specific force of the epoch, df its change.  Keep Gbar = 0 in the coherent model:
    1 ppb/g at 10 g is 3 m/s of drift, 2 rad in 20 ms, and the interval itself breaks the lock.
    """

    scale_factor: float = 3e-3  # sbar
    latency_s: float = 10e-3  # taubar
    g_sensitivity_ppb_per_g: float = 0.0  # Gbar
    correlation_s: float = 0.1  # tau_c

    def __post_init__(self) -> None:
        if min(self.scale_factor, self.latency_s, self.g_sensitivity_ppb_per_g) < 0.0:
            raise ValueError(f"interval bounds: {self}, expected none below 0")
        if self.correlation_s <= 0.0:
            raise ValueError(f"correlation_s: {self.correlation_s}, expected > 0")

    def apply(self, state: Gaussian, prediction: Prediction) -> tuple[Gaussian, Prediction]:
        """State with P widened, prediction with Q widened."""
        layout, C = prediction.layout, prediction.C_b_e
        gamma = self.g_sensitivity_ppb_per_g * 1e-9 / STANDARD_GRAVITY
        P, Q = _widen(
            state.cov, prediction.q, C, prediction.f_b, prediction.df_b,
            layout.v.start, layout.cd.start, self.scale_factor**2 * 2.0 * self.correlation_s
            * prediction.T, self.latency_s, C_MPS * gamma,
        )  # fmt: skip
        return Gaussian(state.mean, P), prediction._replace(q=Q)


@dataclass(frozen=True)
class VelocityQ:
    """White acceleration beyond the data sheet's, at all times: Q += T (Phi G Phi' + G) / 2."""

    density: float  # velocity random walk [m/s/sqrt(s)]

    def __post_init__(self) -> None:
        if not self.density > 0.0:
            raise ValueError(f"velocity random walk: {self.density}, expected > 0")

    def apply(self, prediction: Prediction) -> Prediction:
        """The prediction with Q widened."""
        q = np.array(prediction.q)
        per_half = 0.5 * prediction.T * self.density**2
        add_white_noise(prediction.phi, prediction.layout.v.start, per_half, q)
        return prediction._replace(q=q)


# ---------------------------------------------------------------------------------- kernels


@kernel
def add_white_noise(phi: np.ndarray, first: int, per_half: float, q: np.ndarray) -> None:
    """q (n, n) += per_half (Phi E Phi' + E), E the identity on rows first..first+2."""
    n = q.shape[0]
    for k in range(first, first + 3):
        for i in range(n):
            if phi[i, k] != 0.0:
                for j in range(n):
                    # in this order the two halves of Q get the same bits
                    q[i, j] += per_half * (phi[i, k] * phi[j, k])
        q[k, k] += per_half


@kernel
def _widen(
    cov: np.ndarray,
    q: np.ndarray,
    C: np.ndarray,
    f: np.ndarray,
    df: np.ndarray,
    v: int,
    cd: int,
    per_force: float,
    latency: float,
    clock_per_force: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Copies of P and Q with the interval terms added at rows v..v+2 and cd."""
    P, Q = cov.copy(), q.copy()
    for i in range(3):
        for j in range(3):
            for a in range(3):
                g = C[i, a] * C[j, a]
                Q[v + i, v + j] += g * per_force * f[a] ** 2
                P[v + i, v + j] += g * (latency * df[a]) ** 2
    for a in range(3):
        P[cd, cd] += (clock_per_force * df[a]) ** 2
    return P, Q
