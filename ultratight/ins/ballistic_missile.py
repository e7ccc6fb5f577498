"""A ballistic missile over a round Earth: powered flight by a pitch programme, then free fall.

The launch frame i does not turn: x down range, y up at the launch point, z = x cross y.  A point
mass is driven along its own axis (no angle of attack) while the motor burns,

    v' = (T - D) / m - g sin theta,   x' = v cos theta,   y' = v sin theta
    theta = theta_0 up to t1,   theta_k + (theta_0 - theta_k) ((t2 - t) / (t2 - t1))^2,   theta_k

and falls freely, (x, y)'' = -g (x, R + y) / r, from burnout on; drag on re-entry is left out.
T = exhaust speed x mass flow, D = rho v^2 (C_d S) / 2, rho = rho_0 exp(-h / H), g = g_0 (R / r)^2,
r^2 = x^2 + (R + y)^2, h = r - R.  That g sin theta takes the vertical of the launch point for the
local one is meant for motors that burn out within some 150 km (Zarchan, *Tactical and Strategic
Missile Guidance*, has the general case).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from signals.compiled import kernel
from ultratight.ins.attitude import rotation_from_euler, vector_from_rotation

EARTH_RADIUS_M, SURFACE_GRAVITY = 6_371_000.0, 9.7803267714
SEA_LEVEL_DENSITY, SCALE_HEIGHT_M = 1.225, 7200.0


@dataclass(frozen=True)
class Missile:
    """A single stage and its pitch programme, SI units and radians."""

    mass_kg: float  # at lift-off
    mass_flow_kg_per_s: float
    exhaust_mps: float
    drag_area_m2: float  # C_d S
    burnout_s: float
    pitch: tuple[float, float] = (0.5 * math.pi, math.radians(38.0))  # theta_0, theta_k
    turn_s: tuple[float, float] = (10.0, 80.0)  # t1, t2

    def __post_init__(self) -> None:
        burnt = self.mass_flow_kg_per_s * self.burnout_s
        thrust = self.exhaust_mps * self.mass_flow_kg_per_s
        if not 0.0 < burnt < self.mass_kg < math.inf:
            raise ValueError(f"mass_kg: {self.mass_kg}, expected more than the {burnt} that burn")
        if not self.mass_kg * SURFACE_GRAVITY < thrust < math.inf:
            raise ValueError(f"thrust: {thrust:.6g} N, expected more than the weight at lift-off")
        if not 0.0 <= self.drag_area_m2 < math.inf:
            raise ValueError(f"drag_area_m2: {self.drag_area_m2}, expected 0 or more")
        if not 0.0 <= self.turn_s[0] < self.turn_s[1] <= self.burnout_s:
            raise ValueError(f"turn_s: {self.turn_s}, expected rising, before {self.burnout_s} s")
        if not all(0.0 < theta <= 0.5 * math.pi for theta in self.pitch):
            raise ValueError(f"pitch: {self.pitch} rad, expected above 0 and at most pi / 2")

    def pitch_at(self, t_s: ArrayLike) -> np.ndarray:
        """theta (...) [rad]; after burnout the axis keeps its direction."""
        first, last = self.pitch
        t1, t2 = self.turn_s
        share = (t2 - np.clip(t_s, t1, t2)) / (t2 - t1)
        return last + (first - last) * share**2


class Flight(NamedTuple):
    """Motion in the launch plane at instants dt_s apart, from lift-off on."""

    t_s: np.ndarray  # (n,)
    position_m: np.ndarray  # (n, 2) x, y
    velocity_mps: np.ndarray  # (n, 2)
    force_mps2: np.ndarray  # (n, 3) specific force in axes i: v' - g
    pitch: np.ndarray  # (n,) [rad]

    @property
    def height_m(self) -> np.ndarray:
        """(n,) above the round Earth."""
        x, y = self.position_m.T
        return np.hypot(x, EARTH_RADIUS_M + y) - EARTH_RADIUS_M

    @property
    def ground_range_m(self) -> np.ndarray:
        """(n,) arc on the surface from the launch point."""
        x, y = self.position_m.T
        return EARTH_RADIUS_M * np.arctan2(x, EARTH_RADIUS_M + y)


def fly(missile: Missile, duration_s: float, dt_s: float = 0.01) -> Flight:
    """Integrate from lift-off; ValueError unless duration_s is a multiple of dt_s."""
    n = round(duration_s / dt_s) if 0.0 < dt_s < math.inf and math.isfinite(duration_s) else 0
    if n < 1 or abs(n * dt_s - duration_s) > 1e-6 * dt_s:
        raise ValueError(f"duration_s, dt_s: {duration_s}, {dt_s}, expected a multiple of dt_s > 0")
    t = dt_s * np.arange(n + 1)
    pitch = missile.pitch_at(t)
    position, velocity, force = np.zeros((n + 1, 2)), np.zeros((n + 1, 2)), np.zeros(n + 1)
    _fly(
        missile.mass_kg, missile.mass_flow_kg_per_s, missile.exhaust_mps, missile.drag_area_m2,
        round(missile.burnout_s / dt_s), missile.pitch_at(t[:-1] + 0.5 * dt_s), dt_s, position,
        velocity, force,
    )  # fmt: skip
    along = np.stack([np.cos(pitch), np.sin(pitch), np.zeros(n + 1)], axis=1)
    return Flight(t, position, velocity, force[:, None] * along, pitch)


def turned(angles: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """C_b_i (n, 3, 3) by angles (n, 3) about x, y, z [rad]; rotation vectors (n - 1, 3) between.

    The angles are roll, heading and pitch of a missile (x forward, y up, z right), turned in the
    order z, y, x; C_b_i[k + 1] = C_b_i[k] exp([alpha_k x]).
    """
    a = np.ascontiguousarray(angles, dtype=float)
    if a.ndim != 2 or a.shape[1] != 3 or len(a) < 2 or not np.isfinite(a).all():
        raise ValueError(f"angles: shape {a.shape}, expected (2 or more, 3) finite numbers")
    C, alpha = np.empty((len(a), 3, 3)), np.empty((len(a) - 1, 3))
    _turn(a, C, alpha)
    return C, alpha


# --- kernels --------------------------------------------------------------------------------

_rotation, _vector = kernel(rotation_from_euler), kernel(vector_from_rotation)


@kernel
def _turn(angles: np.ndarray, C: np.ndarray, alpha: np.ndarray) -> None:
    step = np.empty((3, 3))
    for k in range(angles.shape[0]):
        C[k] = _rotation(angles[k, 0], angles[k, 1], angles[k, 2])
        if k == 0:
            continue
        for i in range(3):
            for j in range(3):
                s = 0.0
                for m in range(3):
                    s += C[k - 1, m, i] * C[k, m, j]
                step[i, j] = s
        alpha[k - 1] = _vector(step)


@kernel
def _fly(
    mass: float,
    flow: float,
    exhaust: float,
    drag_area: float,
    burnout: int,
    pitch: np.ndarray,
    dt: float,
    position: np.ndarray,
    velocity: np.ndarray,
    force: np.ndarray,
) -> None:
    """Leapfrog in free fall; speed by Euler, position by both speeds' mean before it.

    ``pitch`` (n,) is that of the middles of the steps; force (n + 1,) along the axis.
    """
    R, speed = EARTH_RADIUS_M, 0.0
    for k in range(pitch.size + 1):
        x, y = position[k, 0], position[k, 1]
        r = math.sqrt(x * x + (R + y) * (R + y))
        g = SURFACE_GRAVITY * (R / r) ** 2
        if k < burnout:
            density = SEA_LEVEL_DENSITY * math.exp(-(r - R) / SCALE_HEIGHT_M)
            drag = 0.5 * density * speed * speed * drag_area
            force[k] = (exhaust * flow - drag) / (mass - flow * k * dt)
        if k == pitch.size:
            break
        if k < burnout:
            c, s = math.cos(pitch[k]), math.sin(pitch[k])
            before, speed = speed, speed + (force[k] - g * s) * dt
            mean = 0.5 * (before + speed)
            velocity[k + 1, 0], velocity[k + 1, 1] = speed * c, speed * s
            position[k + 1, 0], position[k + 1, 1] = x + mean * c * dt, y + mean * s * dt
        else:
            for i in range(2):
                down = x if i == 0 else R + y
                velocity[k + 1, i] = velocity[k, i] - g * down / r * dt
                position[k + 1, i] = position[k, i] + velocity[k + 1, i] * dt
