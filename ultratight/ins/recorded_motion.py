"""Motion from a table of positions: a spline through them, smooth in velocity and acceleration.

The spline is quintic (four continuous derivatives) and passes through every point; it is made in
ECEF, so that no latitude, longitude or date line is special.  Positions are those of the IMU, as
in a profile.  A table has no attitude: the body axes are north-east-down at the first point and
stay fixed to the Earth.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ultratight.ins.earth import ecef_from_geodetic, geodetic_from_ecef, rotation_e_from_n
from ultratight.ins.trajectory import Motion, RigidMotion, Side

SPEED_LIMIT_MPS = 12_000.0
ACCELERATION_LIMIT_MPS2 = 10_000.0
LEAST_HEIGHT_M = -1000.0
_DEGREE = 5
_GEODETIC, _ECEF = ("t_s", "lat_deg", "lon_deg", "h_m"), ("t_s", "x_m", "y_m", "z_m")
_EXPECTED = f"expected a header {','.join(_GEODETIC)} or {','.join(_ECEF)}"


class RecordedMotion(RigidMotion):
    """The motion through given points.

    Parameters
    ----------
    t_s : (n,) rising times since the start [s], n >= 2.
    r_eb_e : (n, 3) ECEF positions [m].

    Raises
    ------
    ValueError
        Shapes that disagree, times that do not rise, numbers that are not finite, a spline faster
        than 12 km/s, with more than 10 000 m/s2 or deeper than 1 km below the ellipsoid.
    """

    def __init__(self, t_s: np.ndarray, r_eb_e: np.ndarray) -> None:
        from scipy.interpolate import make_interp_spline

        t, r = np.array(t_s, float), np.array(r_eb_e, float)
        if t.ndim != 1 or len(t) < 2 or r.shape != (len(t), 3):
            raise ValueError(f"t_s {t.shape}, r_eb_e {r.shape}: expected (n,), (n, 3), n >= 2")
        if not (np.isfinite(t).all() and np.isfinite(r).all()):
            raise ValueError("positions: expected finite numbers only")
        if not (np.diff(t) > 0.0).all():
            at = int(np.argmin(np.diff(t) > 0.0))
            raise ValueError(f"t_s: {t[at + 1]:g} follows {t[at]:g}, expected times that rise")
        self.t_s, self.origin = t, r[0]
        # fewer than 6 points: the one polynomial through them
        self._position = make_interp_spline(t, r - self.origin, min(_DEGREE, len(t) - 1))
        lat, lon, _ = geodetic_from_ecef(self.origin)
        self.C_n_e = rotation_e_from_n(lat, lon)
        self.breakpoints_s, self.first_jump_s = np.empty(0), None
        self._check()

    @classmethod
    def from_csv(cls, path: str | Path) -> RecordedMotion:
        """Read a table; its header names columns and units.

        ``t_s`` [s since the start] and either ``lat_deg``, ``lon_deg``, ``h_m`` (geodetic, WGS-84)
        or ``x_m``, ``y_m``, ``z_m`` (ECEF), in any order, other columns are ignored; lines that
        begin with # are comments.  ValueError names the file and the line.
        """
        path = Path(path)
        try:
            with path.open(encoding="utf-8-sig", newline="") as file:
                names, table, lines = _read(path, file)
        except FileNotFoundError:
            raise ValueError(f"{path}: no such file, expected a trajectory (CSV)") from None
        except UnicodeDecodeError:
            raise ValueError(f"{path}: not a text file, expected a trajectory (CSV)") from None
        except OSError as error:
            raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
        t, r = table[:, 0], table[:, 1:]
        falls = np.flatnonzero(np.diff(t) <= 0.0)
        if len(falls):
            k = falls[0]
            raise ValueError(
                f"{path} line {lines[k + 1]}: t_s is {t[k + 1]:g} after {t[k]:g}, expected times "
                "that rise"
            )
        if names == _GEODETIC:
            r = ecef_from_geodetic(np.radians(r[:, 0]), np.radians(r[:, 1]), r[:, 2])
        try:
            return cls(t, r)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def at(self, t: ArrayLike, side: Side = "right") -> Motion:
        """Motion at times t (...) [s]; a little outside the table the spline goes on."""
        t = np.asarray(t, float)
        return Motion(
            r_eb_e=self.origin + self._position(t),
            v_eb_e=self._position(t, 1),
            a_eb_e=self._position(t, 2),
            C_b_e=np.broadcast_to(self.C_n_e, (*t.shape, 3, 3)),
            omega_eb_b=np.zeros((*t.shape, 3)),
        )

    def check_covers(self, duration_s: float) -> None:
        """ValueError unless the table reaches from the start to the end of a run."""
        if self.t_s[0] > 0.0 or self.t_s[-1] < duration_s:
            raise ValueError(
                f"t_s runs from {self.t_s[0]:g} to {self.t_s[-1]:g} s, expected 0 to "
                f"duration_s = {duration_s:g} at least"
            )

    def _check(self) -> None:
        """Refuse what no vehicle does: at the points and between them."""
        t = np.union1d(self.t_s, 0.5 * (self.t_s[1:] + self.t_s[:-1]))
        height_m = geodetic_from_ecef(self.origin + self._position(t))[2]
        if not height_m.min() >= LEAST_HEIGHT_M:
            raise ValueError(
                f"height {height_m.min():.4g} m at t = {t[height_m.argmin()]:g} s, expected "
                f"{LEAST_HEIGHT_M:g} m or more"
            )
        limits = (
            ("speed", "m/s", 1, SPEED_LIMIT_MPS),
            ("acceleration", "m/s2", 2, ACCELERATION_LIMIT_MPS2),
        )
        for name, unit, order, limit in limits:
            size = np.linalg.norm(self._position(t, order), axis=1)
            k = int(size.argmax())
            if not size[k] <= limit:
                raise ValueError(
                    f"{name} {size[k]:.4g} {unit} at t = {t[k]:g} s, expected at most {limit:g} "
                    f"{unit}"
                )


def _read(path: Path, file: Iterator[str]) -> tuple[tuple[str, ...], np.ndarray, list[int]]:
    """Column names, (n, 4) numbers in their order, and the line of each row."""
    names: tuple[str, ...] = ()
    columns: list[int] = []
    rows, lines = [], []
    reader = csv.reader(file, skipinitialspace=True)
    for cells in reader:
        if not cells or cells[0].startswith("#"):
            continue
        where = f"{path} line {reader.line_num}"
        if not names:
            header = [cell.strip() for cell in cells]
            kinds = [k for k in (_GEODETIC, _ECEF) if set(k) <= set(header)]
            if len(kinds) != 1 or len(set(header)) < len(header):
                raise ValueError(f"{where}: {','.join(header)[:60]}, {_EXPECTED}")
            names = kinds[0]
            columns = [header.index(name) for name in names]
            continue
        if len(cells) != len(header):
            raise ValueError(f"{where}: {len(cells)} values, expected {len(header)}")
        rows.append(
            [_number(where, name, cells[c]) for name, c in zip(names, columns, strict=True)]
        )
        lines.append(reader.line_num)
    if not names:
        raise ValueError(f"{path}: empty, {_EXPECTED}")
    if len(rows) < 2:
        raise ValueError(f"{path}: {len(rows)} points, expected two or more")
    return names, np.array(rows), lines


_BOUNDS = {"lat_deg": (-90.0, 90.0), "lon_deg": (-360.0, 360.0), "h_m": (-1_000.0, 2_000_000.0)}


def _number(where: str, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{where}: {name} is {text.strip()!r}, expected a number") from None
    low, high = _BOUNDS.get(name, (-1e8, 1e8))
    if not low <= value <= high:
        raise ValueError(f"{where}: {name} is {text.strip()}, expected {low:g} to {high:g}")
    return value
