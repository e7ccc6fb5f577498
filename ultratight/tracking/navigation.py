"""From tracked channels to positions: message, observations, a fix and a filter per epoch.

Nothing is used before it could be known: a time of week from the end of the handover word that
settles it, a set of ephemerides from the end of the subframe that completes it.  What its
clock reads at sample 0, to the millisecond, and the ionosphere's coefficients, which come every
12.5 minutes, are found with hindsight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from signals import satellites as s
from signals.codes import GPS_L1CA
from signals.constants import C_MPS, WEEK_S
from signals.lnav_words import SUBFRAME_S
from signals.navigation_message import constellation_of
from signals.satellites import MAX_AGE_S, Constellation
from ultratight.tracking import position_filter
from ultratight.tracking.from_samples import Tracks
from ultratight.tracking.observables import (
    Observations,
    observe,
    start_guess_ms,
    sure_edges,
    telemetry,
)
from ultratight.tracking.position_filter import Estimate
from ultratight.tracking.single_point import FEWEST, Epoch, Fix, Models, solve
from ultratight.tracking.telemetry import Telemetry

NEAR_WEEK = 2400
"""The message has ten bits of the week: 1888 to 2911, spring of 2016 to autumn of 2035"""
INTERVAL_MS = 100
_WAVELENGTH_M = C_MPS / GPS_L1CA.carrier_hz
_START_EPOCHS = 100
"""So many are tried for the fix that sets the receiver's clock"""


class Position(NamedTuple):
    """An epoch with a solution; satellites are indices of channels."""

    t_s: float  # from sample 0 on
    tow_s: float  # receiver's clock
    channel: np.ndarray  # (n,) of the satellites that the fix and the filter were offered
    fix: Fix | None  # least squares
    estimate: Estimate | None  # the filter, after this epoch

    @property
    def gps_tow_s(self) -> float:
        """GPS time of week of the estimate, or of the fix."""
        state = self.estimate.state if self.estimate else self.fix.state if self.fix else None
        return self.tow_s - (0.0 if state is None else float(state[3]) / C_MPS)


class Navigation(NamedTuple):
    """What a recording says of the receiver's place."""

    tracks: Tracks
    telemetry: list[Telemetry]  # per channel
    sky: Constellation | None  # what was decoded
    week: int  # to which times of week belong; 0: unknown
    observations: Observations | None
    positions: list[Position]
    possible_s: float  # when four satellites' message had come, from sample 0 on; NaN: never
    why_not: str  # there is no position, "" if there is


def navigate(
    tracks: Tracks,
    *,
    atmosphere: bool = True,
    near_week: int = NEAR_WEEK,
    interval_ms: int = INTERVAL_MS,
    acceleration: float = position_filter.ACCELERATION,
) -> Navigation:
    """Decode, observe and position a recording's tracks.

    ``atmosphere``: correct pseudoranges by a standard troposphere, and by the message's ionosphere
    if it came.  ``near_week``: a GPS week within 511 of the true one.

    Raises
    ------
    ValueError
        An interval below 1 ms.
    """
    tracks = sure_edges(tracks)
    told = telemetry(tracks)
    start_ms = start_guess_ms(tracks, told)
    if start_ms is None:
        why = "no handover word came whole: 7.2 s of one satellite in phase lock are enough"
        return Navigation(tracks, told, None, 0, None, [], np.nan, why)
    try:
        received = {int(p): t.subframes for p, t in zip(tracks.prn, told, strict=True)}
        sky = constellation_of(received, near_week)
    except ValueError:
        seen = observe(tracks, told, start_ms, interval_ms)
        why = "no satellite's subframes 1 to 3 came whole: 18 to 30 s are needed"
        return Navigation(tracks, told, None, 0, seen, [], np.nan, why)
    week = _week(sky, start_ms * 1e-3)
    models = Models(atmosphere, sky.iono_utc)
    seen = observe(tracks, told, start_ms, interval_ms)
    first = _first_fix(seen, sky, week, models)
    if first is not None:
        # to the nearest millisecond, as receivers steer their clocks
        start_ms -= round(first.state[3] / C_MPS * 1e3)
        seen = observe(tracks, told, start_ms, interval_ms)
    enough = [len(_usable(seen, k, sky, week)[0]) >= FEWEST for k in range(len(seen.t_s))]
    possible = float(seen.t_s[int(np.argmax(enough))]) if any(enough) else np.nan
    positions = _positions(seen, sky, week, models, acceleration)
    why = ""
    if not positions:
        most = max((len(_usable(seen, k, sky, week)[0]) for k in range(len(seen.t_s))), default=0)
        why = f"{most} satellites with ephemeris and time of transmission, {FEWEST} are needed"
        if most >= FEWEST:
            why = "residuals or geometry allow none"
    return Navigation(tracks, told, sky, week, seen, positions, possible, why)


def _week(sky: Constellation, tow_s: float) -> int:
    """The week to which ``tow_s`` belongs."""
    return int(sky.week[0]) + round((float(sky.transmission_s[0]) - tow_s) / WEEK_S)


def _usable(
    seen: Observations, k: int, sky: Constellation, week: int
) -> tuple[np.ndarray, np.ndarray]:
    """Channels of epoch k with observation and ephemeris, and the sets' indices."""
    channels, sets = [], []
    for i in np.flatnonzero(np.isfinite(seen.pseudorange_m[k])).tolist():
        sent = seen.sent_s[k, i]
        shift = WEEK_S * (sky.week - week)
        age = np.abs(sky.elements[:, s.TOE] + shift - sent)
        come = sky.transmission_s + shift + SUBFRAME_S <= sent
        mine = (sky.prn == seen.prn[i]) & (sky.health == 0) & come & (age <= MAX_AGE_S)
        if mine.any():
            channels.append(i)
            sets.append(int(np.argmin(np.where(mine, age, np.inf))))
    return np.array(channels, np.int64), np.array(sets, np.int64)


def epoch_of(seen: Observations, k: int, sky: Constellation, week: int) -> tuple[np.ndarray, Epoch]:
    """Channels with an observation and an ephemeris at epoch k, and what they observe."""
    channels, sets = _usable(seen, k, sky, week)
    return channels, Epoch(
        float(seen.tow_ms[k]) * 1e-3,
        sky.rows(sets, week),
        seen.pseudorange_m[k, channels],
        -_WAVELENGTH_M * seen.doppler_hz[k, channels],
        seen.cn0_dbhz[k, channels],
        sky.status[sets, s.URA],
    )


def _first_fix(seen: Observations, sky: Constellation, week: int, models: Models) -> Fix | None:
    tried = 0
    for k in range(len(seen.t_s)):
        channels, epoch = epoch_of(seen, k, sky, week)
        if len(channels) < FEWEST:
            continue
        fix = solve(epoch, models)
        tried += 1
        if (fix is not None and fix.consistent) or tried == _START_EPOCHS:
            return fix
    return None


def _positions(
    seen: Observations, sky: Constellation, week: int, models: Models, acceleration: float
) -> list[Position]:
    """Epochs with a consistent fix, or a filter that was begun with one."""
    found: list[Position] = []
    near, estimate, last_s = None, None, 0.0
    for k in range(len(seen.t_s)):
        channels, epoch = epoch_of(seen, k, sky, week)
        if not len(channels):
            continue
        fix = solve(epoch, models, near) if len(channels) >= FEWEST else None
        if fix is not None and not fix.consistent:
            fix = None
        t_s = float(seen.t_s[k])
        if estimate is not None:
            estimate = position_filter.advance(estimate, t_s - last_s, epoch, models, acceleration)
            if estimate.lost:
                estimate = None
        if estimate is None and fix is not None:
            estimate = position_filter.begin(fix)
        last_s = t_s
        near = fix.state if fix is not None else near
        if fix is not None or estimate is not None:
            found.append(Position(t_s, epoch.tow_s, channels, fix, estimate))
    return found
