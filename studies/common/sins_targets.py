"""Acceptance figures of ACEKF by an independent prototype, and the cost of a flight."""

from __future__ import annotations

import time

import numpy as np

from common.ledger import Claim, Must
from common.sins_cells import CELLS, FILTERS, FIRST_SEED, Merits
from common.sins_flight import LARGE, draw, fly
from common.sins_measures import averaged, gain
from common.statistics import number

PROTOTYPE, REPEATS = "independent prototype", 7


def prototype(m: dict[str, Merits], single: dict[float, dict[str, float]]) -> list[Claim]:
    """Acceptance figures, from other seeds and another implementation."""
    none = {n: m[f"none {n}"]["twelve"][:, 6:].mean(0) for n in CELLS["none"]}
    quiet = [
        number(f"no anomaly, RMSE {n} / EKF, furthest from 1",
               1.0 + np.abs(none[n] / none["EKF"] - 1.0).max(), Must("below", bound))
        for n, bound in (("REKF", 1.1), ("AEKF", 1.1), ("ACEKF", 1.1), ("ACEKF, both", 1.4))
    ]  # fmt: skip
    normal = m["none ACEKF"]
    swap, base = (m[f"BASE white {n}"]["twelve"][:, 9:].mean(0) for n in
                  ("ACEKF, swapped", "ACEKF"))  # fmt: skip
    within = Must("within", (-15.0, 15.0))
    classes_a = m["T1 ar ACEKF"]["classes"]
    rows = {
        "quiet": ("Without anomalies all filters are alike", "4 to 6 %, 24 % with both", (
            *quiet,
            averaged("normalised velocity error, largest", normal["normalised"], "",
                     Must("below", 1.6)),
            averaged("class B without cause", normal["share_b"], "",
                     Must("within", (0.28, 0.42))))),
        "classes": ("Windows are told apart", "0.98 to 1", (
            averaged("class A in 1, 4", classes_a[:, LARGE, 2], "", Must("above", 0.95), "min"),
            averaged("class B in 2, 3, 5, 6", classes_a[:, [1, 2, 4, 5], 1], "",
                     Must("above", 0.90), "min"))),
        "ekf": ("Gain over EKF", "96.7 / 94.7, 90.8, 94.2 %", (
            gain(m, "T1 ar", "EKF", False, Must("above", 94.0)),
            gain(m, "T1 ar", "EKF", True, Must("above", 90.0)),
            gain(m, "T1 white", "EKF", False, Must("above", 86.0)),
            gain(m, "T1 bias", "EKF", False, Must("above", 88.0)),
            averaged("T1 ar, EKF: RMSE of position", m["T1 ar EKF"]["twelve"][:, 9:], "m",
                     Must("above", 80.0), "min"),
            averaged("T1 ar, ACEKF: RMSE of position", m["T1 ar ACEKF"]["twelve"][:, 9:], "m",
                     Must("below", 10.0)))),
        "others": ("Gains over REKF and AEKF", "-0.1, 8.4; 31.8, 60.2 % with windows of 50", (
            gain(m, "T1 ar", "REKF", False, within),
            gain(m, "T1 ar", "AEKF", False, Must("within", (-10.0, 25.0))),
            gain(m, "T1 ar", "REKF 50", False, Must("within", (15.0, 45.0))),
            gain(m, "T1 ar", "AEKF 50", False, Must("within", (45.0, 70.0))))),
        "swapped": ("With the classes exchanged the filter is ruined", "2 to 155 times", (
            number("BASE white, RMSE of position, swapped / ACEKF, least", (swap / base).min(),
                   Must("above", 5.0)),)),
        "ud": ("UD equals the plain form in double precision, and is better in single, R x 1e-8",
               "1e-11; 5e-6 against 0.43", (
            number("largest difference of an output", m["forms"]["off"].max(),
                   Must("below", 1e-6), "m, m/s"),
            number("UD, single", single[1e-8]["UD, single"], Must("below", 1e-4)),
            number("short form, single", single[1e-8]["short, single"], Must("above", 1e-2)))),
    }  # fmt: skip
    return [
        Claim(f"acekf-prototype-{key}", claim, PROTOTYPE, theirs, ours,
              "other seeds, another implementation", target=True)
        for key, (claim, theirs, ours) in rows.items()
    ]  # fmt: skip


def speed() -> Claim:
    """CPU time of the thread for 1000 s of four filters, the best of some."""
    world, best = draw(FIRST_SEED), np.inf
    for _ in range(REPEATS):
        began = time.thread_time()
        for name in ("EKF", "REKF", "AEKF", "ACEKF"):
            fly(world, FILTERS[name])
        best = min(best, time.thread_time() - began)
    return Claim("acekf-speed", "1000 s at 200 Hz with four filters take at most 1 s of CPU",
                 "this project", "2 s, 1 s at best",
                 (number("four filters", best, Must("below", 1.0), "s"),),
                 f"the best of {REPEATS}", target=True)  # fmt: skip
