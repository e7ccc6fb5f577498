"""A trajectory file: the motion goes through its points, smoothly, or the file is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ultratight.ins.earth import ecef_from_geodetic, gravity, rotation_e_from_n
from ultratight.ins.recorded_motion import RecordedMotion

EARTH_RATE = 7.292115e-5  # WGS-84
START = ecef_from_geodetic(np.radians(45.0), np.radians(-120.0), 300.0)


def helix(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A climbing turn of 200 m radius and 40 s: position, velocity, acceleration in ECEF."""
    w, c = 2.0 * np.pi / 40.0, rotation_e_from_n(np.radians(45.0), np.radians(-120.0))
    zero = np.zeros_like(t)
    r = np.stack([200 * np.sin(w * t), 200 * (1 - np.cos(w * t)), -3.0 * t], axis=-1)
    v = np.stack([200 * w * np.cos(w * t), 200 * w * np.sin(w * t), zero - 3.0], axis=-1)
    a = np.stack([-200 * w**2 * np.sin(w * t), 200 * w**2 * np.cos(w * t), zero], axis=-1)
    return START + r @ c.T, v @ c.T, a @ c.T


def test_the_motion_between_the_points_is_the_true_one() -> None:
    """A quintic through points every 1 s of a turn: error (w h)^6 of its radius and less.

    w h = 0.157: 200 m x 1.5e-5 / 720 x a few; its derivatives by 1/h each.  Near the ends more.
    """
    t = np.arange(0.0, 61.0)
    motion = RecordedMotion(t, helix(t)[0])
    np.testing.assert_allclose(motion.at(t).r_eb_e, helix(t)[0], rtol=0, atol=2e-9)
    between = np.linspace(6.0, 54.0, 997)
    m = motion.at(between)
    for given, expected, tolerance in zip(m[:3], helix(between), (1e-6, 1e-5, 2e-4), strict=True):
        np.testing.assert_allclose(given, expected, rtol=0, atol=tolerance)
    np.testing.assert_allclose(motion.speed(between), np.hypot(200 * 2 * np.pi / 40, 3), atol=1e-4)


def test_velocity_and_acceleration_do_not_jump_at_the_points() -> None:
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.5, 2.0, 30))
    motion = RecordedMotion(t, START + np.cumsum(rng.standard_normal((30, 3)), axis=0))
    for name in ("v_eb_e", "a_eb_e"):
        before, after = (getattr(motion.at(t[1:-1] + d), name) for d in (-1e-7, 1e-7))
        # they change by their own rate only: < 1000 m/s3 x 0.2 us
        np.testing.assert_allclose(before, after, rtol=0, atol=2e-4)


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_few_points_make_one_polynomial(n: int) -> None:
    """Positions t^(n - 1) along x are met exactly, everywhere."""
    t = np.arange(n) * 1.0
    r = np.zeros((n, 3)) + START
    r[:, 0] += t ** (n - 1)
    fine = np.linspace(0.0, n - 1.0, 50)
    m = RecordedMotion(t, r).at(fine)
    np.testing.assert_allclose(m.r_eb_e[:, 0] - START[0], fine ** (n - 1), atol=1e-7)
    np.testing.assert_allclose(m.v_eb_e[:, 0], (n - 1) * fine ** (n - 2), atol=1e-7)


def test_the_imu_feels_this_motion() -> None:
    """At rest: gravity and the Earth's turn; in the turn: the same plus the acceleration."""
    t = np.arange(0.0, 61.0)
    rest = RecordedMotion(t, np.tile(START, (61, 1)))
    f = rest.specific_force(np.array([30.0]))[0]
    np.testing.assert_allclose(f, [0.0, 0.0, -np.linalg.norm(gravity(START))], atol=0.02)
    alpha, nu = rest.increments(np.array([10.0, 10.005, 10.01]))
    assert np.linalg.norm(alpha[0]) == pytest.approx(EARTH_RATE * 0.005, rel=1e-6)
    np.testing.assert_allclose(nu[0], f * 0.005, atol=1e-9)
    turn = RecordedMotion(t, helix(t)[0])
    at = np.array([30.0])
    v, a = helix(at)[1][0], helix(at)[2][0]
    r = helix(at)[0][0]
    expected = a + 2.0 * np.cross([0.0, 0.0, EARTH_RATE], v) - gravity(r)
    given = turn.at(at).C_b_e[0] @ turn.specific_force(at)[0]
    np.testing.assert_allclose(given, expected, atol=2e-4)


def test_geodetic_and_ecef_tables_are_the_same(tmp_path: Path) -> None:
    """Columns in any order, others ignored, comments, spaces, a byte order mark."""
    lat, lon, h = np.linspace(10, 10.01, 8), np.linspace(179.995, 180.005, 8), np.full(8, 20.0)
    r = ecef_from_geodetic(np.radians(lat), np.radians(lon), h)
    one, two = tmp_path / "geodetic.csv", tmp_path / "ecef.csv"
    table = zip(lat.tolist(), lon.tolist(), h.tolist(), strict=True)
    rows = [f"{b!r}, {k * 10}, {a!r}, 7, {c!r}" for k, (a, b, c) in enumerate(table)]
    text = "# a flight over the date line\nlon_deg, t_s, lat_deg, note, h_m\n" + "\n".join(rows)
    one.write_text("\ufeff" + text, encoding="utf-8")
    rows = [f"{k * 10},{x!r},{y!r},{z!r}" for k, (x, y, z) in enumerate(r.tolist())]
    two.write_text("t_s,x_m,y_m,z_m\n" + "\n".join(rows) + "\n\n")
    a, b = (RecordedMotion.from_csv(p).at(np.linspace(0.0, 70.0, 99)) for p in (one, two))
    np.testing.assert_allclose(a.r_eb_e, b.r_eb_e, rtol=0, atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(a.v_eb_e, axis=1), 22.2, atol=0.3)


HEAD = "t_s,lat_deg,lon_deg,h_m\n"
BAD = {
    "empty": ("", "empty, expected a header t_s,lat_deg,lon_deg,h_m or t_s,x_m,y_m,z_m"),
    "no header": ("0,1,2,3\n1,1,2,3\n", "line 1: 0,1,2,3, expected a header"),
    "radians": ("t_s,lat_rad,lon_rad,h_m\n", "line 1: t_s,lat_rad,lon_rad,h_m, expected a header"),
    "both": ("t_s,lat_deg,lon_deg,h_m,x_m,y_m,z_m\n", "expected a header"),
    "one point": (HEAD + "0,1,2,3\n", "1 points, expected two or more"),
    "short line": (HEAD + "0,1,2,3\n1,1,2\n", "line 3: 3 values, expected 4"),
    "a word": (HEAD + "0,1,2,3\n1,north,2,3\n", "line 3: lat_deg is 'north', expected a number"),
    "nan": (HEAD + "0,1,2,3\n1,nan,2,3\n", "line 3: lat_deg is nan, expected -90 to 90"),
    "inf": (HEAD + "0,1,2,inf\n", "line 2: h_m is inf, expected -1000 to 2e[+]06"),
    "latitude": (HEAD + "0,91,2,3\n", "line 2: lat_deg is 91, expected -90 to 90"),
    "time stands": (HEAD + "0,1,2,3\n# x\n0,1,2,4\n", "line 4: t_s is 0 after 0, expected times"),
    "time falls": (HEAD + "5,1,2,3\n4,1,2,3\n", "line 3: t_s is 4 after 5, expected times that"),
    "speed": (HEAD + "0,1,2,0\n1,1,2,20000\n", "speed 2e[+]04 m/s at t = 0 s, expected at most 12"),
    "acceleration": (
        HEAD + "0,1,2,0\n0.5,1,2,1200\n1,1,2,0\n1.5,1,2,1200\n",
        "acceleration .* m/s2 at t = .* s, expected at most 10000 m/s2",
    ),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_table_that_cannot_be_flown_is_named(tmp_path: Path, kind: str) -> None:
    text, expected = BAD[kind]
    path = tmp_path / "flight.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=expected) as caught:
        RecordedMotion.from_csv(path)
    assert "flight.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such file"):
        RecordedMotion.from_csv(tmp_path / "none.csv")
    (tmp_path / "binary.csv").write_bytes(bytes(range(128, 256)))
    with pytest.raises(ValueError, match="not a text file"):
        RecordedMotion.from_csv(tmp_path / "binary.csv")
    with pytest.raises(ValueError, match="cannot be read"):
        RecordedMotion.from_csv(tmp_path)


def test_a_table_must_cover_the_run() -> None:
    motion = RecordedMotion(np.array([0.0, 10.0]), np.tile(START, (2, 1)))
    motion.check_covers(10.0)
    with pytest.raises(ValueError, match="t_s runs from 0 to 10 s, expected 0 to duration_s = 10"):
        motion.check_covers(10.02)
    with pytest.raises(ValueError, match="t_s runs from 1 to 2 s"):
        RecordedMotion(np.array([1.0, 2.0]), np.tile(START, (2, 1))).check_covers(1.5)


def test_arrays_that_do_not_fit() -> None:
    for t, r, expected in (
        ([0.0], np.zeros((1, 3)), "n >= 2"),
        ([0.0, 1.0], np.zeros((3, 3)), r"expected \(n,\), \(n, 3\)"),
        ([0.0, 0.0], np.zeros((2, 3)), "0 follows 0, expected times that rise"),
        ([0.0, 1.0], np.full((2, 3), np.nan), "finite numbers only"),
    ):
        with pytest.raises(ValueError, match=expected):
            RecordedMotion(np.array(t), r)
