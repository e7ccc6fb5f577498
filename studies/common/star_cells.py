"""What the study `mmae` flies: filters, banks, settings, and the figures of one flight."""

from __future__ import annotations

import numpy as np

from common.star_flight import (
    DURATION_S,
    SWITCH_S,
    Aided,
    Flown,
    Setting,
    World,
    bank,
    draw,
    estimate,
)
from ultratight.tracking.star_fixes import Weighing

RUNS, FIRST_SEED, RUNS_100_HZ = 12, 701, 3
LINEAR, POINTS = "linearised", "unscented-projected"
ONE, TEN = np.ones((1, 2)), bank()
FOUR = {
    "EKF": Aided(LINEAR, ONE),
    "UKF": Aided(POINTS, ONE),
    "MMAE-EKF": Aided(LINEAR, TEN),
    "MMAE-UKF": Aided(POINTS, TEN),
}
KNOWN = {"true Q": Aided(LINEAR, None)}
PLAIN = {name: FOUR[name] for name in ("EKF", "MMAE-EKF")} | KNOWN
SAME_WGA = TEN * [1.0, 0.0] + [0.0, 1.0]
BANKS = {
    "5 models": bank(5),
    "20 models": bank(20),
    "0.1 to 4": bank(10, 0.1, 4.0),
    "0.5, 1, 2": np.array([0.5, 1.0, 2.0])[:, None] * np.ones(2),
    "random": 0.25 + 2.25 * np.random.default_rng(1).random((10, 2)),
}
WEIGHINGS = {
    "no floor": Weighing(0.0),
    "floor 1e-6": Weighing(1e-6),
    "floor 1e-2": Weighing(1e-2),
    "forgetting 0.999": Weighing(0.0, 0.999),
}
CELLS: dict[str, tuple[Setting, dict[str, Aided]]] = {
    "arcmin": (Setting(), FOUR | KNOWN
               | {n: Aided(LINEAR, points) for n, points in BANKS.items()}
               | {n: Aided(LINEAR, TEN, w) for n, w in WEIGHINGS.items()}
               | {"equal wga": Aided(LINEAR, SAME_WGA)}),
    "deg": (Setting("deg"), FOUR | KNOWN | {
        "true Q, UKF": Aided(POINTS, None), "iterated EKF": Aided(LINEAR, ONE, passes=8),
        "no floor": Aided(POINTS, TEN, WEIGHINGS["no floor"])}),
    "psd": (Setting(mode="psd"), PLAIN),
    "rate": (Setting(mode="rate"), PLAIN),
    **{f"star {a:g} arcsec": (Setting(star_arcsec=a), PLAIN) for a in (3.0, 30.0, 120.0)},
    "R x 4": (Setting(), {n: Aided(LINEAR, FOUR[n].scales, star_arcsec=20.0)
                          for n in ("EKF", "MMAE-EKF")}),
}  # fmt: skip
"""How the gaps of the paper are filled, and the filters that fly there"""
TIMES = (100, 250, 500, 520, 600, 750, 1000)

Merits = dict[str, np.ndarray]


def merits(world: World, flown: Flown) -> Merits:
    """Figures of one flight."""
    t, star_hz = world.setting.t_s, world.setting.star_hz
    halves = [(t > 50.0) & (t <= SWITCH_S), (t > SWITCH_S) & (t <= DURATION_S)]
    norm = (flown.angle**2).sum(axis=1)
    ratio = (flown.turn[1:] ** 2 / flown.run.variance[:, :3]).mean(axis=1)
    return {
        "all": (flown.angle**2).mean(axis=0),
        "settled": np.array([norm[t > 50.0].mean(), *(norm[h].mean() for h in halves)]),
        "scale": flown.scale[np.array(TIMES) * star_hz - 1],
        "nis": flown.run.nis[t[1:] > 50.0].mean(axis=0)[:1] / 3.0,
        "normalised": np.array([ratio[h[1:]].mean() for h in halves]),
        "mishaps": np.array(flown.run.first) >= 0,
    }


def fly_seed(seed: int) -> dict[str, Merits]:
    """Every filter in every cell of one seed, and what wga changes."""
    out = {}
    for cell, (setting, filters) in CELLS.items():
        world, kept = draw(seed, setting), {}
        for name, aided in filters.items():
            kept[name] = estimate(world, aided)
            out[f"{cell} {name}"] = merits(world, kept[name])
        if "equal wga" in kept:
            a, b = kept["MMAE-EKF"], kept["equal wga"]
            off = [np.abs(a.run.weight - b.run.weight).max(), np.abs(a.turn - b.turn).max()]
            out["wga"] = {"off": np.array(off)}
    return out


def fly_100_hz(seed: int) -> dict[str, Merits]:
    """The four filters with a fix for each of the 100 000 samples."""
    world = draw(seed, Setting("deg", star_hz=100))
    return {f"100 Hz {name}": merits(world, estimate(world, a)) for name, a in FOUR.items()}


def stacked(runs: list[dict[str, Merits]]) -> dict[str, Merits]:
    """(run, ..) of each figure."""
    return {key: {q: np.array([r[key][q] for r in runs]) for q in runs[0][key]} for key in runs[0]}
