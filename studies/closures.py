"""The same sky, motion, IMU, oscillator and noise for every closure: what does each one hold?

Scalar loops, INS-aided ones, a VDFLL on GNSS alone, the federated and the centralised ultra-tight
form.  Tracking thresholds in C/N0 (10 % of the channels lost within 20 s, by the truth) in uniform
motion, in jumps of 10 g and with two to six of eleven satellites blocked; velocity and position
errors; the time to be back after outages of 1 to 30 s; what vector loops gain over equivalent
scalar ones, beside the 6.2 dB with 11 and 2.4 dB with 5 satellites of Lashley, Bevly & Hung (PLANS
2010); and where `ultratight predict` is right.

Expected: vector loops gain what averaging over four common unknowns gives, 4.4 and 1.0 dB, and what
the narrower filter gives; with a tactical IMU no replica of an ultra-tight closure leaves its
signal within 20 s; predictions within 2 dB.
"""

from __future__ import annotations

import sys

import numpy as np
import xarray as xr
from common import closure_figures as figures
from common.campaign import Study, carry_out
from common.closure_bench import bandwidth_hz, equivalents, loop
from common.closure_cells import INS, MOTIONS, campaigns
from common.closure_claims import all_claims
from common.closure_measures import Found, collect, spread, useful
from common.ledger import Quantity
from common.thresholds import LOSS, threshold

CAMPAIGNS = campaigns("--quick" in sys.argv)


def main() -> None:
    """Fly, tabulate, draw, judge."""
    study = Study(__file__, CAMPAIGNS)
    bench = equivalents(study.quick)
    found = collect(study)
    tell_loops(study, bench)
    tell_thresholds(study, found)
    tell_errors(study, found)
    tell_outages(study, found)
    study.figure("closures_thresholds", figures.losses(found))
    study.figure("closures_errors", figures.errors(found))
    study.figure("closures_outages", figures.outages(found.outages))
    study.figure("closures_predicted", figures.predictions(found))
    study.conclude(all_claims(found, bench, study.quick))


def shown(q: Quantity) -> str:
    """Value and interval, or the side of the levels on which it lies."""
    if q.value is None:
        return " ".join(q.name.split()[-2:])
    return f"{q.value:.1f} [{q.low:.1f}, {q.high:.1f}]"


def tell_loops(study: Study, bench: dict[str, xr.DataArray]) -> None:
    """Loops without receivers."""
    study.say("\nloops alone: threshold [dB-Hz]; noise bandwidth of the scalar ones at 24 dB-Hz "
              + ", ".join(f"{bandwidth_hz(loop(None, n), 24.0):.2f} Hz ({n} states)"
                          for n in (8, 11)))  # fmt: skip
    for name, share in bench.items():
        study.say(f"{name:28} {shown(threshold(name, share))}")


def tell_thresholds(study: Study, f: Found) -> None:
    """A line per motion and closure."""
    study.say("\nthreshold [dB-Hz] by the truth; by own indicator; by either; predicted; blocked "
              "ones back at the end, lowest to highest level")  # fmt: skip
    for cell in f.either:
        share = f.lost[cell]
        by = [shown(threshold("", x)) for x in (share, f.own[cell], f.either[cell])]
        least = "" if share.mean("run").min() <= LOSS else f" (least {share.mean('run').min():.2f})"
        x = f.predicted.get(cell, np.nan)
        text = f"{cell[0]:16} {cell[1]:18} " + " ".join(f"{b:20}" for b in by) + f"{x:6.1f}{least}"
        if cell in f.back:
            text += " " + ", ".join(f"{b:.2f}" for b in f.back[cell].mean("run").values)
        study.say(text)


def tell_errors(study: Study, f: Found) -> None:
    """Medians where a tenth is lost at most."""
    study.say(f"\nvelocity [m/s] and position [m], uniform motion; INS alone "
              f"{np.median(f.alone):.2f} m/s")  # fmt: skip
    for name, ds in f.errors.items():
        cells = []
        for x in ds["cn0_dbhz"].values:
            at = ds.sel(cn0_dbhz=x)
            v, r = (float(at[kind].median("run")) for kind in ("jump", "position_end"))
            held = at["loss"].mean("run") <= LOSS
            cells.append(f"{x:g}: {v:.4f}, {r:.2f}" if held else f"{x:g}: lost")
        study.say(f"{name:18} " + "; ".join(cells))
    for motion in MOTIONS:
        for name in (n for n in INS if (motion, n) in f.velocity):
            q = useful("", f.velocity[motion, name], f.alone)
            study.say(f"useful down to, {motion}, {name}: {shown(q)} dB-Hz")


def tell_outages(study: Study, f: Found) -> None:
    """Median, worst, share that is never back."""
    study.say("\nback on the signal after an outage: median, worst [s], share never")
    for name, times in f.outages.items():
        for x in times["cn0_dbhz"].values:
            cells = []
            for s in times["outage"].values:
                a, b, c = spread(times.sel(cn0_dbhz=x, outage=s))
                cells.append(f"{s} s: {a:.2f}, {b:.2f}, {c:.2f}")
            study.say(f"{name:18} {x:g} dB-Hz  " + "; ".join(cells))


if __name__ == "__main__":
    carry_out(main)
