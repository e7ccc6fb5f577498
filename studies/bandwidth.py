"""How narrow may a PLL be that an INS aids?  By IMU grade and by the latency of the aid.

Xu, Zeng & Huang (Geom. Inf. Sci. Wuhan Univ. 42(12), 2017) remark that inertial aiding allows a
loop bandwidth of about 3 Hz in high dynamics.  Here a third-order Costas PLL of 5 ms flies JPL's
trajectory (25 g, 100 g/s along the line of sight) at 45 dB-Hz, where noise takes nobody's lock:
alone, and with the Doppler and its rate from a free INS.  The smallest bandwidth that holds is the
smallest of the grid from which on at most 10 % of the channels are lost.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from common.campaign import Campaign, Study, carry_out
from common.jpl import ALONE, LINE, band, lost, thinned, world
from common.ledger import Claim, Must, Quantity
from common.statistics import interval
from common.thresholds import LOSS
from matplotlib.figure import Figure

from ultratight.plots import COLOURS, STYLES

Change = dict[str, Any]
RUNS, FIRST_SEED = 3, 3001
LEAD_S = 9.0
"""A loop of 1 Hz narrows 6 s after it has locked"""
BANDWIDTHS = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 18.0)
ALONE_BANDWIDTHS = (8.0, 12.0, 18.0, 25.0, 35.0, 50.0, 65.0)
GRADES = ("navigation", "tactical", "industrial-mems")
LATENCIES_MS = (0, 5, 20, 100)
PAPER_HZ = 3.0
LOOP: Change = world(LEAD_S) | ALONE | {
    "cn0_dbhz": 45.0, "receiver.integration_s": 0.005, "receiver.pll_order": 3,
}  # fmt: skip


def _of(bandwidths: tuple[float, ...]) -> dict[str, Change]:
    return {f"{b:g}": {"receiver.bandwidth_hz": b} for b in bandwidths}


CAMPAIGNS = {
    "alone": Campaign(
        "uniform",
        {
            "closure": {"alone": LOOP | {"receiver.closure": "scalar"}},
            "bandwidth": _of(ALONE_BANDWIDTHS),
        },
        RUNS,
        FIRST_SEED,
        weight=0.3,
    ),
    "aided": Campaign(
        "uniform",
        {
            "closure": {"aided": LOOP | {"receiver.closure": "scalar-ins"}},
            "grade": {g: {"imu.grade": g} for g in GRADES},
            "latency_ms": {f"{x}": {"receiver.aiding_latency_s": 1e-3 * x} for x in LATENCIES_MS},
            "bandwidth": _of(BANDWIDTHS),
        },
        RUNS,
        FIRST_SEED,
        weight=0.3,
    ),
}


def main() -> None:
    """Fly, draw, judge."""
    study = Study(__file__, CAMPAIGNS)
    if study.quick:
        few = study.campaigns
        few["alone"] = thinned(few["alone"], bandwidth=3)
        few["aided"] = thinned(few["aided"], bandwidth=3, latency_ms=3)
    alone = lost(study.fly("alone")).isel(closure=0, drop=True)
    aided = lost(study.fly("aided")).isel(closure=0, drop=True)
    study.say("\nsmallest bandwidth that holds [Hz]")
    study.say(f"{'unaided':28} {told(smallest('unaided', alone))}")
    for grade in GRADES:
        for ms in aided["latency_ms"].values:
            q = smallest("", aided.sel(grade=grade, latency_ms=ms))
            study.say(f"{grade:16} {ms:>4} ms {'':4} {told(q)}")
    draw(study, alone, aided)
    study.conclude([narrow(alone, aided), late(aided)])


def told(q: Quantity) -> str:
    """None: no bandwidth of the grid holds."""
    return "none of the grid" if q.value is None else f"{q.value:g}"


def least(bandwidths: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Smallest bandwidth from which on all hold (..., n_bandwidth) -> (...,), inf for none."""
    held = np.logical_and.accumulate((share <= LOSS)[..., ::-1], axis=-1)[..., ::-1]
    return np.where(held.any(axis=-1), bandwidths[held.argmax(axis=-1)], np.inf)


def smallest(name: str, share: xr.DataArray, must: Must | None = None) -> Quantity:
    """`least` of the mean over the runs, with a bootstrap over them."""
    bandwidths = np.array([float(b) for b in share["bandwidth"].values])
    values = share.transpose("run", "bandwidth").values
    return interval(name, values, lambda drawn: least(bandwidths, drawn.mean(axis=-2)), "Hz", must)


# -- what is shown --------------------------------------------------------------------------------


def draw(study: Study, alone: xr.DataArray, aided: xr.DataArray) -> None:
    """Loss against bandwidth, a panel per grade and a line per latency; the unaided in each."""
    page = Figure(figsize=(7.5, 6.6), layout="constrained")
    axes = page.subplots(len(GRADES), 1, sharex=True, sharey=True)
    for ax, grade in zip(axes, GRADES, strict=True):
        lines = {"unaided": alone} | {
            f"aided, {ms} ms late": aided.sel(grade=grade, latency_ms=ms)
            for ms in aided["latency_ms"].values
        }
        for k, (label, share) in enumerate(lines.items()):
            x = share["bandwidth"].values.astype(float) * 1.02 ** (k - 2)  # side by side
            p, down, up = band(share.transpose("bandwidth", "run").values, len(LINE))
            ax.errorbar(x, p, (np.maximum(p - down, 0.0), np.maximum(up - p, 0.0)),
                        fmt=STYLES[k % 4], color=COLOURS[k % 7], marker=".", capsize=2.0,
                        linewidth=1.1, elinewidth=0.6, label=label)  # fmt: skip
        ax.axvline(PAPER_HZ, color="black", linewidth=0.8, linestyle=":")
        ax.set_ylabel(f"channels lost\n{grade}", fontsize=8.0)
        ax.set_xscale("log")
        ax.grid(True, alpha=0.3)
    ticks = sorted({*BANDWIDTHS, *ALONE_BANDWIDTHS})
    axes[-1].set_xticks(ticks, [f"{b:g}" for b in ticks])
    axes[-1].minorticks_off()
    axes[-1].set_xlabel("noise bandwidth of the PLL [Hz] (dotted: 3 Hz)")
    axes[0].legend(fontsize=7.0, ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    study.figure("bandwidth", page)


# -- claims ---------------------------------------------------------------------------------------


def narrow(alone: xr.DataArray, aided: xr.DataArray) -> Claim:
    """The remark itself."""
    now = aided.sel(latency_ms="0")
    must = Must("below", PAPER_HZ)
    return Claim(
        id="bandwidth-3-hz",
        claim="Inertial aiding without latency allows a PLL of 3 Hz in high dynamics",
        source="Xu et al. 2017",
        theirs="about 3 Hz",
        ours=(
            *(smallest(f"aided, {g}", now.sel(grade=g), must) for g in GRADES),
            smallest("unaided", alone),
        ),
        why="what is left of a jerk of 100 g/s is the sensors' lag times it",
    )


def late(aided: xr.DataArray) -> Claim:
    """What latency costs."""
    mine = aided.sel(grade="tactical")
    musts = {"0": Must("below", PAPER_HZ), "5": Must("below", PAPER_HZ),
             "100": Must("above", PAPER_HZ)}  # fmt: skip
    return Claim(
        id="bandwidth-latency",
        claim="With a tactical IMU 3 Hz survive 5 ms of latency, and no longer 100 ms",
        source="this project",
        theirs="the aid is extrapolated with its rate: 100 g/s leave 5153 L Hz/s, L late",
        ours=tuple(
            smallest(f"{ms} ms late", mine.sel(latency_ms=ms), musts.get(str(ms)))
            for ms in mine["latency_ms"].values
        ),
        target=True,
        why="a third-order loop takes a jump of the rate r with a peak of about r / w0^2 cycles",
    )


if __name__ == "__main__":
    carry_out(main)
