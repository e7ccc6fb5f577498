"""Positions for other programs: NMEA sentences, GeoJSON, KML.

Heights are above the WGS-84 ellipsoid everywhere; NMEA's geoid separation is left empty, as no
geoid is known here.  Times are UTC by the table of leap seconds (`signals.gps_time`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import escape

import numpy as np

from signals.constants import C_MPS
from signals.gps_time import utc_text
from ultratight.ins.earth import geodetic_from_ecef, rotation_e_from_n
from ultratight.tracking.navigation import Navigation

KNOT_MPS = 1852.0 / 3600.0
_SLOWEST_MPS = 0.1
"""Below, the course is not told"""


class Place(NamedTuple):
    """One epoch for a map; deg, m, m/s."""

    utc: str  # RFC 3339, microseconds, Z
    t_s: float  # from sample 0 on
    gps_tow_s: float
    lat_deg: float
    lon_deg: float
    height_m: float
    speed_mps: float  # over ground
    course_deg: float
    n_used: int
    hdop: float  # NaN: no fix by least squares


def places(nav: Navigation) -> list[Place]:
    """The filter's positions, or the fix's where there is no filter."""
    found = []
    for p in nav.positions:
        of = p.estimate or p.fix
        if of is not None:
            hdop = p.fix.dop.horizontal if p.fix else math.nan
            used = int(np.count_nonzero(of.used))
            found.append(place(nav.week, p.t_s, p.tow_s, of.state, used, hdop))
    return found


def place(
    week: int, t_s: float, tow_s: float, state: np.ndarray, n_used: int, hdop: float = math.nan
) -> Place:
    """Of r, c b, v (8,) in ECEF, tow_s being what the receiver's clock reads."""
    lat, lon, h = (float(x) for x in geodetic_from_ecef(state[:3]))
    north, east, _ = rotation_e_from_n(lat, lon).T @ state[4:7]
    gps_s = tow_s - float(state[3]) / C_MPS
    return Place(
        utc_text(week, gps_s), t_s, gps_s, math.degrees(lat), math.degrees(lon), h,
        math.hypot(north, east), math.degrees(math.atan2(east, north)) % 360.0, n_used, hdop,
    )  # fmt: skip


def write(of: Sequence[Place], folder: Path, name: str) -> list[Path]:
    """NAME.nmea, .geojson and .kml; nothing without a position."""
    texts = {"nmea": nmea, "geojson": geojson, "kml": lambda places: kml(places, name)}
    paths = []
    for ending, text in texts.items() if of else ():
        paths.append(folder / f"{name}.{ending}")
        paths[-1].write_text(text(of), encoding="utf-8", newline="")
    return paths


def nmea(of: Sequence[Place]) -> str:
    """GGA and RMC of each place (NMEA 0183, 4.11), lines ending in CR LF."""
    lines = []
    for p in of:
        at = datetime.fromisoformat(p.utc.replace(":60.", ":59.").replace("Z", "+00:00"))
        clock = f"{p.utc[11:13]}{p.utc[14:16]}{p.utc[17:23]}"
        place = f"{_angle(p.lat_deg, 2, 'NS')},{_angle(p.lon_deg, 3, 'EW')}"
        hdop = "" if math.isnan(p.hdop) else f"{p.hdop:.2f}"
        used = f"{min(p.n_used, 99):02d}"
        lines.append(f"GPGGA,{clock},{place},1,{used},{hdop},{p.height_m:.3f},M,,M,,")
        course = f"{p.course_deg:.2f}" if p.speed_mps >= _SLOWEST_MPS else ""
        speed = f"{p.speed_mps / KNOT_MPS:.3f}"
        lines.append(f"GPRMC,{clock},A,{place},{speed},{course},{at:%d%m%y},,,A")
    return "".join(f"${line}*{_checksum(line):02X}\r\n" for line in lines)


def geojson(of: Sequence[Place]) -> str:
    """The path as a feature (RFC 7946), a position per epoch with time, speed and satellites."""
    line = [[round(p.lon_deg, 9), round(p.lat_deg, 9), round(p.height_m, 4)] for p in of]
    # a line needs two positions
    kind: dict[str, Any] = {"type": "LineString", "coordinates": line}
    if len(of) == 1:
        kind = {"type": "Point", "coordinates": line[0]}
    facts = {
        "utc": [p.utc for p in of],
        "t_s": [round(p.t_s, 6) for p in of],
        "speed_mps": [round(p.speed_mps, 4) for p in of],
        "satellites": [p.n_used for p in of],
    }
    feature = {"type": "Feature", "geometry": kind, "properties": facts}
    return json.dumps({"type": "FeatureCollection", "features": [feature]}) + "\n"


def kml(of: Sequence[Place], name: str) -> str:
    """The path as a track with times (KML 2.2 with the gx:Track of its readers)."""
    when = "".join(f"<when>{p.utc.replace(':60.', ':59.')}</when>\n" for p in of)
    at = "".join(
        f"<gx:coord>{p.lon_deg:.9f} {p.lat_deg:.9f} {p.height_m:.4f}</gx:coord>\n" for p in of
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">'
        f"\n<Document>\n<Placemark>\n<name>{escape(name)}</name>\n<gx:Track>\n"
        f"<altitudeMode>absolute</altitudeMode>\n{when}{at}</gx:Track>\n"
        "</Placemark>\n</Document>\n</kml>\n"
    )


def _angle(deg: float, width: int, letters: str) -> str:
    """Degrees and minutes to 1e-7 of these (0.2 mm), and the hemisphere."""
    whole, minutes = divmod(round(abs(deg) * 60.0 * 1e7), 60 * 10**7)
    return f"{whole:0{width}d}{minutes / 1e7:010.7f},{letters[deg < 0.0]}"


def _checksum(line: str) -> int:
    total = 0
    for byte in line.encode("ascii"):
        total ^= byte
    return total
