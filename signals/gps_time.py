"""GPS time to UTC: whole leap seconds, table of the IERS (Bulletin C)."""

from __future__ import annotations

from datetime import datetime, timedelta

from signals.constants import WEEK_S

_EPOCH = datetime(1980, 1, 6)
# UTC instants from which GPS - UTC is 1, 2, 3 ... s
_STEPS = (
    (1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7),
    (1993, 7), (1994, 7), (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7),
    (2015, 7), (2017, 1),
)  # fmt: skip


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
    return [
        (datetime(year, month, 1) - _EPOCH).total_seconds() + k
        for k, (year, month) in enumerate(_STEPS, 1)
    ]
