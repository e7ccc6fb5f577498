"""Beyond FIQKF: the final run of the jump-triggered filter (JTQ), fixed before it was flown.

JTQ needs no knowledge of the cause: at a change of the measured specific force it opens the
covariance of accelerometer bias, velocity and clock drift under four hypotheses, relinearises its
update, and reopens by a score test.  An independent prototype converged in 960 of 960 runs (eight
mechanisms, cases 1, 2 and 4, models C and D) with 0.014-0.045 m/s in model C, case 2.  Seeds,
cells and bars stand in `beyond_fiqkf.toml`.  Beside the results: the bound for a jump of known
time, the plain QKF, what each part is worth, false alarms, and cells outside the envelope.
"""

from __future__ import annotations

from common.campaign import Study, carry_out
from common.jump_cells import CASES, GRID, campaigns
from common.jump_claims import (
    all_converge,
    beside_the_bound,
    clock_free,
    false_alarms,
    from_samples,
    graceful,
    grid,
    harmless,
    parts,
    price,
    relatives,
)
from common.jump_figures import draw_envelope, draw_grid

CAMPAIGNS = campaigns()


def main() -> None:
    """Fly, draw, judge."""
    study = Study(__file__, CAMPAIGNS)
    flown = {name: study.fly(name) for name in CAMPAIGNS}
    for name, ds in flown.items():
        study.table(name, ds)
    draw_grid(study, flown)
    draw_envelope(study, flown["envelope"])
    claims = [grid(flown, model, case) for model in GRID["models"] for case in CASES]
    claims += [all_converge(flown), *beside_the_bound(flown), harmless(flown), price(flown)]
    claims += parts(flown) + relatives(flown)
    claims += [clock_free(flown), false_alarms(study), from_samples(flown)]
    claims += graceful(flown["envelope"])
    study.conclude(claims)


if __name__ == "__main__":
    carry_out(main)
