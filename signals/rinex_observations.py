"""RINEX 3 observation files out: code, carrier phase, Doppler and C/N0 of GPS L1 C/A.

Format: IGS/RTCM, RINEX 3.05, sections 5 and 6, tables A2 and A3.  Carrier phases grow with range
(5.2.4.2, sign of the pseudorange), the opposite of ours; Doppler is positive when approaching
(5.2.4.3).  Epochs are readings of the receiver's clock, which no observation is corrected for.
"""

from __future__ import annotations

import math
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from signals.constants import WEEK_S

TYPES = ("C1C", "L1C", "D1C", "S1C")
_GPS_EPOCH = datetime(1980, 1, 6)
_WIDEST = 1e9
"""F14.3 holds less than ten digits and a sign before the point"""


def write_observations(
    path: str | Path,
    week: int,
    tow_ms: np.ndarray,
    prn: np.ndarray,
    pseudorange_m: np.ndarray,
    carrier_cycles: np.ndarray,
    doppler_hz: np.ndarray,
    cn0_dbhz: np.ndarray,
    restarted: np.ndarray,
    *,
    program: str,
    made: str,
    position_m: np.ndarray | None = None,
) -> int:
    """Write epochs (n,) of satellites (m,); returns the number of epochs written.

    Parameters
    ----------
    week, tow_ms : (n,) int64
        GPS week, and milliseconds of it that the receiver's clock reads.
    prn : (m,)
    pseudorange_m, carrier_cycles, doppler_hz, cn0_dbhz : (n, m)
        NaN where there is no observation; the carrier phase grows with positive Doppler.  Whole
        cycles are taken off each satellite so that it begins near the pseudorange.
    restarted : (n, m) bool
        The carrier phase does not go on from the epoch before: loss-of-lock indicator 1.
    program, made
        Who wrote it, and when (YYYYMMDD HHMMSS UTC).
    position_m : (3,), optional
        Approximate antenna position in ECEF.

    Raises
    ------
    ValueError
        Shapes that disagree, PRNs that RINEX has no name for, or no observation at all.
    """
    n, m = len(tow_ms), len(prn)
    tables = pseudorange_m, carrier_cycles, doppler_hz, cn0_dbhz, restarted
    if any(np.shape(x) != (n, m) for x in tables):
        raise ValueError(f"observations: shapes {[np.shape(x) for x in tables]}, expected {(n, m)}")
    if not ((np.asarray(prn) >= 1) & (np.asarray(prn) <= 99)).all():
        raise ValueError(f"prn is {prn}: expected 1 to 99")
    seen = np.isfinite(pseudorange_m)
    epochs = np.flatnonzero(seen.any(axis=1))
    if not len(epochs):
        raise ValueError("observations: none, expected at least one")
    phase = -carrier_cycles - _whole_cycles(pseudorange_m, carrier_cycles, seen)
    first, last = int(tow_ms[epochs[0]]), int(tow_ms[epochs[-1]])
    step_s = float(np.diff(tow_ms).min(initial=1000)) * 1e-3
    lines = _header(program, made, position_m, week, first, last, step_s)
    for k in epochs.tolist():
        present = np.flatnonzero(seen[k]).tolist()
        lines.append(f"> {_epoch(week, int(tow_ms[k]))}  0{len(present):3d}")
        for i in sorted(present, key=lambda i: int(prn[i])):
            values = pseudorange_m[k, i], phase[k, i], doppler_hz[k, i], cn0_dbhz[k, i]
            lost = "1" if restarted[k, i] and k > epochs[0] else " "
            strength = str(min(max(int(cn0_dbhz[k, i] // 6), 1), 9))  # table 12
            fields = [_field(v) for v in values]
            fields[1] += lost + strength
            line = f"G{int(prn[i]):02d}{fields[0]}  {fields[1]}{fields[2]}  {fields[3]}"
            lines.append(line.rstrip())
    Path(path).write_text("\n".join(lines) + "\n", encoding="ascii")
    return len(epochs)


def _whole_cycles(rho_m: np.ndarray, carrier: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Of each satellite, (m,): what brings -carrier next to the first pseudorange."""
    from signals.codes import GPS_L1CA
    from signals.constants import C_MPS

    out = np.zeros(rho_m.shape[1])
    for i in range(rho_m.shape[1]):
        if seen[:, i].any():
            k = int(seen[:, i].argmax())
            out[i] = -np.rint(carrier[k, i] + rho_m[k, i] * GPS_L1CA.carrier_hz / C_MPS)
    return out


def _field(value: float) -> str:
    """F14.3, blank where it is not known or does not fit."""
    fits = math.isfinite(value) and abs(value) < _WIDEST
    return f"{value:14.3f}" if fits else " " * 14


def _header(
    program: str,
    made: str,
    position_m: np.ndarray | None,
    week: int,
    first_ms: int,
    last_ms: int,
    step_s: float,
) -> list[str]:
    x, y, z = (0.0, 0.0, 0.0) if position_m is None else (float(v) for v in position_m)
    types = f"G  {len(TYPES):3d}" + "".join(f" {t}" for t in TYPES)
    body = [
        (f"{3.05:9.2f}{'':11}{'OBSERVATION DATA':20}{'G: GPS':20}", "RINEX VERSION / TYPE"),
        (f"{program[:20]:20}{'':20}{made + ' UTC':20}", "PGM / RUN BY / DATE"),
        ("UNKNOWN", "MARKER NAME"),
        ("GEODETIC" if position_m is None else "NON_GEODETIC", "MARKER TYPE"),
        ("", "OBSERVER / AGENCY"),
        (f"{'':20}{'software receiver':20}{program[:20]:20}", "REC # / TYPE / VERS"),
        (f"{'':20}{'UNKNOWN         NONE':20}", "ANT # / TYPE"),
        (f"{x:14.4f}{y:14.4f}{z:14.4f}", "APPROX POSITION XYZ"),
        (f"{0.0:14.4f}{0.0:14.4f}{0.0:14.4f}", "ANTENNA: DELTA H/E/N"),
        (types, "SYS / # / OBS TYPES"),
        ("DBHZ", "SIGNAL STRENGTH UNIT"),
        (f"{step_s:10.3f}", "INTERVAL"),
        (_moment(week, first_ms), "TIME OF FIRST OBS"),
        (_moment(week, last_ms), "TIME OF LAST OBS"),
        ("G L1C", "SYS / PHASE SHIFT"),
        ("", "END OF HEADER"),
    ]
    return [f"{text:60}{label}" for text, label in body]


def _date(week: int, tow_ms: int) -> tuple[datetime, float]:
    """Calendar minute of GPS time and seconds in it."""
    minutes, ms = divmod(week * round(WEEK_S * 1e3) + tow_ms, 60_000)
    return _GPS_EPOCH + timedelta(minutes=minutes), ms * 1e-3


def _epoch(week: int, tow_ms: int) -> str:
    at, seconds = _date(week, tow_ms)
    return f"{at:%Y %m %d %H %M}{seconds:11.7f}"


def _moment(week: int, tow_ms: int) -> str:
    at, seconds = _date(week, tow_ms)
    parts = f"{at.year:6d}{at.month:6d}{at.day:6d}{at.hour:6d}{at.minute:6d}"
    return f"{parts}{seconds:13.7f}     GPS"
