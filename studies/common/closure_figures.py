"""Figures of `closures`: loss over C/N0, errors, times to be back, predicted beside flown."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from common.closure_cells import DURATION_S, MAIN, MOTIONS
from common.closure_measures import Found
from common.figures import SMALL
from common.thresholds import LOSS, threshold
from ultratight.plots import COLOURS, STYLES

SHOWN = (*MAIN, "scalar, 50 Hz", "scalar FLL", "VDFLL-8")
LOOK = {name: (COLOURS[k % len(COLOURS)], STYLES[k // len(COLOURS)])
        for k, name in enumerate(SHOWN)}  # fmt: skip
AT_ONCE_S, NEVER_S = 0.01, 30.0
WITHIN_DB = 2.0


def losses(f: Found) -> Figure:
    """A panel per motion: by the truth in full, by a closure's own indicator thin and pale."""
    motions = [
        m for m in MOTIONS if any(cell[0] == m for cell in f.either) and m != "jump, 3000 ppm"
    ]
    page = Figure(figsize=(7.5, 1.6 + 1.9 * -(-len(motions) // 2)), layout="constrained")
    axes = page.subplots(-(-len(motions) // 2), 2, sharex=True, sharey=True, squeeze=False)
    for ax in axes.flat[len(motions) :]:
        ax.set_visible(False)
    for ax, motion in zip(axes.flat, motions, strict=False):
        for name, (colour, style) in LOOK.items():
            if (motion, name) not in f.either:
                continue
            for share, width, alpha in ((f.own, 0.7, 0.45), (f.lost, 1.4, 1.0)):
                mean = share[motion, name].mean("run")
                ax.plot(mean["cn0_dbhz"], mean, style, color=colour, linewidth=width, alpha=alpha,
                        marker=".", markersize=3.0)  # fmt: skip
        ax.axhline(LOSS, color="black", linewidth=0.6)
        ax.set_title(motion, fontsize=SMALL)
        ax.grid(True, alpha=0.3)
        ax.tick_params(labelsize=7.0)
    for ax in axes[:, 0]:
        ax.set_ylabel("share of channels lost", fontsize=SMALL)
    for ax in axes[-1]:
        ax.set_xlabel("C/N0 [dB-Hz]", fontsize=SMALL)
    _legend(page, [n for n in SHOWN if any(cell[1] == n for cell in f.lost)])
    page.suptitle(
        f"Channels lost within {DURATION_S:g} s by the truth (thin and pale: by the closure's own "
        "indicator)",
        fontsize=SMALL + 1.0,
    )
    return page


def _legend(page: Figure, names: list[str]) -> None:
    ax = page.axes[0]
    lines = [ax.plot([], [], LOOK[n][1], color=LOOK[n][0], marker=".", label=n)[0] for n in names]
    page.legend(handles=lines, loc="outside lower center", ncols=4, fontsize=7.0)


def errors(f: Found) -> Figure:
    """Velocity and position errors against C/N0 of closures that hold there."""
    page = Figure(figsize=(7.5, 5.6), layout="constrained")
    axes = page.subplots(2, 1, sharex=True)
    kinds = (("jump", "velocity error,\nr.m.s. [m/s]"), ("position_end", "position error,\nr.m.s. "
                                                         "of the last 2.5 s [m]"))  # fmt: skip
    for ax, (kind, text) in zip(axes, kinds, strict=True):
        for name, ds in f.errors.items():
            holds = ds["loss"].mean("run") <= LOSS
            middle = ds[kind].median("run").where(holds)
            ax.plot(ds["cn0_dbhz"], middle, LOOK[name][1], color=LOOK[name][0], marker=".")
        ax.set_yscale("log")
        ax.set_ylabel(text, fontsize=SMALL)
        ax.grid(True, which="both", alpha=0.25)
        ax.tick_params(labelsize=7.0)
    axes[0].axhline(float(np.median(f.alone)), color="black", linewidth=0.8, linestyle=":")
    axes[0].annotate("INS alone", (25.0, float(np.median(f.alone))), (0, -9), fontsize=7.0,
                     textcoords="offset points")  # fmt: skip
    axes[1].set_xlabel("C/N0 [dB-Hz]", fontsize=SMALL)
    _legend(page, list(f.errors))
    page.suptitle("Uniform motion, 11 satellites: medians over the runs, where at most a tenth of "
                  "the channels is lost", fontsize=SMALL + 1.0)  # fmt: skip
    return page


def outages(times: Mapping[str, xr.DataArray]) -> Figure:
    """Median and range over channels and runs of the time to be back, by length of the outage."""
    levels = next(iter(times.values()))["cn0_dbhz"].values
    page = Figure(figsize=(7.5, 2.9 * len(levels) + 0.9), layout="constrained")
    for ax, level in zip(np.ravel(page.subplots(len(levels), 1, sharex=True)), levels, strict=True):
        for k, (name, of) in enumerate(times.items()):
            at = of.sel(cn0_dbhz=level)
            for m, label in enumerate(at["outage"].values):
                _bar(ax, m + 0.11 * (k - 3), at.sel(outage=label).values.ravel(), LOOK[name][0])
        ax.set_yscale("log")
        ax.set_ylim(0.6 * AT_ONCE_S, 1.6 * NEVER_S)
        ax.set_yticks([AT_ONCE_S, 0.1, 1.0, 10.0, NEVER_S],
                      ["at once", "0.1", "1", "10", "never"])  # fmt: skip
        ax.minorticks_off()
        ax.set_ylabel("back on the signal\nafter [s]", fontsize=SMALL)
        ax.set_title(f"{level:g} dB-Hz", fontsize=SMALL)
        ax.grid(True, axis="y", alpha=0.3)
        ax.tick_params(labelsize=7.0)
    names = next(iter(times.values()))["outage"].values
    ax.set_xticks(range(len(names)), [f"{x} s" for x in names])
    ax.set_xlim(-0.5, len(names) - 0.5)
    ax.set_xlabel("outage of all satellites", fontsize=SMALL)
    _legend(page, list(times))
    page.suptitle("From the end of an outage until a replica is on its signal for good: median "
                  "(dot), 10 to 90 % (bar), worst (dash)", fontsize=SMALL + 1.0)  # fmt: skip
    return page


def _bar(ax: Axes, x: float, values: np.ndarray, colour: str) -> None:
    shown = np.clip(values, AT_ONCE_S, NEVER_S)
    low, middle, high = np.quantile(shown, [0.1, 0.5, 0.9], method="inverted_cdf")
    ax.plot([x, x], [low, high], color=colour, linewidth=2.5, alpha=0.5)
    ax.plot(x, middle, "o", color=colour, markersize=4.5)
    ax.plot(x, shown.max(), "_", color=colour, markersize=7.0)


def predictions(f: Found) -> Figure:
    """Flown against predicted thresholds, those of them that are numbers."""
    page = Figure(figsize=(6.4, 5.6), layout="constrained")
    ax = page.subplots()
    markers = dict(zip(("uniform", "5 satellites", "jump", "jump, 3000 ppm"), "os^D", strict=True))
    ends = []
    for (motion, name), x in f.predicted.items():
        q = threshold("", f.either[motion, name])
        if name not in LOOK or q.value is None or q.low is None or q.high is None:
            continue
        if not np.isfinite(x):
            continue
        ends += [x, q.value]
        ax.errorbar(x, q.value, ([q.value - q.low], [q.high - q.value]), color=LOOK[name][0],
                    marker=markers[motion], markersize=5.0, linestyle="", capsize=2.0,
                    elinewidth=0.8, markerfacecolor=_inside(name))  # fmt: skip
    span = np.array([min(ends) - 2.0, max(ends) + 2.0])
    ax.plot(span, span, color="black", linewidth=0.8)
    ax.fill_between(span, span - WITHIN_DB, span + WITHIN_DB, color="black", alpha=0.08,
                    linewidth=0.0)  # fmt: skip
    ax.set_xlim(span)
    ax.set_ylim(span)
    ax.set_aspect("equal")
    ax.set_xlabel("predicted threshold [dB-Hz]", fontsize=SMALL)
    ax.set_ylabel("flown threshold [dB-Hz]", fontsize=SMALL)
    ax.grid(True, alpha=0.3)
    ax.tick_params(labelsize=7.0)
    handles = [ax.plot([], [], m, color="grey", label=k)[0] for k, m in markers.items()]
    ax.legend(handles=handles, fontsize=7.0, loc="upper left")
    names = [n for n in SHOWN if any(cell[1] == n for cell in f.predicted)]
    lines = [ax.plot([], [], "o", color=LOOK[n][0], markerfacecolor=_inside(n), label=n)[0]
             for n in names]  # fmt: skip
    page.legend(handles=lines, loc="outside lower center", ncols=4, fontsize=7.0)
    page.suptitle("`ultratight predict` beside flights: C/N0 at which 10 % are lost, by the truth "
                  "or declared; band: 2 dB", fontsize=SMALL)  # fmt: skip
    return page


def _inside(name: str) -> str:
    """Hollow where another closure has the colour."""
    return LOOK[name][0] if name in MAIN else "white"
