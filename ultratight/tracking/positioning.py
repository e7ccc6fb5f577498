"""Position, velocity and clock of one epoch from pseudoranges and their rates, by least squares."""

from __future__ import annotations

import numpy as np

from signals.compiled import kernel
from signals.propagation import pseudorange

FEWEST_CHANNELS = 4
_ITERATIONS = 8
_SMALL_STEP_M = 1e-4
_POOR_GEOMETRY = 1e-9
"""Determinant of A'A / n of unit vectors and clock; 1e-9 means a DOP of a thousand and more"""


@kernel
def least_squares(
    rows: np.ndarray,
    tow_s: float,
    rho: np.ndarray,
    rho_rate: np.ndarray,
    use: np.ndarray,
    solution: np.ndarray,
) -> bool:
    """Unweighted Gauss-Newton solution; False where there is none, ``solution`` then is as it was.

    rows (n, N_ELEMENT); rho (n,) [m] and rho_rate (n,) [m/s] at receiver time of week tow_s; use
    (n,) bool.  solution (8,): r (3), c b [m], v (3), c b' [m/s] of the antenna in ECEF; the
    start, and where the answer goes.  Kaplan & Hegarty, 3rd ed., 2.5.
    """
    if np.sum(use) < FEWEST_CHANNELS:
        return False
    x = solution.copy()
    design = np.ones(4)
    for _ in range(_ITERATIONS):
        normal = np.zeros((4, 4))
        right = np.zeros((4, 2))
        n_used = 0
        for i in range(rows.shape[0]):
            if not use[i]:
                continue
            expected, expected_rate, ux, uy, uz = pseudorange(
                rows[i], tow_s, x[0:3], x[4:7], x[3], x[7]
            )
            design[0], design[1], design[2] = -ux, -uy, -uz
            n_used += 1
            for j in range(4):
                right[j, 0] += design[j] * (rho[i] - expected)
                right[j, 1] += design[j] * (rho_rate[i] - expected_rate)
                for k in range(4):
                    normal[j, k] += design[j] * design[k]
        if not np.linalg.det(normal / n_used) > _POOR_GEOMETRY:
            return False
        step = np.linalg.solve(normal, right)
        x[0:4] += step[:, 0]
        x[4:8] += step[:, 1]
        if np.abs(step).max() < _SMALL_STEP_M:
            solution[:] = x
            return True
    return False
