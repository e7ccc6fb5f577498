"""Delays of the atmosphere: known answers, an independent standard, and their laws."""

import json
from pathlib import Path

import numpy as np
import pytest

from signals.atmosphere import ionosphere_delay_m, troposphere_delay_m
from signals.propagation import elevation_azimuth

# gnsstk, test of the broadcast ionosphere (getIonoCorr), GPS week 2100, second of week 135; the
# first receiver stands at 39 N, 108.5 W, 1400 m
ALPHA = (1.11758709e-08, -2.37159346e-09, -6.03921316e-09, 3.84468251e-09)
BETA = (116736.0, -73012.6485, -13280.3702, 33818.185)
KNOWN = (
    ((-1575232.0141, -4707872.2332, 3993198.4383), (18217581.007, -14220522.58, 12707796.859),
     7.999406421871311),
)  # fmt: skip
CASES = Path(__file__).parents[3] / "shared" / "data" / "orbit" / "orbit_iono_known_answers.json"


def geodetic(r: np.ndarray) -> tuple[float, float]:
    """Latitude and longitude by iteration on the height (Hofmann-Wellenhof, 10.2.1)."""
    a, e2 = 6378137.0, 6.69437999014e-3
    p = np.hypot(r[0], r[1])
    lat = np.arctan2(r[2], p * (1 - e2))
    for _ in range(20):
        n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
        height = p / np.cos(lat) - n
        lat = np.arctan2(r[2], p * (1 - e2 * n / (n + height)))
    return lat, np.arctan2(r[1], r[0])


def known_delay(receiver, satellite, tow_s, alpha, beta) -> float:
    r = np.array(receiver)
    line = np.array(satellite) - r
    elevation, azimuth = elevation_azimuth(r, line / np.linalg.norm(line))
    return float(ionosphere_delay_m(*geodetic(r), azimuth, elevation, tow_s, alpha, beta))


@pytest.mark.nojit
def test_klobuchar_known_answer():
    for receiver, satellite, delay in KNOWN:
        assert known_delay(receiver, satellite, 135.0, ALPHA, BETA) == pytest.approx(
            delay, abs=1e-11
        )


@pytest.mark.skipif(
    not CASES.exists(), reason="needs the reference data folder beside the repository"
)
def test_klobuchar_known_answers():
    for case in json.loads(CASES.read_text())["klobuchar"]:
        delay = known_delay(
            case["rx_ecef"], case["sv_ecef"], case["sow"], case["alpha"], case["beta"]
        )
        assert delay == pytest.approx(case["L1_delay_m"], abs=1e-11)


def test_klobuchar_day_and_night():
    # 20.3.3.5.2.5: 5 ns at night, maximum at 14 h local time at the pierce point; straight up the
    # obliquity is 1 + 16 (0.53 - 0.5)^3 and the pierce point 0.0137 / 0.61 - 0.022 semicircles off
    t = np.arange(0.0, 86_400.0, 60.0)
    up = ionosphere_delay_m(0.3, 0.0, 0.0, np.pi / 2, t, ALPHA, BETA)
    night = 299_792_458.0 * 5e-9 * (1 + 16 * 0.03**3)
    assert up.min() == pytest.approx(night, rel=1e-12)
    assert t[up.argmax()] == 50_400.0
    assert 2.0 < up.max() < 10.0
    # eastwards by an hour the day comes an hour earlier; a whole day makes no difference
    east = ionosphere_delay_m(
        0.3, np.pi / 12, 0.0, np.pi / 2, t - 3600.0 + 5 * 86_400.0, ALPHA, BETA
    )
    # (the geomagnetic latitude differs: only the night and the moment are the same)
    assert t[east.argmax()] == 50_400.0
    assert east.min() == pytest.approx(night, rel=1e-12)
    # zeros of all coefficients leave the 5 ns
    zero = ionosphere_delay_m(0.3, 0.0, 0.0, np.pi / 2, 50_400.0, [0.0] * 4, [0.0] * 4)
    assert zero == pytest.approx(night, rel=1e-12)
    # obliquity: 5 deg elevation costs three times the zenith
    low = ionosphere_delay_m(0.3, 0.0, 0.0, np.radians(5.0), 0.0, ALPHA, BETA)
    assert low / night == pytest.approx(3.03, abs=0.02)


def test_shapes_broadcast():
    delay = ionosphere_delay_m(0.3, 0.1, np.zeros((3, 1)), np.full(4, 0.7), 0.0, ALPHA, BETA)
    assert delay.shape == (3, 4)
    assert troposphere_delay_m(0.3, np.zeros((3, 1)), np.full(4, 0.7)).shape == (3, 4)
    assert troposphere_delay_m(0.3, 0.0, 0.7).shape == ()


@pytest.mark.nojit
def test_zenith_delay_against_the_minimum_operational_standard():
    # RTCA DO-229D A.4.2.4: hydrostatic k1 Rd p / g_m, its mean profile at latitude 45 deg:
    # p = 1015.75 hPa, e = 11.66 hPa, T = 283.15 K, beta = 5.58 K/km, lambda = 2.57
    hydrostatic = 1e-6 * 77.604 * 287.054 / 9.784
    ours = troposphere_delay_m(np.pi / 4, 0.0, np.pi / 2, relative_humidity=0.0)
    # the two differ by k1 (77.604 against Saastamoinen's 77.624) and by g_m: 0.04 %
    assert ours / 1013.25 == pytest.approx(hydrostatic, rel=4e-4)
    wet = 1e-6 * 382_000.0 * 287.054 / (9.784 * 3.57 - 5.58e-3 * 287.054) * 11.66 / 283.15
    total = 1015.75 * hydrostatic + wet
    # the same vapour at the 15 C of our atmosphere, saturated at 17.04 hPa (WMO-No. 8); wet zenith
    # models differ by 2 cm in 13 (their scale heights), pressure by 2.5 hPa = 6 mm
    ours = troposphere_delay_m(np.pi / 4, 0.0, np.pi / 2, relative_humidity=11.66 / 17.04)
    assert ours == pytest.approx(total, abs=0.03)
    assert 2.3 < troposphere_delay_m(np.pi / 4, 0.0, np.pi / 2) < 2.42


def test_hydrostatic_delay_is_the_weight_of_the_air_above():
    # Saastamoinen: 2.2768 mm per hPa; ICAO standard atmosphere (Doc 7488): 1013.25, 540.20,
    # 226.32 and 54.749 hPa at 0, 5, 11 and 20 km
    h = np.array([0.0, 5e3, 11e3, 20e3])
    p = np.array([1013.25, 540.20, 226.32, 54.749])
    expected = 2.2768e-3 * p / (1.0 - 0.28e-6 * h)
    # the standard's heights are geopotential, hence 0.1 % at most
    np.testing.assert_allclose(
        troposphere_delay_m(np.pi / 4, h, np.pi / 2, 0.0), expected, rtol=1e-3
    )
    # gravity is 0.53 % larger at the pole than at the equator
    pole, equator = troposphere_delay_m(np.array([np.pi / 2, 0.0]), 0.0, np.pi / 2, 0.0)
    assert equator / pole == pytest.approx((1 + 0.00266) / (1 - 0.00266), rel=1e-9)


def test_mapping_against_the_global_mapping_function():
    # IERS Conventions software, GMF.F, test case: zenith distance 1.278564131 rad (elevation
    # 16.744 deg): hydrostatic 3.425245519339, wet 3.449589116182
    elevation = np.pi / 2 - 1.278564131
    mapping = troposphere_delay_m(0.6708665767, 844.715, elevation) / troposphere_delay_m(
        0.6708665767, 844.715, np.pi / 2
    )
    assert 3.425 < mapping < 3.450
    # held below 3 deg
    low = troposphere_delay_m(0.5, 0.0, np.radians([3.0, 1.0, -2.0]))
    assert low[0] == low[1] == low[2]


def test_refusals():
    with pytest.raises(ValueError, match=r"alpha is .*: expected four finite numbers"):
        ionosphere_delay_m(0.3, 0.0, 0.0, 1.0, 0.0, ALPHA[:3], BETA)
    with pytest.raises(ValueError, match=r"beta is .*nan.*: expected four finite numbers"):
        ionosphere_delay_m(0.3, 0.0, 0.0, 1.0, 0.0, ALPHA, (np.nan, 0, 0, 0))
    with pytest.raises(ValueError, match=r"relative_humidity = 1\.5: expected 0 to 1"):
        troposphere_delay_m(0.3, 0.0, 1.0, 1.5)
