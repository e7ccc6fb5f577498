"""What the study `ishakf` flies: ISHAKF's parts, what they meet, and their tunings."""

from __future__ import annotations

from dataclasses import replace

from joblib import Parallel, delayed

from common.ballistic_range import LOW, Cell, Flown, T, fly_all, outliers, stepped
from ultratight.filters.adaptive import SageHusa
from ultratight.filters.robust import Ishakf

FIRST_SEED = 2001
V1 = SageHusa(Q=False, b=(0.97, 0.97), fix="none", gain="previous")
V3 = Ishakf(robust=False)
ROWS: dict[str, SageHusa | Ishakf | None] = {
    "V0": None, "V1": V1, "V1g": replace(V1, fix="skip"),
    "V2": Ishakf(adaptive=False, robust=False), "V3": V3, "V4": Ishakf(),
    "V3 single": replace(V3, low_side="single"),
}  # fmt: skip
NAMES = {
    "V0": "fixed R", "V1": "innovation form", "V1g": "V1, indefinite steps skipped",
    "V2": "residual form", "V3": "V2 + adaptive forgetting", "V4": "V3 + robust gain: ISHAKF",
    "V3 single": "V3, falls seen in one sample",
}  # fmt: skip
TUNINGS = {
    name: Cell(noise)
    for name, noise in {
        "base": Ishakf(), "c3 = 9.5": Ishakf(c3=9.5), "c3 = 20, c4 = 30": Ishakf(c3=20.0, c4=30.0),
        "c4 = 30": Ishakf(c4=30.0), "c4 = 100": Ishakf(c4=100.0), "c1 = 1.7": Ishakf(c1=1.7),
        "c1 = 1.9": Ishakf(c1=1.9), "c2 = 7": Ishakf(c2=7.0), "c2 = 9": Ishakf(c2=9.0),
        "b0 = 0.65": Ishakf(b0=0.65, db=0.32), "b0 = 0.8": Ishakf(b0=0.8, db=0.17),
        "b0 + db = 0.95": Ishakf(db=0.25), "b0 + db = 0.99": Ishakf(db=0.29),
        "window 10": Ishakf(window=10), "window 40": Ishakf(window=40),
        "recursive d": Ishakf(recursive=True),
    }.items()
} | {
    "R_0 = (1 m)^2": Cell(Ishakf(), R0_m=1.0), "R_0 = (500 m)^2": Cell(Ishakf(), R0_m=500.0),
    "q = 1": Cell(Ishakf(), q=1.0), "q = 100": Cell(Ishakf(), q=100.0),
}  # fmt: skip
"""All ranges that the text gives, and beyond"""
LENGTHS, NOISES, FACTORS = (1, 5, 10, 20, 40, 80), (10, 20, 30, 50, 60), (3, 5, 6, 8, 10)
BURST_S, JUMP_S = 50.0, 50.0
MISSILE = 126.6 * (0.3 + 1.2 * T / 100.0)
"""Noise of the surrogate of the paper's missile [m]: 38 to 190 m, r.m.s. 122.1 m"""
RUNS = {"nominal": 200, "low": 50, "outliers": 50, "length": 50, "jump": 20, "tuning": 20,
        "missile": 50}  # fmt: skip


def cells(group: str) -> dict[str, Cell]:
    """What is flown of a group, by name."""
    R0 = {"V0": 20.0}
    rows = {name: Cell(noise, R0_m=R0.get(name, 50.0)) for name, noise in ROWS.items()}
    if group in ("nominal", "outliers"):
        rows |= {"known": Cell(None, known=True)}
    if group == "low":
        return {name: replace(c, sigma=stepped(LOW)) for name, c in rows.items()}
    if group == "outliers":
        return {name: replace(c, offset=outliers()) for name, c in rows.items()}
    if group == "length":
        return {
            f"{sigma} {n}": Cell(Ishakf(), stepped([sigma], ()), outliers([BURST_S], n))
            for sigma in NOISES for n in LENGTHS
        }  # fmt: skip
    if group == "jump":
        kinds = {"known": None, "V2": ROWS["V2"], "V3": V3, "V4": Ishakf(),
                 "c4 = 60": Ishakf(c4=60.0), "max_reject": Ishakf(max_reject=40)}  # fmt: skip
        return {
            f"{f} {name}": Cell(noise, stepped([20.0, 20.0 * f], [JUMP_S]), known=noise is None)
            for f in FACTORS for name, noise in kinds.items()
        }  # fmt: skip
    if group == "tuning":
        return TUNINGS | {
            f"{name} outliers": replace(c, offset=outliers()) for name, c in TUNINGS.items()
        }
    if group == "missile":
        both = {"V4": (Ishakf(), 50.0), "V0": (None, 122.1)}
        return {
            f"{q} {name}": Cell(noise, MISSILE, R0_m=R0_m, q=float(q), axes=1)
            for q in (10, 100) for name, (noise, R0_m) in both.items()
        }  # fmt: skip
    return rows


Group = dict[str, Flown]


def fly_group(group: str, runs: int, jobs: int | None, first_seed: int = FIRST_SEED) -> Group:
    """All cells over the same flights; threads, since the compiled filter leaves Python alone."""
    flown = cells(group)
    seeds = range(first_seed, first_seed + runs)
    done = Parallel(n_jobs=jobs or -1, prefer="threads")(
        delayed(fly_all)(cell, seeds) for cell in flown.values()
    )
    return dict(zip(flown, done, strict=True))
