"""GPS time to UTC: whole leap seconds, table of the IERS (Bulletin C)."""

from __future__ import annotations

from datetime import datetime, timedelta

from signals.constants import WEEK_S

_EPOCH = datetime(1980, 1, 6)

LEAP_DAYS = (
    542, 907, 1272, 2003, 2917, 3648, 4013, 4560, 4925, 5290, 5839, 6386, 6935, 9492, 10_588,
    11_865, 12_960, 13_510,
)  # fmt: skip
"""Days after 1980-01-06 at whose start (UTC) GPS - UTC grew by one second, to 1, 2 ... 18 s

(IERS Bulletin C: 1981-07-01 to 2017-01-01)
"""


def gps_minus_utc_s(week: int, tow_s: float) -> int:
    """Leap seconds GPS - UTC at a GPS time; those announced later than 2017 are not known."""
    return sum(week * WEEK_S + tow_s >= start for start in _starts())


def utc_text(week: int, tow_s: float) -> str:
    """A GPS time (week without rollover) as UTC, RFC 3339 to the microsecond, with Z."""
    leap = gps_minus_utc_s(week, tow_s)
    at = timedelta(weeks=week, microseconds=round(tow_s * 1e6))
    inside = any(start - 1.0 <= week * WEEK_S + tow_s < start for start in _starts())
    # inside a leap second the day before has a 61st second in its last minute
    utc = _EPOCH + at - timedelta(seconds=leap + inside)
    text = utc.strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    return text.replace(":59.", ":60.") if inside else text


def _starts() -> list[float]:
    """GPS times [s since the epoch] at which the steps have been taken."""
    return [86_400.0 * day + k for k, day in enumerate(LEAP_DAYS, 1)]
