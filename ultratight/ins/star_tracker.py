"""A star tracker beside gyros that run free: attitudes, their difference, and the errors behind it.

C_b_i takes body axes to a frame that does not turn, i; its angles (..., 3) are turns about x, y
and z (roll, heading and pitch of a missile), made in the order z, y, x (`attitude`).  Gyros give
C_ins, never corrected, the tracker C_star = exp([n x]) C_true.  With

    x = [phi, eps, nabla],   C_true = exp([phi x]) C_ins,   measured rate = true + eps + noise
    phi <- -log(exp([C eps tau x]) exp([-phi x])),   eps constant
    nabla <- exp(-tau / tau_a) nabla
    z = angles(C_ins) - angles(C_star) = h(phi) + v
    h = angles(C_ins) - angles(exp([phi x]) C_ins)
    dh / dphi = -M^-1 J(phi),   dphi+ / deps = -J^-1(-phi) C tau

C is the mean of C_ins at both ends of the interval tau, M takes rates of the angles to the angular
velocity in i, J is the left Jacobian of SO(3) (Barfoot, *State Estimation for Robotics*, 7.1.3).
phi may be tens of degrees.  The accelerometers' bias nabla does not enter z: without gravity in the
attitude equation nothing tells of it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from signals.compiled import FAST_SUM, borrowing, kernel
from ultratight.ins.attitude import (
    make_orthonormal,
    rotation,
    turn_left,
    turn_right,
    vector_from_rotation,
)

N_ERRORS = 9


def run_free(C_b_i: ArrayLike, alpha: ArrayLike, every: int = 1) -> np.ndarray:
    """C_b_i (m, 3, 3) by increments alpha (n, 3) [rad], at the start and after each ``every``."""
    C, alpha = np.array(C_b_i, dtype=float), np.ascontiguousarray(alpha, dtype=float)
    if C.shape != (3, 3) or alpha.ndim != 2 or alpha.shape[1] != 3:
        raise ValueError(f"C_b_i, alpha: shapes {C.shape}, {alpha.shape}, expected (3, 3), (n, 3)")
    if every < 1 or len(alpha) == 0 or len(alpha) % every:
        raise ValueError(f"every: {every}, expected a divisor of {len(alpha)} increments")
    out = np.empty((len(alpha) // every + 1, 3, 3))
    _run_free(C, alpha, every, out)
    return out


def turned_by(phi: ArrayLike, C_b_i: ArrayLike) -> np.ndarray:
    """exp([phi x]) C (n, 3, 3) of rotation vectors (n, 3) in axes i [rad]."""
    phi, C = np.ascontiguousarray(phi, dtype=float), np.array(C_b_i, dtype=float)
    if phi.ndim != 2 or phi.shape[1] != 3 or C.shape != (len(phi), 3, 3):
        raise ValueError(f"phi, C_b_i: shapes {phi.shape}, {C.shape}, expected (n, 3), (n, 3, 3)")
    _turn_by(phi, C)
    return C


def turn_between(C_to: np.ndarray, C_from: np.ndarray) -> np.ndarray:
    """Rotation vectors (n, 3) in axes i, C_to = exp([phi x]) C_from."""
    out = np.empty((len(C_to), 3))
    _turn_between(C_to, C_from, out)
    return out


def angles_of(C_b_i: np.ndarray) -> np.ndarray:
    """Angles (n, 3) about x, y, z [rad] of (n, 3, 3)."""
    out = np.empty((len(C_b_i), 3))
    _angles(np.ascontiguousarray(C_b_i), out)
    return out


def wrapped(angle: np.ndarray) -> np.ndarray:
    """To -pi .. pi [rad]."""
    return np.asarray(angle - 2.0 * np.pi * np.round(angle / (2.0 * np.pi)))


def difference(C_ins: np.ndarray, C_star: np.ndarray) -> np.ndarray:
    """z (n, 3) [rad] of attitudes (n, 3, 3)."""
    return wrapped(angles_of(C_ins) - angles_of(C_star))


# --- kernels --------------------------------------------------------------------------------

_vector = kernel(vector_from_rotation)
_SMALL = 1e-3


@kernel
def _run_free(C: np.ndarray, alpha: np.ndarray, every: int, out: np.ndarray) -> None:
    out[0] = C
    for k in range(alpha.shape[0]):
        turn_right(C, alpha[k, 0], alpha[k, 1], alpha[k, 2])
        if (k + 1) % every == 0:
            make_orthonormal(C)
            out[(k + 1) // every] = C


@kernel
def _turn_by(phi: np.ndarray, C: np.ndarray) -> None:
    for k in range(phi.shape[0]):
        turn_left(phi[k, 0], phi[k, 1], phi[k, 2], C[k])


@kernel
def _turn_between(C_to: np.ndarray, C_from: np.ndarray, out: np.ndarray) -> None:
    for k in range(out.shape[0]):
        out[k] = _vector(C_to[k] @ C_from[k].T.copy())


@kernel
def _angles(C: np.ndarray, out: np.ndarray) -> None:
    for k in range(out.shape[0]):
        out[k, 0], out[k, 1], out[k, 2] = angles(
            C[k, 0, 0], C[k, 1, 0], C[k, 2, 0], C[k, 2, 1], C[k, 2, 2]
        )  # fmt: skip


@borrowing
def angles(
    c00: float, c10: float, c20: float, c21: float, c22: float
) -> tuple[float, float, float]:
    """About x, y, z, of the entries of C that they depend on."""
    y = math.atan2(-c20, math.sqrt(c21 * c21 + c22 * c22))
    return math.atan2(c21, c22), y, math.atan2(c10, c00)


@borrowing
def wrap(angle: float) -> float:
    """To -pi .. pi [rad]."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@borrowing
def turned_angles(x: float, y: float, z: float, C: np.ndarray) -> tuple[float, float, float]:
    """Angles of exp([phi x]) C, phi = (x, y, z)."""
    a, b, c, d, e, f, g, h, k = rotation(x, y, z)
    return angles(
        a * C[0, 0] + b * C[1, 0] + c * C[2, 0], d * C[0, 0] + e * C[1, 0] + f * C[2, 0],
        g * C[0, 0] + h * C[1, 0] + k * C[2, 0], g * C[0, 1] + h * C[1, 1] + k * C[2, 1],
        g * C[0, 2] + h * C[1, 2] + k * C[2, 2],
    )  # fmt: skip


@borrowing(fastmath=FAST_SUM)
def predicted(C: np.ndarray, Y: np.ndarray, Z: np.ndarray) -> None:
    """Z (3, p) = h at points Y (3, p), none further than pi from the first."""
    x0, y0, z0 = angles(C[0, 0], C[1, 0], C[2, 0], C[2, 1], C[2, 2])
    for i in range(Y.shape[1]):
        x, y, z = turned_angles(Y[0, i], Y[1, i], Y[2, i], C)
        Z[0, i], Z[1, i], Z[2, i] = wrap(x0 - x), wrap(y0 - y), wrap(z0 - z)
        for q in range(3):
            Z[q, i] = Z[q, 0] + wrap(Z[q, i] - Z[q, 0])


@borrowing(fastmath=FAST_SUM)
def slope(C: np.ndarray, phi: np.ndarray, G: np.ndarray) -> None:
    """G (3, 3) = dh / dphi = -M^-1 J(phi) at phi (3,)."""
    _, y, z = turned_angles(phi[0], phi[1], phi[2], C)
    n2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if n2 < _SMALL * _SMALL:  # the next terms are below 1e-13
        a, b = 0.5 - n2 / 24.0, 1.0 / 6.0 - n2 / 120.0
    else:
        n = math.sqrt(n2)
        a, b = (1.0 - math.cos(n)) / n2, (n - math.sin(n)) / (n2 * n)
    _polynomial(phi, a, b, G)
    c, s, level, up = math.cos(z), math.sin(z), math.cos(y), math.sin(y)
    for j in range(3):
        p, q, r = G[0, j], G[1, j], G[2, j]
        along = (c * p + s * q) / level
        G[0, j], G[1, j], G[2, j] = -along, s * p - c * q, -r - up * along


@borrowing(fastmath=FAST_SUM)
def _polynomial(v: np.ndarray, a: float, b: float, G: np.ndarray) -> None:
    """G = I + a K + b K^2, K = [v x]."""
    x, y, z = v[0], v[1], v[2]
    n2 = x * x + y * y + z * z
    for i in range(3):
        for j in range(3):
            G[i, j] = b * v[i] * v[j]
        G[i, i] += 1.0 - b * n2
    G[0, 1] -= a * z
    G[0, 2] += a * y
    G[1, 0] += a * z
    G[1, 2] -= a * x
    G[2, 0] -= a * y
    G[2, 1] += a * x


@kernel(fastmath=FAST_SUM)
def misalign(
    before: np.ndarray, after: np.ndarray, tau: float, mean: np.ndarray, Phi: np.ndarray
) -> np.ndarray:
    """phi (3,) after an interval between attitudes ``before`` and ``after`` of the INS.

    Its slope goes to Phi (9, 9)[:3, 3:6]; mean (9,).
    """
    v = -mean[:3]
    n2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if n2 < _SMALL * _SMALL:
        b = 1.0 / 12.0 + n2 / 720.0
    else:
        n = math.sqrt(n2)
        b = 1.0 / n2 - (1.0 + math.cos(n)) / (2.0 * n * math.sin(n))
    inverse, turn = np.empty((3, 3)), np.zeros(3)
    _polynomial(v, -0.5, b, inverse)
    for i in range(3):
        for j in range(3):
            s = 0.0
            for m in range(3):
                s -= inverse[i, m] * (before[m, j] + after[m, j])
            Phi[i, 3 + j] = 0.5 * tau * s
            turn[i] += 0.5 * tau * (before[i, j] + after[i, j]) * mean[3 + j]
    C = np.empty((3, 3))
    (
        C[0, 0], C[0, 1], C[0, 2], C[1, 0], C[1, 1], C[1, 2], C[2, 0], C[2, 1], C[2, 2],
    ) = rotation(v[0], v[1], v[2])  # fmt: skip
    turn_left(turn[0], turn[1], turn[2], C)
    return -_vector(C)
