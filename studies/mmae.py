"""MMAE of EKFs and of UKFs on SINS/CNS of a ballistic missile: what does a bank of ten models win?

Fan, Zhao, Li, Tang & He claim that the UKF is better than the EKF and a bank over Q clearly better
than either, from a table whose rows differ by less than 1 % (one run; no noise and no rate of the
star tracker).  Here the r.m.s. error of the attitude after 50 s, on common seeds, against a filter
that is told the true Q.  Expected: the bank wins nearly all that there is to win, 10 % where Q is
wrong by 2; the UKF wins the first fixes from a misalignment of 10 deg and nothing from 10 arcmin;
without a floor under the weights, as printed, the bank does not follow the change of the noise.
"""

from __future__ import annotations

import time

import numpy as np
from common.campaign import Campaign, Study, carry_out
from common.star_cells import (
    CELLS,
    FIRST_SEED,
    FOUR,
    RUNS,
    RUNS_100_HZ,
    TEN,
    TIMES,
    Merits,
    fly_100_hz,
    fly_seed,
    stacked,
)
from common.star_claims import ORDER, TABLE_2, of_ours, of_the_bank, of_the_table
from common.star_figures import course, errors, flight_page, gains
from common.star_flight import SCALES, SWITCH_S, Setting, draw, estimate
from common.star_measures import gain
from common.star_targets import prototype, speed
from joblib import Parallel, delayed

from ultratight.provenance import sources_sha256

CAMPAIGNS = {"flights": Campaign("", {"filter": {n: {} for n in CELLS}}, RUNS, FIRST_SEED, 1.0)}


def main() -> None:
    """Fly, tabulate, draw, judge."""
    study = Study(__file__, CAMPAIGNS)
    study.codes.add(sources_sha256()[:12])
    runs, began = study.campaigns["flights"].runs, time.monotonic()
    seeds = range(FIRST_SEED, FIRST_SEED + runs)
    many = Parallel(n_jobs=study.jobs or -1)
    m = stacked(many(delayed(fly_seed)(seed) for seed in seeds))
    m |= stacked(many(delayed(fly_100_hz)(seed) for seed in seeds[:RUNS_100_HZ]))
    study.say(f"{len(m) - 1} filters x {runs} flights (100 Hz: {min(runs, RUNS_100_HZ)}) in "
              f"{time.monotonic() - began:.0f} s")  # fmt: skip
    tabulate(study, m)
    large, small = draw(FIRST_SEED, Setting("deg")), draw(FIRST_SEED)
    study.figure("mmae_flight", flight_page(TEN))
    study.figure("mmae_errors", errors(
        large.setting.t_s, {name: estimate(large, aided).angle for name, aided in FOUR.items()}
    ))  # fmt: skip
    weights = {"floor of 1e-3": estimate(small, FOUR["MMAE-EKF"]),
               "no floor": estimate(small, CELLS["arcmin"][1]["no floor"])}  # fmt: skip
    study.figure("mmae_weights", course(
        {name: (f.run.weight, f.scale) for name, f in weights.items()}, TEN[:, 0], SCALES, SWITCH_S
    ))  # fmt: skip
    names = ("MMAE-EKF", "MMAE-UKF", "true Q", "true Q, UKF")
    study.figure("mmae_gains", gains({
        cell: {n: gain(m, cell, n, "EKF") for n in filters if n in names}
        for cell, (_, filters) in CELLS.items()
    }))  # fmt: skip
    study.conclude([*of_the_table(m), *of_the_bank(m), *of_ours(m), *prototype(m), speed()])


def tabulate(study: Study, m: dict[str, Merits]) -> None:
    """R.m.s. errors after 50 s, then Table 2 beside ours."""
    study.say(f"\n{'':30} r.m.s. [microrad] 50-500 s, 500-1000 s, both; gain [%]; wgt / wgt0 at "
              + ", ".join(map(str, TIMES)) + " s; error / sigma")  # fmt: skip
    for cell, (_, filters) in CELLS.items():
        for name in filters:
            x = m[f"{cell} {name}"]
            both, before, after = 1e6 * np.sqrt(x["settled"].mean(axis=0))
            won = gain(m, cell, name, "EKF").value
            found = " ".join(f"{s:.2f}" for s in x["scale"].mean(axis=0))
            ratio = " ".join(f"{r:.2f}" for r in np.sqrt(x["normalised"].mean(axis=0)))
            study.say(f"{cell + ', ' + name:30} {before:6.2f} {after:6.2f} {both:6.2f} "
                      f"{won:6.2f}   {found}   {ratio}")  # fmt: skip
    study.say("\nr.m.s. errors over all epochs [1e-4 rad], heading, pitch, roll: theirs (Table 2), "
              "ours (degrees, 100 Hz).\nAbsolute values are not comparable: the paper states "
              "neither noise nor rate of its star tracker.")  # fmt: skip
    for name, row in TABLE_2.items():
        ours = 1e4 * np.sqrt(m[f"100 Hz {name}"]["all"].mean(axis=0))[ORDER]
        settled = 1e6 * np.sqrt(m[f"100 Hz {name}"]["settled"][:, 0].mean())
        study.say(f"{name:10} " + " ".join(f"{1e4 * x:.4f}" for x in row) + "    "
                  + " ".join(f"{x:.4f}" for x in ours)
                  + f"    after 50 s: {settled:.2f} microrad")  # fmt: skip


if __name__ == "__main__":
    carry_out(main)
