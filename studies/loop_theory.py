"""Loops against the textbook: jitter, slips, stress, thresholds, S-curves, C/N0 estimators.

The receiver's own scalar closure on taps in closed form, 20-50 dB-Hz, and its discriminators and
filters alone, against the closed forms of `ultratight.tracking.loop_theory` (Kaplan & Hegarty,
Betz & Kolodziejski, Viterbi).  Expected: within 5 % where small errors may be assumed, i.e. 6 dB
above threshold; not near it, where discriminators bend; and not where the book's Bn belongs to an
analogue loop: a digital one of the same Bn is slower, and its dynamic stress larger.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from common import loop_figures
from common.campaign import Campaign, Study, carry_out
from common.code_loop_claims import code_loop_claims
from common.code_loops import CODE_LOOPS, fly_code_loop
from common.code_loops import LEVELS as CODE_LEVELS
from common.loop_cells import CLEAR_DB, DURATION_S, LEVELS, LOOPS, Flown, Loop, fly_loop
from common.loop_claims import (
    cn0_claims,
    curve_claims,
    shot_claims,
    slip_claims,
    stresses,
    thermal,
    thresholds,
)
from common.loop_samples import (
    SLIP_DB,
    SLIP_ORDERS,
    Slips,
    cn0_bias,
    one_shot,
    s_curves,
    time_to_slip,
)

from ultratight.provenance import sources_sha256

RUNS, FIRST_SEED, CODE_CHANNELS = 8, 701, 40
CAMPAIGNS = {"loops": Campaign("", {"loop": {name: {} for name in LOOPS}}, RUNS, FIRST_SEED, 0.3)}


def main() -> None:
    """Fly, tabulate, draw, judge."""
    study = Study(__file__, CAMPAIGNS)
    study.codes.add(sources_sha256()[:12])
    began, runs = time.process_time(), study.campaigns["loops"].runs
    share = runs / RUNS
    flown = {
        name: kept(study, name, loop, runs, FIRST_SEED + k)
        for k, (name, loop) in enumerate(LOOPS.items())
    }
    code_loops = {
        name: fly_code_loop(loop, CODE_CHANNELS // (1 if share == 1.0 else 8), FIRST_SEED + k)
        for k, (name, loop) in enumerate(CODE_LOOPS.items())
    }
    slips = time_to_slip(1200 if share == 1.0 else 100)
    shots = one_shot(round(4000 * share) + 100)
    curves = s_curves(round(600 * share) + 50)
    cn0 = cn0_bias(round(240 * share))
    study.say(f"{len(flown)} flights of {DURATION_S:g} s, {time.process_time() - began:.0f} s CPU")
    tabulate(study, flown, slips, cn0)
    study.figure("loop_theory_jitter", loop_figures.jitter_page(LEVELS, LOOPS, flown, CLEAR_DB))
    study.figure("loop_theory_thresholds", loop_figures.threshold_page(LOOPS, flown, slips))
    study.figure("loop_theory_code",
                 loop_figures.code_loop_page(CODE_LEVELS, CODE_LOOPS, code_loops))  # fmt: skip
    study.figure("loop_theory_s_curves", loop_figures.curve_page(curves))
    study.figure("loop_theory_cn0", loop_figures.cn0_page(LEVELS, cn0))
    study.conclude([
        *thermal(flown), *code_loop_claims(code_loops), *shot_claims(shots), *stresses(flown),
        *slip_claims(slips), *thresholds(flown), *curve_claims(curves), *cn0_claims(cn0),
    ])  # fmt: skip


def kept(study: Study, name: str, loop: Loop, runs: int, seed: int) -> Flown:
    """A flight, or what is left of it in the study's folder if the same sources flew it."""
    folder = study.out / ("quick" if study.quick else "full")
    path = folder / f"{name.replace(' ', '-')}-{sources_sha256()[:12]}.npz"
    if path.is_file() and not study.fresh:
        with np.load(path) as data:
            return Flown(*(data[key] for key in Flown._fields))
    flown = fly_loop(loop, runs, seed)
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(path, **flown._asdict())
    return flown


def tabulate(
    study: Study, flown: dict[str, Flown], slips: Slips, cn0: dict[str, np.ndarray]
) -> None:
    """Every cell."""
    rows: list[tuple[str, Callable[[Flown], np.ndarray]]] = [
        ("carrier", lambda f: f.carrier), ("code", lambda f: f.code),
    ]  # fmt: skip
    for what, of in rows:
        study.say(f"\n{what} jitter, measured / theory, at {', '.join(f'{x:g}' for x in LEVELS)} "
                  "dB-Hz (-: lock lost)")  # fmt: skip
        for name, f in flown.items():
            means = [np.nanmean(x) if np.isfinite(x).any() else np.nan for x in of(f).T]
            study.say(f"{name:20} " + " ".join(
                f"{np.sqrt(m):6.3f}" if np.isfinite(m) else "     -" for m in means
            ))  # fmt: skip
    study.say("\nmean time to slip [s], Bn = 1 Hz, at " + ", ".join(f"{x:g}" for x in SLIP_DB)
              + " dB")  # fmt: skip
    for order in SLIP_ORDERS:
        study.say(f"order {order}: " + " ".join(f"{slips[order, db][0]:8.2f}" for db in SLIP_DB))
    study.say(f"\nbias of C/N0 [dB] at {', '.join(f'{x:g}' for x in LEVELS)} dB-Hz")
    for kind, values in cn0.items():
        study.say(f"{kind:12} " + " ".join(f"{np.nanmean(x):6.2f}" for x in values))


if __name__ == "__main__":
    carry_out(main)
