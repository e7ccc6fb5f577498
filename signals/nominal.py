"""The nominal 24 slots of the GPS SPS Performance Standard, for any place and date."""

from __future__ import annotations

import math

import numpy as np

from signals import satellites as s
from signals.constants import GM_GPS, OMEGA_EARTH, WEEK_S
from signals.gps_time import LEAP_DAYS, gps_minus_utc_s
from signals.lnav_fields import quantise
from signals.satellites import MAX_AGE_S, N_ELEMENT, NO_IONO_UTC, Constellation, IonoUtc

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
_SLOT_NODE_A_DEG = 272.847
_SLOT_GREENWICH_DEG = 15.0 * (18.0 + 36.0 / 60.0 + 14.4 / 3600.0)
_SLOT_NODE_RATE = math.radians(-4.4874e-7)  # [rad/s], table A.2-1
_SLOT_A = 26_559_700.0  # [m]
_SLOT_INCLINATION = math.radians(55.0)
# GPS time of the epoch: 1993-07-01 is day 4925 after 1980-01-06; GPS - UTC was 9 s
_SLOT_EPOCH_S = 4925 * 86_400.0 + 9.0


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
    if not math.isfinite(tow_s):
        raise ValueError(f"tow_s = {tow_s}: expected a finite time of week [s]")
    moment = week * WEEK_S + 16.0 * round(tow_s / 16.0)
    week, toe = int(moment // WEEK_S), moment % WEEK_S
    elapsed = moment - _SLOT_EPOCH_S
    turn = _SLOT_NODE_RATE - OMEGA_EARTH  # rate of the node's longitude
    rows = np.zeros((24, N_ELEMENT))
    for slot in range(24):
        plane, place = divmod(slot, 4)
        node = math.radians(_SLOT_NODE_A_DEG + 60.0 * plane - _SLOT_GREENWICH_DEG) + turn * elapsed
        latitude = math.radians(_SLOT_LATITUDE_DEG[plane][place]) - 2.0 * turn * elapsed
        rows[slot, s.OMEGA0] = math.remainder(node + OMEGA_EARTH * toe, 2.0 * math.pi)
        rows[slot, s.M0] = math.remainder(latitude, 2.0 * math.pi)
    rows[:, s.TOE] = rows[:, s.TOC] = toe
    rows[:, s.SQRT_A] = math.sqrt(_SLOT_A)
    rows[:, s.DELTA_N] = -2.0 * turn - math.sqrt(GM_GPS / _SLOT_A**3)
    rows[:, s.OMEGA_DOT] = _SLOT_NODE_RATE
    rows[:, s.I0] = _SLOT_INCLINATION
    whole = np.zeros(24, dtype=np.int64)
    return Constellation(
        prn=np.arange(1, 25),
        week=whole + week,
        elements=quantise(rows),
        health=whole.copy(),
        iode=whole.copy(),
        transmission_s=np.full(24, toe - MAX_AGE_S),
        source="GPS SPS Performance Standard, 24 reference orbit slots",
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
