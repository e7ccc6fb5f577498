"""Which adaptation helps against which disturbance, as a table, a map and over time."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from common.adaptation_cells import (
    BEGIN_S,
    END_S,
    FAMILIES,
    FLOWN,
    QKF,
    SAID,
    SHOWN,
    STEPS,
    Flown,
)
from common.adaptation_measures import difference, ratio
from common.campaign import Study
from common.figures import SMALL, band, heat_map
from common.statistics import count, typical
from common.worlds import MODELS
from ultratight.plots import COLOURS


def unit(which: str) -> str:
    """Of the figure of merit."""
    return "m" if which in STEPS and STEPS[which].position else "m/s"


def tell(study: Study, model: str, flown: Flown) -> None:
    """Medians, paired differences with their intervals, and Wilson's interval of convergence."""
    runs = flown["jump"].sizes["run"]
    study.say(
        f"\n{study.name}: model {model}, {runs} runs; error while it lasts, difference to QKF"
    )
    for which, ds in flown.items():
        study.say(f"{SAID[which]} [{unit(which)}]")
        for label in FLOWN[model]:
            mine = ds.sel(filter=label)
            middle = typical("", mine["merit"].values, "")
            gap = typical("", difference(ds, label), "")
            held = count("", mine["converged"].values)
            study.say(
                f"    {label:12} {_n(middle.value):>9} [{_n(middle.low)}, {_n(middle.high)}]"
                f"  difference {_n(gap.value):>9} [{_n(gap.low)}, {_n(gap.high)}]"
                f"  converged {held.value}/{runs} [{held.low:.1f}, {held.high:.1f}]"
            )


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"


def _n(value: float | None) -> str:
    return "inf" if value is None else f"{value:.3g}"


def draw_map(study: Study, model: str, flown: Flown) -> None:
    """Filter by disturbance: median ratio to the QKF, and who converged."""
    labels = [label for label in FLOWN[model] if label != QKF]
    values = np.empty((len(labels), len(flown)))
    notes = np.empty(values.shape, object)
    for j, ds in enumerate(flown.values()):
        for i, label in enumerate(labels):
            q = typical("", ratio(ds, label), "")
            values[i, j] = np.inf if q.value is None else q.value
            sure = (q.high is not None and q.high < 1.0) or q.low is None or q.low > 1.0
            size = "∞" if q.value is None else _short(q.value)
            hits = int(ds["converged"].sel(filter=label).sum())
            notes[i, j] = f"{size}{'' if sure else ' ='}   {hits}/{ds.sizes['run']}"
    columns = []
    for which, every in flown.items():
        ds = every.sel(filter=QKF)
        q = typical("", ds["merit"].values, "")
        columns.append(f"{SAID[which]}\nQKF {_n(q.value)} {unit(which)}\n"
                       f"{int(ds['converged'].sum())}/{ds.sizes['run']}")  # fmt: skip
    page = Figure(figsize=(2.6 + 1.5 * len(flown), 1.5 + 0.27 * len(labels)), layout="constrained")
    ax = page.subplots()
    heat_map(ax, values, notes, labels, columns, (0.03, 30.0))
    sizes = [sum(label in labels for label in family) for family in FAMILIES.values()]
    edges = np.cumsum(sizes)[:-1] - 0.5
    ax.hlines(edges, -0.5, len(flown) - 0.5, color="white", linewidth=2.0)
    ax.xaxis.tick_top()
    page.suptitle(
        f"Model {model}: error while the disturbance lasts over the QKF's (median of paired "
        "ratios; '=': the interval holds 1)\nand how many runs converged. Groups: nothing adapted, "
        "Q or covariance opened, R and Q, R, weights per channel",
        fontsize=SMALL + 0.5,
    )
    study.figure(f"adaptive_{model}", page)


def draw_time(study: Study, flown: dict[str, Flown]) -> None:
    """One loss of power and one fault, over time."""
    page = Figure(figsize=(9.2, 7.6), layout="constrained")
    axes = page.subplots(3, 2, sharex=True)
    power, fault = "power all", "fault step"
    for ax, which in zip(axes[0], (power, fault), strict=True):
        what = STEPS[which]
        t = np.array([0.0, BEGIN_S, BEGIN_S, what.until_s, what.until_s, END_S])
        on = np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
        level = 35.0 - 15.0 * on if which == power else 100.0 * on
        ax.plot(t, level, color="black", linewidth=2.5, alpha=0.5, label="true")
    for k, model in enumerate(MODELS):
        cn0 = flown[model][power]["cn0"].sel(filter=QKF).median("run")
        axes[0, 0].plot(
            cn0["t_s"], cn0, color=COLOURS[k], label=f"as the receiver sees it, {model}"
        )
        for ax, which, series in ((axes[1 + k, 0], power, "error"),
                                  (axes[1 + k, 1], fault, "position_error")):  # fmt: skip
            for colour, label in zip(COLOURS, (QKF, *SHOWN), strict=False):
                if label not in FLOWN[model]:
                    continue
                band(ax, flown[model][which][series].sel(filter=label), label, colour)
            ax.set_yscale("log")
            of = "velocity error [m/s]" if which == power else "position error [m]"
            ax.set_ylabel(f"model {model}\n{of}", fontsize=SMALL)
            ax.axvspan(BEGIN_S, STEPS[which].until_s, color="0.85", zorder=0)
    _dress(axes)
    runs = flown["C"][power].sizes["run"]
    axes[0, 0].set_title("all satellites 15 dB weaker for 5 s", fontsize=SMALL + 1.0)
    axes[0, 1].set_title("clock of one satellite 100 m off for 10 s", fontsize=SMALL + 1.0)
    axes[0, 0].set_ylabel("C/N0 [dB-Hz]", fontsize=SMALL)
    axes[0, 1].set_ylabel("fault [m]", fontsize=SMALL)
    page.suptitle(f"Uniform motion, 35 dB-Hz, ten satellites: median and 10-90 % of {runs} runs",
                  fontsize=SMALL + 1.0)  # fmt: skip
    study.figure("adaptive_time", page)


def _dress(axes: np.ndarray) -> None:
    """Limits, grids and legends."""
    for ax in axes.flat:
        ax.set_xlim(3.0, END_S)
        ax.grid(True, alpha=0.3)
        ax.tick_params(labelsize=7.5)
    for ax in axes[1]:
        ax.set_ylim(5e-4, 1e3)
    for ax in axes[2]:
        ax.set_ylim(5e-3, 1e3)
    axes[1, 1].set_ylim(5e-3, 1e3)
    axes[0, 0].legend(fontsize=7.0, loc="lower right")
    axes[1, 0].legend(fontsize=7.0, loc="upper left", ncols=2)
    for ax in axes[2]:
        ax.set_xlabel("receiver time [s]", fontsize=SMALL)
