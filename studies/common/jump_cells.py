"""The plan of the jump-triggered filter's final run, `beyond_fiqkf.toml`, as campaigns."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import partial

import numpy as np

from common.campaign import HOME, Campaign
from common.motions import turns, vibration, window
from common.worlds import MECHANISMS, MODELS, filters, mechanisms
from ultratight.filters.catalog import make_filter
from ultratight.filters.jump_triggered import JTQ

PLAN = tomllib.loads((HOME / "beyond_fiqkf.toml").read_text())
RUNS, SEED = PLAN["runs"], PLAN["first_seed"]
GRID, OUTSIDE, BARS = PLAN["grid"], PLAN["envelope"], PLAN["bars"]
CASES = tuple(GRID["cases"])
(BEST,) = GRID["filters"]
C = {"C": MODELS["C"]}


def envelope() -> dict[str, dict[str, object]]:
    """Cells that lie outside what the sizes of the filter were made for."""
    base = MECHANISMS[OUTSIDE["mechanism"]]
    cells: dict[str, dict[str, object]] = {name: MECHANISMS[name] for name in OUTSIDE["causes"]}
    cells |= {f"{n} satellites": base | {"max_satellites": n} for n in OUTSIDE["satellites"]}
    cells |= {f"{x:g} dB-Hz": base | {"cn0_dbhz": x} for x in OUTSIDE["cn0_dbhz"]}
    shake, turn = OUTSIDE["vibration_rms_g"], OUTSIDE["turn_g"]
    cells[f"vibration {shake:g} g r.m.s."] = base | window(vibration(shake, 10.0, 40.0))
    cells[f"turns of {turn:g} g"] = base | window(turns(turn, 200.0, (20.0, 30.0, 40.0)))
    return cells


RECEIVERS = {
    "QKF, D": MODELS["D"] | {"receiver.filter": "qkf"},
    "JTQ-R, C": MODELS["C"] | {"receiver.filter": "jtq-r"},
    "JTQ-R, C, fall-back": MODELS["C"] | {"receiver.filter": "jtq-r", "receiver.fall_back": True},
}
ABLATED = {
    "QKF, 4 passes": partial(make_filter, "qkf3", iterations=4),
    "JTQ, 1 pass": partial(make_filter, "jtq", iterations=1),
    "JTQ, rho = 0": partial(make_filter, "jtq", several=replace(JTQ, spill=0.0)),
    "JTQ, kappa = 0": partial(make_filter, "jtq", several=replace(JTQ, load=0.0)),
    "JTQ, no score test": partial(make_filter, "jtq", several=replace(JTQ, gate=np.inf)),
}


def campaigns() -> dict[str, Campaign]:
    """Everything that the plan asks for."""
    grid = mechanisms(*GRID["mechanisms"])
    models = {m: MODELS[m] for m in GRID["models"]}
    plain = {"model": models, "filter": filters("QKF")}
    made = {}
    for case in CASES:
        preset = f"jump-{case}"
        over = {"model": models, "mechanism": grid, "filter": filters(*GRID["filters"])}
        made[f"case-{case}"] = Campaign(preset, over, RUNS, SEED)
        if case in PLAN["prototype"]["cases"]:
            over = over | {"filter": filters(*PLAN["prototype"]["filters"])}
            runs = PLAN["prototype"]["runs"]
            made[f"case-{case}-prototype"] = Campaign(preset, over, runs, SEED)
        baseline = plain | {"mechanism": mechanisms("none")}
        made[f"case-{case}-qkf"] = Campaign(preset, baseline, RUNS, SEED)
    harmless = mechanisms(*PLAN["harmless"]["mechanisms"])
    made["harmless"] = Campaign(
        "jump-2",
        {"model": models, "mechanism": harmless, "filter": filters(*GRID["filters"])},
        RUNS,
        SEED,
    )
    for name, preset in (("relatives", "jump-2"), ("ramps", "jump-4")):
        over = {"model": C, "mechanism": grid, "filter": filters(*PLAN[name]["filters"])}
        made[name] = Campaign(preset, over, RUNS, SEED)
    made["envelope"] = Campaign("jump-2", {"cell": envelope(), "receiver": RECEIVERS}, RUNS, SEED)
    some = mechanisms(*PLAN["ablations"]["mechanisms"])
    names = {name: {"receiver.filter": name} for name in ABLATED}
    for name, preset, causes in (
        ("ablations", "jump-2", some),
        ("ablations-ramps", "jump-4", mechanisms("saturation 10 g")),
    ):
        over = {"model": C, "mechanism": causes, "filter": filters("QKF", "JTQ") | names}
        made[name] = Campaign(preset, over, PLAN["ablations"]["runs"], SEED, filters=ABLATED)
    samples = {"samples": {"correlator.kind": "samples"}}
    made["samples"] = Campaign(
        "jump-2",
        {"model": C, "mechanism": grid, "correlator": samples, "filter": filters(BEST)},
        1,
        SEED,
        weight=12.0,
    )
    return made
