"""A long flight over a spherical Earth, in the wander-azimuth frame of a platform INS.

The frame w has z up and its x, y axes turned by the wander angle a about Up from east and north,
counter-clockwise, and is not turned about z by the motion over the Earth:

    x = E cos a + N sin a,   y = -E sin a + N cos a,   a' = -(V_E / R) tan L
    w_ie = W (cos L sin a, cos L cos a, sin L),   w_ew = (-V_y, V_x, 0) / R
    V' = f - (2 w_ie + w_ew) x V + (0, 0, -g)

(Groves, 2nd ed., 5.3.5, has z down.)  R is constant: the height enters nowhere.  Speed, climb angle
and turn rate of the flight are linear between knots, the heading is their exact integral.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from signals.compiled import borrowing, kernel
from signals.constants import OMEGA_EARTH, STANDARD_GRAVITY

EARTH_RADIUS = 6_371_000.0
"""Mean radius of the sphere [m]"""


class Flight(NamedTuple):
    """Where the platform is, how it moves and what it feels, at times t_s (n,)."""

    t_s: np.ndarray
    lat: np.ndarray  # (n,) [rad]
    lon: np.ndarray  # (n,) [rad]
    wander: np.ndarray  # (n,) [rad]
    v_w: np.ndarray  # (n, 3) velocity over the Earth [m/s]
    f_w: np.ndarray  # (n, 3) specific force [m/s2]


@dataclass(frozen=True)
class FlightProfile:
    """Speed, climb angle and turn rate (n,), each linear between the knots t_s (n,).

    After the last knot they stay as they are; the turn rate is that of the heading, positive to
    the right.  ValueError where knots do not increase or a number is not finite.
    """

    t_s: np.ndarray  # [s]
    speed_mps: np.ndarray
    climb_rad: np.ndarray
    turn_rate: np.ndarray  # [rad/s]

    def __post_init__(self) -> None:
        for name in ("t_s", "speed_mps", "climb_rad", "turn_rate"):
            value = np.array(getattr(self, name), float)
            if value.ndim != 1 or value.size < 1 or not np.isfinite(value).all():
                raise ValueError(f"{name}: {value}, expected at least one finite number per knot")
            if value.size != np.size(self.t_s):
                raise ValueError(f"{name}: {value.size} values for {np.size(self.t_s)} knots")
            object.__setattr__(self, name, value)
        if np.any(np.diff(self.t_s) <= 0.0):
            raise ValueError(f"t_s: {self.t_s}, expected increasing knots")

    def heading(self, heading0: float) -> np.ndarray:
        """Heading at the knots [rad], clockwise from north, that of the first given."""
        turned = 0.5 * np.diff(self.t_s) * (self.turn_rate[1:] + self.turn_rate[:-1])
        return heading0 + np.concatenate([[0.0], np.cumsum(turned)])


def fly(
    profile: FlightProfile,
    t_s: ArrayLike,
    *,
    lat: float,
    lon: float,
    heading: float,
    wander: float = 0.0,
) -> Flight:
    """The flight at increasing times t_s (n,), from a position and two angles at the first knot.

    Position and wander angle [rad] are integrated from time to time by one Runge-Kutta step of
    fourth order.  ValueError where times do not increase, precede the first knot, or the flight
    comes nearer than a degree to a pole.
    """
    t = np.ascontiguousarray(t_s, dtype=float)
    if t.ndim != 1 or t.size < 1 or not np.isfinite(t).all() or np.any(np.diff(t) <= 0.0):
        raise ValueError("t_s: expected increasing finite times")
    if t[0] < profile.t_s[0]:
        raise ValueError(f"t_s: first time {t[0]} s, expected >= {profile.t_s[0]} s, the knots'")
    start = np.array([lat, lon, wander], float)
    if not (np.isfinite(start).all() and math.isfinite(heading)):
        raise ValueError(f"lat, lon, wander, heading: {(*start, heading)}, expected finite angles")
    knots = np.column_stack(
        [profile.t_s, profile.speed_mps, profile.climb_rad, profile.turn_rate,
         profile.heading(heading)]
    )  # fmt: skip
    out = np.empty((t.size, 9))
    highest = _fly(knots, t, start, out)
    if not highest < math.radians(89.0):
        raise ValueError(f"lat: the flight reaches {math.degrees(highest)} deg, expected < 89")
    return Flight(t, out[:, 0], out[:, 1], out[:, 2], out[:, 3:6], out[:, 6:9])


# --- kernels --------------------------------------------------------------------------------


@borrowing
def _kinematics(
    knots: np.ndarray, i: int, t: float
) -> tuple[float, float, float, float, float, float]:
    """Speed, climb angle and heading at t, each followed by its derivative; i: knot before t."""
    h = t - knots[i, 0]
    dv, dc, dw = 0.0, 0.0, 0.0
    if i + 1 < knots.shape[0]:
        length = knots[i + 1, 0] - knots[i, 0]
        dv = (knots[i + 1, 1] - knots[i, 1]) / length
        dc = (knots[i + 1, 2] - knots[i, 2]) / length
        dw = (knots[i + 1, 3] - knots[i, 3]) / length
    rate = knots[i, 3] + dw * h
    psi = knots[i, 4] + h * (knots[i, 3] + 0.5 * dw * h)
    return knots[i, 1] + dv * h, dv, knots[i, 2] + dc * h, dc, psi, rate


@borrowing
def _knot_before(knots: np.ndarray, i: int, t: float) -> int:
    while i + 1 < knots.shape[0] and knots[i + 1, 0] <= t:
        i += 1
    return i


@borrowing
def _rates(knots: np.ndarray, i: int, t: float, lat: float) -> tuple[float, float, float]:
    """lat', lon', a'."""
    i = _knot_before(knots, i, t)
    speed, _, climb, _, psi, _ = _kinematics(knots, i, t)
    across = speed * math.cos(climb) / EARTH_RADIUS
    east = across * math.sin(psi)
    return across * math.cos(psi), east / math.cos(lat), -east * math.tan(lat)


@kernel
def _fly(knots: np.ndarray, t: np.ndarray, start: np.ndarray, out: np.ndarray) -> float:
    """Rows lat, lon, a, V_w, f_w of ``out`` (n, 9); returns the largest |lat|."""
    lat, lon, wander = start[0], start[1], start[2]
    now, i, highest = knots[0, 0], 0, abs(lat)
    for k in range(t.size):
        h = t[k] - now
        if h > 0.0:
            a1, b1, c1 = _rates(knots, i, now, lat)
            a2, b2, c2 = _rates(knots, i, now + 0.5 * h, lat + 0.5 * h * a1)
            a3, b3, c3 = _rates(knots, i, now + 0.5 * h, lat + 0.5 * h * a2)
            a4, b4, c4 = _rates(knots, i, t[k], lat + h * a3)
            lat += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
            lon += h / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
            wander += h / 6.0 * (c1 + 2.0 * c2 + 2.0 * c3 + c4)
        now = t[k]
        i = _knot_before(knots, i, now)
        highest = max(highest, abs(lat))
        out[k, 0], out[k, 1], out[k, 2] = lat, lon, wander
        _feel(_kinematics(knots, i, now), out[k])
    return highest


@borrowing
def _feel(path: tuple[float, float, float, float, float, float], row: np.ndarray) -> None:
    """Velocity and specific force at the position and wander angle that the row begins with."""
    speed, dspeed, climb, dclimb, psi, dpsi = path
    lat, wander = row[0], row[2]
    sc, cc, chi = math.sin(climb), math.cos(climb), psi + wander
    level, dlevel = speed * cc, dspeed * cc - speed * sc * dclimb
    dchi = dpsi - level * math.sin(psi) * math.tan(lat) / EARTH_RADIUS
    s, c = math.sin(chi), math.cos(chi)
    vx, vy, vz = level * s, level * c, speed * sc
    wx = 2.0 * OMEGA_EARTH * math.cos(lat) * math.sin(wander) - vy / EARTH_RADIUS
    wy = 2.0 * OMEGA_EARTH * math.cos(lat) * math.cos(wander) + vx / EARTH_RADIUS
    wz = 2.0 * OMEGA_EARTH * math.sin(lat)
    row[3], row[4], row[5] = vx, vy, vz
    row[6] = dlevel * s + level * c * dchi + wy * vz - wz * vy
    row[7] = dlevel * c - level * s * dchi + wz * vx - wx * vz
    row[8] = dspeed * sc + speed * cc * dclimb + wx * vy - wy * vx + STANDARD_GRAVITY
