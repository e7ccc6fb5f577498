"""C/N0 from 20 to 50 dB-Hz: errors, consistency, time to lose lock, for every closure and filter.

Uniform motion of 30 s with an IMU that obeys the filter's model, so that noise alone acts.  The
tracking threshold is the C/N0 at which 10 % of the channels lose lock within these 30 s, by linear
interpolation between the levels, with a bootstrap interval over the runs.  Expected: filters that
differ in the jump coincide here (phase s.d. below 0.1 rad: no nonlinearity, nothing to fade), and
the ultra-tight closure holds to lower C/N0 than channel loops.  The rest of the catalogue of
filters is flown beside it, fewer and shorter runs.
"""

from __future__ import annotations

from typing import get_args

import numpy as np
import xarray as xr
from common.campaign import Campaign, Study, carry_out
from common.ledger import Claim, Must, Quantity
from common.statistics import interval, typical
from common.thresholds import LOSS, crossing
from common.worlds import MATCHED, MODELS, Change
from matplotlib.figure import Figure

from ultratight.filters.catalog import CATALOG
from ultratight.plots import COLOURS, STYLES
from ultratight.scenario import Receiver

LEVELS = (20.0, 21.0, 22.0, 23.0, 24.0, 26.0, 28.0, 30.0, 35.0, 40.0, 50.0)
DURATION_S, RUNS = 30.0, 12
REST_LEVELS = (20.0, 22.5, 25.0, 27.5, 30.0, 35.0, 50.0)
REST_S, REST_RUNS = 15.0, 6
SETTLED_S, FIRST_SEED = 5.0, 501
LOOPS = tuple(
    c for c in get_args(Receiver.model_fields["closure"].annotation) if c != "ultra-tight"
)
MAIN = ("kf", "qkf", "fiqkf-r", "jtq-r")
SHOWN = (*LOOPS, "C qkf", "C fiqkf-r", "C jtq-r", "D qkf", "D fiqkf-r", "D jtq-r")


def world(duration_s: float) -> Change:
    """Errors count from `SETTLED_S` on."""
    return MATCHED | {"duration_s": duration_s, "jump_window_s": [SETTLED_S, duration_s]}


def tight(*names: str) -> dict[str, Change]:
    """Both measurements with each filter."""
    return {
        f"{model} {name}": change | {"receiver.filter": name}
        for model, change in MODELS.items()
        for name in names
    }


def _campaign(
    receivers: dict[str, Change], levels: tuple[float, ...], runs: int, duration_s: float
) -> Campaign:
    over: dict[str, dict[str, Change]] = {
        "receiver": {name: world(duration_s) | change for name, change in receivers.items()},
        "cn0_dbhz": {f"{x:g}": {"cn0_dbhz": x} for x in levels},
    }
    return Campaign("uniform", over, runs, FIRST_SEED, weight=duration_s / 50.0)


CAMPAIGNS = {
    "levels": _campaign(
        {name: {"receiver.closure": name} for name in LOOPS} | tight(*MAIN),
        LEVELS, RUNS, DURATION_S,
    ),
    "catalogue": _campaign(
        tight(*(name for name in CATALOG if name not in MAIN)), REST_LEVELS, REST_RUNS, REST_S
    ),
}  # fmt: skip


def main() -> None:
    """Fly, draw, judge."""
    study = Study(__file__, CAMPAIGNS)
    flown = {name: levelled(study.fly(name)) for name in CAMPAIGNS}
    for ds in flown.values():
        tabulate(study, ds)
    ds = flown["levels"]
    draw(study, ds)
    study.conclude([same(ds), *lower(ds["loss"]), fewer(ds["loss"]), consistent(ds)])


def levelled(ds: xr.Dataset) -> xr.Dataset:
    """C/N0 as numbers, and the share of channels that lost lock."""
    ds = ds.assign_coords(cn0_dbhz=[float(x) for x in ds["cn0_dbhz"].values])
    return ds.assign(loss=ds["n_lost"] / ds["n_satellites"])


def threshold(name: str, share: xr.DataArray) -> Quantity:
    """Where the mean over the runs crosses; the bootstrap draws runs."""
    levels = share["cn0_dbhz"].values
    return interval(
        f"{name} threshold",
        share.transpose("run", "cn0_dbhz").values,
        lambda drawn: crossing(levels, drawn.mean(axis=-2)),
        "dB-Hz",
    )


def gap(a: xr.DataArray, b: xr.DataArray, name: str, must: Must) -> Quantity:
    """Difference of two thresholds, runs drawn in pairs."""
    levels = a["cn0_dbhz"].values
    both = np.stack([x.transpose("run", "cn0_dbhz").values for x in (a, b)], axis=-1)

    def difference(drawn: np.ndarray) -> np.ndarray:
        average = drawn.mean(axis=-3)
        return crossing(levels, average[..., 0]) - crossing(levels, average[..., 1])

    return interval(name, both, difference, "dB", must)


# -- what is shown --------------------------------------------------------------------------------


def tabulate(study: Study, ds: xr.Dataset) -> None:
    """A line per receiver."""
    at, low = ds.sel(cn0_dbhz=35.0), ds.sel(cn0_dbhz=LEVELS[0])
    study.say("\ntracking threshold [dB-Hz]; at 35 dB-Hz velocity [m/s], position [m], NEES; "
              "median time to lose lock at 20 dB-Hz [s]")  # fmt: skip
    for name in ds["receiver"].values:
        q = threshold(str(name), ds["loss"].sel(receiver=name))
        first = low["first_loss_s"].sel(receiver=name).fillna(np.inf)
        v, p, n = (
            float(at[k].sel(receiver=name).median("run")) for k in ("jump", "position_end", "nees")
        )
        study.say(
            f"{q.name:34} {q.value:5.1f} [{q.low:.1f}, {q.high:.1f}]  {v:.4f}  {p:.2f}  {n:.2f}  "
            f"{float(first.median('run')):.1f}"
        )


PANELS = (
    ("jump", "velocity error\n[m/s]", True),
    ("position_end", "position error\n[m]", True),
    ("loss", f"channels lost\nin {DURATION_S:g} s", False),
    ("nees", "NEES / chi2\nmedian", True),
)


def draw(study: Study, ds: xr.Dataset) -> None:
    """Medians over the runs against C/N0."""
    shown = [name for name in SHOWN if name in ds["receiver"].values]
    page = Figure(figsize=(7.5, 9.0), layout="constrained")
    axes = page.subplots(len(PANELS), 1, sharex=True)
    for ax, (key, text, logarithmic) in zip(axes, PANELS, strict=True):
        for k, name in enumerate(shown):
            values = ds[key].sel(receiver=name)
            middle = values.mean("run") if key == "loss" else values.median("run")
            ax.plot(ds["cn0_dbhz"], middle, STYLES[k % 4], color=COLOURS[k % 7], marker=".",
                    label=name)  # fmt: skip
        ax.set_ylabel(text, fontsize=8.0)
        ax.grid(True, alpha=0.3)
        if logarithmic:
            ax.set_yscale("log")
    axes[2].axhline(LOSS, color="black", linewidth=0.6)
    axes[0].legend(fontsize=7.0, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0),
                   handlelength=4.5)  # fmt: skip
    axes[-1].set_xlabel("C/N0 [dB-Hz]")
    page.suptitle(
        f"Uniform motion, matched IMU, {ds.sizes['run']} runs of {DURATION_S:g} s: medians",
        fontsize=9.0,
    )
    study.figure("snr_sweep", page)


# -- claims ---------------------------------------------------------------------------------------


def same(ds: xr.Dataset) -> Claim:
    """In tracking the rules coincide."""
    at = ds["jump"].sel(cn0_dbhz=[30.0, 35.0, 50.0])
    quantities = []
    for model in MODELS:
        for name in ("kf", "fiqkf-r"):
            pair = at.sel(receiver=f"{model} {name}") / at.sel(receiver=f"{model} qkf")
            quantities.append(typical(f"{model}: {name} / qkf", pair.values.ravel(), "",
                                      Must("within", (0.9, 1.1))))  # fmt: skip
    return Claim(
        id="snr-same",
        claim="In uniform motion, 30-50 dB-Hz, KF, QKF and FIQKF-R have the same velocity error",
        source="independent prototype",
        theirs="EKF, QKF and all rules coincide for a phase s.d. below 0.1 rad",
        ours=tuple(quantities),
        why="no nonlinearity to capture; fading on noise alone is paid for",
    )


WHY = dict.fromkeys(
    ("scalar", "scalar-ins"), "20 ms against 5 ms, and all satellites share one state"
)
OTHERWISE = "here all satellites share one state too; what counts as lost differs (README)"


def lower(share: xr.DataArray) -> list[Claim]:
    """Ultra-tight against channel loops."""
    claims = []
    for loop in LOOPS:
        quantity = gap(share.sel(receiver=loop), share.sel(receiver="D qkf"),
                       f"{loop} − D qkf", Must("above", 0.0, "low"))  # fmt: skip
        claims.append(
            Claim(
                id=f"snr-{loop}",
                claim=f"The ultra-tight closure tracks to lower C/N0 than {loop}",
                source="this project",
                theirs="the textbooks' claim for deep coupling, several dB",
                ours=(
                    quantity,
                    threshold(loop, share.sel(receiver=loop)),
                    threshold("D qkf", share.sel(receiver="D qkf")),
                ),
                target=True,
                why=WHY.get(loop, OTHERWISE),
            )
        )
    return claims


def fewer(share: xr.DataArray) -> Claim:
    """Does fading cost threshold?"""
    return Claim(
        id="snr-fading",
        claim="The fading factor lowers the tracking threshold",
        source="Xu et al. 2017, conclusion on weak signals",
        theirs="tracks where the QKF does not",
        ours=(
            gap(share.sel(receiver="C qkf"), share.sel(receiver="C fiqkf-r"),
                "qkf − fiqkf-r, C", Must("above", 0.0, "low")),
            gap(share.sel(receiver="D qkf"), share.sel(receiver="D fiqkf-r"),
                "qkf − fiqkf-r, D", Must("above", 0.0, "low")),
        ),
        change="regularised fading, uniform motion",
        why="noise is no reason to trust the prediction less",
    )  # fmt: skip


def consistent(ds: xr.Dataset) -> Claim:
    """Covariance against error, down to 30 dB-Hz."""
    at = ds["nees"].sel(cn0_dbhz=[30.0, 35.0, 50.0])
    return Claim(
        id="snr-consistent",
        claim="The QKF's velocity covariance is right from 30 to 50 dB-Hz",
        source="this project",
        theirs="NEES / chi2 median within 0.5 and 2",
        ours=tuple(
            typical(f"NEES, {m}", at.sel(receiver=f"{m} qkf").values.ravel(), "",
                    Must("within", (0.5, 2.0)))
            for m in MODELS
        ),
        target=True,
        why="matched IMU: what remains is the linearisation",
    )  # fmt: skip


if __name__ == "__main__":
    carry_out(main)
