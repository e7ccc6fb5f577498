"""True motion: along-track acceleration and turns in a plane, exact to the rounding error.

The plane is the local horizontal at the start, or a vertical one there, fixed in ECEF.  In it the
along-track speed V and the heading psi, the climb angle in a vertical plane, are piecewise
quadratic,

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

from signals.compiled import borrowing
from signals.constants import OMEGA_EARTH
from ultratight.ins.earth import ecef_from_geodetic, gravity, gravity_at, rotation_e_from_n

_TURN_PER_CELL = 0.3  # rad; with 8 Gauss points the quadrature error is below 1e-16 relative
_POSITION_NODES, _POSITION_WEIGHTS = np.polynomial.legendre.leggauss(8)
_IMU_NODES, _IMU_WEIGHTS = np.polynomial.legendre.leggauss(5)
_LONGEST_PIECE = 0.02  # s
_INTERVALS_AT_ONCE = 20_000

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
        m = [np.ascontiguousarray(x.reshape(t.size, -1)) for x in self.at(t, side)]
        omega, force = np.empty((t.size, 3)), np.empty((t.size, 3))
        _felt(*m, omega, force)
        return omega.reshape(*t.shape, 3), force.reshape(*t.shape, 3)


@dataclass(frozen=True)
class Trajectory(RigidMotion):
    """A motion, built by `from_profile`; evaluated at any time, also a little outside its segments.

    ``cells`` has one row per cell: t, V, a, a', psi, omega, omega', north, east at its start.
    """

    origin: np.ndarray  # (3,) ECEF start [m]
    C_n_e: np.ndarray  # (3, 3) NED at the start to ECEF
    axes: np.ndarray  # (3, 3) columns: psi = 0, psi = 90 deg and the normal of the plane, ECEF
    cells: np.ndarray  # (n_cell, 9)
    breakpoints_s: np.ndarray  # times where a, omega or their slopes change [s]
    first_jump_s: float | None  # first discontinuity of the acceleration vector [s]
    banked: bool
    upright: bool  # the plane is vertical: the body's right is its normal

    @classmethod
    def from_profile(
        cls,
        position_lla: ArrayLike,
        heading_rad: float,
        speed_mps: float,
        segments: Sequence[Segment] = (),
        *,
        banked: bool = False,
        climb_rad: float | None = None,
        duration_s: float | None = None,
    ) -> Trajectory:
        """Start at (lat [rad], lon [rad], h [m]) and follow the segments, in order of time.

        Between segments, and after the last one, speed and heading are constant.  A segment that
        begins at zero also holds for negative times; one that ends at or after ``duration_s``
        (when given) also holds later.  With ``banked`` the body rolls as in a
        coordinated turn, tan(roll) = V omega / g, which needs a turn rate without jumps.

        With ``climb_rad`` the motion stays in the vertical plane through the heading; it begins
        with that climb angle, and turn rates are those of the climb angle, upwards.

        Raises
        ------
        ValueError
            Segments overlap, a number is not finite, a banked turn rate jumps, or a bank is asked
            for in a vertical plane.
        """
        lat, lon, h = (float(x) for x in np.asarray(position_lla, float))
        if not (abs(lat) <= math.pi / 2 and math.isfinite(lon) and math.isfinite(h)):
            raise ValueError(f"position_lla = {(lat, lon, h)}: expected (lat rad, lon rad, h m)")
        climb = 0.0 if climb_rad is None else climb_rad
        given = ("heading_rad", heading_rad), ("speed_mps", speed_mps), ("climb_rad", climb)
        for name, value in given:
            if not math.isfinite(value):
                raise ValueError(f"{name} = {value}: expected a finite number")
        upright = climb_rad is not None
        if banked and upright:
            raise ValueError(f"banked turn with climb_rad = {climb_rad}: expected one of them")
        profile = _without_gaps(segments, duration_s)
        jumps = _jumps(profile)
        if banked and any(jump != 0.0 for _, _, jump in jumps):
            raise ValueError(
                "banked turn: the turn rate jumps; ramp it with turn_rate0, turn_rate1"
            )
        first = next((t for t, da, dw in jumps if da != 0.0 or dw != 0.0), None)
        N = rotation_e_from_n(lat, lon)
        first_psi = float(climb if upright else heading_rad)
        return cls(
            origin=ecef_from_geodetic(lat, lon, h),
            C_n_e=N,
            axes=_vertical(N, heading_rad) if upright else N,
            cells=_integrate(profile, first_psi, float(speed_mps)),
            breakpoints_s=np.array([t for t, _, _ in jumps], float),
            first_jump_s=first,
            banked=banked,
            upright=upright,
        )

    def speed(self, t: ArrayLike) -> np.ndarray:
        """Signed along-track speed [m/s] at times t [s]."""
        t = np.asarray(t, float)
        t0, v0, a0, da = np.moveaxis(self.cells[self._index(t, "right"), :4], -1, 0)
        h = t - t0
        return v0 + h * (a0 + 0.5 * da * h)

    def at(self, t: ArrayLike, side: Side = "right") -> Motion:
        """Motion at times t (...) [s]; at a jump the limit from the given side."""
        t = np.asarray(t, float)
        shapes = ((3,), (3,), (3,), (3, 3), (3,))
        motion = [np.empty((t.size, *shape)) for shape in shapes]
        _move(
            np.ravel(t), np.ravel(self._index(t, side)), self.cells, self.origin, self.axes,
            self._gravity_at_start if self.banked else math.inf, self.upright, *motion,
        )  # fmt: skip
        return Motion(*(x.reshape(*t.shape, *n) for x, n in zip(motion, shapes, strict=True)))

    @cached_property
    def _gravity_at_start(self) -> float:
        return float(np.linalg.norm(gravity(self.origin)))

    def _index(self, t: np.ndarray, side: Side) -> np.ndarray:
        """Cell of each time."""
        return np.clip(np.searchsorted(self.cells[:, 0], t, side) - 1, 0, len(self.cells) - 1)


def _vertical(C_n_e: np.ndarray, heading: float) -> np.ndarray:
    """Axes of the vertical plane through a heading: forward, up and right, as columns in ECEF."""
    c, s = math.cos(heading), math.sin(heading)
    return C_n_e @ np.array([[c, 0.0, -s], [s, 0.0, c], [0.0, -1.0, 0.0]])


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
            along, across = _displacement(h, v, a, da, w, dw)
            north += math.cos(psi) * along - math.sin(psi) * across
            east += math.sin(psi) * along + math.cos(psi) * across
            v += h * (a + 0.5 * da * h)
            psi += h * (w + 0.5 * dw * h)
    return np.array(rows)


# --- kernels --------------------------------------------------------------------------------


@borrowing
def _displacement(
    h: float, v0: float, a0: float, da: float, w0: float, dw: float
) -> tuple[float, float]:
    """Displacement after h along and across the heading that the cell began with."""
    if w0 == 0.0 and dw == 0.0:
        return h * (v0 + h * (0.5 * a0 + da * h / 6.0)), 0.0
    along, across = 0.0, 0.0
    for k in range(_POSITION_NODES.size):
        u = 0.5 * h * (1.0 + _POSITION_NODES[k])
        ds = 0.5 * h * _POSITION_WEIGHTS[k] * (v0 + u * (a0 + 0.5 * da * u))
        psi = u * (w0 + 0.5 * dw * u)
        along += ds * math.cos(psi)
        across += ds * math.sin(psi)
    return along, across


@borrowing
def _move(
    t: np.ndarray,
    index: np.ndarray,
    cells: np.ndarray,
    origin: np.ndarray,
    N: np.ndarray,
    g: float,
    upright: bool,
    r: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    C: np.ndarray,
    omega: np.ndarray,
) -> None:
    """Fields of a `Motion` at each t (n,), in cell index (n,); N: axes; g: inf for no bank."""
    c0, s0, at = 1.0, 0.0, -1
    for k in range(t.size):
        cell = cells[index[k]]
        if index[k] != at:
            at = index[k]
            c0, s0 = math.cos(cell[4]), math.sin(cell[4])
        h = t[k] - cell[0]
        da, dw = cell[3], cell[6]
        speed, accel = cell[1] + h * (cell[2] + 0.5 * da * h), cell[2] + da * h
        heading, rate = cell[4] + h * (cell[5] + 0.5 * dw * h), cell[5] + dw * h
        along, across = _displacement(h, cell[1], cell[2], da, cell[5], dw)
        north, east = cell[7] + c0 * along - s0 * across, cell[8] + s0 * along + c0 * across
        # banked: tan(roll) = V psi' / g
        tangent = speed * rate / g
        cr = 1.0 / math.sqrt(1.0 + tangent * tangent)
        sr = tangent * cr
        roll_rate = (accel * rate + speed * dw) / g / (1.0 + tangent * tangent)
        if upright:  # the wings stand on the plane
            cr, sr = 0.0, 1.0
        c, s = c0, s0
        if heading != cell[4]:
            c, s = math.cos(heading), math.sin(heading)
        centripetal = speed * rate
        for i in range(3):
            forward, right = c * N[i, 0] + s * N[i, 1], c * N[i, 1] - s * N[i, 0]
            r[k, i] = origin[i] + north * N[i, 0] + east * N[i, 1]
            v[k, i] = speed * forward
            a[k, i] = accel * forward + centripetal * right
            C[k, i, 0] = forward
            C[k, i, 1] = cr * right + sr * N[i, 2]
            C[k, i, 2] = cr * N[i, 2] - sr * right
        omega[k, 0], omega[k, 1], omega[k, 2] = roll_rate, rate * sr, rate * cr


@borrowing
def _felt(
    r: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    C: np.ndarray,
    omega_eb: np.ndarray,
    omega_ib: np.ndarray,
    force: np.ndarray,
) -> None:
    """omega_ib_b and f_ib_b (n, 3) of motions; C (n, 9)."""
    for k in range(r.shape[0]):
        gx, gy, gz = gravity_at(r[k, 0], r[k, 1], r[k, 2])
        x = a[k, 0] - 2.0 * OMEGA_EARTH * v[k, 1] - gx
        y = a[k, 1] + 2.0 * OMEGA_EARTH * v[k, 0] - gy
        z = a[k, 2] - gz
        for j in range(3):
            omega_ib[k, j] = omega_eb[k, j] + OMEGA_EARTH * C[k, 6 + j]
            force[k, j] = C[k, j] * x + C[k, 3 + j] * y + C[k, 6 + j] * z
