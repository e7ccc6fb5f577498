"""What is read off the flights of `closures`: who is lost, who is back when, errors, predictions.

Lost is judged by the truth, the same for every closure: a replica that has been more than 25 Hz off
the true carrier or half a chip off the code for 0.2 s (`off_signal_s`).  What the receivers' own
indicators say stands beside it.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import xarray as xr

import ultratight
from common.campaign import Study
from common.closure_cells import (
    BEFORE_S,
    BLOCKED,
    CLOSURES,
    FIVE,
    LEVELS,
    MOTIONS,
    WORLD,
)
from common.ledger import Must, Quantity
from common.statistics import interval
from common.thresholds import crossing, gap
from ultratight.prediction import predict
from ultratight.scenario import Unsupported

WITHIN_DB = 1.5
COMMON = 4
"""Unknowns that channels share: three of velocity and the clock's drift"""
USEFUL = 0.5
"""An ultra-tight closure still uses its signals while its velocity error is below so much of what
the INS alone, which flies on, has"""

FAR = 100.0


Cell = tuple[str, str]
"""Motion, closure"""


class Found(NamedTuple):
    """All that the claims look at."""

    lost: dict[Cell, xr.DataArray]
    """By the truth, of the channels that are never blocked (cn0_dbhz, run)"""
    own: dict[Cell, xr.DataArray]
    """By the closures' own indicators"""
    either: dict[Cell, xr.DataArray]
    back: dict[Cell, xr.DataArray]
    """Of the blocked ones, those on their signal at the end"""
    velocity: dict[Cell, xr.DataArray]
    """R.m.s. error after `SETTLED_S` [m/s]"""
    errors: dict[str, xr.Dataset]
    outages: dict[str, xr.DataArray]
    """Seconds from the end of an outage (outage, cn0_dbhz, run, channel)"""
    alone: np.ndarray
    """Velocity error of the INS alone (run,) [m/s]"""
    samples: xr.Dataset
    predicted: dict[Cell, float]


def numbered(ds: xr.Dataset) -> xr.Dataset:
    """C/N0 as numbers."""
    return ds.assign_coords(cn0_dbhz=[float(x) for x in ds["cn0_dbhz"].values])


def heard(ds: xr.Dataset, motion: str) -> tuple[list[str], list[str]]:
    """Channels that are heard all the time, and those that are not."""
    hidden = BLOCKED[int(motion.split()[0])] if motion.endswith("blocked") else ()
    gone = [f"G{p:02d}:L1CA" for p in hidden]
    return [c for c in ds["channel"].values if c not in gone], gone


def lost(ds: xr.Dataset, names: tuple[str, ...], channels: list[str]) -> xr.DataArray:
    """Share of the channels with a loss of one of these kinds, per run; all where a run failed."""
    gone = [ds[name].sel(channel=channels).notnull() for name in names]
    share = np.logical_or.reduce(gone).mean(axis=gone[0].get_axis_num("channel"))
    dims = [d for d in gone[0].dims if d != "channel"]
    made = xr.DataArray(share, {d: gone[0][d] for d in dims}, dims)
    return made.where(ds["failure"] == "", 1.0)


def back_s(on_signal_s: xr.DataArray, end_s: xr.DataArray | float) -> xr.DataArray:
    """From the end of an outage until a replica is on its signal for good; inf: not in the run.

    Zero where it never left it.
    """
    return np.maximum(on_signal_s - end_s, 0.0).fillna(np.inf)


def returns(ds: xr.Dataset) -> xr.DataArray:
    """`back_s` of each outage, which begins at `BEFORE_S`."""
    end_s = xr.DataArray(
        [BEFORE_S + float(x) for x in ds["outage"].values], {"outage": ds["outage"]}, ("outage",)
    )
    return back_s(ds["on_signal_s"], end_s)


def collect(study: Study) -> Found:
    """Fly everything."""
    of = Found({}, {}, {}, {}, {}, {}, {}, np.zeros(0), xr.Dataset(), {})
    alone, samples = of.alone, of.samples
    for name in study.campaigns:
        kind, _, closure = name.partition("; ")
        ds = study.fly(name)
        ds = ds if closure == "" else numbered(ds.isel(receiver=0, drop=True))
        if kind in MOTIONS:
            _thresholds(of, (kind, closure), ds)
        elif kind == "errors":
            channels = [str(c) for c in ds["channel"].values]
            of.errors[closure] = ds.assign(loss=lost(ds, ("off_signal_s",), channels))
        elif kind == "outage":
            of.outages[closure] = returns(ds)
        elif kind == "samples":
            samples = ds
        else:
            alone = ds["jump"].values.ravel()
    for cell in of.either:
        if "blocked" not in cell[0]:
            with suppress(Unsupported):  # a closure without a closed form
                of.predicted[cell] = predicted(*cell)
    return of._replace(alone=alone, samples=samples)


def _thresholds(of: Found, cell: Cell, ds: xr.Dataset) -> None:
    seen, hidden = heard(ds, cell[0])
    if cell[0] == "uniform" and cell[1].startswith("scalar"):
        five = [f"G{p:02d}:L1CA" for p in FIVE]
        of.lost["5 satellites", cell[1]] = lost(ds, ("off_signal_s",), five)
    of.lost[cell] = lost(ds, ("off_signal_s",), seen)
    of.own[cell] = lost(ds, ("lost_lock_s",), seen)
    of.either[cell] = lost(ds, ("off_signal_s", "lost_lock_s"), seen)
    of.velocity[cell] = ds["jump"]
    if hidden:
        of.back[cell] = 1.0 - ds["on_signal_s"].sel(channel=hidden).isnull().mean("channel")


def predicted(motion: str, closure: str) -> float:
    """Threshold of `ultratight predict`, median over the satellites; inf: none holds."""
    change = WORLD | CLOSURES[closure] | MOTIONS[motion]
    # the C/N0 about which it looks, and from which what depends on C/N0 is known
    level = LEVELS[motion][closure][-1]
    found = predict(ultratight.load("uniform", change | {"cn0_dbhz": level}))
    return float(np.median([c.threshold_dbhz for c in found.channels]))


def useful(name: str, velocity: xr.DataArray, alone: np.ndarray, must: Must | None = None
           ) -> Quantity:  # fmt: skip
    """C/N0 down to which the median of error / that of the INS alone is below `USEFUL`."""
    levels = velocity["cn0_dbhz"].values
    ratio = velocity.transpose("run", "cn0_dbhz").values / alone[: velocity.sizes["run"], None]
    return interval(
        f"{name} useful to", np.minimum(np.nan_to_num(ratio, nan=FAR), FAR),
        lambda drawn: crossing(levels, np.median(drawn, axis=-2), USEFUL), "dB-Hz", must,
    )  # fmt: skip


def spread(times: xr.DataArray) -> tuple[float, float, float]:
    """Median and worst of the times to be back [s], and the share that never is."""
    values = times.values.ravel()
    return (
        float(np.quantile(values, 0.5, method="inverted_cdf")),
        float(values.max()),
        float(np.mean(np.isinf(values))),
    )


def middle(name: str, times: xr.DataArray, must: Must | None = None) -> Quantity:
    """Median time to be back over channels, the bootstrap draws runs; no number: never."""
    values = times.transpose("run", ...).values.reshape(times.sizes["run"], -1)
    return interval(
        name, values,
        lambda drawn: np.quantile(drawn.reshape(*drawn.shape[:-2], -1), 0.5, axis=-1,
                                  method="inverted_cdf"),
        "s", must,
    )  # fmt: skip


def pair(
    cells: Mapping[Cell, xr.DataArray], a: Cell, b: Cell, name: str, must: Must | None = None
) -> Quantity:
    """Difference of the thresholds of two cells."""
    q = gap({"a": cells[a], "b": cells[b]}, "a", "b", must)
    return replace(q, name=name)


def averaged(satellites: int) -> float:
    """What averaging equal channels over `COMMON` unknowns wins [dB]."""
    return float(10.0 * np.log10(satellites / COMMON))
