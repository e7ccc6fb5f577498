"""What navigation from a recording looks like: signals over time, and where the receiver was."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ultratight.ins.earth import geodetic_from_ecef, rotation_e_from_n
from ultratight.plots import COLOURS, SMALL
from ultratight.tracking.navigation import Navigation
from ultratight.tracking.observables import Observations


def figure(of: Navigation, title: str) -> Figure:
    """C/N0 and Doppler of all channels; position about its mean over time, and from above."""
    fig = Figure(figsize=(9.0, 7.0), layout="constrained")
    axes = fig.subplots(2, 2)
    fig.suptitle(title, fontsize=SMALL + 1)
    seen = of.observations
    if seen is not None:
        _channels(seen, seen.cn0_dbhz, axes[0, 0], "C/N0 [dB-Hz]")
        _channels(seen, seen.doppler_hz / 1e3, axes[0, 1], "Doppler [kHz]")
        handles, names = axes[0, 1].get_legend_handles_labels()
        fig.legend(
            handles, names, loc="outside right upper", fontsize=SMALL, frameon=False, title="PRN",
            title_fontsize=SMALL,
        )  # fmt: skip
    _positions(of, axes[1, 0], axes[1, 1])
    for ax in axes.flat:
        ax.tick_params(labelsize=SMALL)
        ax.grid(alpha=0.3)
    return fig


def _channels(seen: Observations, values: np.ndarray, ax: Axes, label: str) -> None:
    for i in np.argsort(seen.prn).tolist():
        ax.plot(
            seen.t_s, values[:, i], linewidth=0.9, color=COLOURS[i % len(COLOURS)],
            linestyle=("-", "--", ":")[i // len(COLOURS) % 3], label=str(seen.prn[i]),
        )  # fmt: skip
    ax.set_xlabel("time from sample 0 [s]", fontsize=SMALL)
    ax.set_ylabel(label, fontsize=SMALL)


def _positions(of: Navigation, over_time: Axes, above: Axes) -> None:
    """East, north, up about the mean of the filter's positions."""
    kinds = (
        ("least squares", [(p.t_s, p.fix.state[:3]) for p in of.positions if p.fix]),
        ("filter", [(p.t_s, p.estimate.state[:3]) for p in of.positions if p.estimate]),
    )
    whole = kinds[1][1] or kinds[0][1]
    if whole:
        mean = np.mean([r for _, r in whole], axis=0)
        C = rotation_e_from_n(*geodetic_from_ecef(mean)[:2])
        for (name, rows), thin in zip(kinds, (True, False), strict=True):
            if not rows:
                continue
            t = np.array([t for t, _ in rows])
            north, east, down = ((np.array([r for _, r in rows]) - mean) @ C).T
            for k, (part, what) in enumerate(((east, "east"), (north, "north"), (-down, "up"))):
                over_time.plot(
                    t, part, color=COLOURS[k], linewidth=0.6 if thin else 1.5,
                    alpha=0.5 if thin else 1.0, label=None if thin else what,
                )  # fmt: skip
            above.plot(
                east, north, "." if thin else "-", color="#999999" if thin else "black",
                markersize=3.0, linewidth=1.2, label=name,
            )  # fmt: skip
        over_time.legend(
            fontsize=SMALL, frameon=False, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0),
            title="filter; thin: least squares", title_fontsize=SMALL,
        )  # fmt: skip
        above.legend(
            fontsize=SMALL, frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0)
        )
    above.set_aspect("equal", adjustable="datalim")
    over_time.set_xlabel("time from sample 0 [s]", fontsize=SMALL)
    over_time.set_ylabel("about the filter's mean [m]", fontsize=SMALL)
    above.set_xlabel("east [m]", fontsize=SMALL)
    above.set_ylabel("north [m]", fontsize=SMALL)
