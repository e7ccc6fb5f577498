"""Figures of campaigns: bands over time, heat maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from ultratight.plots import COLOURS

SMALL = 8.0
FLOOR_MPS, CEILING_MPS = 5e-4, 1e3
"""What a logarithmic axis of velocity errors shows; errors beyond lie on its edge"""


def band(ax: Axes, error: xr.DataArray, label: str, colour: str) -> None:
    """Median over the runs, and the 10-90 % band; runs that diverged count as infinite."""
    full = error.fillna(np.inf).transpose("run", "t_s").values
    low, middle, high = np.clip(
        np.percentile(full, [10.0, 50.0, 90.0], axis=0, method="nearest"), FLOOR_MPS, CEILING_MPS
    )
    t = error["t_s"].values
    ax.fill_between(t, low, high, color=colour, alpha=0.22, linewidth=0.0)
    ax.plot(t, middle, color=colour, linewidth=1.1, label=label)


def velocity_page(
    speed: tuple[np.ndarray, np.ndarray],
    columns: Mapping[str, xr.DataArray],
    groups: Sequence[Sequence[str]],
    title: str,
) -> Figure:
    """Speed above, velocity errors below, a column per state of the cause.

    ``columns`` maps a heading to errors (filter, run, t_s); each group of filters has a panel.
    """
    n_row, n_column = 1 + len(groups), len(columns)
    page = Figure(figsize=(4.6 * n_column, 1.2 + 1.35 * n_row), layout="constrained")
    axes = page.subplots(n_row, n_column, sharex=True, sharey="row", squeeze=False)
    for c, (heading, errors) in enumerate(columns.items()):
        axes[0, c].plot(*speed, color="black", linewidth=1.2)
        axes[0, c].set_title(heading, fontsize=SMALL + 1.0)
        for ax, group in zip(axes[1:, c], groups, strict=True):
            for k, name in enumerate(group):
                band(ax, errors.sel(filter=name), name, COLOURS[k])
            ax.set_yscale("log")
            ax.set_ylim(FLOOR_MPS, CEILING_MPS)
            ax.set_yticks([1e-3, 1e-2, 1e-1, 1e0, 1e1, 1e2])
        axes[-1, c].set_xlabel("receiver time [s]", fontsize=SMALL)
    for ax in axes.flat:
        ax.set_xlim(0.0, float(speed[0][-1]))
        ax.grid(True, alpha=0.3)
        ax.tick_params(labelsize=7.0)
    axes[0, 0].set_ylabel("speed [m/s]", fontsize=SMALL)
    for ax in axes[1:, 0]:
        ax.set_ylabel("velocity\nerror [m/s]", fontsize=SMALL)
        ax.legend(fontsize=7.0, loc="upper left", ncols=len(groups[0]), framealpha=0.8)
    page.suptitle(title, fontsize=SMALL + 1.0, x=0.01, ha="left")
    return page


def heat_map(
    ax: Axes,
    values: np.ndarray,
    notes: np.ndarray,
    rows: Sequence[str],
    columns: Sequence[str],
    limits: tuple[float, float],
) -> None:
    """Values (row, column) on a logarithmic scale of colours, with a note in every field."""
    norm = LogNorm(*limits)
    shown = np.clip(np.nan_to_num(values, nan=limits[1]), *limits)
    ax.imshow(shown, norm=norm, cmap="cividis", aspect="auto")
    middle = np.sqrt(limits[0] * limits[1])
    for (i, j), note in np.ndenumerate(notes):
        colour = "white" if shown[i, j] < middle else "black"
        ax.text(j, i, note, ha="center", va="center", fontsize=6.5, color=colour)
    ax.set_xticks(range(len(columns)), columns, fontsize=7.0)
    ax.set_yticks(range(len(rows)), rows, fontsize=7.0)
    ax.tick_params(length=0.0)
