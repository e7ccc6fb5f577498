"""Classified weights (ACEKF) on SINS/GNSS with six anomaly windows: how much better, than what?

Guo, Liu, Shi & Sun claim at least 95.6 % smaller errors than the EKF, 44.5 % than REKF, 24.6 %
than AEKF, single runs; their equations, tables and windows are lost and reconstructed here.  Each
claim is judged on 12 numbers, MAE and RMSE of six channels ("at least": the worst of them), with
white, correlated and constant anomalies, windows of 10 and of 50 residuals for REKF and AEKF.  A
plain chi-square test that leaves a fix out stands beside them.  Expected: the gain over the EKF
measures the anomalies, not the filter; with equal windows there is little between the adaptive
filters; the chi-square test is better than all of them when anomalies are correlated.
"""

from __future__ import annotations

import time

import numpy as np
from common.campaign import Campaign, Study, carry_out
from common.sins_cells import CELLS, FIRST_SEED, RUNS, Merits, fly_seed
from common.sins_claims import CLAIMED, forms, improvements, windows
from common.sins_figures import classes, errors, gains
from common.sins_flight import precision
from common.sins_measures import POSITION, VELOCITY, gain, peaks
from common.sins_targets import prototype, speed
from joblib import Parallel, delayed

from ultratight.provenance import sources_sha256

CAMPAIGNS = {"flights": Campaign("", {"filter": {n: {} for n in CELLS}}, RUNS, FIRST_SEED, 1.5)}


def main() -> None:
    """Fly, tabulate, draw, judge."""
    study = Study(__file__, CAMPAIGNS)
    study.codes.add(sources_sha256()[:12])
    runs, began = study.campaigns["flights"].runs, time.monotonic()
    one = Parallel(n_jobs=study.jobs or -1)(
        delayed(fly_seed)(seed) for seed in range(FIRST_SEED, FIRST_SEED + runs)
    )
    m = {key: {q: np.array([run[key][q] for run in one]) for q in one[0][key]} for key in one[0]}
    study.say(f"{len(m) - 1} filters x {runs} flights in {time.monotonic() - began:.0f} s")
    tabulate(study, m)
    study.figure("acekf_errors", errors())
    study.figure("acekf_classes", classes())
    study.figure("acekf_gains", gains(m))
    single = {1.0: precision(1.0), 1e-8: precision(1e-8)}
    study.say(f"\nlargest relative error of a standard deviation, R x 1 and x 1e-8: {single}")
    study.conclude([*improvements(m), *windows(m), *forms(m, single), *prototype(m, single),
                    speed()])  # fmt: skip


def tabulate(study: Study, m: dict[str, Merits]) -> None:
    """MAE and RMSE of velocity and position, as in tables 2 and 3, which are lost."""
    for cell, filters in CELLS.items():
        study.say(f"\n{cell:22} MAE v [m/s] E N U      p [m] lat lon h     RMSE v             p"
                  "                 peak v, p")  # fmt: skip
        for name in filters:
            x = m[f"{cell} {name}"]
            mean = [f"{value:.3g}" for value in x["twelve"].mean(0)]
            largest = [f"{peaks(x, part).mean():.3g}" for part in (VELOCITY, POSITION)]
            study.say(f"{name:18} " + " ".join(f"{v:>6}" for v in (*mean, *largest)))
    study.say("\ngain of ACEKF, mean / worst of 12 [%]; the paper: at least "
              + ", ".join(f"{v} over {n}" for n, v in CLAIMED.items()))  # fmt: skip
    for cell in ("T1 white", "T1 ar", "T1 bias", "BASE ar"):
        names = ("EKF", "REKF", "REKF 50", "AEKF", "AEKF 50", "chi-square test")
        cells = [
            f"{n} {gain(m, cell, n, False).value:.1f} / {gain(m, cell, n, True).value:.1f}"
            for n in names
        ]
        study.say(f"{cell:10} " + ";  ".join(cells))


if __name__ == "__main__":
    carry_out(main)
