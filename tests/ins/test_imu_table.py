"""IMU data as text: what is written is read, and what cannot be right is refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ultratight.ins.imu import Increments
from ultratight.ins.imu_table import INCREMENTS, RATES, read_increments, write_increments

DT = 1.0 / 128.0


def data(n: int = 12) -> Increments:
    """At rest and level, with noise; the first row ends at sample 0."""
    rng = np.random.default_rng(3)
    alpha, nu = 1e-5 * rng.standard_normal((2, n, 3))
    return Increments(DT * np.arange(-1, n), alpha, nu + DT * np.array([0.0, 0.0, -9.8]))


def lines_of(path: Path, imu: Increments) -> list[str]:
    write_increments(path, imu)
    return path.read_text().splitlines()


def test_what_is_written_is_read(tmp_path: Path) -> None:
    """15 digits of the values, nanoseconds of the times."""
    path, imu = tmp_path / "imu.csv", data()
    lines_of(path, imu)
    found = read_increments(path)
    np.testing.assert_allclose(found.t_s, imu.t_s, atol=1e-9)
    np.testing.assert_allclose(found.alpha_ib_b, imu.alpha_ib_b, rtol=1e-9)
    np.testing.assert_allclose(found.nu_ib_b, imu.nu_ib_b, rtol=1e-9)


def test_increments_and_comments_are_read_too(tmp_path: Path) -> None:
    """Two rows of which everything is known: they end at 0.49 and 0.5 s."""
    path = tmp_path / "imu.csv"
    path.write_text(
        "# of a bench\n" + ",".join(INCREMENTS) + "\n0.49,1e-6,2e-6,3e-6,0,0,-0.098\n\n"
        "0.50,4e-6,5e-6,6e-6,0.001,0,-0.098\n"
    )
    found = read_increments(path)
    np.testing.assert_allclose(found.t_s, [0.48, 0.49, 0.50], atol=1e-12)
    np.testing.assert_allclose(found.alpha_ib_b, [[1e-6, 2e-6, 3e-6], [4e-6, 5e-6, 6e-6]])
    np.testing.assert_allclose(found.nu_ib_b, [[0.0, 0.0, -0.098], [0.001, 0.0, -0.098]])


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ((3, 5, "nan"), "line 4: accel_y_mps2 is 'nan', expected a finite number"),
        ((3, 1, "fast"), "line 4: gyro_x_rad_s is 'fast', expected a finite number"),
        ((3, 1, "1,2"), "line 4: 8 values, expected 7"),
        ((5, 0, "0.5"), "line 6: t_s is 0.5 after 0.0234375, expected rows every 0.0078125 s"),
        ((0, 4, "accel_x_g"), "accel_x_g,accel_y_mps2,accel_z_mps2, expected the header t_s,gyro_"),
        ((3, 2, "250.0"), "line 4: gyro_y_rad_s means 250 rad/s, expected at most 100 rad/s; is"),
        ((3, 6, "-2e4"), "line 4: accel_z_mps2 means 2e+04 m/s2, expected at most 10000 m/s2; is"),
    ],
)
def test_one_line_for_a_wrong_table(
    tmp_path: Path, change: tuple[int, int, str], expected: str
) -> None:
    path = tmp_path / "imu.csv"
    lines = lines_of(path, data())
    row, column, value = change
    cells = lines[row].split(",")
    cells[column] = value
    path.write_text("\n".join([*lines[:row], ",".join(cells), *lines[row + 1 :]]))
    with pytest.raises(ValueError, match=r"imu\.csv") as error:
        read_increments(path)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_a_row_that_is_missing_is_found(tmp_path: Path) -> None:
    path = tmp_path / "imu.csv"
    lines = lines_of(path, data())
    path.write_text("\n".join(lines[:6] + lines[7:]))
    with pytest.raises(ValueError, match=r"line 7: t_s is .* expected rows every 0.0078125 s, wit"):
        read_increments(path)


def test_units_of_time_and_force(tmp_path: Path) -> None:
    """Milliseconds; g in place of m/s2; nothing; no file."""
    path, imu = tmp_path / "imu.csv", data()
    write_increments(path, imu._replace(nu_ib_b=imu.nu_ib_b / 9.80665))
    with pytest.raises(ValueError, match=r"specific force is 0.999 m/s2 .* is the unit g\?"):
        read_increments(path)
    path.write_text(",".join(RATES) + "\n" + "".join(f"{5 * k},0,0,0,0,0,-9.8\n" for k in range(9)))
    with pytest.raises(ValueError, match=r"t_s grows by 5 a row, expected 0.0001 to 0.1 s"):
        read_increments(path)
    path.write_text(",".join(RATES) + "\n0,0,0,0,0,0,-9.8\n")
    with pytest.raises(ValueError, match="1 rows, expected two or more"):
        read_increments(path)
    path.write_text("\n")
    with pytest.raises(ValueError, match="empty, expected the header t_s,gyro_x_rad_s"):
        read_increments(path)
    with pytest.raises(ValueError, match=r"none\.csv: no such file, expected a table of IMU data"):
        read_increments(tmp_path / "none.csv")
