"""Broadcast orbits against known answers, precise orbits and the laws of the constellation."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from signals import satellites
from signals.constants import C_MPS, GM_GPS, OMEGA_EARTH, WEEK_S
from signals.rinex import read_navigation
from signals.satellites import Constellation, embedded, orbit

DATA = Path(__file__).parents[3] / "shared" / "data" / "orbit"
needs_data = pytest.mark.skipif(
    not DATA.exists(), reason="needs the reference data folder beside the repository"
)


def geodetic_to_ecef(latitude_deg: float, longitude_deg: float, height: float) -> np.ndarray:
    # WGS-84, NGA.STND.0036 (4-14)
    lat, lon = np.radians([latitude_deg, longitude_deg])
    e2 = 6.69437999014e-3
    n = 6378137.0 / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    flat = (n + height) * np.cos(lat)
    return np.array([flat * np.cos(lon), flat * np.sin(lon), (n * (1 - e2) + height) * np.sin(lat)])


def sines_of_elevation(r: np.ndarray, up: np.ndarray, satellite: np.ndarray) -> np.ndarray:
    line = satellite - r
    return line @ up / np.linalg.norm(line, axis=-1)


@needs_data
@pytest.mark.nojit
def test_full_keplerian_evaluation():
    # gnsstk's OrbitDataKepler test; 1 um is 200 times the last digit's worth of agreement
    case = json.loads((DATA / "orbit_iono_known_answers.json").read_text())["kepler_gps_lnav"]
    given, answer = case["inputs"], case["outputs"]
    names = {
        "TOE": "toe_sow", "TOC": "toc_sow", "SQRT_A": "sqrtA", "ECC": "ecc", "M0": "M0",
        "DELTA_N": "delta_n", "OMEGA0": "OMEGA0", "OMEGA_DOT": "OMEGADOT", "I0": "i0",
        "IDOT": "IDOT", "OMEGA": "omega", "CUC": "Cuc", "CUS": "Cus", "CRC": "Crc",
        "CRS": "Crs", "CIC": "Cic", "CIS": "Cis", "AF0": "af0", "AF1": "af1", "AF2": "af2",
    }  # fmt: skip
    row = np.zeros(satellites.N_ELEMENT)
    for ours, theirs in names.items():
        row[getattr(satellites, ours)] = given[theirs]
    out = orbit(row, given["t_eval_sow"])
    np.testing.assert_allclose(out[:3], answer["ecef_m"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(out[3:6], answer["vel_mps"], rtol=0, atol=1e-9)
    clock = answer["clk_bias_s_polynomial_only"] + answer["relativity_s"]
    assert out[6] == pytest.approx(clock, abs=1e-18)
    row[satellites.TGD] = 1e-8
    assert orbit(row, given["t_eval_sow"])[6] == pytest.approx(clock - 1e-8, abs=1e-18)


@pytest.fixture(scope="module")
def known() -> list[dict[str, float]]:
    with (DATA / "gps_orbit_known_answers_even_prn.csv").open() as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


@needs_data
def test_broadcast_orbits_against_another_evaluation_and_precise_orbits(known):
    constellation = read_navigation(DATA / "brdc1180.21n")
    assert len(known) > 150
    errors = []
    for k in known:
        (chosen,) = np.flatnonzero(
            (constellation.prn == k["prn"])
            & (constellation.elements[:, satellites.TOE] == k["toe_used"])
            & (constellation.iode == k["iode"])
        )[:1]
        row = constellation.elements[chosen].copy()
        row[satellites.TGD] = 0.0  # the table's clock is for the ionosphere-free user
        out = np.array(orbit(row, k["sow"]))
        position = [k["x_m"], k["y_m"], k["z_m"]]
        # the table's evaluation of the same elements, printed to 0.1 mm and 1 um/s: half a digit
        np.testing.assert_allclose(out[:3], position, rtol=0, atol=5.1e-5)
        np.testing.assert_allclose(
            out[3:6], [k["vx_mps"], k["vy_mps"], k["vz_mps"]], rtol=0, atol=6e-7
        )
        clock = k["clk_poly_s"] + k["clk_relativistic_s"]
        assert out[6] == pytest.approx(clock, abs=1e-18)
        # CODE's precise orbit of the centre of mass: 6 m (broadcast error and antenna offset)
        precise = [k["sp3_com_x_m"], k["sp3_com_y_m"], k["sp3_com_z_m"]]
        errors.append(np.linalg.norm(out[:3] - precise))
        assert errors[-1] < 6.0
    # and as a whole the 1.8 m of 3D error that the broadcast orbits of that day have
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1.82, abs=0.05)


def numerical_rates(constellation: Constellation, row: np.ndarray, tow: float) -> np.ndarray:
    """Five-point derivative of position and clock at 1 s: error h^4/30 x 5th derivative < 1e-9."""
    points = np.array([orbit(row, tow + k) for k in (-2.0, -1.0, 1.0, 2.0)])
    return (points[0] - 8 * points[1] + 8 * points[2] - points[3]) / 12.0


def test_velocity_and_clock_rate_are_the_derivatives():
    constellation = embedded()
    rows = constellation.select(2149, 475_220.0)[1]
    for row in rows:
        row = row.copy()
        row[satellites.AF2] = 1e-15  # zero in the real message
        for tow in (472_000.25, 475_220.0, 478_800.5):
            rates = numerical_rates(constellation, row, tow)
            out = orbit(row, tow)
            np.testing.assert_allclose(out[3:6], rates[:3], rtol=0, atol=1e-7)
            assert C_MPS * out[7] == pytest.approx(C_MPS * rates[6], abs=1e-9)


def test_eccentric_orbit_solves_keplers_equation():
    # e = 0.03 is the most that table 20-III provides for; r = a (1 - e cos E) must satisfy
    # Kepler's equation to rounding for any mean anomaly
    row = np.zeros(satellites.N_ELEMENT)
    row[satellites.SQRT_A], row[satellites.ECC], row[satellites.I0] = 5153.7, 0.03, 0.96
    for mean in np.linspace(-3.0, 3.0, 13):
        row[satellites.M0] = mean
        out = orbit(row, 0.0)
        true = np.arctan2(np.hypot(out[1], out[2]) * np.sign(out[2]), out[0])
        eccentric = 2 * np.arctan(np.sqrt(0.97 / 1.03) * np.tan(true / 2))
        assert eccentric - 0.03 * np.sin(eccentric) == pytest.approx(mean, abs=2e-15 * 10)
        # vis viva in the inertial frame
        x, y, z, vx, vy, vz = out[:6]
        speed2 = (vx - OMEGA_EARTH * y) ** 2 + (vy + OMEGA_EARTH * x) ** 2 + vz**2
        a = 5153.7**2
        assert speed2 == pytest.approx(GM_GPS * (2 / np.sqrt(x * x + y * y + z * z) - 1 / a))


def test_sets_of_a_satellite_agree_where_they_meet():
    # two sets of the real constellation, an hour from each toe: fits of one prediction join far
    # below its URA of 2 m
    constellation = embedded()
    for prn in (1, 3, 4, 6, 9, 14, 17, 19, 22, 28):
        sets = np.flatnonzero(constellation.prn == prn)
        early, late = constellation.elements[sets[[0, -1]]]
        a, b = np.array(orbit(early, 478_800.0)), np.array(orbit(late, 478_800.0))
        assert np.linalg.norm(a[:3] - b[:3]) < 1.0
        assert np.linalg.norm(a[3:6] - b[3:6]) < 1e-3
        assert abs(a[6] - b[6]) < 1e-9


def test_embedded_constellation_is_the_sky_of_beijing():
    constellation = embedded()
    assert len(constellation) == 24
    prns, rows = constellation.select(2149, 475_220.0)
    assert prns.tolist() == [1, 2, 3, 4, 6, 9, 12, 14, 17, 19, 21, 22, 28]
    r = geodetic_to_ecef(39.9, 116.4, 8000.0)
    up = np.array([np.cos(np.radians(39.9)) * np.cos(np.radians(116.4)),
                   np.cos(np.radians(39.9)) * np.sin(np.radians(116.4)),
                   np.sin(np.radians(39.9))])  # fmt: skip
    where = np.array([orbit(row, 475_220.0)[:3] for row in rows])
    assert (sines_of_elevation(r, up, where) > np.sin(np.radians(10.0))).sum() == 10
    # spacecraft of that day: nominal radius within 2 %, clocks below 1 ms
    assert np.abs(np.linalg.norm(where, axis=1) / 26_560e3 - 1).max() < 0.025
    with pytest.raises(ValueError, match=r"covers week 2149, tow 467984 s to week 2149, tow 4896"):
        constellation.select(2149, 500_000.0)


def shifted(constellation: Constellation, seconds: float, weeks: int) -> Constellation:
    """Same satellites with all times moved: the ground tracks turn with OMEGA_EARTH toe."""
    elements = constellation.elements.copy()
    elements[:, satellites.TOE] += seconds
    elements[:, satellites.TOC] += seconds
    elements[:, satellites.OMEGA0] += OMEGA_EARTH * seconds
    return replace(constellation, week=constellation.week + weeks, elements=elements)


def test_week_crossing_changes_nothing_but_the_count():
    # toe 200 s before the end of week 2148 = toe -200 s of week 2149
    base = embedded()
    moved = shifted(base, WEEK_S - 475_400.0, -1)
    expected = base.at(2149, 476_000.0, 28)
    for week, tow in ((2148, WEEK_S + 600.0), (2149, 600.0)):
        for got, want, tolerance in zip(
            moved.at(week, tow, 28), expected, (2e-6, 1e-9, 1e-18, 1e-20), strict=True
        ):
            np.testing.assert_allclose(got, want, rtol=0, atol=tolerance)
    prns, rows = moved.select(2149, 600.0)
    row = rows[prns.tolist().index(28)]
    assert row[satellites.TOE] == -200.0
    np.testing.assert_allclose(orbit(row, 600.0)[:3], expected[0], rtol=0, atol=2e-6)


def example(**columns: np.ndarray) -> Constellation:
    n = len(columns["toe"])
    elements = np.zeros((n, satellites.N_ELEMENT))
    elements[:, satellites.TOE] = columns["toe"]
    elements[:, satellites.SQRT_A] = 5153.7
    elements[:, satellites.AF0] = 1e-9 * np.arange(n)  # tells the sets apart
    whole = np.zeros(n, dtype=np.int64)
    return Constellation(
        prn=whole + 7,
        week=whole + 2000,
        elements=elements,
        health=np.asarray(columns.get("health", whole)),
        iode=whole.copy(),
        transmission_s=np.asarray(columns.get("sent", np.zeros(n))),
        source="example",
    )


def test_choice_of_the_set():
    def chosen(constellation: Constellation, tow: float) -> int:
        return round(constellation.select(2000, tow)[1][0, satellites.AF0] / 1e-9)

    three = example(toe=np.array([7200.0, 14_400.0, 14_384.0]))
    assert chosen(three, 10_700.0) == 0
    assert chosen(three, 10_793.0) == 2  # nearest, 14384 from 10792 on
    assert chosen(three, 14_393.0) == 1
    assert chosen(three, 14_391.0) == 2
    assert chosen(three, 0.0) == 0  # exactly 2 h
    with pytest.raises(ValueError, match="week 2000, tow -1 s: no satellite has a healthy eph"):
        three.select(2000, -1.0)
    # the one sent later wins a tie, in either order
    assert chosen(example(toe=np.array([0.0, 0.0]), sent=np.array([-9.0, -6.0])), 5.0) == 1
    assert chosen(example(toe=np.array([0.0, 0.0]), sent=np.array([-6.0, -9.0])), 5.0) == 0
    # the sick one is passed over
    assert chosen(example(toe=np.array([0.0, 3600.0]), health=np.array([63, 0])), 5.0) == 1
    with pytest.raises(ValueError, match="example has none at all"):
        example(toe=np.array([0.0]), health=np.array([1])).select(2000, 0.0)
    # `at` chooses for each time on its own
    clock = three.at(2000, np.array([[10_700.0, 14_393.0]]), 7)[2]
    np.testing.assert_allclose(clock, [[0.0, 1e-9]], atol=1e-18)
    with pytest.raises(ValueError, match="week 2000, tow 21601 s: G07 has no healthy ephemeris"):
        three.at(2000, np.array([14_400.0, 21_601.0]), 7)
    with pytest.raises(ValueError, match="G08 has no healthy"):
        three.at(2000, 7200.0, 8)
    with pytest.raises(ValueError, match="tow_s = nan"):
        three.select(2000, np.nan)


def test_arrays_are_checked_and_frozen():
    good = embedded()
    with pytest.raises(ValueError, match="read-only"):
        good.elements[0, 0] = 1.0
    with pytest.raises(ValueError, match=r"iode has shape \(3,\), expected \(24,\)"):
        replace(good, iode=np.zeros(3, dtype=np.int64))
    with pytest.raises(ValueError, match=r"status has shape \(24, 4\), expected \(24, 5\)"):
        replace(good, status=np.zeros((24, 4), dtype=np.int64))
    with pytest.raises(ValueError, match="elements has shape"):
        replace(good, elements=np.zeros((24, 5)))
    with pytest.raises(ValueError, match="not finite"):
        replace(good, elements=np.full((24, satellites.N_ELEMENT), np.nan))
