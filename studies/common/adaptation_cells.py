"""Filters of the loop that adapt, what disturbs them, and the flights of each with each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import xarray as xr

from common.campaign import Campaign
from common.worlds import CAUSE_OFF, MODELS, Change

QKF = "QKF"
FAMILIES: dict[str, dict[str, str]] = {
    "none": {QKF: "qkf", "KF": "kf"},
    "Q": {
        "FIQKF-R": "fiqkf-r", "Sage-Husa Q": "kf-sage-husa-q", "IMM2": "imm2", "IMM3": "imm3",
        "MMAE": "mmae", "JTQ-R": "jtq-r",
    },
    "R and Q": {"Sage-Husa": "kf-sage-husa", "improved 1": "kf-sage-husa-1",
                "improved 2": "kf-sage-husa-2"},
    "R": {
        "Sage-Husa R": "kf-sage-husa-r", "residual R": "kf-residual-r",
        "forgetting": "kf-residual-forgetting", "ISHAKF": "kf-ishakf",
    },
    "weights": {
        "robust gain": "kf-robust-gain", "ACEKF": "kf-acekf", "REKF": "kf-rekf",
        "AEKF": "kf-aekf", "gate": "kf-gate",
    },
}  # fmt: skip
"""What is adapted -> label -> row of the catalogue: opened covariance or Q; R; channels' weights"""
ROWS = {label: row for rows in FAMILIES.values() for label, row in rows.items()}
SHOWN = ("FIQKF-R", "Sage-Husa", "Sage-Husa R", "ACEKF", "MMAE")
"""Beside the QKF over time"""
SAMPLED = (QKF, "Sage-Husa", "ACEKF")
TWIN = "improved 1"
"""The same filter as Sage-Husa, it is said below: a few runs show it"""
MORE = ("IMM3", "improved 2", "residual R", "forgetting", "robust gain", "REKF", "AEKF")
"""Flown after the others, in model C alone"""
FLOWN = {
    "C": tuple(label for label in ROWS if label != TWIN),
    "D": (QKF, "MMAE", "Sage-Husa", "Sage-Husa R", "ACEKF"),
}
RUNS, SEED = 20, 701

FAULTY = 6
BEGIN_S, END_S = 7.0, 20.0
JUMP_S, AFTER_S, LAST_S = 10.0, 30.0, 33.0
LEGS = [
    {"t0_s": t, "t1_s": t + 10.0, "accel0_mps2": a, "accel1_mps2": a}
    for t, a in ((JUMP_S, 100.0), (20.0, -100.0))
]
CASE_2 = {"profile": LEGS, "duration_s": LAST_S}
"""Case 2 of the velocity jumps, 10 s earlier, which saves time"""
JUMPS: dict[str, Change] = {"jump": CASE_2, "no cause": CASE_2 | CAUSE_OFF}


@dataclass(frozen=True)
class Judged:
    """A disturbance of uniform motion, from `BEGIN_S` on."""

    until_s: float
    what: Change
    position: bool = False  # judged by position

    @property
    def changes(self) -> Change:
        """Overrides of the preset."""
        row = {"t0_s": BEGIN_S, "t1_s": self.until_s, **self.what}
        return {"duration_s": END_S, "channel.disturbance": [row]}


STEPS = {
    "power all": Judged(12.0, {"cn0_change_db": -15.0}),
    "fault step": Judged(17.0, {"pseudorange_m": 100.0, "prns": [FAULTY]}, True),
}
SAID = {
    "jump": "jump with its cause",
    "no cause": "without its cause",
    "power all": "−15 dB, all",
    "fault step": "100 m, one satellite",
}


FACED = {"C": tuple(SAID), "D": ("jump", "power all", "fault step")}


def rows(labels: Sequence[str]) -> dict[str, Change]:
    """Overrides of these filters."""
    return {label: {"receiver.filter": ROWS[label]} for label in labels}


def campaigns(model: str) -> dict[str, Campaign]:
    """One per disturbance and part; of a jump and a fault also twins, and IF samples."""
    made = {}
    samples = {"taps": {"samples": {"correlator.kind": "samples"}}}
    for which in FACED[model]:
        step = STEPS.get(which)
        preset, weight = ("jump-2", 1.3) if step is None else ("uniform", 0.7)
        change = JUMPS[which] if step is None else step.changes
        world = {"model": {model: MODELS[model]}, "disturbance": {which: change}}
        name = f"{which}-{model}".replace(" ", "-")
        for part, labels in (
            ("", [x for x in FLOWN[model] if x not in MORE]),
            ("-more", [x for x in FLOWN[model] if x in MORE]),
        ):
            if labels:
                over = world | {"filter": rows(labels)}
                made[name + part] = Campaign(preset, over, RUNS, SEED, weight, KEPT)
        if which in ("jump", "fault step"):
            over = world | {"filter": rows(("Sage-Husa", TWIN))}
            made[f"{name}-twins"] = Campaign(preset, over, 3, SEED, weight, KEPT)
            over = world | samples | {"filter": rows(SAMPLED)}
            made[f"{name}-samples"] = Campaign(preset, over, 1, SEED, 12.0 * weight, KEPT)
    return made


KEPT = ("velocity_error", "position_error", "cn0")
CAMPAIGNS = campaigns("C") | campaigns("D")
Flown = dict[str, xr.Dataset]
"""Disturbance -> filter, run, t_s, with ``merit`` and ``quiet``"""
