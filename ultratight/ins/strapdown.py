"""Strapdown navigation in ECEF: integrates IMU increments into position, velocity, attitude.

Groves, 2nd ed., section 5.3 (ECEF equations), with the attitude and velocity increments of Savage,
"Strapdown Inertial Navigation Integration Algorithm Design", J. Guidance, Control, and Dynamics
21 (1998): finite rotation inside the interval, and coning and sculling from the previous
increment, exact for rates and forces that are linear over two intervals.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from signals.compiled import borrowing, kernel
from signals.constants import OMEGA_EARTH
from ultratight.ins.attitude import orthonormalise, rotation_from_vector, turn_right
from ultratight.ins.earth import gravity_at
from ultratight.ins.error_state import Layout
from ultratight.ins.imu import Increments

_NONE = np.zeros(3)
_NONE.flags.writeable = False


class NavState(NamedTuple):
    """What the receiver believes of its motion, its sensors and its clock."""

    t_s: float  # receiver time [s]
    r_eb_e: np.ndarray  # (3,) position of the IMU [m]
    v_eb_e: np.ndarray  # (3,) [m/s]
    C_b_e: np.ndarray  # (3, 3) body to ECEF
    gyro_bias: np.ndarray = _NONE  # (3,) [rad/s]
    accel_bias: np.ndarray = _NONE  # (3,) [m/s2]
    clock_m: float = 0.0  # receiver clock bias, c b [m]
    clock_rate_mps: float = 0.0
    accel_scale_factor: np.ndarray = _NONE  # (3,)


def compensate(state: NavState, increments: Increments) -> tuple[np.ndarray, np.ndarray]:
    """Increments alpha, nu (m, 3) freed of the biases and scale factors that the state holds."""
    dt = np.diff(increments.t_s)[:, None]
    alpha = increments.alpha_ib_b - state.gyro_bias * dt
    nu = (increments.nu_ib_b - state.accel_bias * dt) / (1.0 + state.accel_scale_factor)
    return alpha, nu


def trace(
    state: NavState, increments: Increments, previous: Increments | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity (m + 1, 3) and attitude (m + 1, 3, 3) at the nodes of the increments.

    ``previous``: earlier increments, of which the last one serves the coning and sculling terms
    of the first step; without it that step takes constant rate and force.
    """
    dt = np.diff(increments.t_s)
    if dt.size == 0 or abs(increments.t_s[0] - state.t_s) > 1e-6:
        raise ValueError(f"increments begin at {increments.t_s[0]} s: expected {state.t_s} s")
    alpha, nu = compensate(state, increments)
    before = (alpha[0], nu[0])
    if previous is not None:
        a, n = compensate(state, previous)
        scale = dt[0] / (previous.t_s[-1] - previous.t_s[-2])
        before = (a[-1] * scale, n[-1] * scale)
    m = dt.size
    r, v, C = np.empty((m + 1, 3)), np.empty((m + 1, 3)), np.empty((m + 1, 3, 3))
    r[0], v[0], C[0] = state.r_eb_e, state.v_eb_e, state.C_b_e
    _run(r, v, C, alpha, nu, before[0].copy(), before[1].copy(), dt)
    return r, v, C


def propagate(
    state: NavState, increments: Increments, previous: Increments | None = None
) -> NavState:
    """The state at the end of the increments, which must begin at state.t_s; see `trace`."""
    r, v, C = trace(state, increments, previous)
    elapsed = increments.t_s[-1] - increments.t_s[0]
    return state._replace(
        t_s=float(increments.t_s[-1]),
        r_eb_e=r[-1],
        v_eb_e=v[-1],
        C_b_e=C[-1],
        clock_m=state.clock_m + state.clock_rate_mps * float(elapsed),
    )


def correct(state: NavState, error: np.ndarray, layout: Layout | None = None) -> NavState:
    """The state plus an estimated error (n,), error = true - estimate, in the order of a layout.

    The layout defaults to the 17 states.  C_true = exp([psi x]) C_est, which is
    (I + [psi x]) C_est to first order, made orthonormal again.
    """
    s = layout or Layout.build()
    x = np.asarray(error, float)
    if x.ndim != 1 or x.size < s.n:
        raise ValueError(f"error of shape {x.shape}: expected ({s.n},)")
    turn = rotation_from_vector(np.ascontiguousarray(x[s.psi]))
    return state._replace(
        r_eb_e=state.r_eb_e + x[s.r],
        v_eb_e=state.v_eb_e + x[s.v],
        C_b_e=orthonormalise(turn @ state.C_b_e),
        accel_bias=state.accel_bias + x[s.accel_bias],
        gyro_bias=state.gyro_bias + x[s.gyro_bias],
        clock_m=state.clock_m + float(x[s.cb][0]),
        clock_rate_mps=state.clock_rate_mps + float(x[s.cd][0]),
        accel_scale_factor=(
            state.accel_scale_factor + x[s.accel_scale_factor]
            if s.n_scale
            else state.accel_scale_factor
        ),
    )


# --- kernels --------------------------------------------------------------------------------


@kernel
def _run(
    r: np.ndarray,
    v: np.ndarray,
    C: np.ndarray,
    alpha: np.ndarray,
    nu: np.ndarray,
    alpha_prev: np.ndarray,
    nu_prev: np.ndarray,
    dt: np.ndarray,
) -> None:
    """Fill rows 1 ... m of r, v, C from row 0."""
    ratio = 1.0
    for k in range(dt.shape[0]):
        if k > 0:
            ratio = dt[k] / dt[k - 1]
            alpha_prev, nu_prev = ratio * alpha[k - 1], ratio * nu[k - 1]
        r[k + 1], v[k + 1], C[k + 1] = r[k], v[k], C[k]
        strapdown_step(r[k + 1], v[k + 1], C[k + 1], alpha[k], nu[k], alpha_prev, nu_prev, dt[k])


@borrowing
def _cross(a: Any, b: Any) -> tuple[float, float, float]:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@borrowing
def _rotated_force(
    alpha: np.ndarray, nu: np.ndarray, alpha_prev: np.ndarray, nu_prev: np.ndarray
) -> tuple[float, float, float]:
    """Integral of the specific force over the interval, in body axes at its start (Savage II).

    nu + a alpha x nu + b alpha x (alpha x nu) + (alpha_prev x nu + nu_prev x alpha) / 12, with
    a = (1 - cos x) / x^2, b = (x - sin x) / x^3, x = |alpha|.
    """
    x2 = alpha[0] * alpha[0] + alpha[1] * alpha[1] + alpha[2] * alpha[2]
    if x2 < 1e-4:
        a = 0.5 * (1.0 - x2 / 12.0 * (1.0 - x2 / 30.0))
        b = (1.0 - x2 / 20.0 * (1.0 - x2 / 42.0)) / 6.0
    else:
        x = math.sqrt(x2)
        a = (1.0 - math.cos(x)) / x2
        b = (1.0 - math.sin(x) / x) / x2
    w = _cross(alpha, nu)
    q = _cross(alpha, w)
    s = _cross(alpha_prev, nu)
    p = _cross(nu_prev, alpha)
    return (
        nu[0] + a * w[0] + b * q[0] + (s[0] + p[0]) / 12.0,
        nu[1] + a * w[1] + b * q[1] + (s[1] + p[1]) / 12.0,
        nu[2] + a * w[2] + b * q[2] + (s[2] + p[2]) / 12.0,
    )


@borrowing
def strapdown_step(
    r: np.ndarray,
    v: np.ndarray,
    C: np.ndarray,
    alpha: np.ndarray,
    nu: np.ndarray,
    alpha_prev: np.ndarray,
    nu_prev: np.ndarray,
    dt: float,
) -> None:
    """One interval: r, v (3,), C (3, 3) move to its end, by increments free of biases.

    The previous increments (of an interval of the same length) serve coning and sculling; they
    are not needed to be there: give this interval's own to leave both out.  Gravity and Coriolis
    are taken at mid-point, position by the trapezium of velocity, whose error telescopes.
    """
    # velocity: the specific force turned by half of the Earth's rotation
    f = _rotated_force(alpha, nu, alpha_prev, nu_prev)
    x = C[0, 0] * f[0] + C[0, 1] * f[1] + C[0, 2] * f[2]
    y = C[1, 0] * f[0] + C[1, 1] * f[1] + C[1, 2] * f[2]
    z = C[2, 0] * f[0] + C[2, 1] * f[1] + C[2, 2] * f[2]
    half = 0.5 * OMEGA_EARTH * dt
    x, y = x + half * y, y - half * x
    g = gravity_at(
        r[0] + dt * (0.5 * v[0] + 0.125 * x),
        r[1] + dt * (0.5 * v[1] + 0.125 * y),
        r[2] + dt * (0.5 * v[2] + 0.125 * z),
    )
    w2 = 2.0 * OMEGA_EARTH
    # mid-point velocity, for Coriolis: half of the change without the Coriolis of that half
    vx = v[0] + 0.5 * (x + dt * (g[0] + w2 * v[1]))
    vy = v[1] + 0.5 * (y + dt * (g[1] - w2 * v[0]))
    after = (
        v[0] + x + dt * (g[0] + w2 * vy),
        v[1] + y + dt * (g[1] - w2 * vx),
        v[2] + z + dt * g[2],
    )
    for i in range(3):
        r[i] += 0.5 * dt * (v[i] + after[i])
        v[i] = after[i]

    # attitude: C(t + dt) = exp(-[W dt x]) C(t) exp([phi x])
    c = _cross(alpha_prev, alpha)
    turn_right(C, alpha[0] + c[0] / 12.0, alpha[1] + c[1] / 12.0, alpha[2] + c[2] / 12.0)
    sine, cosine = math.sin(OMEGA_EARTH * dt), math.cos(OMEGA_EARTH * dt)
    for j in range(3):
        p, q = C[0, j], C[1, j]
        C[0, j] = cosine * p + sine * q
        C[1, j] = cosine * q - sine * p
