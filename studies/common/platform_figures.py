"""Figures of flights of the platform INS, in the form of Wei et al. (2012)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from common.ledger import Quantity
from common.platform_flight import FAULT, OUTAGE, Flown, K
from ultratight.ins.wander_azimuth import EARTH_RADIUS
from ultratight.plots import COLOURS

Flights = Mapping[str, Mapping[str, Flown]]
"""Q_0 -> filter -> flight: columns and rows of a page"""


def shade(ax: Axes, faults: bool = False) -> None:
    """Outages grey, faults of GPS yellow."""
    spans = [(OUTAGE, "0.88"), (FAULT != 0.0, "#F6E8B1")] if faults else [(OUTAGE, "0.88")]
    for when, colour in spans:
        ax.fill_between(K, 0, 1, where=when, transform=ax.get_xaxis_transform(), color=colour,
                        linewidth=0.0, zorder=0.5)  # fmt: skip
    ax.set_xlim(0, K[-1])
    ax.grid(True, alpha=0.3)
    ax.tick_params(labelsize=7.0)


def grid(flights: Flights, height: float, unit: str) -> tuple[Figure, np.ndarray]:
    """A page with labels: a column per Q_0, a row per filter."""
    rows = list(next(iter(flights.values())))
    page = Figure(figsize=(9.0, height * len(rows) + 0.8), layout="constrained")
    axes = page.subplots(len(rows), len(flights), sharex=True, sharey="row")
    for ax, q in zip(axes[0], flights, strict=True):
        ax.set_title(f"$Q_0$ {q}", fontsize=9.0)
    for ax, name in zip(axes[:, 0], rows, strict=True):
        ax.set_ylabel(f"{name}\n{unit}", fontsize=8.0)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]", fontsize=8.0)
    return page, axes


def velocities(scenario: str, flights: Flights) -> Figure:
    """Errors of both velocities in one flight."""
    page, axes = grid(flights, 1.4, "error [m/s]")
    for column, runs in zip(axes.T, flights.values(), strict=True):
        for ax, flown in zip(column, runs.values(), strict=True):
            for axis, name in enumerate(("$V_x$", "$V_y$")):
                ax.plot(K, flown.error[:, axis], color=COLOURS[axis], linewidth=0.7, label=name)
            shade(ax, scenario == "3")
    axes[0, 0].legend(fontsize=7.0, ncols=2, loc="upper right")
    yellow = ", faults of GPS yellow" if scenario == "3" else ""
    page.suptitle(
        f"Scenario {scenario}: velocity errors of one flight; outages grey{yellow}", fontsize=9.0
    )
    return page


def root_R(flights: Flights) -> Figure:
    """Scenario 3: square roots of R^ and of P of latitude."""
    page, axes = grid(flights, 2.1, "[m]")
    for column, runs in zip(axes.T, flights.values(), strict=True):
        for ax, (_, run) in zip(column, runs.values(), strict=True):
            for values, colour, style, name in (
                (run.R_variance[:, 0], COLOURS[0], "-", r"$\sqrt{\hat R}$ of latitude"),
                (run.variance[:, 2], COLOURS[1], "--", r"$\sqrt{P}$ of latitude"),
            ):
                ax.plot(K, EARTH_RADIUS * np.sqrt(values), style, color=colour, linewidth=0.8,
                        label=name)  # fmt: skip
            ax.set_yscale("log")
            shade(ax, True)
    axes[0, 0].legend(fontsize=7.0, loc="upper right")
    page.suptitle("Scenario 3: what the filters hold for the noise of GPS, one flight; outages "
                  "grey, faults of GPS yellow", fontsize=9.0)  # fmt: skip
    return page


def over_Q0(drifts: Sequence[float], found: Mapping[str, Sequence[Quantity]], runs: int) -> Figure:
    """R.m.s. errors with intervals against the drift noise in Q_0: where the ranking turns over."""
    page = Figure(figsize=(6.0, 3.8), layout="constrained")
    ax = page.subplots()
    for colour, (name, quantities) in zip(COLOURS, found.items(), strict=False):
        ax.fill_between(drifts, [q.low for q in quantities], [q.high for q in quantities],
                        color=colour, alpha=0.2, linewidth=0.0)  # fmt: skip
        ax.plot(drifts, [q.value for q in quantities], marker=".", color=colour, label=name)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("drift noise in $Q_0$ [deg/h in a second]; the truth's is 0")
    ax.set_ylabel("r.m.s. velocity error [m/s]")
    ax.grid(True, which="both", alpha=0.3)
    ax.legend(fontsize=8.0)
    ax.set_title(f"Scenario 1, geometric mean of {runs} flights, 95 % interval", fontsize=9.0)
    return page
