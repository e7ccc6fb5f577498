"""Linear error model of a gimballed wander-azimuth INS: 11 navigation errors, 13 of its sensors.

error = what the INS says - true; phi is the small rotation from the true frame w
(`wander_azimuth`) to the platform.  With W = 2 w_ie + w_ew, w = w_ie + w_ew, and all else as there:

    dV_x'  = f_y phi_z - f_z phi_y + (W x V)-errors + acc_x        dV_y' likewise
    phi'   = -w x phi + dw + drift
    acc_x  = b_x + th_xz f_y + Ka_x f_x       acc_y = b_y - th_yz f_x + Ka_y f_y
    drift_x = e_x + Kg_x w_x + m_XX f_x/g + q_ZX (f_z/g - 1)
    drift_y = e_y + Kg_y w_y + m_YY f_y/g + q_ZY (f_z/g - 1)
    drift_z = e_z + Kg_z w_z

The gyros are those of a platform: two of two degrees of freedom with mass unbalance m (drift by
the force along the axis) and quadrature q (by the force along the spin axis z), torquers with
scale factor errors Kg.  V_z is taken as known, sensor errors are constants.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from signals.compiled import FAST_SUM, borrowing, kernel
from signals.constants import OMEGA_EARTH, STANDARD_GRAVITY
from ultratight.ins.wander_azimuth import EARTH_RADIUS, Flight

NAVIGATION = ("dVx", "dVy", "dL", "dlon", "phi_x", "phi_y", "phi_z", "da", "e_x", "e_y", "e_z")
"""States of a filter, [m/s] and [rad], gyro drifts [rad/s]"""
SENSORS = (
    "b_x", "b_y", "th_xz", "th_yz", "Kg_x", "Kg_y", "Kg_z", "Ka_x", "Ka_y",
    "m_XX", "q_ZX", "m_YY", "q_ZY",
)  # fmt: skip
"""Constant sensor errors [m/s2], [rad], [-], and [rad/s] per g for the last four"""
N_NAVIGATION, N_SENSORS = len(NAVIGATION), len(SENSORS)
N_ERRORS = N_NAVIGATION + N_SENSORS

QUADRATURE = ("calibrated", "full", "z-gyro")
"""q acts by f_z/g - 1 (its part at rest is in the fixed drift), by f_z/g, or by f_x, f_y on z"""


def error_matrix(flight: Flight, k: int = 0, quadrature: str = "calibrated") -> np.ndarray:
    """A (24, 24) of x' = A x at row k of a flight; the order is `NAVIGATION`, then `SENSORS`."""
    A = np.zeros((N_ERRORS, N_ERRORS))
    _error_matrix(_points(flight)[k], _quadrature(quadrature), A)
    return A


def transitions(
    flight: Flight, per_epoch: int = 1, quadrature: str = "calibrated"
) -> tuple[np.ndarray, np.ndarray]:
    """Phi (n, 11, 11) and Gamma (n, 11, 13): x_k = Phi x_{k-1} + Gamma (sensor errors).

    ``flight`` has the middles of equal steps, ``per_epoch`` of them to an epoch; each step is
    I + A h + (A h)^2 / 2.  ValueError where steps are not equal or do not fill epochs.
    """
    t = flight.t_s
    h = float(t[1] - t[0]) if t.size > 1 else np.nan
    if per_epoch < 1 or t.size < 2 or t.size % per_epoch:
        raise ValueError(f"per_epoch: {per_epoch} for {t.size} steps, expected whole epochs")
    if not np.allclose(np.diff(t), h, rtol=1e-6, atol=0.0):
        raise ValueError("flight: expected the middles of equal steps")
    Phi = np.empty((t.size // per_epoch, N_NAVIGATION, N_NAVIGATION))
    Gamma = np.empty((len(Phi), N_NAVIGATION, N_SENSORS))
    _transitions(_points(flight), per_epoch, h, _quadrature(quadrature), Phi, Gamma)
    return Phi, Gamma


def propagate(
    Phi: np.ndarray, Gamma: np.ndarray, start: ArrayLike, noise: np.ndarray
) -> np.ndarray:
    """Navigation errors (n + 1, 11) from all 24 at the start and noise (n, 11) of each epoch."""
    first = np.asarray(start, float)
    if first.shape != (N_ERRORS,) or not np.isfinite(first).all():
        raise ValueError(f"start: shape {first.shape}, expected {N_ERRORS} finite errors")
    if noise.shape != Phi.shape[:2] or not np.isfinite(noise).all():
        raise ValueError(f"noise: shape {noise.shape}, expected {Phi.shape[:2]}, all finite")
    driven = Gamma @ first[N_NAVIGATION:] + noise
    x = np.empty((len(Phi) + 1, N_NAVIGATION))
    x[0] = first[:N_NAVIGATION]
    _propagate(Phi, driven, x)
    return x


def _points(flight: Flight) -> np.ndarray:
    """(n, 9): lat, lon, wander, V, f."""
    return np.column_stack([flight.lat, flight.lon, flight.wander, flight.v_w, flight.f_w])


def _quadrature(name: str) -> int:
    if name not in QUADRATURE:
        raise ValueError(f"quadrature: {name!r}, expected one of {', '.join(QUADRATURE)}")
    return QUADRATURE.index(name)


# --- kernels --------------------------------------------------------------------------------


@borrowing
def _error_matrix(point: np.ndarray, quadrature: int, A: np.ndarray) -> None:
    """Rows of the navigation errors, at a point (9,); other entries of A (>= 11, 24) stay zero."""
    L, a = point[0], point[2]
    vx, vy, vz, fx, fy, fz = point[3], point[4], point[5], point[6], point[7], point[8]
    R, sL, cL, sa, ca = EARTH_RADIUS, math.sin(L), math.cos(L), math.sin(a), math.cos(a)
    xl, yl, zl = -OMEGA_EARTH * sL * sa, -OMEGA_EARTH * sL * ca, OMEGA_EARTH * cL
    xa, ya, z_rate = OMEGA_EARTH * cL * ca, -OMEGA_EARTH * cL * sa, OMEGA_EARTH * sL
    wx, wy = -ya - vy / R, xa + vx / R
    v_east, v_north, tL = vx * ca - vy * sa, vx * sa + vy * ca, sL / cL

    A[0, 0], A[0, 1], A[0, 2] = -vz / R, 2.0 * z_rate, 2.0 * (vy * zl - vz * yl)
    A[0, 5], A[0, 6], A[0, 7] = -fz, fy, -2.0 * vz * ya
    A[1, 0], A[1, 1], A[1, 2] = -2.0 * z_rate, -vz / R, 2.0 * (vz * xl - vx * zl)
    A[1, 4], A[1, 6], A[1, 7] = fz, -fx, 2.0 * vz * xa
    A[2, 0], A[2, 1], A[2, 7] = sa / R, ca / R, v_east / R
    A[3, 0], A[3, 1], A[3, 7] = ca / (R * cL), -sa / (R * cL), -v_north / (R * cL)
    A[3, 2] = v_east * tL / (R * cL)
    A[4, 1], A[4, 2], A[4, 5], A[4, 6], A[4, 7] = -1.0 / R, xl, z_rate, -wy, xa
    A[5, 0], A[5, 2], A[5, 4], A[5, 6], A[5, 7] = 1.0 / R, yl, -z_rate, wx, ya
    A[6, 2], A[6, 4], A[6, 5] = zl, wy, -wx
    A[7, 0], A[7, 1], A[7, 7] = -ca * tL / R, sa * tL / R, v_north * tL / R
    A[7, 2] = -v_east / (R * cL * cL)
    A[4, 8], A[5, 9], A[6, 10] = 1.0, 1.0, 1.0

    g = STANDARD_GRAVITY
    A[0, 11], A[0, 13], A[0, 18] = 1.0, fy, fx
    A[1, 12], A[1, 14], A[1, 19] = 1.0, -fx, fy
    A[4, 15], A[5, 16], A[6, 17] = wx, wy, z_rate
    A[4, 20], A[5, 22] = fx / g, fy / g
    if quadrature == 2:
        A[6, 21], A[6, 23] = fx / g, fy / g
    else:
        A[4, 21] = fz / g - (1.0 if quadrature == 0 else 0.0)
        A[5, 23] = A[4, 21]


@kernel(fastmath=FAST_SUM)
def _transitions(
    points: np.ndarray,
    per_epoch: int,
    h: float,
    quadrature: int,
    Phi: np.ndarray,
    Gamma: np.ndarray,
) -> None:
    n, n_all = Phi.shape[1], Phi.shape[1] + Gamma.shape[2]
    A = np.zeros((n, n_all))
    Y, D1, D2 = np.empty((n, n_all)), np.empty((n, n_all)), np.empty((n, n_all))
    for k in range(Phi.shape[0]):
        for i in range(n):
            for j in range(n_all):
                Y[i, j] = 1.0 if i == j else 0.0
        for step in range(per_epoch):
            _error_matrix(points[k * per_epoch + step], quadrature, A)
            # [Y; 0 I] is the transition so far: its derivative is A [Y; 0 I]
            _rows_times(A, Y, D1)
            for i in range(n):
                for j in range(n, n_all):
                    D1[i, j] += A[i, j]
            _rows_times(A, D1, D2)
            for i in range(n):
                for j in range(n_all):
                    Y[i, j] += h * (D1[i, j] + 0.5 * h * D2[i, j])
        for i in range(n):
            for j in range(n):
                Phi[k, i, j] = Y[i, j]
            for j in range(n, n_all):
                Gamma[k, i, j - n] = Y[i, j]


@borrowing(fastmath=FAST_SUM)
def _rows_times(A: np.ndarray, Y: np.ndarray, out: np.ndarray) -> None:
    """out = A[:, :n] Y with the zeros of A passed over."""
    for i in range(Y.shape[0]):
        for j in range(Y.shape[1]):
            out[i, j] = 0.0
        for c in range(Y.shape[0]):
            g = A[i, c]
            if g != 0.0:
                for j in range(Y.shape[1]):
                    out[i, j] += g * Y[c, j]


@borrowing(fastmath=FAST_SUM)
def _propagate(Phi: np.ndarray, driven: np.ndarray, x: np.ndarray) -> None:
    for k in range(driven.shape[0]):
        for i in range(driven.shape[1]):
            s = driven[k, i]
            for j in range(driven.shape[1]):
                s += Phi[k, i, j] * x[k, j]
            x[k + 1, i] = s
