"""What a closure flown on a recording looks like: speed, doubt, C/N0 and lock over time."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ultratight.plots import COLOURS, LOST, SMALL
from ultratight.recording_flight import Flown, locked
from ultratight.tracking.navigation import Navigation

_LINES = "-", "--", ":"


def figure(of: Flown, nav: Navigation, title: str) -> Figure:
    """From where the closure takes over: speed, its 1 sigma, C/N0 and a bar per channel in lock."""
    run = of.run
    panels = [_speed, _sigma, _cn0, _lock]
    if "covariance" not in run:
        panels.remove(_sigma)
    n = len(run["channel"])
    heights = [0.5 + 0.12 * n if draw is _lock else 1.6 for draw in panels]
    fig = Figure(figsize=(9.0, 1.0 + 1.2 * sum(heights)), layout="constrained")
    axes = fig.subplots(len(panels), 1, sharex=True, height_ratios=heights)
    for draw, ax in zip(panels, axes, strict=True):
        draw(of, nav, ax)
        ax.tick_params(labelsize=SMALL)
        ax.grid(alpha=0.3)
    axes[-1].set_xlim(of.t0_s - 2.0, float(run.t_s[-1]))
    axes[-1].set_xlabel("time from sample 0 [s]", fontsize=SMALL)
    how = ", ".join(str(run.summary[k]) for k in ("closure", "filter") if run.summary[k])
    fig.suptitle(f"{title}: {how}", fontsize=SMALL + 1)
    return fig


def _speed(of: Flown, nav: Navigation, ax: Axes) -> None:
    rows = [(p.t_s, p.estimate.state[4:7]) for p in nav.positions if p.estimate]
    t, v = np.array([t for t, _ in rows]), np.array([v for _, v in rows])
    ax.plot(
        t, np.linalg.norm(v, axis=1), ".", color="#999999", markersize=4.0,
        label="scalar tracking and position filter",
    )  # fmt: skip
    speed = np.linalg.norm(of.run["v_eb_e"], axis=1)
    ax.plot(of.run.t_s, speed, color=COLOURS[0], linewidth=1.2, label="closure")
    _named(ax, "speed [m/s]", 2)


def _sigma(of: Flown, nav: Navigation, ax: Axes) -> None:
    variance = np.diagonal(of.run["covariance"], axis1=1, axis2=2)
    for k, name in enumerate(("position [m]", "velocity [m/s]")):
        sigma = np.sqrt(variance[:, 3 * k : 3 * k + 3].sum(axis=1))
        ax.plot(of.run.t_s, sigma, _LINES[k], color=COLOURS[k], linewidth=1.2, label=name)
    ax.set_yscale("log")
    _named(ax, "1 sigma, 3-D,\nas the filter believes", 2)


def _cn0(of: Flown, nav: Navigation, ax: Axes) -> None:
    for i, name in enumerate(of.run["channel"]):
        ax.plot(
            of.run.t_s, of.run["cn0"][:, i], _LINES[i // len(COLOURS) % 3],
            color=COLOURS[i % len(COLOURS)], linewidth=1.0, label=_short(name),
        )  # fmt: skip
    _named(ax, "C/N0 [dB-Hz]", 12)


def _lock(of: Flown, nav: Navigation, ax: Axes) -> None:
    """A bar where the closure takes a channel for locked; a cross at each loss."""
    run, names = of.run, [str(name) for name in of.run["channel"]]
    lock = locked(run)
    for i, name in enumerate(names):
        ax.plot(
            run.t_s, np.where(lock[:, i], float(i), np.nan), color=COLOURS[0], linewidth=3.0,
            solid_capstyle="butt",
        )  # fmt: skip
        lost = [e.t_s for e in run.events if e.channel == name and e.kind == LOST]
        ax.plot(lost, [i] * len(lost), "x", color="black", markersize=4.0)
    ax.set_yticks(range(len(names)), [_short(name) for name in names])
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.set_ylabel("in lock; x: loss", fontsize=SMALL)


def _named(ax: Axes, label: str, columns: int) -> None:
    ax.set_ylabel(label, fontsize=SMALL)
    ax.legend(
        fontsize=SMALL, frameon=False, ncols=columns, loc="lower right", bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.1, columnspacing=1.0, handlelength=1.5,
    )  # fmt: skip


def _short(name: str) -> str:
    return str(name).partition(":")[0]
