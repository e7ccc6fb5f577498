"""Figures of the study `ishakf`: definiteness, noise in steps, outliers, limits, missile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from common.ballistic_range import LOW, NOMINAL, T, between, fly, stepped
from common.range_cells import (
    FACTORS,
    FIRST_SEED,
    LENGTHS,
    MISSILE,
    NAMES,
    NOISES,
    Group,
    cells,
)
from common.range_measures import length_peak, pooled
from ultratight.plots import COLOURS


def tidy(ax: Axes, ylabel: str) -> None:
    """Labels and grid of a panel over time."""
    ax.set_ylabel(ylabel, fontsize=8.0)
    ax.set_xlim(0.0, 100.0)
    ax.grid(True, alpha=0.3)
    ax.tick_params(labelsize=7.0)


def definiteness() -> Figure:
    """One run at low noise: the smaller eigenvalue of R^."""
    page = Figure(figsize=(7.0, 4.4), layout="constrained")
    axes = page.subplots(2, 1, sharex=True, sharey=True)
    for ax, name, colour in zip(axes, ("V1", "V2"), COLOURS, strict=False):
        _, run = fly(cells("low")[name], FIRST_SEED)
        least = np.linalg.eigvalsh(run.R_epoch)[:, 0]
        ax.axhline(0.0, color="black", linewidth=0.6)
        ax.plot(T, least, color=colour, linewidth=0.8, label=f"{name}, {NAMES[name]}")
        ax.plot(T, stepped(LOW) ** 2, color="0.4", linewidth=0.8, linestyle="--",
                label="true variance")  # fmt: skip
        ax.set_yscale("symlog", linthresh=1.0)
        tidy(ax, "smaller eigenvalue\nof R^ [m²]")
        ax.legend(fontsize=7.0, loc="lower left", ncols=2)
    axes[-1].set_xlabel("time [s]", fontsize=8.0)
    page.suptitle("Noise of 5, 20, 2, 20, 5 m: one run", fontsize=9.0)
    return page


def noise(nominal: Group) -> Figure:
    """Estimated noise, and error of the state, over time."""
    page = Figure(figsize=(7.0, 5.6), layout="constrained")
    top, bottom = page.subplots(2, 1, sharex=True)
    runs = nominal["V2"].error.shape[0]
    for k, name in enumerate(("V2", "V3")):
        f = nominal[name]
        low, high = np.percentile(f.sigma, [10.0, 90.0], axis=0)
        top.fill_between(T, low, high, color=COLOURS[k], alpha=0.2, linewidth=0.0)
        top.plot(T, f.sigma.mean(axis=0), color=COLOURS[k], linewidth=1.0,
                 label=f"{name}, {NAMES[name]}")  # fmt: skip
        each = np.sqrt(np.mean(f.error.astype(float) ** 2, axis=(0, 2)))
        bottom.plot(T, each, color=COLOURS[k], linewidth=0.7, label=name)
    top.plot(T, stepped(NOMINAL), color="black", linewidth=0.8, linestyle="--", label="true")
    tidy(top, "noise [m]")
    tidy(bottom, "r.m.s. position error\nof a coordinate [m]")
    top.legend(fontsize=7.0, ncols=3, loc="upper right")
    top.set_ylim(0.0, 105.0)
    bottom.set_ylim(0.0, None)
    bottom.set_xlabel("time [s]", fontsize=8.0)
    page.suptitle(f"Noise in steps, {runs} runs; bands hold 80 % of them", fontsize=9.0)
    return page


def bursts(flown: Group) -> Figure:
    """Errors over time with outliers."""
    shown = ("V2", "V3", "V4")
    page = Figure(figsize=(7.0, 5.6), layout="constrained")
    axes = page.subplots(len(shown), 1, sharex=True, sharey=True)
    sigma = stepped(NOMINAL)
    for k, (ax, name) in enumerate(zip(axes, shown, strict=True)):
        size = np.abs(flown[name].error).max(axis=2).mean(axis=0)
        ax.plot(T, size, color=COLOURS[k], linewidth=0.8)
        ax.fill_between(T, 0.0, 1.0, where=sigma > 50.0, transform=ax.get_xaxis_transform(),
                        color="0.9", linewidth=0.0, zorder=0.5)  # fmt: skip
        tidy(ax, f"{name}\n|error| [m]")
    axes[-1].set_xlabel("time [s]", fontsize=8.0)
    runs = flown["V2"].error.shape[0]
    page.suptitle(f"Five outliers of -200 m every 10 s, mean of {runs} runs (larger coordinate); "
                  "noise of 60 m grey", fontsize=9.0)  # fmt: skip
    return page


def limits(m: dict[str, Group]) -> Figure:
    """How long a burst, and how large a rise of the noise, is survived."""
    page = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = page.subplots(1, 2)
    for k, sigma in enumerate(NOISES):
        found = [length_peak(m["length"][f"{sigma} {n}"], n).mean() for n in LENGTHS]
        left.plot(LENGTHS, found, marker=".", color=COLOURS[k], label=f"{sigma} m")
    left.axhline(200.0, color="black", linewidth=0.6, linestyle="--")
    left.set_xlabel("outliers of -200 m in a row", fontsize=8.0)
    left.set_ylabel("mean peak error of V4 [m]", fontsize=8.0)
    left.legend(fontsize=7.0, title="noise", title_fontsize=7.0)
    names = {"known": "Kalman filter, R known", "V2": "V2", "V3": "V3", "V4": "V4",
             "c4 = 60": "V4, c4 = 60", "max_reject": "V4, 40 rejections at most"}  # fmt: skip
    for k, (name, text) in enumerate(names.items()):
        found = [pooled(m["jump"][f"{f} {name}"].error, between(51.0, 100.0)) for f in FACTORS]
        right.plot(FACTORS, found, marker=".", color=COLOURS[k], label=text)
    right.set_xlabel("rise of the noise, from 20 m by a factor", fontsize=8.0)
    right.set_ylabel("r.m.s. error from 1 s after it [m]", fontsize=8.0)
    right.legend(fontsize=7.0)
    for ax in (left, right):
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.grid(True, which="both", alpha=0.3)
        ax.tick_params(labelsize=7.0)
    left.set_xticks(LENGTHS, [str(n) for n in LENGTHS])
    right.set_xticks(FACTORS, [str(f) for f in FACTORS])
    for ax, ticks in ((left, (10, 20, 50, 100, 200, 500)), (right, (20, 50, 100, 1000, 10_000))):
        ax.set_yticks(ticks, [str(tick) for tick in ticks])
    right.minorticks_off()
    left.minorticks_off()
    return page


def missile() -> Figure:
    """One run of the surrogate: measured and filtered, and the noise that was found."""
    page = Figure(figsize=(7.0, 4.4), layout="constrained")
    top, bottom = page.subplots(2, 1, sharex=True)
    cell = cells("missile")["10 V4"]
    error, run = fly(cell, FIRST_SEED)
    measured = fly(replace(cell, noise=None, R0_m=1e-3), FIRST_SEED)[0]  # R = 0: z itself
    top.plot(T, measured, color="0.6", linewidth=0.6, label="measured")
    top.plot(T, error, color=COLOURS[0], linewidth=1.0, label="V4")
    bottom.plot(T, MISSILE, color="black", linewidth=0.8, linestyle="--", label="true")
    bottom.plot(T, np.sqrt(run.R_variance), color=COLOURS[1], linewidth=0.9, label="V4")
    tidy(top, "error [m]")
    tidy(bottom, "noise [m]")
    for ax in (top, bottom):
        ax.legend(fontsize=7.0, loc="upper left", ncols=2)
    bottom.set_xlabel("time [s]", fontsize=8.0)
    page.suptitle("Surrogate of the missile: noise from 38 to 190 m, one run, q = 10", fontsize=9.0)
    return page
