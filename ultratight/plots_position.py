"""What navigation from a recording looks like: signals, the sky, and where the receiver was."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes

from ultratight.ins.earth import geodetic_from_ecef, rotation_e_from_n
from ultratight.plots import COLOURS, SMALL
from ultratight.sky_view import SkyPath, sky_paths
from ultratight.tracking.navigation import Navigation
from ultratight.tracking.observables import Observations


def figure(of: Navigation, title: str) -> Figure:
    """C/N0 and Doppler of all channels, the sky; position over time, and from above."""
    fig = Figure(figsize=(12.0, 7.0), layout="constrained")
    grid = fig.add_gridspec(2, 3)
    axes = [fig.add_subplot(grid[k // 2, k % 2]) for k in range(4)]
    sky = cast(PolarAxes, fig.add_subplot(grid[0, 2], projection="polar"))
    rest = fig.add_subplot(grid[1, 2])
    rest.axis("off")
    fig.suptitle(title, fontsize=SMALL + 1)
    seen = of.observations
    if seen is not None:
        styles = {int(seen.prn[i]): _style(i) for i in range(len(seen.prn))}
        _channels(seen, seen.cn0_dbhz, axes[0], "C/N0 [dB-Hz]", styles)
        _channels(seen, seen.doppler_hz / 1e3, axes[1], "Doppler [kHz]", styles)
        _sky(sky_paths(of), sky, styles)
        handles, names = axes[1].get_legend_handles_labels()
        rest.legend(
            handles, names, loc="center", fontsize=SMALL, frameon=False, title="PRN", ncols=2,
            title_fontsize=SMALL, handlelength=3.0,
        )  # fmt: skip
    _positions(of, axes[2], axes[3])
    for ax in axes:
        ax.tick_params(labelsize=SMALL)
        ax.grid(alpha=0.3)
    return fig


def _style(i: int) -> dict[str, Any]:
    """Of channel i, the same in every panel."""
    return {"color": COLOURS[i % len(COLOURS)],
            "linestyle": ("-", "--", ":")[i // len(COLOURS) % 3]}  # fmt: skip


def _channels(
    seen: Observations, values: np.ndarray, ax: Axes, label: str, styles: dict[int, dict[str, Any]]
) -> None:
    for i in np.argsort(seen.prn).tolist():
        prn = int(seen.prn[i])
        ax.plot(seen.t_s, values[:, i], linewidth=0.9, label=str(prn), **styles[prn])
    ax.set_xlabel("time from sample 0 [s]", fontsize=SMALL)
    ax.set_ylabel(label, fontsize=SMALL)


def _sky(paths: list[SkyPath], ax: PolarAxes, styles: dict[int, dict[str, Any]]) -> None:
    """Zenith in the middle, north above, east to the right; the dot is where it was last."""
    ax.set_theta_zero_location("N")
    ax.set_theta_direction(-1)
    ax.set_rlim(0.0, 90.0)
    ax.set_rgrids((30.0, 60.0), ("60", "30"), fontsize=SMALL - 1)
    ax.set_thetagrids((0.0, 90.0, 180.0, 270.0), ("N", "E", "S", "W"), fontsize=SMALL)
    ax.set_title("satellites: elevation [deg], azimuth" if paths else
                 "no position, hence no directions", fontsize=SMALL)  # fmt: skip
    ax.grid(alpha=0.4)
    for prn, _, elevation, azimuth in paths:
        down, azimuth = 90.0 - elevation, np.radians(azimuth)
        ax.plot(np.unwrap(azimuth), down, linewidth=1.2, **styles[prn])
        ax.plot(azimuth[-1], down[-1], "o", markersize=5.0, color=styles[prn]["color"])
        ax.annotate(str(prn), (azimuth[-1], down[-1]), (4, 3), textcoords="offset points",
                    fontsize=SMALL)  # fmt: skip


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
