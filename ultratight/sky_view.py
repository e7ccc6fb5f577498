"""Where the satellites of a recording stood, seen from the positions that were found."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ultratight.sky import look
from ultratight.tracking.navigation import Navigation

POINTS = 60
"""Of a path across the sky, at most"""


class SkyPath(NamedTuple):
    """One satellite's way."""

    prn: int
    t_s: np.ndarray  # (n,) from sample 0 on
    elevation_deg: np.ndarray  # (n,)
    azimuth_deg: np.ndarray  # (n,) from north, clockwise


def sky_paths(of: Navigation) -> list[SkyPath]:
    """Of every satellite that was tracked and whose ephemeris came; empty without a position."""
    places = [(p, best.state[:3]) for p in of.positions if (best := p.estimate or p.fix)]
    if of.sky is None or not places:
        return []
    chosen = np.unique(np.linspace(0, len(places) - 1, min(POINTS, len(places))).astype(int))
    t_s = np.array([places[k][0].t_s for k in chosen])
    tow_s = np.array([places[k][0].gps_tow_s for k in chosen])
    antenna = np.array([places[k][1] for k in chosen])
    seen = sorted(set(of.tracks.prn.tolist()) & set(of.sky.prn.tolist()))
    paths = []
    for prn in seen:
        elevation, azimuth = look(of.sky, prn, of.week, tow_s, antenna)
        paths.append(SkyPath(prn, t_s, np.degrees(elevation), np.degrees(azimuth) % 360.0))
    return paths
