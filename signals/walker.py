"""The 24 reference slots of Galileo, for any place and date."""

from __future__ import annotations

import math

import numpy as np

from signals import satellites as s
from signals.constants import GM_GPS, OMEGA_EARTH, WEEK_S
from signals.nominal import leap_seconds
from signals.satellites import MAX_AGE_S, N_ELEMENT, Constellation

# Walker 24/3/1 of the Galileo Open Service Definition Document, annex "reference constellation",
# at 2016-11-21 00:00 UTC; the ground tracks repeat after 17 orbits in 10 days.
_NODE_DEG = 77.632  # right ascension of plane A; B and C are 120 and 240 deg east of it
_LATITUDE_DEG = 225.153  # argument of latitude of slot A1
_SLOT_DEG, _PLANE_DEG = 45.0, 15.0  # from slot to slot, and from plane to plane
_NODE_RATE = math.radians(-0.02764398) / 86_400.0  # [rad/s]
_ORBITS_PER_TURN = 1.7
_A = 29_599_800.0  # [m]
_INCLINATION = math.radians(56.0)
# GPS time of the epoch: 2016-11-21 is day 13468 after 1980-01-06; GPS - UTC was 17 s
_EPOCH_S = 13_468 * 86_400.0 + 17.0
# Mean sidereal time at Greenwich then: 100.4606184 deg + 360.9856473662 deg / day since J2000
# (2451545.0; Vallado, Fundamentals of Astrodynamics, eq. 3-45 without its small terms)
_GREENWICH_DEG = 280.46061837 + 360.98564736629 * (2_457_713.5 - 2_451_545.0)


def galileo_24(week: int, tow_s: float) -> Constellation:
    """Place the 24 slots of Galileo's reference constellation around a given time.

    Circular orbits without clock errors; PRN 1-24 are the slots A1 ... A8, B1 ... C8, not the
    satellites that have these numbers.  The sets serve 2 h before and after ``tow_s``.

    Raises
    ------
    ValueError
        The time is not a finite number.
    """
    if not math.isfinite(tow_s):
        raise ValueError(f"tow_s = {tow_s}: expected a finite time of week [s]")
    moment = week * WEEK_S + 16.0 * round(tow_s / 16.0)
    week, toe = int(moment // WEEK_S), moment % WEEK_S
    elapsed = moment - _EPOCH_S
    turn = _NODE_RATE - OMEGA_EARTH  # rate of the node's longitude
    rows = np.zeros((24, N_ELEMENT))
    for slot in range(24):
        plane, place = divmod(slot, 8)
        node = math.radians(_NODE_DEG + 120.0 * plane - _GREENWICH_DEG) + turn * elapsed
        start = math.radians(_LATITUDE_DEG + _PLANE_DEG * plane + _SLOT_DEG * place)
        rows[slot, s.OMEGA0] = math.remainder(node + OMEGA_EARTH * toe, 2.0 * math.pi)
        rows[slot, s.M0] = math.remainder(start - _ORBITS_PER_TURN * turn * elapsed, 2.0 * math.pi)
    rows[:, s.TOE] = rows[:, s.TOC] = toe
    rows[:, s.SQRT_A] = math.sqrt(_A)
    rows[:, s.DELTA_N] = -_ORBITS_PER_TURN * turn - math.sqrt(GM_GPS / _A**3)
    rows[:, s.OMEGA_DOT] = _NODE_RATE
    rows[:, s.I0] = _INCLINATION
    whole = np.zeros(24, dtype=np.int64)
    return Constellation(
        prn=np.arange(1, 25),
        week=whole + week,
        elements=rows,
        health=whole.copy(),
        iode=whole.copy(),
        transmission_s=np.full(24, toe - MAX_AGE_S),
        source="Galileo reference constellation, Walker 24/3/1",
        iono_utc=leap_seconds(moment),
    )
