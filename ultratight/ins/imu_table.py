"""What an IMU measured, as a table of text (CSV).

Its first line names columns and units, and is one of

    t_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_mps2,accel_y_mps2,accel_z_mps2
    t_s,dtheta_x_rad,dtheta_y_rad,dtheta_z_rad,dv_x_mps,dv_y_mps,dv_z_mps

Body axes are forward-right-down: at rest and level the accelerometers read 0, 0, -9.8 m/s2.  A row
is about the interval that ends at its t_s: mean rates over it, or increments.  t_s is receiver time
[s] since the first sample of the recording, may begin below zero, and has one spacing; lines that
begin with # are comments.
"""

from __future__ import annotations

from pathlib import Path
from typing import TextIO

import numpy as np

from ultratight.ins.imu import Increments

RATES = (
    "t_s", "gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s",
    "accel_x_mps2", "accel_y_mps2", "accel_z_mps2",
)  # fmt: skip
INCREMENTS = (
    "t_s", "dtheta_x_rad", "dtheta_y_rad", "dtheta_z_rad", "dv_x_mps", "dv_y_mps", "dv_z_mps",
)  # fmt: skip
SHORTEST_S, LONGEST_S = 1e-4, 0.1
MOST_RAD_S, MOST_MPS2 = 100.0, 10_000.0
_ONE_G = 0.9, 1.1
"""A median specific force [m/s2] in here is one in g: else somebody falls, and not quite freely"""
_EVEN = 0.01
"""Of an interval: times may be rounded by so much"""
_ROWS = 20_000


def read_increments(path: str | Path) -> Increments:
    """Read a table; see the module.

    Raises
    ------
    ValueError
        Any other header, values that are not finite numbers, gaps, units that cannot be those of
        the header; says which file, line and value.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file, expected a table of IMU data (CSV)") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file, expected a table of IMU data (CSV)") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    numbered = [(k, x) for k, x in enumerate(lines, 1) if x.strip() and not x.startswith("#")]
    names = _header(path, numbered)
    at = [k for k, _ in numbered[1:]]
    table = _numbers(path, numbered[1:], names)
    dt = _interval(path, table[:, 0], at)
    if names == INCREMENTS:
        table[:, 1:] /= dt
    _check_units(path, table, at, names)
    t_s = table[0, 0] + dt * np.arange(-1, len(table))
    return Increments(t_s, table[:, 1:4] * dt, table[:, 4:7] * dt)


def write_increments(path: str | Path, imu: Increments) -> None:
    """Write a table of rates."""
    with Path(path).open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join(RATES) + "\n")
        for first in range(0, len(imu.alpha_ib_b), _ROWS):
            _write(file, imu, slice(first, first + _ROWS))


def _write(file: TextIO, imu: Increments, part: slice) -> None:
    dt = np.diff(imu.t_s)[part, None]
    rows = np.hstack([imu.t_s[1:][part, None], imu.alpha_ib_b[part] / dt, imu.nu_ib_b[part] / dt])
    np.savetxt(file, rows, fmt=["%.9f", *["%.15g"] * 6], delimiter=",")


def _header(path: Path, numbered: list[tuple[int, str]]) -> tuple[str, ...]:
    expected = f"expected the header {','.join(RATES)} or {','.join(INCREMENTS)}"
    if not numbered:
        raise ValueError(f"{path}: empty, {expected}")
    number, first = numbered[0]
    names = tuple(cell.strip() for cell in first.split(","))
    if names not in (RATES, INCREMENTS):
        raise ValueError(f"{path} line {number}: {','.join(names)[:120]}, {expected}")
    if len(numbered) < 3:
        raise ValueError(f"{path}: {len(numbered) - 1} rows, expected two or more")
    return names


def _numbers(path: Path, rows: list[tuple[int, str]], names: tuple[str, ...]) -> np.ndarray:
    """(n, 7) finite numbers."""
    try:
        table = np.loadtxt([row for _, row in rows], delimiter=",", ndmin=2)
        if table.shape == (len(rows), len(names)) and np.isfinite(table).all():
            return table
    except ValueError:
        pass
    for number, row in rows:
        cells = row.split(",")
        if len(cells) != len(names):
            raise ValueError(f"{path} line {number}: {len(cells)} values, expected {len(names)}")
        for name, cell in zip(names, cells, strict=True):
            if not _is_finite(cell):
                raise ValueError(
                    f"{path} line {number}: {name} is {cell.strip()!r}, expected a finite number"
                )
    raise ValueError(f"{path}: expected numbers only")


def _is_finite(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False


def _interval(path: Path, t_s: np.ndarray, at: list[int]) -> float:
    """The spacing of the rows; ValueError where there is none."""
    steps = np.diff(t_s)
    dt = float(np.median(steps))
    if not SHORTEST_S <= dt <= LONGEST_S:
        raise ValueError(
            f"{path}: t_s grows by {dt:g} a row, expected {SHORTEST_S:g} to {LONGEST_S:g} s"
        )
    off = np.flatnonzero(np.abs(steps - dt) > 2.0 * _EVEN * dt)
    if not len(off):
        # over all rows, as single ones are rounded
        dt = float(t_s[-1] - t_s[0]) / len(steps)
        away = np.abs(t_s - t_s[0] - dt * np.arange(len(t_s)))
        off = np.flatnonzero(away[1:] > _EVEN * dt)
    if len(off):
        k = int(off[0])
        raise ValueError(
            f"{path} line {at[k + 1]}: t_s is {t_s[k + 1]:.9g} after {t_s[k]:.9g}, expected rows "
            f"every {dt:.9g} s, without gaps"
        )
    return dt


def _check_units(path: Path, table: np.ndarray, at: list[int], names: tuple[str, ...]) -> None:
    """Refuse what no vehicle does; ``table`` has rates."""
    limits = (("gyro", "rad/s", MOST_RAD_S, "deg/s"), ("accel", "m/s2", MOST_MPS2, "mm/s2"))
    for part, (name, unit, most, other) in zip((slice(1, 4), slice(4, 7)), limits, strict=True):
        size = np.abs(table[:, part])
        k, axis = np.unravel_index(int(size.argmax()), size.shape)
        if size[k, axis] > most:
            column = names[part][axis]
            raise ValueError(
                f"{path} line {at[k]}: {column} means {size[k, axis]:.4g} {unit}, expected at most "
                f"{most:g} {unit}; is the {name}'s unit {other}?"
            )
    force = float(np.median(np.linalg.norm(table[:, 4:7], axis=1)))
    if _ONE_G[0] <= force <= _ONE_G[1]:
        raise ValueError(
            f"{path}: the specific force is {force:.3f} m/s2 in the middle, expected about 9.8 at "
            "rest; is the unit g?"
        )
