"""The 24 reference slots of GPS and of Galileo, for any place and date."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from signals import satellites as s
from signals.constants import GM_GPS, OMEGA_EARTH, WEEK_S
from signals.gps_time import LEAP_DAYS, gps_minus_utc_s
from signals.lnav_fields import quantise
from signals.satellites import MAX_AGE_S, N_ELEMENT, NO_IONO_UTC, Constellation, IonoUtc


class Slots(NamedTuple):
    """Circular orbits in equal planes at an epoch; angles in degrees."""

    source: str
    epoch_s: float  # GPS seconds since 1980-01-06
    node_deg: float  # right ascension of the first plane; the others follow evenly to the east
    latitude_deg: tuple[tuple[float, ...], ...]  # argument of latitude of each slot, plane by plane
    greenwich_deg: float  # sidereal time at Greenwich
    node_rate: float  # [rad/s]
    turns: float  # orbits per turn of the Earth relative to the node
    a_m: float
    inclination_deg: float


# Reference orbit slots at 1993-07-01 00:00 UTC: argument of latitude [deg] of slots 1-4 of planes
# A-F, whose right ascensions of the node are 60 deg apart; GPS SPS Performance Standard (October
# 2001), table 3-1, and its almanac form, table A.2-1.
_SLOT_LATITUDE_DEG = (
    (268.126, 161.786, 11.676, 41.806),
    (80.956, 173.336, 309.976, 204.376),
    (111.876, 11.796, 339.666, 241.556),
    (135.226, 265.446, 35.156, 167.356),
    (197.046, 302.596, 66.066, 333.686),
    (238.886, 345.226, 105.206, 135.346),
)
# GPS time of the epoch: 1993-07-01 is day 4925 after 1980-01-06; GPS - UTC was 9 s
_SLOT_EPOCH_S = 4925 * 86_400.0 + 9.0
_GPS = Slots(
    "GPS SPS Performance Standard, 24 reference orbit slots",
    _SLOT_EPOCH_S,
    272.847,
    _SLOT_LATITUDE_DEG,
    15.0 * (18.0 + 36.0 / 60.0 + 14.4 / 3600.0),
    math.radians(-4.4874e-7),  # table A.2-1
    2.0,
    26_559_700.0,
    55.0,
)
# Walker 24/3/1 of the Galileo Open Service Definition Document, annex "reference constellation",
# at 2016-11-21 00:00 UTC; the ground tracks repeat after 17 orbits in 10 days.  GPS time of the
# epoch: day 13468 after 1980-01-06, GPS - UTC was 17 s.  Mean sidereal time at Greenwich then:
# Vallado, Fundamentals of Astrodynamics, eq. 3-45 without its small terms.
_GALILEO = Slots(
    "Galileo reference constellation, Walker 24/3/1",
    13_468 * 86_400.0 + 17.0,
    77.632,
    tuple(tuple(225.153 + 15.0 * plane + 45.0 * slot for slot in range(8)) for plane in range(3)),
    280.46061837 + 360.98564736629 * (2_457_713.5 - 2_451_545.0),
    math.radians(-0.02764398) / 86_400.0,
    1.7,
    29_599_800.0,
    56.0,
)


def nominal_24(week: int, tow_s: float) -> Constellation:
    """Place the 24 slots of the GPS SPS Performance Standard around a given time.

    Circular orbits without clock errors; PRN 1-24 are the slots A1, A2 ... F4.  The ground tracks
    are held where the standard puts them, as the control segment does: the argument of latitude
    advances by two turns for each turn of the Earth relative to the node.

    The sets have their toe at ``tow_s`` to the nearest 16 s and serve 2 h before and after it.
    They are rounded to the navigation message (`lnav_fields.quantise`), so that the truth made
    from them is what a receiver decodes: no satellite leaves its slot by more than 0.1 m.

    Raises
    ------
    ValueError
        The time is not a finite number.
    """
    sky = _around(_GPS, week, tow_s)
    return replace(sky, elements=quantise(sky.elements))


def galileo_24(week: int, tow_s: float) -> Constellation:
    """Place the 24 slots of Galileo's reference constellation around a given time.

    Circular orbits without clock errors; PRN 1-24 are the slots A1 ... A8, B1 ... C8, not the
    satellites that have these numbers.  The sets serve 2 h before and after ``tow_s``.

    Raises
    ------
    ValueError
        The time is not a finite number.
    """
    return _around(_GALILEO, week, tow_s)


def _around(slots: Slots, week: int, tow_s: float) -> Constellation:
    if not math.isfinite(tow_s):
        raise ValueError(f"tow_s = {tow_s}: expected a finite time of week [s]")
    moment = week * WEEK_S + 16.0 * round(tow_s / 16.0)
    week, toe = int(moment // WEEK_S), moment % WEEK_S
    elapsed = moment - slots.epoch_s
    turn = slots.node_rate - OMEGA_EARTH  # rate of the node's longitude
    places = [(p, x) for p, plane in enumerate(slots.latitude_deg) for x in plane]
    apart_deg = 360.0 / len(slots.latitude_deg)
    rows = np.zeros((len(places), N_ELEMENT))
    for row, (plane, latitude_deg) in zip(rows, places, strict=True):
        node = math.radians(slots.node_deg + apart_deg * plane - slots.greenwich_deg)
        longitude = node + turn * elapsed
        latitude = math.radians(latitude_deg) - slots.turns * turn * elapsed
        row[s.OMEGA0] = math.remainder(longitude + OMEGA_EARTH * toe, 2.0 * math.pi)
        row[s.M0] = math.remainder(latitude, 2.0 * math.pi)
    rows[:, s.TOE] = rows[:, s.TOC] = toe
    rows[:, s.SQRT_A] = math.sqrt(slots.a_m)
    rows[:, s.DELTA_N] = -slots.turns * turn - math.sqrt(GM_GPS / slots.a_m**3)
    rows[:, s.OMEGA_DOT] = slots.node_rate
    rows[:, s.I0] = math.radians(slots.inclination_deg)
    whole = np.zeros(len(places), dtype=np.int64)
    return Constellation(
        prn=np.arange(1, len(places) + 1),
        week=whole + week,
        elements=rows,
        health=whole.copy(),
        iode=whole.copy(),
        transmission_s=np.full(len(places), toe - MAX_AGE_S),
        source=slots.source,
        iono_utc=leap_seconds(moment),
    )


def leap_seconds(gps_s: float) -> IonoUtc:
    """UTC parameters of a moment, GPS seconds since 1980-01-06; no ionosphere."""
    past = gps_minus_utc_s(0, gps_s)
    if past == 0:
        return NO_IONO_UTC
    eve = LEAP_DAYS[past - 1] - 1  # the leap second ends that day; 1 is Sunday
    # sent modulo 256 and, when past, kept within 127 weeks of the present (20.3.3.5.2.4)
    week = int(gps_s // WEEK_S)
    return IonoUtc(
        week_t=week,
        leap_s=past,
        leap_future_s=past,
        week_lsf=max(eve // 7, week - 127),
        day=eve % 7 + 1,
    )
