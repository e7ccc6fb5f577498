"""Relinearisation where a phase may be off by radians: how wide a prior is, what a step is."""

from __future__ import annotations

import numpy as np

from signals.compiled import borrowing
from ultratight.filters.gaussian import Gaussian, Measurement, Prediction
from ultratight.filters.quadrature import gauss_hermite
from ultratight.filters.rules import Rule

STEP_RAD = 0.15
"""A turn of phase that matters: priors beyond are wide, steps below end the iteration"""


def _wide(d: int) -> tuple[np.ndarray, np.ndarray]:
    return gauss_hermite((3,) + (7,) * (d - 1), d)


WIDE = Rule(
    "gh3-range-7", "projected", _wide, "Gauss-Hermite tensor, 3 points in range, 7 elsewhere"
)
"""Where phase or rate may be off by a good part of a radian; the narrow rule has 3 points"""


def radians_per(measurement: Measurement, prediction: Prediction) -> np.ndarray:
    """Phase in radians per unit of each projected number y (d,): slope of Q = sin where y = 0.

    In the coherent model the rate counts by what it turns in half an epoch.
    """
    nb, d, _ = measurement.A.shape
    _, J = measurement.h_jacobian(np.zeros((nb, d)))
    slope = np.abs(J[:, 1, :]).max(axis=0)
    slope[0] = 0.0
    if d > 2:
        slope[-1] = 0.5 * prediction.T * slope[1]
    return np.asarray(slope)


def is_wide(prior: Gaussian, prediction: Prediction, step_weight: np.ndarray) -> bool:
    """May a phase turn, or start, beyond what three points see?  Weights: `radians_per` / 0.15."""
    layout = prediction.layout
    return _is_wide(prior.cov, layout.cd.start, layout.phase.start, layout.phase.stop, step_weight)


# ---------------------------------------------------------------------------------- kernels


@borrowing
def _is_wide(cov: np.ndarray, cd: int, first: int, last: int, step_weight: np.ndarray) -> bool:
    rate, phase = step_weight[step_weight.size - 1], 0.5 * step_weight[1]
    wide = cov[cd, cd] * (rate * rate) > 1.0
    for i in range(first, last):
        wide |= cov[i, i] * (phase * phase) > 1.0
    return bool(wide)
