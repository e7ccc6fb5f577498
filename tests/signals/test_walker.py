"""Galileo's reference slots: the laws of a Walker 24/3/1 constellation."""

import numpy as np
import pytest

from signals.nominal import galileo_24
from signals.satellites import orbit

WEEK, TOW = 2149, 475_220.0


def positions(week: int, tow_s: float) -> np.ndarray:
    prn, rows = galileo_24(week, tow_s).select(week, tow_s)
    assert prn.tolist() == list(range(1, 25))
    return np.array([orbit(row, tow_s)[:3] for row in rows])


def test_slots_stand_as_walker_24_3_1():
    r = positions(WEEK, TOW)
    np.testing.assert_allclose(np.linalg.norm(r, axis=1), 29_599_800.0, atol=1.0)
    planes = r.reshape(3, 8, 3)
    normals = np.cross(planes[:, 0], planes[:, 1])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    np.testing.assert_allclose(np.degrees(np.arccos(normals[:, 2])), 56.0, atol=1e-9)
    nodes = np.degrees(np.arctan2(normals[:, 0], -normals[:, 1]))
    np.testing.assert_allclose(np.diff(nodes) % 360.0, 120.0, atol=1e-9)
    for plane in planes:  # slots 45 deg apart
        cosine = np.sum(plane * np.roll(plane, -1, axis=0), axis=1) / 29_599_800.0**2
        np.testing.assert_allclose(np.degrees(np.arccos(cosine)), 45.0, atol=1e-4)
    # 15 deg from plane to plane: argument of latitude from the height over the equator
    up = np.cross(normals, np.array([0.0, 0.0, 1.0])) / np.sin(np.radians(56.0))
    node = -up
    across = np.cross(normals, node)
    first = planes[:, 0]
    east, north = np.sum(first * node, axis=1), np.sum(first * across, axis=1)
    latitude = np.degrees(np.arctan2(north, east))
    np.testing.assert_allclose(np.diff(latitude) % 45.0, 15.0, atol=1e-6)


def test_ground_tracks_repeat_after_seventeen_orbits():
    # 10 turns of the Earth with respect to the node: sidereal days less the node's motion
    day = 2 * np.pi / (7.2921151467e-5 + np.radians(0.02764398) / 86_400.0)
    start = 100_000.0
    later = start + 10 * day - 7 * 86_400.0
    whole = 16.0 * round(later / 16.0)
    assert whole < 604_800.0
    first = np.array([orbit(row, start) for row in galileo_24(WEEK, start).select(WEEK, start)[1]])
    sky = galileo_24(WEEK + 1, whole).select(WEEK + 1, later)[1]
    second = np.array([orbit(row, later) for row in sky])
    np.testing.assert_allclose(second[:, :3], first[:, :3], atol=20.0)


def test_a_time_that_is_none_is_refused():
    with pytest.raises(ValueError, match="tow_s = nan: expected a finite time of week"):
        galileo_24(WEEK, np.nan)
