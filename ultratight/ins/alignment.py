"""Attitude at the start, of a body that may be moving, from its IMU and its GNSS velocity.

With G(t) the body's turn from t to the end of a window, by the gyros alone, the specific force
f and the velocity v over the Earth belong together as

    C_b_e b(t) = s(t),   b(t) = int G f dt,   s(t) = v(t) - v(0) + int (2 W x v - g) dt

and a vehicle's forward axis points where it goes but for a slip of a degree or so, C_b_e x = v/|v|.
The rotation that fits both best is Wahba's (SIAM Review 7, 1965; by singular values: Markley, J.
Astronautical Sciences 36, 1988), with weights that are inverse variances.  The force levels, the
course gives the heading.  The Earth turns by 0.07 mrad a second meanwhile, which is left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from signals.constants import OMEGA_EARTH
from ultratight.ins.attitude import rotation_from_vector
from ultratight.ins.earth import gravity
from ultratight.ins.imu import Increments

FEWEST = 5
"""Velocities in a window"""
SLIP_SIGMA = np.radians(1.0)
"""Between the forward axis and the course, in both directions"""
_FORCE_AGREES = 0.1
"""Relative: by so much may the specific force's size differ from what the velocities ask for"""
_LEAST_FORCE_MPS2 = 1.0


class Alignment(NamedTuple):
    """Attitude at the last velocity's time."""

    C_b_e: np.ndarray  # (3, 3)
    sigma: np.ndarray  # (3,) about the axes of ECEF [rad]


def align(
    imu: Increments,
    t_s: np.ndarray,
    r_e: np.ndarray,
    v_e: np.ndarray,
    v_sigma_mps: float,
    accel_bias_sigma: float = 0.0,
) -> Alignment:
    """Attitude at t_s[-1] from velocities v_e (n, 3) at t_s (n,), n >= 5, near r_e (3,).

    ``imu`` covers these times; v_sigma_mps is that of each component, accel_bias_sigma [m/s2] that
    of each accelerometer.

    Raises
    ------
    ValueError
        Too few velocities, IMU data that do not cover them, a specific force that does not go with
        them or levels nothing.
    """
    if len(t_s) < FEWEST:
        raise ValueError(f"{len(t_s)} velocities to level by, expected {FEWEST} at least")
    if imu.t_s[0] > t_s[0] or imu.t_s[-1] < t_s[-1]:
        raise ValueError(
            f"IMU data from {imu.t_s[0]:.3f} to {imu.t_s[-1]:.3f} s: expected "
            f"{t_s[0]:.3f} to {t_s[-1]:.3f} s"
        )
    felt, forward = _body(imu, t_s)
    asked = _asked_for(t_s, r_e, v_e)
    # the first velocity is no surer than the others
    b, s = felt - felt.mean(axis=0), asked - asked.mean(axis=0)
    over_s = float(t_s[-1] - t_s[0])
    force = float(np.linalg.norm(felt[-1])) / over_s
    _check_force(force, float(np.linalg.norm(asked[-1])) / over_s)
    M = s.T @ b / v_sigma_mps**2
    information = _information(b) / v_sigma_mps**2
    speed = np.linalg.norm(v_e, axis=1)
    if speed.min() > v_sigma_mps:
        course = v_e / speed[:, None]
        variance = SLIP_SIGMA**2 + (v_sigma_mps / speed.min()) ** 2
        # a slip lasts: all of them count as one
        M += course.T @ forward / (len(t_s) * variance)
        information += _information(forward) / (len(t_s) * variance)
    U, _, Vt = np.linalg.svd(M)
    C = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    # without a heading there is hardly any information about it: no singular matrix
    cov = np.linalg.inv(information + 1e-3 * np.eye(3))
    variance_e = np.diag(C @ cov @ C.T) + (accel_bias_sigma / force) ** 2
    return Alignment(C, np.sqrt(variance_e))


def _body(imu: Increments, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """b (n, 3) and the forward axis (n, 3) at t_s, in body axes of the last of them."""
    turn = np.eye(3)
    first = max(int(np.searchsorted(imu.t_s, t_s[0], "right")) - 1, 0)
    last = int(np.searchsorted(imu.t_s, t_s[-1] - 1e-9))
    force, axis = [np.zeros(3)], [turn[:, 0]]
    for alpha, nu in zip(imu.alpha_ib_b[first:last], imu.nu_ib_b[first:last], strict=True):
        half = rotation_from_vector(0.5 * alpha)
        force.append(force[-1] + turn @ half @ nu)
        turn = turn @ half @ half
        axis.append(turn[:, 0])
    nodes = imu.t_s[first : last + 1]
    # so far in body axes of the first node; turn' takes these to those of the last
    b, x = (
        np.stack([np.interp(t_s, nodes, column) for column in (np.array(rows) @ turn).T], axis=1)
        for rows in (force, axis)
    )
    return b - b[0], x


def _asked_for(t_s: np.ndarray, r_e: np.ndarray, v_e: np.ndarray) -> np.ndarray:
    """s (n, 3) at t_s."""
    earth = np.array([0.0, 0.0, OMEGA_EARTH])
    rate = 2.0 * np.cross(earth, v_e) - gravity(np.ascontiguousarray(r_e, float))
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(t_s)[:, None]
    return v_e - v_e[0] + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])


def _information(vectors: np.ndarray) -> np.ndarray:
    """What directions (n, 3) of unit variance say of a small rotation (3, 3)."""
    return np.eye(3) * np.sum(vectors**2) - vectors.T @ vectors


def _check_force(measured: float, expected: float) -> None:
    if expected < _LEAST_FORCE_MPS2:
        raise ValueError(
            f"the specific force is {expected:.2g} m/s2 where the attitude is looked for, expected "
            f"{_LEAST_FORCE_MPS2:g} at least: nothing to level by"
        )
    if not abs(measured / expected - 1.0) <= _FORCE_AGREES:
        raise ValueError(
            f"the IMU's specific force is {measured:.4g} m/s2, the GNSS velocities ask for "
            f"{expected:.4g}: expected the same within {100.0 * _FORCE_AGREES:g} % (units, or time)"
        )
