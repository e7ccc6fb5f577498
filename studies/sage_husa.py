"""Sage-Husa filters on a wander-azimuth INS with GPS outages and faults: which one, and when?

Wei, Qin, Zhang & Zhang, J. Chinese Inertial Technology 20(6), 2012, 678-686: six filters on a
flight of 8424 s, single runs.  Their claim: Sage-Husa misses terms of Q^; with them (improved 1, 2)
the errors are smallest, with R^ alone largest, the plain Kalman filter's between.  Here every
scenario is flown with 40 seeds, a Q_0 that over-states the drift and one matched to the truth, and
the gain made with R^_k, or with R^_k-1 as printed.  Q_0 and gain are not given in the paper; both
were chosen after its amplitudes of scenario 1, so that those show what is possible, no more.
Expected: the ranking holds where Q_0 is far too large and turns over where it is right; the terms
missed are zero.
"""

from __future__ import annotations

import time

import numpy as np
from common.campaign import Campaign, Study, carry_out
from common.platform_cells import (
    DRIFTS,
    FIRST_SEED,
    NAMES,
    RUNS,
    Merits,
    algorithm,
    cells,
    fly_all,
    one_flight,
)
from common.platform_claims import PEAKS, amplitudes, ranking, scenarios, section_5, theory
from common.platform_figures import over_Q0, root_R, velocities
from common.platform_flight import Q0, Flown
from common.platform_measures import equal_b, middle, typical
from common.platform_targets import prototype, speed

from ultratight.provenance import sources_sha256

COST = 0.3
"""Of a flight, in units of a closed-form run of 50 s"""
CAMPAIGNS = {
    "flights": Campaign("", {"filter": {name: {} for name in cells()}}, RUNS, FIRST_SEED, COST)
}


def filter_name(n: str) -> str:
    """Number and name."""
    return f"({n}) {NAMES[n]}"


def flights(scenario: str, shown: str) -> dict[str, dict[str, Flown]]:
    """One flight of each filter for each Q_0."""
    return {
        q: {
            filter_name(n): one_flight(scenario, Q, algorithm(n, scenario), FIRST_SEED)
            for n in shown
        }
        for q, Q in Q0.items()
    }


def main() -> None:
    """Fly, tabulate, draw, judge."""
    study = Study(__file__, CAMPAIGNS)
    study.codes.add(sources_sha256()[:12])
    began = time.monotonic()
    m = fly_all(cells(), study.campaigns["flights"].runs, study.jobs)
    study.say(f"{len(m)} filters x {m['full 5']['rms'].size} flights in "
              f"{time.monotonic() - began:.0f} s")  # fmt: skip
    tabulate(study, m)
    for s in "123":
        study.figure(f"sage_husa_{s}", velocities(s, flights(s, "12345")))
    study.figure("sage_husa_noise", root_R(flights("3", "34")))
    found = {filter_name(n): [typical("", m[f"drift {d} {n}"]["rms"], "") for d in DRIFTS]
             for n in "1345"}  # fmt: skip
    study.figure("sage_husa_q0", over_Q0(DRIFTS, found, m["full 5"]["rms"].size))
    same = equal_b()
    claims = [*amplitudes(m), *ranking(m), *scenarios(m), *theory(m, same), *section_5(m)]
    study.conclude([*claims, *prototype(m, same), speed()])


def tabulate(study: Study, m: dict[str, Merits]) -> None:
    """A line per filter: geometric means; durations and times are medians."""
    lines = {
        "scenario 1": [f"1 {q} {n}" for q in Q0 for n in NAMES],
        "scenario 1, gain with R^_k-1": [f"1 {q} {n} previous" for q in Q0 for n in "1234"],
        "scenario 1, forms": [k for k in m if k.endswith(("whole", "drop-minus", "initial"))
                              and k[0] == "1"] + [k for k in m if k.startswith("1 b")] + ["full 5"],
        "scenario 2": [f"2 {q} {n}" for q in Q0 for n in NAMES],
        "scenario 3": [f"3 {q} {n}" for q in Q0 for n in NAMES],
        "section 5": [k for k in m if k.startswith("5 ")],
        "scenario 1, drift in Q_0": [k for k in m if k.startswith("drift")],
    }  # fmt: skip
    for title, keys in lines.items():
        study.say(
            f"\n{title}{'':{36 - len(title)}} peak Vx, Vy [m/s] (x/: of one run)   rms   late  "
            "azimuth ['']  lasts a, b [s]  sqrt(R) > 100 m [s]  max [m]  lost"
        )
        for key in keys:
            x = m[key]
            scatter = [np.exp(np.std(np.log(x[f"peak_{axis}"]))) for axis in "xy"]
            a, b = (np.median(np.maximum(x[f"long_{w}_x"], x[f"long_{w}_y"])) for w in "ab")
            study.say(
                f"{label(key):36} {middle(x['peak_x']):8.3g} {middle(x['peak_y']):8.3g} "
                f"({scatter[0]:.2f}, {scatter[1]:.2f}) {middle(x['rms']):9.3g} "
                f"{middle(x['rms_late']):6.3g} {middle(x['azimuth']):8.0f} {a:8.0f} {b:6.0f} "
                f"{np.median(x['sqrt_R_s']):10.0f} {middle(x['sqrt_R']):12.0f} "
                f"{int(np.isfinite(x['lost']).sum()):6d}"
            )
    study.say("\nscenario 1, peaks Vx / Vy [m/s]: paper, over-stated Q_0, matched Q_0")
    for n, theirs in PEAKS.items():
        ours = [
            f"{middle(m[f'1 {q} {n}']['peak_x']):.3g} / {middle(m[f'1 {q} {n}']['peak_y']):.3g}"
            for q in Q0
        ]
        study.say(f"{n} {NAMES[n]:12} {theirs[0]:g} / {theirs[1]:g}   {ours[0]}   {ours[1]}")


def label(key: str) -> str:
    """Of a cell, with the filter's name."""
    words = key.split(" ")
    return " ".join(f"{w} {NAMES[w]}" if w in NAMES and i == 2 else w for i, w in enumerate(words))


if __name__ == "__main__":
    carry_out(main)
