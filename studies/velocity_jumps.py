"""Velocity jumps in four cases: which filter keeps lock, and does it matter without the cause?

Xu, Zeng & Huang (Geom. Inf. Sci. Wuhan Univ. 42(12), 2017), Figs. 3-6: at the jump the velocity
error of the KF and the QKF grows, that of the fading-factor interval filter (FIQKF) stays small.
With an IMU that obeys the filter's model nothing can happen at a jump.  The cause here is an
accelerometer scale factor that no state describes: 3000 ppm with the coherent measurement (C),
5000 ppm with the differential one (D), an industrial MEMS part without temperature calibration;
35 dB-Hz, fall-back to D off.  Expected from an independent prototype: KF = QKF, both lose lock in
C; the fading as printed diverges; its regularised forms hold.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from common.campaign import Campaign, Study, carry_out, speed_profile
from common.figures import velocity_page
from common.ledger import Claim, Must
from common.statistics import count, typical
from common.worlds import CAUSE_OFF, MODELS, filters

CASES = ("1", "2", "3", "4")
ONE = ("KF", "QKF", "FIQKF", "FIQKF-R", "FIQKF-C", "QKF+intQ", "20-state", "QKF+vrw")
SEVERAL = ("IMM2", "JTQ", "JTQ-R")
"""Filters with one Gaussian, and with several hypotheses"""
GROUPS = (("KF", "QKF"), ("FIQKF", "FIQKF-R"), ("FIQKF-C", "QKF+intQ"), ("20-state", "QKF+vrw"),
          ("IMM2", "JTQ", "JTQ-R"))  # fmt: skip
ON = {"C": MODELS["C"], "D": MODELS["D"] | {"imu.accel_scale_factor_ppm": [5000.0, 0.0, 0.0]}}
OFF = {name: change | CAUSE_OFF for name, change in MODELS.items()}
FEW = ("QKF", "FIQKF-R", "JTQ-R")

ON_RUNS, OFF_RUNS, FALL_BACK_RUNS = 50, 10, 10


def campaigns(case: str) -> dict[str, Campaign]:
    """What is flown of one case: the cause on and off, with fall-back, from samples."""
    preset = f"jump-{case}"
    few = filters(*FEW)
    fall_back = {"on": {"receiver.fall_back": True}}
    samples = {"samples": {"correlator.kind": "samples"}}
    kept = ("velocity_error",)
    made = {
        f"{cause}-{kind}": Campaign(preset, {"model": worlds, "filter": filters(*labels)}, runs,
                                    keep=kept)
        for cause, worlds, runs in (("on", ON, ON_RUNS), ("off", OFF, OFF_RUNS))
        for kind, labels in (("one", ONE), ("several", SEVERAL))
    }  # fmt: skip
    return made | {
        "fall-back": Campaign(
            preset,
            {"model": {"C": ON["C"]}, "fall_back": fall_back, "filter": few},
            FALL_BACK_RUNS,
        ),
        "samples": Campaign(
            preset, {"model": ON, "correlator": samples, "filter": few}, 1, weight=12.0
        ),
    }


CAMPAIGNS = {f"case-{case}-{name}": c for case in CASES for name, c in campaigns(case).items()}


def main() -> None:
    """Fly, draw, judge."""
    study = Study(__file__, CAMPAIGNS)
    on, off = (
        {c: study.fly(f"case-{c}-{cause}-one", f"case-{c}-{cause}-several") for c in CASES}
        for cause in ("on", "off")
    )
    fall_back, samples = (
        {c: study.fly(f"case-{c}-{name}") for c in CASES} for name in ("fall-back", "samples")
    )
    for case in CASES:
        for model in MODELS:
            draw(study, case, model, on[case], off[case])
        study.table(f"case {case}, cause on", on[case])
        study.table(f"case {case}, cause off", off[case])
    claims = [shape(case, model, on[case]) for model in MODELS for case in CASES]
    claims += [as_printed(on), kalman(on), no_cause(off), not_consistent(on)]
    claims += rivals(on)
    claims += [cured(fall_back), from_samples(on, samples)]
    study.conclude(claims)


def draw(study: Study, case: str, model: str, on: xr.Dataset, off: xr.Dataset) -> None:
    """The paper's figure, and the same with the cause switched off beside it."""
    ppm = ON[model].get("imu.accel_scale_factor_ppm", [3000.0])[0]
    present = set(on["filter"].values)
    groups = [[name for name in group if name in present] for group in GROUPS]
    columns = {
        f"scale factor ±{ppm:.0f} ppm ({on.sizes['run']} runs)": on["error"].sel(model=model),
        f"cause switched off ({off.sizes['run']} runs)": off["error"].sel(model=model),
    }
    title = (
        f"Case {case}, model {model}: 35 dB-Hz, 10 GPS satellites, closed form, no fall-back\n"
        f"median and 10-90 % band; an accelerometer of {ppm:.0f} ppm is an industrial MEMS part"
    )
    page = velocity_page(
        speed_profile(f"jump-{case}"), columns, [group for group in groups if group], title
    )
    study.figure(f"jump_{case}_{model}", page)


# -- claims ---------------------------------------------------------------------------------------


def shape(case: str, model: str, on: xr.Dataset) -> Claim:
    """The paper's main figure."""
    mine = on.sel(model=model)
    qkf, fading = mine.sel(filter="QKF"), mine.sel(filter="FIQKF-R")
    ratio = (qkf["jump"] / fading["jump"]).values
    return Claim(
        id=f"jump-{case}-{model}",
        claim=f"Case {case}, model {model}: QKF's error grows and stays, FIQKF's is small, returns",
        source=f"Xu et al. 2017, Fig. {int(case) + 2}",
        theirs="figure only",
        ours=(
            count("QKF converged", qkf["converged"].values, Must("below", 0.5)),
            count("FIQKF-R converged", fading["converged"].values, Must("above", 0.9)),
            typical("QKF / FIQKF-R in the jump", ratio, "", Must("above", 2.0, "low")),
            typical("FIQKF-R in the jump", fading["jump"].values, "m/s"),
        ),
        change=f"model {model}, regularised fading, and a cause that the paper does not name",
        why=WHY[case, model],
    )


WHY = {
    ("1", "C"): "the QKF loses phase lock within seconds of the jump; the fading opens velocity "
    "and phase behind its gate",
    ("2", "C"): "as case 1, at each change of acceleration",
    ("3", "C"): "the jump begins while the covariance is open: the bias states absorb the error",
    ("4", "C"): "each ramp is a new surprise that no single bias describes",
    ("1", "D"): "frequency lock is not lost at once: the QKF stays wrong by the scale factor's "
    "velocity",
    ("2", "D"): "as case 1",
    ("3", "D"): "as in model C",
    ("4", "D"): "the QKF keeps frequency lock: the fading has little to save",
}


def as_printed(on: dict[str, xr.Dataset]) -> Claim:
    """The literal filter."""
    hits = [ds["converged"].sel(filter="FIQKF", model=m).values for ds in on.values() for m in "CD"]
    return Claim(
        id="jump-as-printed",
        claim="The fading-factor interval QKF as printed keeps lock",
        source="Xu et al. 2017, Figs. 3-6",
        theirs="it does, in all four cases",
        ours=(count("FIQKF converged, C and D", np.concatenate(hits), Must("above", 0.9)),),
        why="the mean of max(1, lambda) exceeds 1: at 50 Hz the unobservable states grow without "
        "bound, and the first acceleration turns that into velocity",
    )


def kalman(on: dict[str, xr.Dataset]) -> Claim:
    """Does the quadrature help at the jump?"""
    pairs = [ds["jump"].sel(model="C") for ds in on.values()]
    ratio = np.concatenate([(p.sel(filter="KF") / p.sel(filter="QKF")).values for p in pairs])
    return Claim(
        id="jump-kf-worse",
        claim="The KF's error in the jump exceeds the QKF's",
        source="Xu et al. 2017, Figs. 3-6",
        theirs="clearly, by eye",
        ours=(typical("KF / QKF in the jump, C", ratio, "", Must("above", 1.1, "low")),),
        why="before the jump the phase s.d. is below 0.05 rad: there is no nonlinearity to capture",
    )


def no_cause(off: dict[str, xr.Dataset]) -> Claim:
    """The negative control."""
    c = [ds.sel(model="C") for ds in off.values()]
    gaps = [abs(d["jump"].sel(filter="QKF") - d["jump"].sel(filter="FIQKF-R")).values for d in c]
    held = [d["converged"].sel(filter=["QKF", "FIQKF-R"]).values.ravel() for d in c]
    return Claim(
        id="jump-no-cause",
        claim="Without the cause nothing happens at the jump, and no filter is better",
        source="independent prototype, 20 seeds",
        theirs="QKF = FIQKF-R; 157 of 160 converge",
        ours=(
            count("QKF and FIQKF-R converged, C", np.concatenate(held), Must("above", 0.95)),
            typical("|QKF − FIQKF-R| in the jump", np.concatenate(gaps), "m/s",
                    Must("below", 0.03, "high")),
        ),
        why="truth, IMU and signals come from one motion",
    )  # fmt: skip


def not_consistent(on: dict[str, xr.Dataset]) -> Claim:
    """FIQKF-R's covariance in the jump."""
    nees = on["1"]["nees"].sel(model="C", filter="FIQKF-R").values
    return Claim(
        id="jump-fading-nees",
        claim="FIQKF-R keeps lock, but its covariance in the jump is far too small",
        source="independent prototype, case 1, model C",
        theirs="NEES over its expectation 324",
        ours=(typical("NEES / chi2 median", nees, "", Must("above", 50.0, "low")),),
        why="between two openings of the gate the filter believes its nominal noise",
    )


RIVALS = {
    "QKF+intQ": ("interval bounds turned into process noise", 0.029),
    "20-state": ("three scale-factor states", 0.034),
    "QKF+vrw": ("a constant velocity noise of 0.1 m/s/√s", 0.036),
    "FIQKF-C": ("fading of all states, clamped at the first covariance", 0.050),
    "IMM2": ("two models, no knowledge of the cause", 0.039),
    "JTQ": ("jump-triggered quadrature filter, no knowledge of the cause", 0.015),
    "JTQ-R": ("JTQ made robust, no knowledge of the cause", None),
}
"""Label -> what it is, and the prototype's error in the jump of case 2 (case 1 for the first three)
in model C [m/s]"""


def rivals(on: dict[str, xr.Dataset]) -> list[Claim]:
    """What beats the fading factor, cases 1 and 2 in model C."""
    claims = []
    c = xr.concat([on[k].sel(model="C") for k in ("1", "2")], "run")
    fading = c["jump"].sel(filter="FIQKF-R")
    for label, (what, theirs) in RIVALS.items():
        if label not in c["filter"].values:
            continue
        mine = c.sel(filter=label)
        claims.append(
            Claim(
                id=f"jump-rival-{label.lower()}",
                claim=f"{label} ({what}) beats FIQKF-R in the jump",
                source="independent prototype, model C" if theirs else "this project's aim",
                theirs=f"{theirs:g} m/s against 0.13 m/s" if theirs else "better than JTQ's 0.015",
                target=theirs is None,
                ours=(
                    typical(
                        f"{label} / FIQKF-R",
                        (mine["jump"] / fading).values,
                        "",
                        Must("below", 1.0, "high"),
                    ),
                    typical("in the jump", mine["jump"].values, "m/s"),
                    typical("before it", mine["before"].values, "m/s"),
                    count("converged", mine["converged"].values, Must("above", 0.95)),
                ),
                why="cases 1 and 2, paired by seed",
            )
        )
    return claims


def cured(flown: dict[str, xr.Dataset]) -> Claim:
    """The fall-back."""
    hits = [ds["converged"].sel(filter="QKF").values.ravel() for ds in flown.values()]
    return Claim(
        id="jump-fall-back",
        claim="A fall-back to the differential measurement lets the plain QKF recover",
        source="independent prototype, case 1",
        theirs="10 of 10",
        ours=(count("QKF converged, cases 1-4", np.concatenate(hits), Must("above", 0.95)),),
        why="hence no fall-back wherever the paper's claim is judged",
    )


def from_samples(on: dict[str, xr.Dataset], samples: dict[str, xr.Dataset]) -> Claim:
    """Do IF samples tell the same story as the closed form?"""
    same, ratio = [], []
    for case, ds in samples.items():
        taps = ds.isel(correlator=0)
        model = on[case].sel(filter=taps["filter"], run=taps["run"])
        same.append((taps["converged"] == model["converged"]).values.ravel())
        both = taps["converged"] & model["converged"]
        ratio.append((taps["jump"] / model["jump"]).where(both).values.ravel())
    ratios = np.concatenate(ratio)
    return Claim(
        id="jump-samples",
        claim="IF samples tell the same story as the closed form",
        source="this project",
        theirs="the same mean and covariance of taps",
        ours=(
            count("same outcome, per case, model and filter", np.concatenate(same),
                  Must("above", 0.9)),
            typical("error in the jump, samples / closed form", ratios[np.isfinite(ratios)], "",
                    Must("within", (0.8, 1.25))),
        ),
        target=True,
        why=f"seed {int(next(iter(on.values()))['seed'][0])} of every case, {', '.join(FEW)}",
    )  # fmt: skip


if __name__ == "__main__":
    carry_out(main)
