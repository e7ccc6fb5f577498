"""Figures of the study `acekf`: errors, classes and weights, gains."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from common.sins_cells import FILTERS, FIRST_SEED, Merits
from common.sins_flight import EPOCHS, KINDS, LARGE, WINDOWS, draw, fly
from ultratight.plots import COLOURS

CHANNELS = ("$V_E$", "$V_N$", "$V_U$", "latitude", "longitude", "height")
SHOWN = {"EKF": "0.6", "REKF": COLOURS[1], "AEKF": COLOURS[2], "ACEKF": COLOURS[0]}


def shade(ax: Axes) -> None:
    """Windows: class A dark, class B light."""
    for w, (a, b) in enumerate(WINDOWS):
        ax.axvspan(a, b, color="0.80" if w in LARGE else "0.92", linewidth=0.0, zorder=0.5)
    ax.set_xlim(0, EPOCHS[-1])
    ax.grid(True, alpha=0.3)
    ax.tick_params(labelsize=7.0)


def errors() -> Figure:
    """The paper's form: errors of six channels in one flight, all four filters."""
    page = Figure(figsize=(9.0, 7.5), layout="constrained")
    axes = page.subplots(6, 1, sharex=True)
    world = draw(FIRST_SEED)
    for name, colour in SHOWN.items():
        error = fly(world, FILTERS[name]).error
        for c, ax in enumerate(axes):
            ax.plot(EPOCHS, error[:, c], color=colour, linewidth=0.8, label=name)
    for c, ax in enumerate(axes):
        linear = 0.5 if c < 3 else 10.0
        ax.set_yscale("symlog", linthresh=linear, linscale=1.5)
        ax.axhline(linear, color="k", linewidth=0.5, linestyle=":")
        ax.axhline(-linear, color="k", linewidth=0.5, linestyle=":")
        top = 10.0 ** np.ceil(np.log10(max(map(abs, ax.get_ylim()))))
        ax.set_ylim(-top, top)
        ticks = [-top, -linear, 0.0, linear, top]
        ax.set_yticks(ticks, [f"{t:g}" for t in ticks])
        ax.minorticks_off()
        ax.set_ylabel(f"{CHANNELS[c]}\n[{'m/s' if c < 3 else 'm'}]", fontsize=8.0)
        shade(ax)
    axes[-1].set_xlabel("time [s]", fontsize=8.0)
    page.legend(*axes[0].get_legend_handles_labels(), fontsize=8.0, ncols=4,
                loc="outside upper right")  # fmt: skip
    page.suptitle("T1, correlated anomalies: errors of one flight; linear between the dotted lines",
                  fontsize=9.0, x=0.01, ha="left")  # fmt: skip
    return page


def classes() -> Figure:
    """The detector and the weights it leads to, in one flight."""
    flown = fly(draw(FIRST_SEED), FILTERS["ACEKF"])
    page = Figure(figsize=(9.0, 4.6), layout="constrained")
    above, below = page.subplots(2, 1, sharex=True)
    for kind, (colour, label) in enumerate(
        ((COLOURS[2], "normal"), (COLOURS[0], "class B"), (COLOURS[1], "class A"))
    ):
        which = flown.kind == kind
        above.plot(EPOCHS[which], flown.eta[which], ".", color=colour, markersize=3.0, label=label)
    for level in (1.1, 334.2):
        above.axhline(level, color="k", linewidth=0.6, linestyle="--")
    above.set_yscale("log")
    above.set_ylabel(r"$\eta$", fontsize=8.0)
    above.legend(fontsize=7.0, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    for c, colour in ((0, COLOURS[0]), (3, COLOURS[1])):
        below.plot(EPOCHS, np.maximum(flown.weight[:, c], 0.1), color=colour, linewidth=0.8,
                   label=CHANNELS[c])  # fmt: skip
    below.set_yscale("log")
    below.set_ylabel(r"weight $\lambda$" "\n(none: 0.1)", fontsize=8.0)
    below.legend(fontsize=7.0, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    below.set_xlabel("time [s]", fontsize=8.0)
    for ax in (above, below):
        shade(ax)
    page.suptitle("T1, correlated anomalies: classes of the residuals and weights of one flight; "
                  r"dashed: $1 + \xi$ and $\eta_1$", fontsize=9.0, x=0.01, ha="left")  # fmt: skip
    return page


def gains(m: dict[str, Merits]) -> Figure:
    """Horizontal position RMSE of every filter by kind of anomaly."""
    page = Figure(figsize=(9.0, 4.2), layout="constrained")
    ax = page.subplots()
    cells = ("none", *(f"T1 {k}" for k in KINDS), "BASE ar")
    for c, cell in enumerate(cells):
        names = [n for n in FILTERS if f"{cell} {n}" in m]
        rmse = [np.sqrt((m[f"{cell} {n}"]["twelve"][:, 9:11] ** 2).sum(1)) for n in names]
        at = [list(FILTERS).index(n) + 0.14 * (c - 2) for n in names]
        mean = [r.mean() for r in rmse]
        spread = np.abs(np.array([np.percentile(r, [10, 90]) for r in rmse]).T - mean)
        ax.errorbar(at, mean, spread, fmt="o^sDv"[c], color=COLOURS[c], markersize=4.5,
                    elinewidth=0.9, label=cell)  # fmt: skip
    ax.axhline(10.0, color="k", linewidth=0.6, linestyle=":")
    ax.set_yscale("log")
    ax.set_yticks([1, 3, 10, 30, 100, 300], ["1", "3", "10", "30", "100", "300"])
    ax.set_xticks(range(len(FILTERS)), [n.replace(", ", ",\n").replace("-square", "-square\n")
                                        for n in FILTERS], fontsize=7.0)  # fmt: skip
    ax.set_ylabel("RMSE of the horizontal position [m]", fontsize=8.0)
    ax.tick_params(axis="y", labelsize=7.0)
    ax.grid(True, axis="y", alpha=0.3)
    ax.legend(fontsize=7.0, title="anomalies", title_fontsize=7.0, loc="upper left",
              bbox_to_anchor=(1.0, 1.0))  # fmt: skip
    page.suptitle("Mean of the flights, bars from the 10th to the 90th percentile", fontsize=9.0,
                  x=0.01, ha="left")  # fmt: skip
    return page
