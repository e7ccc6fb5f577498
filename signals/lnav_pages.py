"""Pages of LNAV subframes 4 and 5: almanacs, health, ionosphere and UTC (IS-GPS-200 20.3.3.5).

The 25 pages go out in 12.5 minutes and begin anew with the week (20.3.2).
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from signals import satellites as s
from signals.constants import GM_GPS, WEEK_S
from signals.lnav_fields import ALMANAC, IONOSPHERE_UTC, PAGE_ID, from_elements, pack
from signals.lnav_words import put
from signals.satellites import Constellation, IonoUtc

N_PAGE = 25
DATA_ID = 1
"""Data structure of 20.3.3.5.1.1"""
N_ALMANAC = 32
DUMMY = 0
IONOSPHERE_UTC_PAGE = 56
CORRECTION_TABLE_PAGE = 52
HEALTH_4_PAGE = 63
HEALTH_5_PAGE = 51
# Table 20-V: SV (page) IDs of pages 1 to 25; 1 to 32 are almanacs
SUBFRAME_4_IDS = (
    57, 25, 26, 27, 28, 57, 29, 30, 31, 32, 57, 62, 52, 53, 54, 57, 55, 56, 58, 59, 57, 60, 61,
    62, 63,
)  # fmt: skip
SUBFRAME_5_IDS = (*range(1, 25), 51)

_TOA_STEP_S = 4096.0
_ABSENT = 0b111111  # 20.3.3.5.1.3: no satellite, or one that must not be used
# Anti-spoofing on and the first of the defined configurations (20.3.3.5.1.4); ephemerides do not
# tell a satellite's block
_CONFIGURATION = 0b1001


class Pages:
    """Subframes 4 and 5 of a constellation, the same for all satellites and all the time.

    The almanac's reference time is the multiple of 4096 s nearest to the middle of all toe; a
    satellite's almanac comes from its set next to it.  What an almanac cannot say is folded in:
    its semi-major axis carries the mean motion, node and inclination are moved by their rates.
    """

    def __init__(self, constellation: Constellation) -> None:
        self._sky = constellation
        moments = constellation.week * WEEK_S + constellation.elements[:, s.TOE]
        middle = float(np.median(moments))
        self.week = int(middle // WEEK_S)
        last = math.floor((WEEK_S - 1.0) / _TOA_STEP_S)
        self.toa_s = _TOA_STEP_S * min(round(middle % WEEK_S / _TOA_STEP_S), last)

    def page_id(self, number: int, tow_s: float) -> int:
        """SV (page) ID that subframe ``number`` (4 or 5) has in the frame that begins at tow_s."""
        page = round(tow_s / 30.0) % N_PAGE
        return (SUBFRAME_4_IDS if number == 4 else SUBFRAME_5_IDS)[page]

    def data(self, page_id: int) -> int:
        """Words 3 to 10 of a page."""
        if page_id <= N_ALMANAC:
            integers = self.almanacs.get(page_id)
            if integers is not None:
                return pack(ALMANAC, {**integers, "data_id": DATA_ID, "page_id": page_id})
            page_id = DUMMY  # table 20-V, note 2
        if page_id == IONOSPHERE_UTC_PAGE:
            return _ionosphere_utc(self._sky.iono_utc)
        data = pack(PAGE_ID, {"data_id": DATA_ID, "page_id": page_id})
        if page_id == CORRECTION_TABLE_PAGE:
            return put(data, 3, 9, 2, 0b10)  # 20.3.3.5.1.9: no table available
        if page_id == HEALTH_4_PAGE:
            return self._configurations(data)
        if page_id == HEALTH_5_PAGE:
            data = put(data, 3, 9, 8, round(self.toa_s / _TOA_STEP_S))
            data = put(data, 3, 17, 8, self.week)
            for prn in range(1, 25):
                data = put(data, 4 + (prn - 1) // 4, 1 + 6 * ((prn - 1) % 4), 6, self._health(prn))
        return data

    @cached_property
    def almanacs(self) -> dict[int, dict[str, int]]:
        """Numbers of the almanac pages by PRN."""
        sky = self._sky
        distance = np.abs((sky.week - self.week) * WEEK_S + sky.elements[:, s.TOE] - self.toa_s)
        found = {}
        for prn in range(1, N_ALMANAC + 1):
            sets = np.flatnonzero(sky.prn == prn)
            if len(sets):
                index = sets[distance[sets].argmin()]
                row = self._row(sky.rows(np.array([index]), self.week)[0])
                health = int(sky.health[index])
                # the signal's five bits, and all or nothing for the data's three (20.3.3.5.1.3)
                extra = {"health8": (0b111 << 5 if health & 0b100000 else 0) | health & 0b11111}
                found[prn] = from_elements(ALMANAC, row) | extra
        return found

    def _row(self, row: np.ndarray) -> np.ndarray:
        """Elements of an almanac at toa from those of a set, harmonics left out."""
        later = self.toa_s - row[s.TOE]
        n = math.sqrt(GM_GPS) / row[s.SQRT_A] ** 3 + row[s.DELTA_N]
        out = row.copy()
        out[s.SQRT_A] = (GM_GPS / n**2) ** (1.0 / 6.0)
        out[s.M0] += n * later
        # OMEGA0 is the node's longitude when the week began, for either reference time
        out[s.OMEGA0] += row[s.OMEGA_DOT] * later
        out[s.I0] += row[s.IDOT] * later
        out[s.AF0] += row[s.AF1] * (self.toa_s - row[s.TOC])
        out[s.TOE] = self.toa_s
        return out

    def _health(self, prn: int) -> int:
        if prn not in self.almanacs:
            return _ABSENT
        health8 = self.almanacs[prn]["health8"]
        return (0b100000 if health8 else 0) | health8 & 0b11111

    def _configurations(self, data: int) -> int:
        """Page 25 of subframe 4: configurations of 32 satellites, health of PRN 25-32."""
        place = 8  # bits of word 3 that are taken
        for prn in range(1, N_ALMANAC + 1):
            word, bit = 3 + place // 24, 1 + place % 24
            data = put(data, word, bit, 4, _CONFIGURATION if prn in self.almanacs else 0)
            place += 4
        place += 2  # reserved
        for prn in range(25, N_ALMANAC + 1):
            data = put(data, 3 + place // 24, 1 + place % 24, 6, self._health(prn))
            place += 6
        return data


def _ionosphere_utc(p: IonoUtc) -> int:
    values = {f"alpha{k}": p.alpha[k] for k in range(4)} | {f"beta{k}": p.beta[k] for k in range(4)}
    values |= {"a0": p.a0, "a1": p.a1, "tot_s": p.tot_s}
    values |= {"leap_s": p.leap_s, "leap_future_s": p.leap_future_s, "day": p.day}
    values |= {"wn_t": p.week_t % 256, "wn_lsf": p.week_lsf % 256}
    values |= {"data_id": DATA_ID, "page_id": IONOSPHERE_UTC_PAGE}
    return pack(IONOSPHERE_UTC, {f.name: f.integer(values[f.name]) for f in IONOSPHERE_UTC})
