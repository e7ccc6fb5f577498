"""Strapdown navigation in the local level, and the 15 errors that a GNSS-aided filter estimates.

n is east-north-up, b right-forward-up, position geodetic on WGS-84; ``C`` takes b to n.  With
W = (0, W cos L, W sin L), w_en = (-v_N / R_M, v_E / R_N, v_E tan L / R_N), w_in = W + w_en, radii
with the height in them, and all increments over dt:

    v <- v + exp(-[w_in dt/2 x]) C exp([dth/2 x]) dv - ((2 W + w_en) x v + (0, 0, g)) dt
    L, lon, h <- by the mean of both v;          C <- exp(-[w_in dt x]) C exp([dth x])

(Groves, 2nd ed., 5.4, in north-east-down).  `Path` holds a motion that these equations follow
exactly, so that error-free increments leave no error.  Errors are computed - true but for the
attitude, C_computed = (I - [phi x]) C_true; measured = true + bias + noise:

    phi' = -w_in x phi + dw_in - C eps          dv' = f x phi + ... + C nabla
    x = [phi, dv, dL, dlon, dh, eps, nabla]     (Titterton & Weston, 2nd ed., 12.3)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from signals.compiled import FAST_SUM, borrowing, kernel
from signals.constants import OMEGA_EARTH, WGS84_A, WGS84_E2
from ultratight.ins.attitude import (
    make_orthonormal,
    turn_left,
    turn_right,
)

N_ERRORS = 15
FREE_AIR = 3.086e-6
"""Decrease of gravity with height [1/s2]"""


class Navigation(NamedTuple):
    """What an INS says, and the sensor biases that it has been told of; changed in place."""

    C: np.ndarray  # (3, 3) body to east-north-up
    v: np.ndarray  # (3,) east, north, up [m/s]
    p: np.ndarray  # (3,) latitude, longitude [rad], height [m]
    gyro_bias: np.ndarray  # (3,) [rad/s]
    accel_bias: np.ndarray  # (3,) [m/s2]


class Path(NamedTuple):
    """A true motion at nodes dt_s apart, and what an error-free IMU reports between them."""

    dt_s: float
    attitude: np.ndarray  # (m + 1, 3) pitch, roll, yaw [rad]
    v: np.ndarray  # (m + 1, 3) [m/s]
    p: np.ndarray  # (m + 1, 3)
    alpha: np.ndarray  # (m, 3) [rad]
    nu: np.ndarray  # (m, 3) [m/s]


def rotation_from_attitude(pitch: float, roll: float, yaw: float) -> np.ndarray:
    """C (3, 3), body to n: yaw about Up from north towards west, pitch about x, roll about y."""
    sp, cp, sr, cr = math.sin(pitch), math.cos(pitch), math.sin(roll), math.cos(roll)
    sy, cy = math.sin(yaw), math.cos(yaw)
    return np.array(
        [
            [cy * cr - sy * sp * sr, -sy * cp, cy * sr + sy * sp * cr],
            [sy * cr + cy * sp * sr, cy * cp, sy * sr - cy * sp * cr],
            [-cp * sr, sp, cp * cr],
        ]
    )


def follow(dt_s: float, attitude: ArrayLike, speed_mps: ArrayLike, p0: ArrayLike) -> Path:
    """Path of a body that moves where its nose points: attitude (m + 1, 3), speed (m + 1,).

    ValueError where shapes disagree, a number is not finite, or a latitude is beyond 89 deg.
    """
    a = np.ascontiguousarray(attitude, dtype=float)
    s, p = np.ascontiguousarray(speed_mps, dtype=float), np.array(p0, dtype=float)
    if s.ndim != 1 or s.size < 2 or a.shape != (s.size, 3) or p.shape != (3,):
        raise ValueError(f"attitude, speed: {a.shape}, {s.shape}, expected (m + 1, 3) and (m + 1,)")
    if not (0.0 < dt_s < math.inf and all(np.isfinite(x).all() for x in (a, s, p))):
        raise ValueError("dt_s, attitude, speed, p0: expected finite numbers, dt_s above 0")
    v = np.stack(
        [-np.sin(a[:, 2]) * np.cos(a[:, 0]), np.cos(a[:, 2]) * np.cos(a[:, 0]), np.sin(a[:, 0])],
        axis=1,
    ) * s[:, None]  # fmt: skip
    C = np.array([rotation_from_attitude(*row) for row in a])
    where, alpha, nu = np.empty((s.size, 3)), np.empty((s.size - 1, 3)), np.empty((s.size - 1, 3))
    where[0] = p
    _follow(C, v, where, alpha, nu, dt_s)
    if not np.abs(where[:, 0]).max() < math.radians(89.0):
        raise ValueError(f"p0, speed: latitudes of {np.degrees(p[0])} deg, expected below 89")
    return Path(float(dt_s), a, v, where, alpha, nu)


def advance(
    state: Navigation,
    alpha: np.ndarray,
    nu: np.ndarray,
    dt_s: float,
    densities: tuple[float, float],
    per_step: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Navigate over increments (m, 3), in place; Phi and Q (15, 15) of the errors over them.

    ``densities``: white noise of the gyros [rad2/s] and the accelerometers [m2/s3]; Phi is a
    product of I + F h + (F h)^2 / 2 over ``per_step`` increments each, with F of their middle.
    """
    if per_step < 1 or alpha.shape[0] % per_step or alpha.shape != nu.shape:
        raise ValueError(f"per_step: {per_step}, expected a divisor of {alpha.shape[0]} increments")
    Phi, Q = np.empty((N_ERRORS, N_ERRORS)), np.empty((N_ERRORS, N_ERRORS))
    _advance(*state, alpha, nu, dt_s, densities[0], densities[1], per_step, Phi, Q)
    return Phi, Q


def correct(state: Navigation, error: np.ndarray) -> None:
    """Take an estimated error (15,) out of a state, in place."""
    turn_left(error[0], error[1], error[2], state.C)
    make_orthonormal(state.C)
    state.v[:] -= error[3:6]
    state.p[:] -= error[6:9]
    state.gyro_bias[:] += error[9:12]
    state.accel_bias[:] += error[12:15]


def radii(lat: float, h: float) -> tuple[float, float]:
    """R_M, R_N [m]: of curvature in the meridian and across it, at that height."""
    return _radii(math.sin(lat), h)


# --- kernels --------------------------------------------------------------------------------


@borrowing
def _radii(sine: float, h: float) -> tuple[float, float]:
    w2 = 1.0 - WGS84_E2 * sine * sine
    w = math.sqrt(w2)
    return WGS84_A * (1.0 - WGS84_E2) / (w * w2) + h, WGS84_A / w + h


@borrowing
def _surroundings(v: np.ndarray, p: np.ndarray) -> tuple[float, ...]:
    """Radii, cos L, w_ie (north, up), w_en (3) and the acceleration -(2 w_ie + w_en) x v - g."""
    s, c = math.sin(p[0]), math.cos(p[0])
    RM, RN = _radii(s, p[2])
    wn, wu = OMEGA_EARTH * c, OMEGA_EARTH * s
    ex, ey, ez = -v[1] / RM, v[0] / RN, v[0] * s / (c * RN)
    s2 = s * s
    g = 9.7803267714 * (1.0 + 5.27094e-3 * s2 + 2.32718e-5 * s2 * s2) - FREE_AIR * p[2]
    ay, az = 2.0 * wn + ey, 2.0 * wu + ez
    return (
        RM, RN, c, wn, wu, ex, ey, ez,
        -(ay * v[2] - az * v[1]), -(az * v[0] - ex * v[2]), -(ex * v[1] - ay * v[0]) - g,
    )  # fmt: skip


@borrowing
def _half_turned(
    C: np.ndarray, x: float, y: float, z: float, alpha: np.ndarray, room: np.ndarray
) -> None:
    """room (3, 3) = exp(-[w/2 x]) C exp([alpha/2 x]) with w = (x, y, z)."""
    for i in range(3):
        for j in range(3):
            room[i, j] = C[i, j]
    turn_right(room, 0.5 * alpha[0], 0.5 * alpha[1], 0.5 * alpha[2])
    turn_left(-0.5 * x, -0.5 * y, -0.5 * z, room)


@borrowing
def step(
    C: np.ndarray,
    v: np.ndarray,
    p: np.ndarray,
    alpha: np.ndarray,
    nu: np.ndarray,
    dt: float,
    room: np.ndarray,
) -> None:
    """One interval; room (3, 3)."""
    RM, RN, c, wn, wu, ex, ey, ez, ax, ay, az = _surroundings(v, p)
    x, y, z = ex * dt, (ey + wn) * dt, (ez + wu) * dt
    _half_turned(C, x, y, z, alpha, room)
    e, n, u = v[0], v[1], v[2]
    v[0] += room[0, 0] * nu[0] + room[0, 1] * nu[1] + room[0, 2] * nu[2] + ax * dt
    v[1] += room[1, 0] * nu[0] + room[1, 1] * nu[1] + room[1, 2] * nu[2] + ay * dt
    v[2] += room[2, 0] * nu[0] + room[2, 1] * nu[1] + room[2, 2] * nu[2] + az * dt
    p[0] += 0.5 * (n + v[1]) / RM * dt
    p[1] += 0.5 * (e + v[0]) / (RN * c) * dt
    p[2] += 0.5 * (u + v[2]) * dt
    turn_right(C, alpha[0], alpha[1], alpha[2])
    turn_left(-x, -y, -z, C)


@kernel
def _vector(C: np.ndarray) -> np.ndarray:
    """Rotation vector of a small turn: C = exp([phi x])."""
    s = np.array([C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]])
    sine = 0.5 * math.sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2])
    # asin(x) / x; rounding of sine^2 is of no account for steps far below a radian
    return 0.5 * s * (math.asin(sine) / sine if sine > 1e-9 else 1.0)


@kernel
def _follow(
    C: np.ndarray, v: np.ndarray, p: np.ndarray, alpha: np.ndarray, nu: np.ndarray, dt: float
) -> None:
    """Increments (m, 3) that carry C (m + 1, 3, 3), v (m + 1, 3) from node to node, and p."""
    room, now = np.empty((3, 3)), np.empty((3, 3))
    speed = np.empty(3)
    for k in range(alpha.shape[0]):
        _, _, _, wn, wu, ex, ey, ez, ax, ay, az = _surroundings(v[k], p[k])
        now[:] = C[k + 1]
        turn_left(ex * dt, (ey + wn) * dt, (ez + wu) * dt, now)
        alpha[k] = _vector(C[k].T.copy() @ now)
        _half_turned(C[k], ex * dt, (ey + wn) * dt, (ez + wu) * dt, alpha[k], room)
        for j in range(3):
            nu[k, j] = (
                room[0, j] * (v[k + 1, 0] - v[k, 0] - ax * dt)
                + room[1, j] * (v[k + 1, 1] - v[k, 1] - ay * dt)
                + room[2, j] * (v[k + 1, 2] - v[k, 2] - az * dt)
            )
        p[k + 1], speed[:], now[:] = p[k], v[k], C[k]
        step(now, speed, p[k + 1], alpha[k], nu[k], dt, room)


@borrowing
def system_matrix(
    C: np.ndarray, v: np.ndarray, p: np.ndarray, f: np.ndarray, F: np.ndarray
) -> None:
    """F (15, 15) of x' = F x; f (3,): specific force in body axes."""
    F[:] = 0.0
    RM, RN, c, wn, wu, ex, ey, ez, _, _, _ = _surroundings(v, p)
    t = wu / wn
    A = F[0:3, 3:6]  # d w_en / d v
    A[0, 1], A[1, 0], A[2, 0] = -1.0 / RM, 1.0 / RN, t / RN
    B = F[0:3, 6:9]  # d w_in / d p
    B[1, 0], B[2, 0] = -wu, wn + v[0] / (RN * c * c)
    B[0, 2], B[1, 2], B[2, 2] = v[1] / (RM * RM), -v[0] / (RN * RN), -v[0] * t / (RN * RN)
    _minus_cross(ex, ey + wn, ez + wu, F[0:3, 0:3])
    _minus_cross(ex, ey + 2.0 * wn, ez + 2.0 * wu, F[3:6, 3:6])
    x = C[0, 0] * f[0] + C[0, 1] * f[1] + C[0, 2] * f[2]
    y = C[1, 0] * f[0] + C[1, 1] * f[1] + C[1, 2] * f[2]
    z = C[2, 0] * f[0] + C[2, 1] * f[1] + C[2, 2] * f[2]
    _minus_cross(-x, -y, -z, F[3:6, 0:3])
    for j in range(3):
        # dv' = v x (d w_en + 2 d w_ie); B has w_ie once
        a, b, d = A[0, j], A[1, j], A[2, j]
        F[3, 3 + j] += v[1] * d - v[2] * b
        F[4, 3 + j] += v[2] * a - v[0] * d
        F[5, 3 + j] += v[0] * b - v[1] * a
        a, b, d = B[0, j], B[1, j], B[2, j]
        if j == 0:
            b, d = b - wu, d + wn
        F[3, 6 + j] = v[1] * d - v[2] * b
        F[4, 6 + j] = v[2] * a - v[0] * d
        F[5, 6 + j] = v[0] * b - v[1] * a
        for i in range(3):
            F[i, 9 + j], F[3 + i, 12 + j] = -C[i, j], C[i, j]
    F[5, 8] += FREE_AIR
    F[6, 4], F[6, 8] = 1.0 / RM, -v[1] / (RM * RM)
    F[7, 3], F[7, 6], F[7, 8] = 1.0 / (RN * c), v[0] * t / (RN * c), -v[0] / (RN * RN * c)
    F[8, 5] = 1.0


@borrowing
def _minus_cross(x: float, y: float, z: float, F: np.ndarray) -> None:
    """F (3, 3) = -[(x, y, z) x]."""
    F[0, 1], F[0, 2], F[1, 2] = z, -y, x
    F[1, 0], F[2, 0], F[2, 1] = -z, y, -x


@kernel(fastmath=FAST_SUM)
def _advance(
    C: np.ndarray,
    v: np.ndarray,
    p: np.ndarray,
    gyro_bias: np.ndarray,
    accel_bias: np.ndarray,
    alpha: np.ndarray,
    nu: np.ndarray,
    dt: float,
    gyro: float,
    accel: float,
    per_step: int,
    Phi: np.ndarray,
    Q: np.ndarray,
) -> None:
    """See `advance`."""
    n = N_ERRORS
    a, f, force, room = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3))
    F, M, X = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    h = per_step * dt
    Phi[:], Q[:] = 0.0, 0.0
    for i in range(n):
        Phi[i, i] = 1.0
    for first in range(0, alpha.shape[0], per_step):
        force[:] = 0.0
        for k in range(first, first + per_step):
            for i in range(3):
                force[i] += (nu[k, i] - accel_bias[i] * dt) / h
        for k in range(first, first + per_step):
            if k == first + per_step // 2:
                system_matrix(C, v, p, force, F)
            for i in range(3):
                a[i] = alpha[k, i] - gyro_bias[i] * dt
                f[i] = nu[k, i] - accel_bias[i] * dt
            step(C, v, p, a, f, dt, room)
        for i in range(n):
            for j in range(n):
                M[i, j] = F[i, j] * h
        _add_product(M, M, 0.5, F, True)  # F <- F h + (F h)^2 / 2
        for i in range(n):
            for j in range(n):
                F[i, j] += M[i, j]
        X[:] = Phi
        _add_product(F, X, 1.0, Phi, False)
        _carry(F, Q, X)
        for i in range(3):
            Q[i, i] += gyro * h
            Q[3 + i, 3 + i] += accel * h
    make_orthonormal(C)


@borrowing(fastmath=FAST_SUM)
def _add_product(A: np.ndarray, B: np.ndarray, scale: float, out: np.ndarray, anew: bool) -> None:
    """out (n, n) += scale A B, from zero where anew; zeros of A are passed over."""
    n = A.shape[0]
    for i in range(n):
        if anew:
            for j in range(n):
                out[i, j] = 0.0
        for k in range(n):
            g = scale * A[i, k]
            if g != 0.0:
                for j in range(n):
                    out[i, j] += g * B[k, j]


@borrowing(fastmath=FAST_SUM)
def _carry(D: np.ndarray, Q: np.ndarray, X: np.ndarray) -> None:
    """Q <- (I + D) Q (I + D)', symmetric to the last bit; X (n, n) is room."""
    n = Q.shape[0]
    for _ in range(2):  # Q <- Q' (I + D)', of a Q that is symmetric at first
        for i in range(n):
            for j in range(n):
                X[i, j] = Q[i, j]
        _add_product(D, Q, 1.0, X, False)
        for i in range(n):
            for j in range(n):
                Q[j, i] = X[i, j]
    for i in range(n):
        for j in range(i):
            s = 0.5 * (Q[i, j] + Q[j, i])
            Q[i, j] = s
            Q[j, i] = s
