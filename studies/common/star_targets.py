"""Acceptance figures of MMAE by an independent prototype, and the cost of a flight."""

from __future__ import annotations

import time

import numpy as np

from common.ledger import Claim, Must
from common.star_cells import FIRST_SEED, FOUR, Merits
from common.star_flight import Setting, draw, estimate
from common.star_measures import excess, gain, rms, scale, spread
from common.statistics import interval, number

PROTOTYPE, OURS, REPEATS = "independent prototype", "this project", 7


def prototype(m: dict[str, Merits]) -> list[Claim]:
    """Acceptance figures, from other seeds and another implementation."""
    micro = 1e6
    first, second = (slice(None), 0), (slice(None), 1)
    halves = (("before", first), ("after", second))
    inside = Must("within", (0.8, 1.2))
    table = [
        rms(f"100 Hz, {name}, {angle}", m[f"100 Hz {name}"]["all"][:, i], "1e-4 rad", 1e4,
            Must("within", (middle * 0.98, middle * 1.02)))
        for name in FOUR
        for i, angle, middle in ((0, "roll", 5.5), (1, "heading", 3.35), (2, "pitch", 5.5))
    ]  # fmt: skip
    rows = {
        "arcmin": ("Misalignment in arc minutes", "39.8 microrad, 11.1 %, 0.54, 1.94", (
            rms("EKF", m["arcmin EKF"]["settled"][:, 0], "microrad", micro,
                Must("within", (38.0, 42.0))),
            gain(m, "arcmin", "MMAE-EKF", "EKF", Must("within", (9.0, 13.0))),
            gain(m, "arcmin", "MMAE-UKF", "EKF", Must("within", (9.0, 13.0))),
            excess(m, "arcmin", "MMAE-EKF", "true Q", Must("below", 0.5)),
            scale(m, "arcmin MMAE-UKF", 500, Must("within", (0.4, 0.7))),
            scale(m, "arcmin MMAE-UKF", 750, Must("within", (1.7, 2.3))))),
        "deg": ("Misalignment in degrees", "1.4, 10.4, 12.3 %", (
            gain(m, "deg", "UKF", "EKF", Must("within", (0.5, 3.0))),
            gain(m, "deg", "MMAE-EKF", "EKF", Must("above", 3.0)),
            gain(m, "deg", "MMAE-UKF", "EKF", Must("within", (10.0, 14.0))))),
        "no-floor": ("Without a floor the weights are locked in", "1.04, 4.0 %", (
            scale(m, "arcmin no floor", 600, Must("below", 1.3)),
            gain(m, "arcmin", "no floor", "EKF", Must("below", 6.0)))),
        "table-2": ("All epochs at 100 Hz", "5.5, 3.35, 5.5; differences of 0.03 to 0.8 %", (
            *table, number("largest difference of the four filters", spread(m).max(),
                           Must("below", 1.5), "%"))),
        "consistent": ("True Q and the bank are consistent, the fixed Q is not",
                       "0.99 / 0.99; 0.91 / 1.01; 0.80 / 1.54", (
            interval("true Q: NIS / 3", m["arcmin true Q"]["nis"][:, 0],
                     lambda d: d.mean(axis=-1), "", Must("within", (0.97, 1.03))),
            *(rms(f"MMAE-EKF: error over sigma, {name} the change",
                  m["arcmin MMAE-EKF"]["normalised"][h], "", 1.0, inside) for name, h in halves),
            rms("EKF: the same, before", m["arcmin EKF"]["normalised"][first], "", 1.0,
                Must("below", 0.9)),
            rms("EKF: the same, after", m["arcmin EKF"]["normalised"][second], "", 1.0,
                Must("above", 1.3)))),
        "star": ("The gain falls with the star tracker's noise", "13.1, 11.1, 9.9, 7.1 %", tuple(
            gain(m, cell, "MMAE-EKF", "EKF", Must("within", (middle - 1.5, middle + 1.5)))
            for cell, middle in (("star 3 arcsec", 13.1), ("arcmin", 11.1),
                                 ("star 30 arcsec", 9.9), ("star 120 arcsec", 7.1)))),
        "definite": ("No update is refused and no covariance indefinite", "none", (
            number("flights with a mishap", sum(
                x["mishaps"].any(axis=1).sum() for x in m.values() if "mishaps" in x),
                Must("below", 0.0)),)),
    }  # fmt: skip
    return [
        Claim(f"mmae-prototype-{key}", claim, PROTOTYPE, theirs, ours,
              "other seeds, another implementation" + (
                  "; twelve flights leave the gain at 120 arcsec uncertain by two points"
                  if key == "star" else ""), target=True)
        for key, (claim, theirs, ours) in rows.items()
    ]  # fmt: skip


def speed() -> Claim:
    """CPU time of the thread, the best of some."""
    taken = {}
    for name, star_hz, repeats in (("EKF", 10, REPEATS), ("MMAE-UKF", 10, REPEATS),
                                   ("MMAE-UKF", 100, 2)):  # fmt: skip
        world, best = draw(FIRST_SEED, Setting("deg", star_hz=star_hz)), np.inf
        for _ in range(repeats):
            began = time.thread_time()
            estimate(world, FOUR[name])
            best = min(best, time.thread_time() - began)
        taken[f"{name}, fixes at {star_hz} Hz, CPU time"] = best
    bounds = (0.15, 1.5, 10.0)
    return Claim("mmae-speed", "1000 s with a fix each 10 ms take ten UKFs at most 10 s of CPU",
                 OURS, "10 s", tuple(number(name, best, Must("below", bound), "s")
                                     for (name, best), bound in zip(taken.items(), bounds,
                                                                    strict=True)),
                 f"the whole run is one compiled call; the best of {REPEATS}, at 100 Hz of 2",
                 target=True)  # fmt: skip
