"""Rotations: matrices, rotation vectors and Euler angles.

``C_b_n`` takes body (forward-right-down) components to north-east-down; roll, pitch and yaw turn
n into b about the axes 3, 2, 1 in this order (Groves, 2nd ed., 2.20-2.25).
"""

from __future__ import annotations

import math

import numpy as np

from signals.compiled import borrowing, kernel


def rotation_from_euler(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """C_b_n (3, 3) from roll, pitch and yaw [rad] (Groves 2.22, transposed)."""
    sr, cr = math.sin(roll), math.cos(roll)
    sp, cp = math.sin(pitch), math.cos(pitch)
    sy, cy = math.sin(yaw), math.cos(yaw)
    return np.array(
        [
            [cp * cy, -cr * sy + sr * sp * cy, sr * sy + cr * sp * cy],
            [cp * sy, cr * cy + sr * sp * sy, -sr * cy + cr * sp * sy],
            [-sp, sr * cp, cr * cp],
        ]
    )


def euler_from_rotation(C_b_n: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw (..., 3) [rad] of C_b_n (..., 3, 3) (Groves 2.23).

    At a pitch of exactly 90 deg roll and yaw are not separable; their values mean nothing there.
    """
    C = np.asarray(C_b_n, float)
    pitch = np.arctan2(-C[..., 2, 0], np.hypot(C[..., 2, 1], C[..., 2, 2]))
    roll = np.arctan2(C[..., 2, 1], C[..., 2, 2])
    yaw = np.arctan2(C[..., 1, 0], C[..., 0, 0])
    return np.stack([roll, pitch, yaw], axis=-1)


def vector_from_rotation(C: np.ndarray) -> np.ndarray:
    """Rotation vector (3,) [rad], at most pi long, of a rotation matrix: C = exp([phi x]).

    By way of the unit quaternion whose largest component is computed first (Shepperd, J. Guidance
    and Control 1, 1978), which is accurate at every angle.
    """
    trace = C[0, 0] + C[1, 1] + C[2, 2]
    squares = np.array([trace, C[0, 0], C[1, 1], C[2, 2]])
    k = int(np.argmax(squares))
    if k == 0:
        q = np.array([1.0 + trace, C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]])
    else:
        i, j, m = k - 1, k % 3, (k + 1) % 3
        q = np.empty(4)
        q[0] = C[m, j] - C[j, m]
        q[1 + i] = 1.0 + 2.0 * C[i, i] - trace
        q[1 + j] = C[j, i] + C[i, j]
        q[1 + m] = C[m, i] + C[i, m]
    q /= math.copysign(np.linalg.norm(q), q[0])
    sine = float(np.linalg.norm(q[1:]))
    if sine < 1e-8:  # 2 asin(s) / s = 2 (1 + s^2 / 6 + ...)
        return 2.0 * q[1:]
    return 2.0 * math.atan2(sine, q[0]) / sine * q[1:]


# --- kernels --------------------------------------------------------------------------------


@kernel
def skew(a: np.ndarray) -> np.ndarray:
    """[a x] (3, 3): skew(a) @ b = a x b."""
    S = np.zeros((3, 3))
    S[0, 1], S[0, 2], S[1, 2] = -a[2], a[1], -a[0]
    S[1, 0], S[2, 0], S[2, 1] = a[2], -a[1], a[0]
    return S


@borrowing
def rotation(x: float, y: float, z: float) -> tuple[float, ...]:
    """exp([phi x]) row by row (9) for a rotation vector x, y, z [rad] (Rodrigues; Groves 5.73)."""
    s2 = x * x + y * y + z * z
    if s2 < 1e-4:  # the next terms are below 2e-17
        a = 1.0 - s2 / 6.0 * (1.0 - s2 / 20.0 * (1.0 - s2 / 42.0))
        b = 0.5 * (1.0 - s2 / 12.0 * (1.0 - s2 / 30.0 * (1.0 - s2 / 56.0)))
    else:
        s = math.sqrt(s2)
        a = math.sin(s) / s
        half = math.sin(0.5 * s)
        b = 2.0 * half * half / s2
    return (
        1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y,
        b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x,
        b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y),
    )  # fmt: skip


@kernel
def rotation_from_vector(phi: np.ndarray) -> np.ndarray:
    """`rotation` of phi (3,) as a matrix (3, 3)."""
    C = np.empty((3, 3))
    (
        C[0, 0], C[0, 1], C[0, 2], C[1, 0], C[1, 1], C[1, 2], C[2, 0], C[2, 1], C[2, 2],
    ) = rotation(phi[0], phi[1], phi[2])  # fmt: skip
    return C


@borrowing
def turn_left(x: float, y: float, z: float, C: np.ndarray) -> None:
    """C (3, 3) <- exp([phi x]) C, in place."""
    a, b, c, d, e, f, g, h, k = rotation(x, y, z)
    for j in range(3):
        p, q, r = C[0, j], C[1, j], C[2, j]
        C[0, j] = a * p + b * q + c * r
        C[1, j] = d * p + e * q + f * r
        C[2, j] = g * p + h * q + k * r


@borrowing
def turn_right(C: np.ndarray, x: float, y: float, z: float) -> None:
    """C (3, 3) <- C exp([phi x]), in place."""
    a, b, c, d, e, f, g, h, k = rotation(x, y, z)
    for i in range(3):
        p, q, r = C[i, 0], C[i, 1], C[i, 2]
        C[i, 0] = p * a + q * d + r * g
        C[i, 1] = p * b + q * e + r * h
        C[i, 2] = p * c + q * f + r * k


@borrowing
def make_orthonormal(C: np.ndarray) -> None:
    """Replace C (3, 3), within a few tenths of a rotation, by the nearest one.

    Newton's iteration C <- C (3 I - C' C) / 2 for the orthogonal polar factor (Higham, *Functions
    of Matrices*, 2008, section 8.3): the error squares at each round.
    """
    for _ in range(12):
        # half of the defect I - C' C, symmetric
        a = 0.5 * (1.0 - (C[0, 0] * C[0, 0] + C[1, 0] * C[1, 0] + C[2, 0] * C[2, 0]))
        b = -0.5 * (C[0, 0] * C[0, 1] + C[1, 0] * C[1, 1] + C[2, 0] * C[2, 1])
        c = -0.5 * (C[0, 0] * C[0, 2] + C[1, 0] * C[1, 2] + C[2, 0] * C[2, 2])
        d = 0.5 * (1.0 - (C[0, 1] * C[0, 1] + C[1, 1] * C[1, 1] + C[2, 1] * C[2, 1]))
        e = -0.5 * (C[0, 1] * C[0, 2] + C[1, 1] * C[1, 2] + C[2, 1] * C[2, 2])
        f = 0.5 * (1.0 - (C[0, 2] * C[0, 2] + C[1, 2] * C[1, 2] + C[2, 2] * C[2, 2]))
        for i in range(3):
            p, q, r = C[i, 0], C[i, 1], C[i, 2]
            C[i, 0] = p + (p * a + q * b + r * c)
            C[i, 1] = q + (p * b + q * d + r * e)
            C[i, 2] = r + (p * c + q * e + r * f)
        if max(abs(a), abs(b), abs(c), abs(d), abs(e), abs(f)) < 0.5e-9:
            break


@kernel
def orthonormalise(C: np.ndarray) -> np.ndarray:
    """The rotation nearest to C (3, 3), see `make_orthonormal`."""
    out = C.copy()
    make_orthonormal(out)
    return out
