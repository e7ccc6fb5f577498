"""Adaptive filters in the ultra-tight loop: which adaptation helps against which disturbance?

Sage-Husa, ISHAKF, ACEKF, IMM and MMAE were proposed for loosely coupled or range data. Here each
closes the loop: 17 states, taps as measurement, the NCO steered by the estimate. Disturbances: a
velocity jump (case 2) with its cause, an accelerometer scale factor of 3000 ppm, and without; all
satellites 15 dB weaker for 5 s; the clock of one satellite (G06) off by 100 m for 10 s (0.34 chip,
code and carrier). Judged by the r.m.s. error while it lasts, of velocity
for jumps and loss of power, of position for faults, paired with the QKF's by seed, and by
convergence at the end. 35 dB-Hz, models C and D, no fall-back; the receiver is not told.
"""

from __future__ import annotations

from common.adaptation_cells import CAMPAIGNS
from common.adaptation_claims import asked, from_samples, identical, price, serves
from common.adaptation_figures import draw_map, draw_time, tell
from common.adaptation_measures import judged
from common.campaign import Study, carry_out
from common.worlds import MODELS


def main() -> None:
    """Fly, draw, judge."""
    study = Study(__file__, CAMPAIGNS)
    flown = {m: judged(study, m) for m in MODELS}
    twins, sampled = ({m: judged(study, m, k) for m in MODELS} for k in ("-twins", "-samples"))
    for model in MODELS:
        draw_map(study, model, flown[model])
        tell(study, model, flown[model])
    draw_time(study, flown)
    claims = [claim for m in MODELS for claim in asked(m, flown[m])]
    claims += [ask(m, flown[m]) for ask in (price, serves) for m in MODELS]
    claims += [identical(m, twins[m]) for m in MODELS]
    study.conclude([*claims, from_samples(flown, sampled)])


if __name__ == "__main__":
    carry_out(main)
