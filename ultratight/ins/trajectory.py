"""True motion: along-track acceleration and turns in a plane, exact to the rounding error.

The plane is the local horizontal at the start, fixed in ECEF.  In it the along-track speed V and
the heading psi are piecewise quadratic,

    V' = a(t),  psi' = omega(t),  a and omega linear on every segment and free to jump between,

so that position is an integral without closed form only while turning; there it is taken by
Gauss-Legendre quadrature on short cells.  The body's x axis points along psi (a negative V is
motion backwards); without turns the body axes therefore are fixed in ECEF.  The inertial
increments come from this very motion (`Trajectory.increments`), so that a jump of the
acceleration reaches antenna and IMU at the same instant.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from signals.constants import OMEGA_EARTH
from ultratight.ins.earth import ecef_from_geodetic, gravity, gravity_each, rotation_e_from_n

_TURN_PER_CELL = 0.3  # rad; with 8 Gauss points the quadrature error is below 1e-16 relative
_POSITION_NODES, _POSITION_WEIGHTS = np.polynomial.legendre.leggauss(8)
_IMU_NODES, _IMU_WEIGHTS = np.polynomial.legendre.leggauss(5)
_LONGEST_PIECE = 0.02  # s
_INTERVALS_AT_ONCE = 20_000
_EARTH_RATE = np.array([0.0, 0.0, OMEGA_EARTH])

Side = Literal["left", "right"]


@dataclass(frozen=True)
class Segment:
    """Along-track acceleration and turn rate, each linear from t0 to t1.

    Times [s] since start, accelerations [m/s2], turn rates [rad/s] (positive to the right).
    """

    t0: float
    t1: float
    a0: float = 0.0
    a1: float = 0.0
    turn_rate0: float = 0.0
    turn_rate1: float = 0.0

    def __post_init__(self) -> None:
        values = (self.t0, self.t1, self.a0, self.a1, self.turn_rate0, self.turn_rate1)
        if not all(math.isfinite(x) for x in values):
            raise ValueError(f"segment {values}: every value must be finite")
        if not self.t1 > self.t0:
            raise ValueError(f"segment from t0 = {self.t0} s to t1 = {self.t1} s: t1 must be later")


class Motion(NamedTuple):
    """Kinematics of the body with respect to the Earth at times of shape (...)."""

    r_eb_e: np.ndarray  # (..., 3) position [m]
    v_eb_e: np.ndarray  # (..., 3) its derivative [m/s]
    a_eb_e: np.ndarray  # (..., 3) derivative of v_eb_e [m/s2]
    C_b_e: np.ndarray  # (..., 3, 3) body to ECEF
    omega_eb_b: np.ndarray  # (..., 3) [rad/s]


class RigidMotion(ABC):
    """A body that moves: what antenna and IMU see follows from `at` alone."""

    C_n_e: np.ndarray  # (3, 3) NED at the start to ECEF
    breakpoints_s: np.ndarray  # times where the acceleration is not smooth [s]
    first_jump_s: float | None  # first discontinuity of the acceleration vector [s]

    @abstractmethod
    def at(self, t: ArrayLike, side: Side = "right") -> Motion:
        """Motion at times t (...) [s]; at a jump the limit from the given side."""

    def speed(self, t: ArrayLike) -> np.ndarray:
        """Speed [m/s] at times t [s]."""
        return np.linalg.norm(self.at(t).v_eb_e, axis=-1)

    def antenna(self, t: ArrayLike, lever_arm_b: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity (..., 3) of a point at lever_arm_b (3,) [m] in body axes."""
        m = self.at(t)
        lever = np.asarray(lever_arm_b, float)
        rotating = np.cross(m.omega_eb_b, lever)
        return (
            m.r_eb_e + m.C_b_e @ lever,
            m.v_eb_e + np.einsum("...ij,...j->...i", m.C_b_e, rotating),
        )

    def specific_force(self, t: ArrayLike, side: Side = "right") -> np.ndarray:
        """f_ib_b (..., 3) [m/s2]: C' (a + 2 W x v - g(r)) (Groves 2.147)."""
        return self._inertial(np.asarray(t, float), side)[1]

    def increments(self, t_nodes: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """What an error-free IMU reports between nodes (m + 1,) [s].

        Returns
        -------
        alpha, nu : (m, 3) arrays
            Integrals of omega_ib_b [rad] and f_ib_b [m/s] in body axes, by five Gauss points on
            every piece, at most 20 ms long, between nodes and jumps.
        """
        t = np.asarray(t_nodes, float)
        if t.ndim != 1 or t.size < 2 or not np.all(np.diff(t) > 0.0):
            raise ValueError("t_nodes: expected at least two strictly increasing times")
        n = _INTERVALS_AT_ONCE
        parts = [self._increments(t[i : i + n + 1]) for i in range(0, t.size - 1, n)]
        return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])

    def _increments(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        inside = self.breakpoints_s[(self.breakpoints_s > t[0]) & (self.breakpoints_s < t[-1])]
        fine = np.arange(t[0], t[-1], _LONGEST_PIECE) if np.diff(t).max() > _LONGEST_PIECE else t
        edges = np.unique(np.concatenate([t, inside, fine]))
        half = 0.5 * np.diff(edges)
        points = edges[:-1, None] + half[:, None] * (1.0 + _IMU_NODES)
        first = np.searchsorted(edges, t[:-1])
        out = []
        for rate in self._inertial(points, "right"):
            pieces = half[:, None] * np.einsum("j,ijk->ik", _IMU_WEIGHTS, rate)
            out.append(np.add.reduceat(pieces, first, axis=0))
        return out[0], out[1]

    def _inertial(self, t: np.ndarray, side: Side) -> tuple[np.ndarray, np.ndarray]:
        """omega_ib_b and f_ib_b at times of any shape."""
        m = self.at(t, side)
        g = gravity_each(np.ascontiguousarray(m.r_eb_e.reshape(-1, 3))).reshape(m.r_eb_e.shape)
        force_e = m.a_eb_e + 2.0 * np.cross(_EARTH_RATE, m.v_eb_e) - g
        omega_ib_b = m.omega_eb_b + _EARTH_RATE @ m.C_b_e
        return omega_ib_b, np.einsum("...ji,...j->...i", m.C_b_e, force_e)


class _Plane(NamedTuple):
    """State in the plane: s-th derivatives of V and psi, north and east displacement, roll."""

    north: np.ndarray
    east: np.ndarray
    speed: np.ndarray
    accel: np.ndarray
    heading: np.ndarray
    turn_rate: np.ndarray
    roll: np.ndarray
    roll_rate: np.ndarray


@dataclass(frozen=True)
class Trajectory(RigidMotion):
    """A motion, built by `from_profile`; evaluated at any time, also a little outside its segments.

    ``cells`` has one row per cell: t, V, a, a', psi, omega, omega', north, east at its start.
    """

    origin: np.ndarray  # (3,) ECEF start [m]
    C_n_e: np.ndarray  # (3, 3) NED at the start to ECEF
    cells: np.ndarray  # (n_cell, 9)
    breakpoints_s: np.ndarray  # times where a, omega or their slopes change [s]
    first_jump_s: float | None  # first discontinuity of the acceleration vector [s]
    banked: bool

    @classmethod
    def from_profile(
        cls,
        position_lla: ArrayLike,
        heading_rad: float,
        speed_mps: float,
        segments: Sequence[Segment] = (),
        *,
        banked: bool = False,
        duration_s: float | None = None,
    ) -> Trajectory:
        """Start at (lat [rad], lon [rad], h [m]) and follow the segments, in order of time.

        Between segments, and after the last one, speed and heading are constant.  A segment that
        begins at zero also holds for negative times; one that ends at or after ``duration_s``
        (when given) also holds later.  With ``banked`` the body rolls as in a
        coordinated turn, tan(roll) = V omega / g, which needs a turn rate without jumps.

        Raises
        ------
        ValueError
            Segments overlap, a number is not finite, or a banked turn rate jumps.
        """
        lat, lon, h = (float(x) for x in np.asarray(position_lla, float))
        if not (abs(lat) <= math.pi / 2 and math.isfinite(lon) and math.isfinite(h)):
            raise ValueError(f"position_lla = {(lat, lon, h)}: expected (lat rad, lon rad, h m)")
        for name, value in (("heading_rad", heading_rad), ("speed_mps", speed_mps)):
            if not math.isfinite(value):
                raise ValueError(f"{name} = {value}: expected a finite number")
        profile = _without_gaps(segments, duration_s)
        jumps = _jumps(profile)
        if banked and any(jump != 0.0 for _, _, jump in jumps):
            raise ValueError(
                "banked turn: the turn rate jumps; ramp it with turn_rate0, turn_rate1"
            )
        first = next((t for t, da, dw in jumps if da != 0.0 or dw != 0.0), None)
        return cls(
            origin=ecef_from_geodetic(lat, lon, h),
            C_n_e=rotation_e_from_n(lat, lon),
            cells=_integrate(profile, float(heading_rad), float(speed_mps)),
            breakpoints_s=np.array([t for t, _, _ in jumps], float),
            first_jump_s=first,
            banked=banked,
        )

    def speed(self, t: ArrayLike) -> np.ndarray:
        """Signed along-track speed [m/s] at times t [s]."""
        return self._plane(np.asarray(t, float), "right").speed

    def at(self, t: ArrayLike, side: Side = "right") -> Motion:
        """Motion at times t (...) [s]; at a jump the limit from the given side."""
        p = self._plane(np.asarray(t, float), side)
        c, s = np.cos(p.heading), np.sin(p.heading)
        zero = np.zeros_like(c)
        north_east = self.C_n_e[:, :2]
        position = np.stack([p.north, p.east], axis=-1)
        velocity = p.speed[..., None] * np.stack([c, s], axis=-1)
        centripetal = p.speed * p.turn_rate
        accel = np.stack([p.accel * c - centripetal * s, p.accel * s + centripetal * c], axis=-1)
        sr, cr = np.sin(p.roll), np.cos(p.roll)
        C_b_n = np.stack(
            [
                np.stack([c, -s * cr, s * sr], axis=-1),
                np.stack([s, c * cr, -c * sr], axis=-1),
                np.stack([zero, sr, cr], axis=-1),
            ],
            axis=-2,
        )
        return Motion(
            r_eb_e=self.origin + position @ north_east.T,
            v_eb_e=velocity @ north_east.T,
            a_eb_e=accel @ north_east.T,
            C_b_e=self.C_n_e @ C_b_n,
            omega_eb_b=np.stack([p.roll_rate, p.turn_rate * sr, p.turn_rate * cr], axis=-1),
        )

    @cached_property
    def _gravity_at_start(self) -> float:
        return float(np.linalg.norm(gravity(self.origin)))

    def _plane(self, t: np.ndarray, side: Side) -> _Plane:
        last = len(self.cells) - 1
        index = np.clip(np.searchsorted(self.cells[:, 0], t, side) - 1, 0, last)
        # arrays of cell values, each of the shape of t
        t0, v0, a0, da, psi0, w0, dw, north, east = np.moveaxis(self.cells[index], -1, 0)
        h = t - t0
        speed, accel = v0 + h * (a0 + 0.5 * da * h), a0 + da * h
        heading, turn_rate = psi0 + h * (w0 + 0.5 * dw * h), w0 + dw * h
        along, across = _displacement(h, v0, a0, da, w0, dw)
        c, s = np.cos(psi0), np.sin(psi0)
        roll, roll_rate = np.zeros_like(h), np.zeros_like(h)
        if self.banked:
            tangent = speed * turn_rate / self._gravity_at_start
            roll = np.arctan(tangent)
            slope = (accel * turn_rate + speed * dw) / self._gravity_at_start
            roll_rate = slope / (1.0 + tangent**2)
        return _Plane(
            north + c * along - s * across,
            east + s * along + c * across,
            speed,
            accel,
            heading,
            turn_rate,
            roll,
            roll_rate,
        )


def _displacement(
    h: np.ndarray,
    v0: np.ndarray,
    a0: np.ndarray,
    da: np.ndarray,
    w0: np.ndarray,
    dw: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Displacement after h along and across the heading that the cell began with, each (...)."""
    straight = h * (v0 + h * (0.5 * a0 + da * h / 6.0))
    turning = (w0 != 0.0) | (dw != 0.0)
    if not np.any(turning):
        return straight, np.zeros_like(straight)
    along, across = np.zeros_like(straight), np.zeros_like(straight)
    for node, weight in zip(_POSITION_NODES, _POSITION_WEIGHTS, strict=True):
        u = 0.5 * h * (1.0 + node)
        ds = 0.5 * h * weight * (v0 + u * (a0 + 0.5 * da * u))
        psi = u * (w0 + 0.5 * dw * u)
        along += ds * np.cos(psi)
        across += ds * np.sin(psi)
    return np.where(turning, along, straight), across


def _without_gaps(segments: Sequence[Segment], duration_s: float | None) -> list[Segment]:
    """The segments with uniform motion put between them, before and after."""
    profile: list[Segment] = []
    for segment in segments:
        before = profile[-1].t1 if profile else 0.0
        if segment.t0 < before - 1e-9:
            raise ValueError(f"segment at t0 = {segment.t0} s: expected t0 >= {before} s")
        if segment.t0 > before + 1e-9:
            profile.append(Segment(before, segment.t0))
        profile.append(segment)
    end = profile[-1].t1 if profile else 0.0
    if duration_s is None or end < duration_s - 1e-9:
        profile.append(Segment(end, end + 1.0))
    return profile


def _jumps(profile: list[Segment]) -> list[tuple[float, float, float]]:
    """Time and jump of acceleration and of turn rate at each border of segments."""
    return [
        (float(after.t0), after.a0 - before.a1, after.turn_rate0 - before.turn_rate1)
        for before, after in zip(profile[:-1], profile[1:], strict=True)
    ]


def _integrate(profile: list[Segment], heading: float, speed: float) -> np.ndarray:
    """Rows of `Trajectory.cells`."""
    rows = []
    psi, v, north, east = heading, speed, 0.0, 0.0
    for s in profile:
        length = s.t1 - s.t0
        da, dw = (s.a1 - s.a0) / length, (s.turn_rate1 - s.turn_rate0) / length
        turn = max(abs(s.turn_rate0), abs(s.turn_rate1)) * length
        n = max(1, math.ceil(turn / _TURN_PER_CELL))
        h = length / n
        for k in range(n):
            a, w = s.a0 + da * k * h, s.turn_rate0 + dw * k * h
            rows.append([s.t0 + k * h, v, a, da, psi, w, dw, north, east])
            cell = [np.array(x) for x in (h, v, a, da, w, dw)]
            along, across = _displacement(*cell)
            north += float(math.cos(psi) * along - math.sin(psi) * across)
            east += float(math.sin(psi) * along + math.cos(psi) * across)
            v += h * (a + 0.5 * da * h)
            psi += h * (w + 0.5 * dw * h)
    return np.array(rows)
