"""JPL's high-dynamic trajectory as a scenario, and who loses the carrier on it.

Vilnrotter, Hinedi & Kumar (IEEE TAES 25(4), 1989) let all their loops track one trajectory along
the line of sight: -25 g for 3 s, a jerk of 100 g/s for 0.5 s, +25 g for 2 s, -100 g/s for 0.5 s,
-25 g to 8 s.  Here a vehicle flies it on the sky of the presets, in the one direction that four of
the ten satellites nearly share, two ahead and two behind: it shows them 0.85 to 0.91 of its
acceleration, so that with 1 / 0.87 of JPL's each of the four sees 0.98 to 1.05 of it.  These four
are judged.  Some seconds of uniform motion and a ramp of -10 g/s to -25 g come before.

To hold is not to find: receivers pull in at 40 dB-Hz, and the C/N0 falls to that of the run 2 s
before the motion begins.

A channel is lost when its NCO has been more than 25 Hz off the true carrier for 0.2 s (the
comparison's half of the sampling rate, 20 ms; noise on the command for less is no loss), or when
the receiver has given it up by its own lock indicators.  The second matters where an INS steers: it
keeps the NCO within 25 Hz without any signal, whatever became of the loop.

The oscillator does not feel the acceleration: 1 ppb/g would move the carrier by 39 Hz.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from common.campaign import Campaign
from common.motions import G, Profile
from ultratight.statistics import wilson

Change = dict[str, Any]

LINE = (2, 4, 9, 12)
"""Satellites that see the acceleration"""
SHARE = 0.87
RAMP_S = 2.5
SHAPE = ((0.0, -25.0), (3.0, -25.0), (3.5, 25.0), (5.5, 25.0), (6.0, -25.0), (8.0, -25.0))
"""Time [s] and acceleration along the line of sight [g], lines between"""
AFTER_S = 0.3
"""The end lasts so much longer, that a loss at the very end is seen"""
PULL_IN_DBHZ, FALL_S, SETTLED_S = 40.0, 0.5, 2.0
"""C/N0 at the start; how long it takes to fall; how long before the motion it has fallen"""
LEAD_S = 6.0
GRADES: dict[str, Change] = {
    "navigation": {"imu.grade": "navigation"},
    "tactical": {"imu.grade": "tactical"},
    "MEMS": {"imu.grade": "industrial-mems", "imu.accel_scale_factor_ppm": [3000.0, 0.0, 0.0]},
}
"""The grade of the MEMS leaves its scale factor open: that of the jump presets, + or - by seed"""


def profile(lead_s: float) -> Profile:
    """Segments of the vehicle's own acceleration after ``lead_s`` of uniform motion."""
    points = [(lead_s, 0.0)] + [(lead_s + RAMP_S + t, a * G / SHARE) for t, a in SHAPE]
    points.append((points[-1][0] + AFTER_S, points[-1][1]))
    return [
        {"t0_s": round(t0, 6), "t1_s": round(t1, 6), "accel0_mps2": a0, "accel1_mps2": a1}
        for (t0, a0), (t1, a1) in zip(points[:-1], points[1:], strict=True)
    ]


def world(lead_s: float = LEAD_S) -> Change:
    """What is laid over the preset ``uniform``; sensors are as their grade has them."""
    legs = profile(lead_s)
    end_s = legs[-1]["t1_s"]
    return {
        "plane": "vertical",
        "heading_deg": 288.0,
        "climb_deg": 6.0,
        "speed_mps": 600.0,
        "profile": legs,
        "duration_s": end_s,
        "jump_window_s": [lead_s + RAMP_S, end_s],
        "imu.accel_scale_factor_ppm": None,
        "imu.lag_s": None,
        "receiver.fall_back": True,
    }


ALONE: Change = {"prns": list(LINE)}
"""Enough for closures whose channels do not help each other"""


def level(cn0_dbhz: float) -> Change:
    """The run's C/N0, to which that of the pull-in falls; a higher one is there from the start."""
    down = max(PULL_IN_DBHZ - cn0_dbhz, 0.0)
    fallen_s = LEAD_S - SETTLED_S
    return {
        "cn0_dbhz": cn0_dbhz,
        "channel.cn0_profile_s_db": [[fallen_s - FALL_S, down], [fallen_s, 0.0]],
    }


def thinned(campaign: Campaign, **steps: int) -> Campaign:
    """Every so manieth label of the axes named: what a quick look leaves out."""
    over = dict(campaign.over)
    for name, step in steps.items():
        over[name] = dict(list(over[name].items())[::step])
    return replace(campaign, over=over)


def lost(ds: xr.Dataset) -> xr.DataArray:
    """Share of the four channels that are lost, per run; all of them where a run failed."""
    return _share(ds, ds["off_carrier_s"].notnull() | ds["lost_lock_s"].notnull())


def astray(ds: xr.Dataset) -> xr.DataArray:
    """Share of those whose NCO was off the carrier, whatever the receiver thought of it."""
    return _share(ds, ds["off_carrier_s"].notnull())


def _share(ds: xr.Dataset, gone: xr.DataArray) -> xr.DataArray:
    share = gone.sel(channel=[f"G{p:02d}:L1CA" for p in LINE]).mean("channel")
    return share.where(ds["failure"] == "", 1.0)


def band(share: np.ndarray, trials_per_run: int) -> np.ndarray:
    """Mean over the runs (n_level, n_run) with Wilson's interval: (3, n_level).

    Channels with loops of their own are trials each; where they share a solution a run is one.
    """
    n = share.shape[1] * trials_per_run
    return np.array([wilson(round(float(x) * n), n)[:3] for x in share.mean(axis=1)]).T
