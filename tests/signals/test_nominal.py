"""The nominal slots: the standard's table, the laws of their orbits, and what LNAV can say."""

import numpy as np
import pytest

from signals import satellites
from signals.constants import GM_GPS, OMEGA_EARTH, PI_GPS, WEEK_S
from signals.lnav_fields import quantise
from signals.nominal import leap_seconds, nominal_24
from signals.satellites import orbit

# Half steps of the message (IS-GPS-200 table 20-III), as metres on an orbit of 26 560 km: angles of
# 2^-31 semicircle along and across, sqrt(A) of 2^-19, and 2^-43 semicircle/s over two hours
ANGLE_M = 0.5 * PI_GPS * 2.0**-31 * 26.56e6
RADIUS_M = 0.5 * 2.0**-19 * 2 * 5153.7
RATE_M = 0.5 * PI_GPS * 2.0**-43 * 7200.0 * 26.56e6


def test_nominal_slots_at_their_epoch():
    # SPS Performance Standard, table 3-1, epoch 1993-07-01 00:00 UTC = GPS week 703, Thursday,
    # plus 9 s: slot B3 (PRN 7) at argument of latitude 309.976 deg, node 332.847 deg east of the
    # equinox, Greenwich at 18 h 36 m 14.4 s
    where, velocity, clock, _ = nominal_24(703, 345_609.0).at(703, 345_609.0, 7)
    node = np.radians(332.847 - (18 * 15 + 36 / 4 + 14.4 / 240))
    u, i, a = np.radians(309.976), np.radians(55.0), 26_559_700.0
    along, across = np.cos(u), np.sin(u) * np.cos(i)
    expected = a * np.array([
        along * np.cos(node) - across * np.sin(node),
        along * np.sin(node) + across * np.cos(node),
        np.sin(u) * np.sin(i),
    ])  # fmt: skip
    # toe is 345616, 7 s later: rates count little; three angles
    np.testing.assert_allclose(where, expected, rtol=0, atol=3 * ANGLE_M + RADIUS_M)
    assert clock == 0.0
    assert velocity @ where == pytest.approx(0.0, abs=1e-2)  # circular


@pytest.mark.parametrize(("week", "tow"), [(703, 345_609.0), (2149, 475_220.0), (2400, 3.0)])
def test_nominal_ground_tracks_stay_and_repeat_every_sidereal_day(week, tow):
    constellation = nominal_24(week, tow)
    prns, rows = constellation.select(week, tow + 3600.0)
    assert prns.tolist() == list(range(1, 25))
    where = np.array([orbit(row, tow) for row in rows])[:, :3]
    np.testing.assert_allclose(np.linalg.norm(where, axis=1), 26_559_700.0, atol=RADIUS_M)
    # the equator is crossed at a fixed longitude: u + 2 (longitude of the node) is a constant of
    # each slot, the same at any time
    reference = nominal_24(703, 345_609.0).elements
    now = constellation.elements
    toes = reference[0, satellites.TOE], now[0, satellites.TOE]
    sums = [
        e[:, satellites.M0] + 2 * (e[:, satellites.OMEGA0] - OMEGA_EARTH * toe)
        for e, toe in zip((reference, now), toes, strict=True)
    ]
    np.testing.assert_allclose(np.exp(1j * sums[0]), np.exp(1j * sums[1]), rtol=0, atol=1e-6)
    # two revolutions bring the track back after the node's day of 86 155 s less some (table 20-IV
    # rates): the period is that of a 26559.7 km orbit to 1e-4 (oblateness)
    period = 2 * np.pi / (np.sqrt(GM_GPS / 26_559_700.0**3) + now[0, satellites.DELTA_N])
    assert period == pytest.approx(2 * np.pi * np.sqrt(26_559_700.0**3 / GM_GPS), rel=1e-4)
    # a day are 12 times two hours of rate errors (mean motion with the step of sqrt(A), node)
    drift = 12 * (2 * RATE_M + 1.5 * RADIUS_M / 26.56e6 * 1.4585e-4 * 7200.0 * 26.56e6)
    later = np.array([orbit(row, tow + 2 * period) for row in rows])[:, :3]
    np.testing.assert_allclose(later, where, rtol=0, atol=1.0 + drift)
    toe_s = constellation.week[0] * WEEK_S + now[0, satellites.TOE]
    assert abs(toe_s - (week * WEEK_S + tow)) <= 8.0
    for t in (toe_s - 7200.0, toe_s + 7200.0):
        assert len(constellation.select(week, t - week * WEEK_S)[0]) == 24
    with pytest.raises(ValueError, match="24 reference orbit slots covers"):
        constellation.select(week, toe_s + 7201.0 - week * WEEK_S)


def test_the_slots_are_what_the_message_can_say():
    for week, tow in ((703, 345_609.0), (2400, 604_799.0), (2400, 3.0)):
        c = nominal_24(week, tow)
        np.testing.assert_array_equal(quantise(c.elements), c.elements)
        assert 0.0 <= c.elements[0, satellites.TOE] < WEEK_S
    assert c.iono_utc.leap_s == 18
    # the last day of week 2399 rounds into week 2400
    assert nominal_24(2399, 604_799.0).week.tolist() == [2400] * 24


@pytest.mark.parametrize(
    ("week", "tow", "leap_s"),
    [(0, 0.0, 0), (1930, 17.0, 17), (1930, 18.0, 18), (703, 345_608.0, 8), (703, 345_609.0, 9)],
)
def test_leap_seconds(week, tow, leap_s):
    # IERS Bulletin C: 18 s from 2017-01-01 (Sunday of week 1930), 9 s from 1993-07-01
    assert leap_seconds(week * WEEK_S + tow).leap_s == leap_s


def test_nominal_constellation_serves_the_whole_earth():
    # SPS Performance Standard 3.3: at least 4 satellites above 5 deg everywhere; 500 points of a
    # Fibonacci lattice on a sphere, all around a day
    k = np.arange(500)
    z = 1 - (2 * k + 1) / 500
    angle = np.pi * (1 + np.sqrt(5)) * k
    up = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], 1)
    for tow in (0.0, 20_000.0, 43_000.0, 61_000.0, 80_000.0):
        rows = nominal_24(2300, tow).select(2300, tow)[1]
        where = np.array([orbit(row, tow)[:3] for row in rows])
        line = where[None] - 6_371_000.0 * up[:, None]
        sine = np.einsum("psi,pi->ps", line, up) / np.linalg.norm(line, axis=2)
        seen = (sine > np.sin(np.radians(5.0))).sum(axis=1)
        assert seen.min() >= 4
        # half of 24 satellites is not in view of anyone, a third on average is
        assert 6.5 < seen.mean() < 9.0


def test_nominal_refuses_a_time_that_is_none():
    with pytest.raises(ValueError, match="tow_s = inf"):
        nominal_24(2149, np.inf)
