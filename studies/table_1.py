"""Table 1: SNR, convergence and run time, in uniform and accelerated motion and in the jump.

Xu, Zeng & Huang (2017), Table 1: FIQKF has 2.04 dB more SNR than the QKF in uniform motion and
2.15 dB more in accelerated motion, converges in 50 of 50 jumps where the QKF does in 44, and takes
0.159 s where the QKF takes 0.128 s.  "SNR" and "converged" are not defined there.  Here: SNR_v =
10 log10(sum |v|^2 / sum |error of v|^2) over all epochs; the coherent loss 20 log10(mean cos of
the phase error), from 5 s on, as the second definition; converged: below 0.5 m/s r.m.s. in the
last 2.5 s.  Model C; the scale factor is N(0, 2000 ppm) on each axis.  Expected from a prototype:
no gain in steady motion, where a fading factor can only lose.
"""

from __future__ import annotations

import json
import time

import numpy as np
import xarray as xr
from common.campaign import Campaign, Study, carry_out
from common.ledger import Claim, Must
from common.statistics import count, mean, number, typical
from common.worlds import CAUSE_OFF, MODELS, filters

import ultratight

MOTIONS = {"uniform": "uniform", "accelerated": "accelerated", "jump": "jump-1"}
LABELS = ("KF", "QKF", "FIQKF", "FIQKF-R", "QKF+intQ", "JTQ-R")
DRAWN = CAUSE_OFF | {
    "imu.accel_scale_factor_alternates": False,
    "imu.accel_scale_factor_sigma_ppm": 2000.0,
}
SCENARIOS = {motion: ultratight.load(preset, DRAWN) for motion, preset in MOTIONS.items()}
RUNS, FIRST_SEED = 50, 101
EPOCH_S, SETTLED_S = 0.02, 5.0
TIMED = ("KF", "QKF", "FIQKF-R", "JTQ", "JTQ-R")
REPEATS = 7

CAMPAIGNS = {
    motion: Campaign(
        preset,
        {"filter": filters(*LABELS)},
        RUNS,
        FIRST_SEED,
        keep=("velocity_error", "speed_true", "lock_indicator"),
        every_s=EPOCH_S,
    )
    for motion, preset in SCENARIOS.items()
}
PAPER_DB = {"uniform": 2.04, "accelerated": 2.15}


def main() -> None:
    """Fly, tabulate, judge."""
    study = Study(__file__, CAMPAIGNS)
    flown = {motion: with_snr(study.fly(motion)) for motion in MOTIONS}
    for motion, ds in flown.items():
        study.table(
            f"{motion}, scale factors N(0, 2000 ppm)", ds, ("snr_db", "settled_db", "loss_db")
        )
    claims = [gain(motion, flown[motion]) for motion in PAPER_DB]
    claims += [loss(flown), in_the_jump(flown["jump"]), printed(flown), run_time(study)]
    study.conclude(claims)


def with_snr(ds: xr.Dataset) -> xr.Dataset:
    """Both definitions of SNR for each run; the signal is the same, whatever is estimated."""
    settled = ds["t_s"] > SETTLED_S
    power, noise = ds["speed_true"] ** 2, ds["error"] ** 2
    in_phase = ds["lock_indicator"].where(settled).mean("t_s").clip(1e-3)

    def decibels(kept: xr.DataArray) -> xr.DataArray:
        ratio = power.where(kept).sum("t_s") / noise.where(kept, 0.0).sum("t_s", skipna=False)
        return 10.0 * np.log10(ratio)

    return ds.assign(
        snr_db=decibels(settled | True),
        settled_db=decibels(settled),
        loss_db=20.0 * np.log10(in_phase),
    )


def difference(db: xr.DataArray) -> np.ndarray:
    """FIQKF-R minus QKF, run by run."""
    return (db.sel(filter="FIQKF-R") - db.sel(filter="QKF")).values


def gain(motion: str, ds: xr.Dataset) -> Claim:
    """Two decibels in steady motion."""
    snr, settled = ds["snr_db"], ds["settled_db"]
    must = Must("covers", PAPER_DB[motion])
    return Claim(
        id=f"table-1-{motion}",
        claim=f"FIQKF has {PAPER_DB[motion]} dB more SNR than the QKF in {motion} motion",
        source="Xu et al. 2017, Table 1",
        theirs=f"+{PAPER_DB[motion]} dB",
        ours=(
            mean("FIQKF-R − QKF, paired", difference(snr), "dB", must),
            mean("the same from 5 s on", difference(settled), "dB", must),
            mean("QKF", snr.sel(filter="QKF").values, "dB"),
            mean("QKF from 5 s on", settled.sel(filter="QKF").values, "dB"),
        ),
        change="model C, SNR of the velocity, regularised fading",
        why="where the filter's model holds the QKF is the best linear filter; inflating its "
        "covariance can only lose",
    )


def loss(flown: dict[str, xr.Dataset]) -> Claim:
    """The second definition of SNR."""
    quantities = []
    for motion in PAPER_DB:
        db = flown[motion]["loss_db"]
        paired = (db.sel(filter="FIQKF-R") - db.sel(filter="QKF")).values
        quantities.append(mean(f"FIQKF-R − QKF, {motion}", paired, "dB",
                               Must("above", 1.0, "high")))  # fmt: skip
    return Claim(
        id="table-1-coherent-loss",
        claim="FIQKF's SNR is higher by some 2 dB, read as coherent correlation loss",
        source="Xu et al. 2017, Table 1",
        theirs="+2.04 and +2.15 dB",
        ours=tuple(quantities),
        change="model C, regularised fading",
        why="in lock the loss is some hundredths of a decibel: there is nothing to gain",
    )


def in_the_jump(ds: xr.Dataset) -> Claim:
    """Convergence in the jump."""
    qkf, fading = (ds.sel(filter=name) for name in ("QKF", "FIQKF-R"))
    only = (fading["converged"] & ~qkf["converged"]).values
    return Claim(
        id="table-1-jump",
        claim="In the jump FIQKF always converges, the QKF does not",
        source="Xu et al. 2017, Table 1",
        theirs="50 of 50 against 44 of 50",
        ours=(
            count("QKF converged", qkf["converged"].values, Must("below", 0.96)),
            count("FIQKF-R converged", fading["converged"].values, Must("above", 0.98)),
            count("FIQKF-R only", only),
            mean("SNR, FIQKF-R − QKF, paired", difference(ds["snr_db"]), "dB"),
            typical("the same, median", difference(ds["snr_db"]), "dB"),
        ),
        change="model C, regularised fading, drawn scale factors",
        why="how many are lost depends on the scale factors drawn: a smaller sigma, fewer losses",
    )


def printed(flown: dict[str, xr.Dataset]) -> Claim:
    """The literal filter has no entry in the table."""
    hits = [ds["converged"].sel(filter="FIQKF").values for ds in flown.values()]
    return Claim(
        id="table-1-as-printed",
        claim="FIQKF as printed converges in all three motions",
        source="Xu et al. 2017, Table 1",
        theirs="50 of 50",
        ours=(count("FIQKF converged, C", np.concatenate(hits), Must("above", 0.98)),),
        why="the fading of all states at 50 Hz diverges even in uniform motion",
    )


def run_time(study: Study) -> Claim:
    """Thread CPU time of whole runs, filters in turn, the best of some repeats."""
    seconds = 10.0 if study.quick else 50.0
    short = {} if seconds == 50.0 else {"duration_s": seconds, "profile": []}
    timed = {
        label: ultratight.load("jump-1", MODELS["C"] | change | short)
        for label, change in filters(*TIMED).items()
    }
    best = dict.fromkeys(timed, np.inf)
    for _ in range(REPEATS + 1):  # the first one compiles, and is never the best
        for label, scenario in timed.items():
            start = time.thread_time()
            ultratight.run(scenario, FIRST_SEED)
            best[label] = min(best[label], time.thread_time() - start)
    study.say("run time, CPU seconds of a run: " + json.dumps(best))
    ratios = tuple(
        number(f"{label} / QKF", best[label] / best["QKF"], bounds)
        for label, bounds in (
            ("FIQKF-R", Must("within", (1.0, 1.5))),
            ("KF", None),
            ("JTQ", None),
            ("JTQ-R", None),
        )
        if label in best
    )
    return Claim(
        id="table-1-run-time",
        claim="FIQKF takes 1.24 times the QKF's time",
        source="Xu et al. 2017, Table 1",
        theirs="0.128 s and 0.159 s",
        ours=(*ratios, number("QKF", best["QKF"], None, "s of CPU per run")),
        change="model C, regularised fading; whole runs with truth, IMU and taps",
        why=f"the best of {REPEATS} runs of each in turn, in one process",
    )


if __name__ == "__main__":
    carry_out(main)
