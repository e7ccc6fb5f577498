"""Rotations: matrices, rotation vectors and Euler angles.

``C_b_n`` takes body (forward-right-down) components to north-east-down; roll, pitch and yaw turn
n into b about the axes 3, 2, 1 in this order (Groves, 2nd ed., 2.20-2.25).
"""

from __future__ import annotations

import math

import numpy as np

from signals.compiled import kernel


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


@kernel
def product(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """A @ B for 3 x 3 matrices, without the price of a BLAS call."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return out


@kernel
def rotation_from_vector(phi: np.ndarray) -> np.ndarray:
    """exp([phi x]) (3, 3) for a rotation vector phi (3,) [rad] (Rodrigues; Groves 5.73)."""
    x, y, z = phi[0], phi[1], phi[2]
    s2 = x * x + y * y + z * z
    if s2 < 1e-4:  # the next terms are below 2e-17
        a = 1.0 - s2 / 6.0 * (1.0 - s2 / 20.0 * (1.0 - s2 / 42.0))
        b = 0.5 * (1.0 - s2 / 12.0 * (1.0 - s2 / 30.0 * (1.0 - s2 / 56.0)))
    else:
        s = math.sqrt(s2)
        a = math.sin(s) / s
        half = math.sin(0.5 * s)
        b = 2.0 * half * half / s2
    C = np.empty((3, 3))
    C[0, 0] = 1.0 - b * (y * y + z * z)
    C[1, 1] = 1.0 - b * (x * x + z * z)
    C[2, 2] = 1.0 - b * (x * x + y * y)
    C[0, 1], C[1, 0] = b * x * y - a * z, b * x * y + a * z
    C[0, 2], C[2, 0] = b * x * z + a * y, b * x * z - a * y
    C[1, 2], C[2, 1] = b * y * z - a * x, b * y * z + a * x
    return C


@kernel
def orthonormalise(C: np.ndarray) -> np.ndarray:
    """The rotation nearest to C (3, 3), which must be within a few tenths of one.

    Newton's iteration C <- C (3 I - C' C) / 2 for the orthogonal polar factor (Higham, *Functions
    of Matrices*, 2008, section 8.3): the error squares at each round.
    """
    out = C.copy()
    half = np.empty((3, 3))
    for _ in range(12):
        error = 0.0
        for i in range(3):
            for j in range(3):
                gram = out[0, i] * out[0, j] + out[1, i] * out[1, j] + out[2, i] * out[2, j]
                defect = (1.0 if i == j else 0.0) - gram
                error = max(error, abs(defect))
                half[i, j] = 0.5 * defect + (1.0 if i == j else 0.0)
        out = product(out, half)
        if error < 1e-9:
            break
    return out
