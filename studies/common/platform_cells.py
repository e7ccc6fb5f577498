"""What the study `sage_husa` flies: six filters, their forms and weights, scenarios and Q_0."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from joblib import Parallel, delayed

from common.platform_flight import (
    Q0,
    SCENARIOS,
    Flown,
    estimate,
    measure,
    merits,
    process_noise,
)
from ultratight.filters.adaptive import SageHusa
from ultratight.filters.catalog import CATALOG

RUNS, FIRST_SEED = 40, 1001
NAMES = {"1": "Sage-Husa", "2": "improved 1", "3": "improved 2", "4": "R only", "5": "Kalman",
         "6": "Q only"}  # fmt: skip
ROWS = {"1": "kf-sage-husa", "2": "kf-sage-husa-1", "3": "kf-sage-husa-2", "4": "kf-sage-husa-r",
        "5": "kf", "6": "kf-sage-husa-q"}  # fmt: skip
"""Number in the paper -> name, row of the catalogue; 6 is mentioned only"""
WEIGHTS = {
    "1": {"b": 0.2, "pair": (0.3, 0.2), "a": (0.1, 0.4)},
    "2": {"b": 0.5, "pair": (0.5, 0.5), "a": (0.5, 1.0)},
    "3": {"b": 0.5, "pair": (0.5, 0.5), "a": (0.5, 1.0)},
}
DRIFTS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)
"""Of Q_0 [deg/h] in a second; the truth has none"""
FORGETTING = (0.2, 0.5, 0.95)

Merits = dict[str, np.ndarray]


@dataclass(frozen=True)
class Cell:
    """One filter in one scenario."""

    scenario: str
    Q: np.ndarray
    noise: SageHusa | None


def algorithm(number: str, scenario: str, **changes: object) -> SageHusa | None:
    """A row of the catalogue with the paper's weights."""
    noise, w = CATALOG[ROWS[number]].noise, WEIGHTS[scenario]
    if noise is None:
        return None
    own = {"2": {"b": w["pair"]}, "3": {"a": w["a"]}}.get(number, {"b": (w["b"], w["b"])})
    return replace(noise, **(own | changes))


def cells() -> dict[str, Cell]:
    """Everything that is flown, by name: scenario, Q_0, filter."""
    out = {
        f"{s} {q} {n}": Cell(s, Q, algorithm(n, s))
        for s in "123"
        for q, Q in Q0.items()
        for n in NAMES
    }
    for q, Q in Q0.items():
        for n in "1234":
            out[f"1 {q} {n} previous"] = Cell("1", Q, algorithm(n, "1", gain="previous"))
        for fix in ("whole", "drop-minus"):
            out[f"1 {q} 1 {fix}"] = Cell("1", Q, algorithm("1", "1", fix=fix))
        out[f"1 {q} 3 of initial"] = Cell("1", Q, algorithm("3", "1", a_of_initial=True))
    for b in ((0.95, 0.0), (0.0, 0.0), (0.5, 0.5)):
        out[f"1 b {b}"] = Cell("1", Q0["over-stated"], algorithm("2", "1", b=b))
    for b in FORGETTING:
        base = SageHusa(b=(b, b))
        variants = {
            "none": replace(base, fix="none"), "fix": base, "whole": replace(base, fix="whole"),
            "drop-minus": replace(base, fix="drop-minus"), "r": replace(base, mean_r=True),
            "q": replace(base, mean_q=True), "both": replace(base, mean_r=True, mean_q=True),
        }  # fmt: skip
        for name, noise in variants.items():
            out[f"5 {name} {b}"] = Cell("section 5", Q0["over-stated"], noise)
    for drift in DRIFTS:
        for n in "1345":
            out[f"drift {drift} {n}"] = Cell("1", process_noise(drift), algorithm(n, "1"))
    out["full 5"] = Cell("full quadrature", Q0["matched"], None)
    return out


def fly_seed(flown: dict[str, Cell], seed: int) -> dict[str, dict[str, float]]:
    """Every cell over the same flight, errors and noise."""
    worlds = {s: measure(SCENARIOS[s], seed) for s in {cell.scenario for cell in flown.values()}}
    return {
        name: merits(estimate(SCENARIOS[c.scenario], *worlds[c.scenario], c.Q, c.noise))
        for name, c in flown.items()
    }


def fly_all(
    flown: dict[str, Cell], runs: int, jobs: int | None, first_seed: int = FIRST_SEED
) -> dict[str, Merits]:
    """Merits (run,) of each cell; threads, since the compiled filter leaves Python alone."""
    seeds = range(first_seed, first_seed + runs)
    one = Parallel(n_jobs=jobs or -1, prefer="threads")(
        delayed(fly_seed)(flown, seed) for seed in seeds
    )
    return {
        name: {key: np.array([run[name][key] for run in one]) for key in one[0][name]}
        for name in flown
    }


def one_flight(scenario: str, Q: np.ndarray, noise: SageHusa | None, seed: int) -> Flown:
    """With its histories."""
    return estimate(SCENARIOS[scenario], *measure(SCENARIOS[scenario], seed), Q, noise)
