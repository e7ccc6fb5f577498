"""Opening blocks of the covariance: a sudden doubt about bias, velocity and clock drift."""

from __future__ import annotations

import numpy as np

from signals.compiled import kernel
from ultratight.filters.gaussian import Gaussian, Measurement, Prediction


def widen(
    cov: np.ndarray,
    prediction: Prediction,
    variances: tuple[float, float, float, float],
    along: np.ndarray,
    transverse: float = 1.0,
) -> None:
    """Add variances to accelerometer bias, velocity and clock drift, in place.

    variances : of bias, velocity, drift, and of clock bias and all carrier phases alike (fully
        correlated).
    along : (3,) unit vector in body axes.  Across it bias and velocity are opened by the share
        ``transverse`` of the size.
    """
    layout = prediction.layout
    _add(
        cov, layout.accel_bias.start, layout.v.start, layout.cb.start, layout.cd.start,
        layout.phase.start, layout.phase.stop, *variances, along, prediction.C_b_e, transverse,
    )  # fmt: skip


def raised(
    gaussian: Gaussian,
    prediction: Prediction,
    sigmas: tuple[float, float, float],
    phase_share: float,
) -> Gaussian:
    """Variances of bias, velocity and drift raised to at least sigma^2, correlations kept.

    ``phase_share`` T^2 of what the drift gains goes to clock bias and phases.  To add in place of
    raising would wind up where it is done again and again.
    """
    cov, layout = gaussian.cov.copy(), prediction.layout
    now = np.diag(cov).copy()
    for block, sigma in zip((layout.accel_bias, layout.v, layout.cd), sigmas, strict=True):
        rows = np.arange(block.start, block.stop)
        cov[rows, rows] = np.maximum(now[rows], sigma**2)
    gained = float(cov[layout.cd.start, layout.cd.start] - now[layout.cd.start])
    common = phase_share * prediction.T**2 * gained
    widen(cov, prediction, (0.0, 0.0, 0.0, common), np.zeros(3))
    return Gaussian(gaussian.mean, cov)


def told(cov: np.ndarray, state: int, sigma: float) -> np.ndarray:
    """Covariance (n, n) as if one state were told with that sigma, where it is wider."""
    variance = float(cov[state, state])
    if variance <= sigma**2:
        return cov
    slope = cov[:, state] / variance
    return np.asarray(cov - np.outer(slope, slope) * (variance - sigma**2))


def seen_from_a_step(measurement: Measurement, prediction: Prediction) -> Measurement:
    """A as it is for a velocity and a drift that have stepped at the start of this epoch.

    An integration of length L = 2 h whose last part o of it lies after the step has the mean phase
    dv o^2 / 2 L.  Seen from the end of the epoch, T after the step, that is the phase there minus
    dv (T - o^2 / 2 L), where an error as old as the integration has dv times the time to its
    middle.  The phase turned between its halves, divided by h, is the rate it shows.
    """
    if measurement.span is None:
        return measurement
    layout, T = prediction.layout, prediction.T
    middle, h = measurement.span[:, 0] - prediction.t_s, measurement.span[:, 1]
    o = middle + h + T
    partly = o < 2.0 * h
    o = np.maximum(o, 0.0)
    early = np.maximum(o - h, 0.0)
    A, columns = measurement.A.copy(), np.r_[layout.v, layout.cd]
    rate = np.where(partly, (o**2 - 2.0 * early**2) / (2.0 * h**2), 1.0)
    A[:, -1, columns] *= rate[:, None]
    if A.shape[1] > 2:
        back = np.where(partly, (T - o**2 / (4.0 * h)) / -middle, 1.0)
        A[:, 1, columns] *= back[:, None]
    return measurement._replace(A=A)


# ---------------------------------------------------------------------------------- kernels


@kernel
def _add(
    cov: np.ndarray,
    bias: int,
    v: int,
    cb: int,
    cd: int,
    first: int,
    last: int,
    v_a: float,
    v_v: float,
    v_c: float,
    v_p: float,
    along: np.ndarray,
    C: np.ndarray,
    transverse: float,
) -> None:
    """Add the variances in place; v_p on clock bias and phases alike, fully correlated."""
    t2 = transverse**2
    for i in range(3):
        cov[bias + i, bias + i] += t2 * v_a
        cov[v + i, v + i] += t2 * v_v
        for j in range(3):
            cov[bias + i, bias + j] += (1.0 - t2) * v_a * (along[i] * along[j])
            a, b = 0.0, 0.0
            for k in range(3):
                a += C[i, k] * along[k]
                b += C[j, k] * along[k]
            cov[v + i, v + j] += (1.0 - t2) * v_v * (a * b)
    cov[cd, cd] += v_c
    cov[cb, cb] += v_p
    for i in range(first, last):
        cov[cb, i] += v_p
        cov[i, cb] += v_p
        for j in range(first, last):
            cov[i, j] += v_p
