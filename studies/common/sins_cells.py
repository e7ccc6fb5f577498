"""What the study `acekf` flies: filters, anomalies, and the figures of one flight."""

from __future__ import annotations

import numpy as np

from common.sins_flight import KINDS, WINDOWS, Aided, Flown, draw, fly
from ultratight.filters.classified import Classified

RUNS, FIRST_SEED = 12, 501
FILTERS = {
    "EKF": Aided("kf", {}),
    "REKF": Aided("kf-rekf", {}),
    "REKF 50": Aided("kf-rekf", {"weights": Classified("nis", 50, True, "channel")}),
    "AEKF": Aided("kf-aekf", {}),
    "AEKF 50": Aided("kf-aekf", {"weights": Classified("always", 50, True, "scalar")}),
    "ACEKF": Aided("kf-acekf", {}),
    "ACEKF, present in": Aided("kf-acekf", {"weights": Classified(current=True)}),
    "ACEKF, both": Aided("kf-acekf", {"weights": Classified(both=True)}),
    "chi-square test": Aided("kf-gate", {}),
    "true R": Aided("kf", {}, true_R=True),
}
SWAPPED = {"ACEKF, swapped": Aided("kf-acekf", {"weights": Classified(swapped=True)})}
PLAIN = {"ACEKF, P": Aided("kf-acekf", {"form": "plain"})}
CELLS = {
    **{f"T1 {kind}": FILTERS for kind in KINDS},
    "BASE ar": FILTERS,
    "BASE white": {n: FILTERS[n] for n in ("EKF", "ACEKF")} | SWAPPED,
    "none": {n: f for n, f in FILTERS.items() if n != "true R"},
}
"""Anomalies, and the filters that fly with them"""

Merits = dict[str, np.ndarray]


def merits(flown: Flown) -> dict[str, np.ndarray]:
    """Figures of one flight: (6,) channels, (6, ..) windows."""
    parts = [flown.error[a:b] for a, b in WINDOWS]
    return {
        "twelve": np.concatenate([np.abs(flown.error).mean(0), np.sqrt((flown.error**2).mean(0))]),
        "window_rmse": np.array([np.sqrt((p**2).mean(0)) for p in parts]),
        "peak": np.array([np.abs(p).max(0) for p in parts]),
        "classes": np.array([np.bincount(flown.kind[a:b], minlength=3) / (b - a)
                             for a, b in WINDOWS]),
        "share_b": np.mean(flown.kind == 1),
        "normalised": np.sqrt(((flown.error[:, :3] / flown.sigma[:, 3:6]) ** 2).mean(0)),
    }  # fmt: skip


def fly_seed(seed: int) -> dict[str, dict[str, np.ndarray]]:
    """Every filter in every cell of one seed, and what UD changes."""
    out = {}
    for cell, filters in CELLS.items():
        world = draw(seed, *(cell.split(" ") if " " in cell else (cell,)))
        for name, aided in filters.items():
            out[f"{cell} {name}"] = merits(flown := fly(world, aided))
            if cell == "T1 ar" and name == "ACEKF":
                plain = fly(world, PLAIN["ACEKF, P"])
                out["forms"] = {"off": np.abs(plain.error - flown.error).max()}
    return out
