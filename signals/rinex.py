"""RINEX 2 and 3 navigation files in: GPS broadcast ephemerides as a `Constellation`.

Formats: W. Gurtner, RINEX 2.11, table A4; IGS/RTCM, RINEX 3.05, table A5 (section 6.5).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from signals import satellites
from signals.constants import WEEK_S
from signals.satellites import Constellation, IonoUtc

_GPS_EPOCH = datetime(1980, 1, 6)
_N_LINE = 8  # of a GPS record, in both versions

# (line, field) of each column of `satellites`, lines and fields from 0; TOC is the record's epoch
_PLACES = {
    satellites.AF0: (0, 0),
    satellites.AF1: (0, 1),
    satellites.AF2: (0, 2),
    satellites.CRS: (1, 1),
    satellites.DELTA_N: (1, 2),
    satellites.M0: (1, 3),
    satellites.CUC: (2, 0),
    satellites.ECC: (2, 1),
    satellites.CUS: (2, 2),
    satellites.SQRT_A: (2, 3),
    satellites.TOE: (3, 0),
    satellites.CIC: (3, 1),
    satellites.OMEGA0: (3, 2),
    satellites.CIS: (3, 3),
    satellites.I0: (4, 0),
    satellites.CRC: (4, 1),
    satellites.OMEGA: (4, 2),
    satellites.OMEGA_DOT: (4, 3),
    satellites.IDOT: (5, 0),
    satellites.TGD: (6, 2),
}
_IODE, _WEEK, _HEALTH, _SENT = (1, 0), (5, 2), (6, 1), (7, 0)
_CODE_ON_L2, _L2P, _ACCURACY, _IODC, _FIT = (5, 1), (5, 3), (6, 0), (6, 3), (7, 1)
# upper ends of user range accuracy indices 0 to 14 [m] (IS-GPS-200 20.3.3.3.1.3)
_URA_M = (2.4, 3.4, 4.85, 6.85, 9.65, 13.65, 24.0, 48.0, 96.0, 192.0, 384.0, 768.0, 1536.0, 3072.0,
          6144.0)  # fmt: skip
# Header records that become an `IonoUtc`: (label, start of the line) -> columns of its numbers
_IONO_UTC = {
    ("ION ALPHA", ""): [(2 + 12 * k, 12) for k in range(4)],
    ("ION BETA", ""): [(2 + 12 * k, 12) for k in range(4)],
    ("DELTA-UTC: A0,A1,T,W", ""): [(3, 19), (22, 19), (41, 9), (50, 9)],
    ("IONOSPHERIC CORR", "GPSA"): [(5 + 12 * k, 12) for k in range(4)],
    ("IONOSPHERIC CORR", "GPSB"): [(5 + 12 * k, 12) for k in range(4)],
    ("TIME SYSTEM CORR", "GPUT"): [(5, 17), (22, 16), (38, 7), (45, 5)],
    ("LEAP SECONDS", ""): [(6 * k, 6) for k in range(4)],
}
# what the message can hold (IS-GPS-200 tables 20-I and 20-III): (column, name, lowest, highest)
_RANGES = (
    (satellites.SQRT_A, "sqrt(A)", 2530.0, 8192.0),
    (satellites.ECC, "eccentricity", 0.0, 0.5),
    (satellites.TOE, "toe", 0.0, WEEK_S),
)


class _Set(NamedTuple):
    prn: int
    week: int
    health: int
    iode: int
    transmission_s: float
    elements: np.ndarray
    status: list[int]


class _Reader:
    """Lines of one file, with complaints that name the place."""

    def __init__(self, path: Path) -> None:
        self.name = path.name
        self.lines = path.read_text(encoding="ascii", errors="replace").splitlines()

    def refuse(self, line: int, text: str) -> NoReturn:
        raise ValueError(f"{self.name}, line {line + 1}: {text}")

    def header(self) -> tuple[int, int]:
        """Major version and index of the first line after the header."""
        if not any(line.strip() for line in self.lines):
            raise ValueError(f"{self.name}: the file is empty, expected a RINEX navigation file")
        first = self.lines[0]
        if first[60:].strip() != "RINEX VERSION / TYPE":
            self.refuse(0, f"{first[:40]!r}: expected a RINEX header (RINEX VERSION / TYPE)")
        version = first[:9].strip()
        if version.partition(".")[0] not in ("2", "3"):
            self.refuse(0, f"RINEX version {version!r}: expected 2 or 3")
        if first[20:21] != "N":
            self.refuse(
                0, f"file type {first[20:40].strip()!r}: expected N, a (GPS) navigation file"
            )
        ends = [k for k, line in enumerate(self.lines) if line[60:].strip() == "END OF HEADER"]
        if not ends:
            last = len(self.lines) - 1
            self.refuse(last, "the file ends in its header, expected END OF HEADER")
        return int(version[0]), ends[0] + 1

    def iono_utc(self) -> IonoUtc:
        """Ionosphere and UTC parameters of the header, zeros where it has none."""
        found: dict[str, list[float]] = {}
        for k in range(1, self.header()[1]):
            label = self.lines[k][60:].strip()
            for (wanted, start), columns in _IONO_UTC.items():
                if label == wanted and self.lines[k].startswith(start):
                    found[start or label] = [self.number(k, at, False, n) for at, n in columns]
        alpha = found.get("GPSA", found.get("ION ALPHA", [0.0] * 4))
        beta = found.get("GPSB", found.get("ION BETA", [0.0] * 4))
        a0, a1, tot, week = found.get("GPUT", found.get("DELTA-UTC: A0,A1,T,W", [0.0] * 4))
        leap, future, week_lsf, day = (int(x) for x in found.get("LEAP SECONDS", [0.0] * 4))
        return IonoUtc(
            alpha=(alpha[0], alpha[1], alpha[2], alpha[3]),
            beta=(beta[0], beta[1], beta[2], beta[3]),
            a0=a0,
            a1=a1,
            tot_s=tot,
            week_t=int(week),
            leap_s=leap,
            week_lsf=week_lsf,
            day=day,
            leap_future_s=future or leap,
        )

    def records(self) -> Iterator[_Set]:
        """GPS records; in a mixed version 3 file the other systems are skipped."""
        version, k = self.header()
        while k < len(self.lines):
            line = self.lines[k]
            if not line.strip() or (version == 3 and line[0] != "G"):
                if version == 3 and line[:1] not in tuple("RESCJI \t") and line.strip():
                    self.refuse(k, f"{line[:23]!r}: expected the first line of a record")
                k += 1
                continue
            yield self.record(version, k)
            k += _N_LINE

    def record(self, version: int, first: int) -> _Set:
        indent, start = (3, 22) if version == 2 else (4, 23)
        block = self.lines[first : first + _N_LINE]
        if len(block) < _N_LINE:
            last = len(self.lines) - 1
            self.refuse(last, f"the file ends in a record, expected {_N_LINE} lines of it")
        prn, epoch = self.epoch(version, first)
        for k, line in enumerate(block[1:], first + 1):
            if line[:indent].strip():
                self.refuse(k, f"{line[:23]!r}: expected line {k - first + 1} of a GPS record")

        def field(place: tuple[int, int], needed: bool = True) -> float:
            line, column = place
            at = 19 * column + (start if line == 0 else indent)
            return self.number(first + line, at, needed)

        elements = np.empty(satellites.N_ELEMENT)
        for column, place in _PLACES.items():
            elements[column] = field(place)
        for column, name, low, high in _RANGES:
            if not low <= elements[column] <= high:
                self.refuse(
                    first + _PLACES[column][0],
                    f"{name} = {elements[column]:g}: expected {low:g} to {high:g}",
                )
        toe = elements[satellites.TOE]
        # toe lies within half a week of toc, whose full date is given: the week field, which some
        # writers leave modulo 1024, is checked and not needed
        week = math.floor((epoch - toe) / WEEK_S + 0.5)
        elements[satellites.TOC] = epoch - week * WEEK_S
        stated = field(_WEEK, needed=False)
        if stated and (stated - week + 1) % 1024 not in (0, 1, 2):
            self.refuse(first + 5, f"week {stated:g} does not belong to the epoch (week {week})")
        sent = field(_SENT, needed=False)
        if not -WEEK_S <= sent <= 2 * WEEK_S:  # 0.9999E+09: unknown
            sent = toe - satellites.MAX_AGE_S
        iode = int(field(_IODE))
        status = [0] * satellites.N_STATUS
        status[satellites.IODC] = int(field(_IODC, needed=False)) or iode
        status[satellites.URA] = bisect_left(_URA_M, field(_ACCURACY, needed=False))
        status[satellites.CODE_ON_L2] = int(field(_CODE_ON_L2, needed=False))
        status[satellites.L2P_OFF] = int(field(_L2P, needed=False))
        status[satellites.FIT_INTERVAL] = int(field(_FIT, needed=False) > 4.0)
        return _Set(prn, week, int(field(_HEALTH)), iode, sent, elements, status)

    def epoch(self, version: int, first: int) -> tuple[int, float]:
        """PRN and toc in seconds since the GPS epoch."""
        line = self.lines[first]
        head = line[:22] if version == 2 else line[1:23]
        try:
            prn, year, month, day, hour, minute = (int(text) for text in head.split()[:6])
            second = float(head.split()[6])
            if version == 2:
                year += 1900 if year >= 80 else 2000
            days = (datetime(year, month, day) - _GPS_EPOCH).days
            if not (1 <= prn <= 63 and 0 <= hour < 24 and 0 <= minute < 60 and 0 <= second <= 60):
                raise ValueError
        except (ValueError, IndexError):
            self.refuse(first, f"{line[:23]!r}: expected PRN, year month day hour minute second")
        return prn, 86_400.0 * days + 3600.0 * hour + 60.0 * minute + second

    def number(self, line: int, at: int, needed: bool, width: int = 19) -> float:
        text = self.lines[line][at : at + width].strip()
        if not text and not needed:
            return 0.0
        try:
            value = float(text.replace("D", "E").replace("d", "e"))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            self.refuse(line, f"{text!r} in columns {at + 1}-{at + width}: expected a number")
        return value


def read_navigation(path: str | Path) -> Constellation:
    """Read the GPS ephemerides of a RINEX 2 or 3 navigation file (mixed files too).

    Raises
    ------
    FileNotFoundError
        There is no such file.
    ValueError
        Not a navigation file, another version, a damaged record, or no GPS record at all; the
        message names file, line and what was expected.
    """
    reader = _Reader(Path(path))
    sets = list(reader.records())
    if not sets:
        raise ValueError(f"{reader.name}: no GPS ephemeris in the file, expected at least one")
    return Constellation(
        prn=np.array([s.prn for s in sets], dtype=np.int64),
        week=np.array([s.week for s in sets], dtype=np.int64),
        elements=np.array([s.elements for s in sets]),
        health=np.array([s.health for s in sets], dtype=np.int64),
        iode=np.array([s.iode for s in sets], dtype=np.int64),
        transmission_s=np.array([s.transmission_s for s in sets]),
        source=reader.name,
        status=np.array([s.status for s in sets], dtype=np.int64),
        iono_utc=reader.iono_utc(),
    )
