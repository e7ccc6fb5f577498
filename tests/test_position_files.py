"""NMEA, GeoJSON and KML of known places, read by others' readers."""

from __future__ import annotations

import json
import xml.etree.ElementTree as xml

import numpy as np
import pynmea2
import pytest

from ultratight import position_files
from ultratight.ins.earth import ecef_from_geodetic, rotation_e_from_n
from ultratight.position_files import Place, places
from ultratight.tracking.from_samples import Tracks
from ultratight.tracking.navigation import Navigation, Position
from ultratight.tracking.position_filter import Estimate

LAT, LON, H = -33.8568, -151.2153, 12.5


@pytest.fixture(scope="module")
def path() -> list[Place]:
    """10 m/s to the south-east, the receiver's clock 1 ms ahead; GPS - UTC is 18 s."""
    found = []
    lat, lon = np.radians(LAT), np.radians(LON)
    v = rotation_e_from_n(lat, lon) @ np.array([-6.0, 8.0, 0.0])
    for k in range(3):
        r = ecef_from_geodetic(lat, lon, H) + v * k
        state = np.array([*r, 299_792.458, *v, 0.0])
        used = np.array([True] * 7 + [False])
        estimate = Estimate(state, np.eye(8), used)
        found.append(Position(30.0 + k, 475_250.001 + k, np.arange(8), None, estimate))
    empty = np.empty(0)
    tracks = Tracks(*[empty] * 12, [])
    return places(Navigation(tracks, [], None, 2149, None, found, 30.0, ""))


def test_nmea_is_read_by_another_parser(path: list[Place]) -> None:
    text = position_files.nmea(path)
    lines = text.split("\r\n")
    assert lines.pop() == ""
    assert len(lines) == 6
    for k in range(3):
        gga, rmc = (pynmea2.parse(line, check=True) for line in lines[2 * k : 2 * k + 2])
        # Friday 2021-03-19, 132:00:50 of the week are 12:00:50 GPS time
        for one in (gga, rmc):
            assert one.timestamp.isoformat() == f"12:00:{32 + k:02d}+00:00"
            assert one.latitude == pytest.approx(LAT - k * 6.0 / 110_915.0, abs=2e-8)
            assert one.longitude == pytest.approx(LON + k * 8.0 / 92_520.0, abs=1e-6)
        assert float(gga.altitude) == pytest.approx(H, abs=2e-3)
        assert (gga.num_sats, gga.gps_qual) == ("07", 1)
        assert rmc.datestamp.isoformat() == "2021-03-19"
        assert rmc.spd_over_grnd == pytest.approx(10.0 / 0.514444, rel=1e-4)
        assert float(rmc.true_course) == pytest.approx(126.87, abs=0.01)  # atan2(8, -6)
        assert rmc.is_valid


def test_geojson_and_kml_have_longitude_first(path: list[Place]) -> None:
    (feature,) = json.loads(position_files.geojson(path))["features"]
    assert feature["geometry"]["type"] == "LineString"
    np.testing.assert_allclose(feature["geometry"]["coordinates"][0], [LON, LAT, H], atol=1e-4)
    assert feature["properties"]["utc"][0] == "2021-03-19T12:00:32.000000Z"
    one = json.loads(position_files.geojson(path[:1]))["features"][0]["geometry"]
    assert one["type"] == "Point"
    root = xml.fromstring(position_files.kml(path, "a & b"))
    ns = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
    assert root.find(".//k:name", ns).text == "a & b"
    at = [c.text for c in root.findall(".//gx:coord", ns)]
    when = [c.text for c in root.findall(".//k:when", ns)]
    assert len(at) == len(when) == 3
    np.testing.assert_allclose([float(x) for x in at[0].split()], [LON, LAT, H], atol=1e-4)
