"""Leap seconds against the table of the reference data and against known instants."""

from __future__ import annotations

import csv
from datetime import datetime
from pathlib import Path

import pytest

from signals.gps_time import gps_minus_utc_s, utc_text

pytestmark = pytest.mark.nojit
TABLE = Path(__file__).parents[3] / "shared" / "data" / "orbit" / "leap_seconds.csv"


@pytest.mark.parametrize(
    ("week", "tow_s", "expected"),
    [
        (0, 0.0, "1980-01-06T00:00:00.000000Z"),  # the epoch, IS-GPS-200 3.3.4
        (2149, 475_220.0, "2021-03-19T12:00:02.000000Z"),  # 18 s since 2017
        (1024, 0.0, "1999-08-21T23:59:47.000000Z"),  # the first rollover: 13 s
        # the second that the IERS inserted at the end of 2016 (Bulletin C 52)
        (1930, 16.0, "2016-12-31T23:59:59.000000Z"),
        (1930, 17.25, "2016-12-31T23:59:60.250000Z"),
        (1930, 18.0, "2017-01-01T00:00:00.000000Z"),
        (2149, 475_220.000_25, "2021-03-19T12:00:02.000250Z"),
    ],
)
def test_known_instants(week: int, tow_s: float, expected: str) -> None:
    assert utc_text(week, tow_s) == expected


@pytest.mark.skipif(
    not TABLE.exists(), reason="needs the reference data folder beside the repository"
)
def test_leap_seconds_are_those_of_the_table() -> None:
    rows = [r for r in csv.DictReader(TABLE.open()) if r["gps_minus_utc_s"]]
    assert len(rows) == 19
    for row in rows:
        day = (datetime.fromisoformat(row["utc_effective_date"]) - datetime(1980, 1, 6)).days
        leap = int(row["gps_minus_utc_s"])
        at = 86_400.0 * day + leap
        if day < 0:
            at = 0.0
        assert gps_minus_utc_s(0, at) == leap
        if leap:
            assert gps_minus_utc_s(0, at - 0.5) == leap - 1
