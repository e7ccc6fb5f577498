"""What search and tracking of a recording look like: peaks, one surface, prompts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ultratight.plots import COLOURS, SMALL
from ultratight.tracking.acquisition import Acquisition, Surface
from ultratight.tracking.from_samples import Tracks

_COLUMNS = 256
"""Of the whole surface: more would hide a peak of one pixel"""
_POINTS = 4000
"""Of a line, at most twice as many"""
_ZOOM_CHIPS = 4.0
_LEAST_DB = -3.0
"""Where the colours begin, against the noise level"""


def figure(rows: Sequence[Acquisition], surface: Surface, prn: int, title: str) -> Figure:
    """Bars of all PRNs, and the surface of ``prn``, whole and about its peak."""
    fig = Figure(figsize=(9.0, 7.0), layout="constrained")
    grid = fig.add_gridspec(2, 2, height_ratios=(1.0, 1.2), width_ratios=(1.6, 1.0))
    bars(rows, fig.add_subplot(grid[0, :])).set_title(title, fontsize=SMALL + 1, loc="left")
    whole(surface, fig.add_subplot(grid[1, 0])).set_title(
        f"PRN {prn}, highest energy in 4 chips", fontsize=SMALL + 1, loc="left"
    )
    ax = fig.add_subplot(grid[1, 1])
    zoom(surface, ax).set_title("about its peak", fontsize=SMALL + 1, loc="left")
    fig.colorbar(ax.collections[0], ax=ax, label="energy over noise [dB]")
    return fig


def bars(rows: Sequence[Acquisition], ax: Axes) -> Axes:
    """Peak over threshold of each PRN, logarithmic."""
    ratio = np.array([row.peak / row.threshold for row in rows])
    found = np.array([row.found for row in rows])
    at = np.arange(len(rows))
    for chosen, colour, name in ((found, COLOURS[0], "found"), (~found, "#999999", "not found")):
        ax.bar(at[chosen], ratio[chosen] - 0.1, bottom=0.1, color=colour, label=name)
    ax.axhline(1.0, color=COLOURS[1], linewidth=1.2, label="threshold")
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set_ylim(0.4, 1.6 * max(2.0, ratio.max()))
    size = SMALL if len(rows) <= 40 else 5.0
    ax.set_xticks(at, [str(row.prn) for row in rows], fontsize=size, rotation=90 * (len(rows) > 40))
    ax.set_xlim(-0.8, len(rows) - 0.2)
    ax.set_xlabel("PRN")
    ax.set_ylabel("peak / threshold")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, fontsize=SMALL, frameon=False)
    return ax


def tracks(of: Tracks, title: str) -> Figure:
    """Prompts of all channels over time, and in the plane; one row of panels per satellite."""
    n = max(1, len(of.prn))
    fig = Figure(figsize=(9.0, 1.2 + 1.1 * n), layout="constrained")
    axes = fig.subplots(n, 2, squeeze=False, sharex="col", width_ratios=(6.0, 1.0))
    for i, (over_time, plane) in enumerate(axes[: len(of.prn)]):
        rows = of.channel == i
        prompt = of.iq[rows, 1]
        step = max(1, len(prompt) // _POINTS)
        t, late = of.t_s[rows][::step], prompt[len(prompt) // 2 :]
        over_time.plot(t, prompt.real[::step], color=COLOURS[0], linewidth=0.7, label="I")
        over_time.plot(t, prompt.imag[::step], color=COLOURS[1], linewidth=0.7, label="Q")
        over_time.set_ylabel(f"PRN {of.prn[i]}", fontsize=SMALL)
        late = late[:: max(1, len(late) // _POINTS)]
        plane.plot(late.real, late.imag, ".", markersize=2.0, color="black")
        plane.set_aspect("equal", adjustable="datalim")
        for ax in (over_time, plane):
            ax.tick_params(labelsize=SMALL - 1)
    axes[-1, 0].set_xlabel("time from sample 0 [s]")
    axes[-1, 1].set_xlabel("I", fontsize=SMALL)
    axes[0, 1].set_title("Q over I, later half", fontsize=SMALL)
    if len(of.prn):
        axes[0, 0].legend(
            loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=SMALL, frameon=False
        )
    fig.suptitle(f"{title}: prompts of 1 ms [standard deviations of the noise]", fontsize=SMALL + 1)
    return fig


def whole(surface: Surface, ax: Axes) -> Axes:
    """Energy over all code phases and Dopplers, the highest of neighbouring delays."""
    order = np.argsort(surface.code_phase_chips)
    energy = surface.energy[:, order]
    n = max(1, energy.shape[1] // _COLUMNS)
    starts = np.arange(0, energy.shape[1], n)
    highest = np.maximum.reduceat(energy, starts, axis=1)
    return _map(ax, surface.code_phase_chips[order][starts], surface.doppler_hz, highest)


def zoom(surface: Surface, ax: Axes) -> Axes:
    """The cells within a few chips of the peak."""
    n = surface.energy.shape[1]
    peak = int(surface.energy.max(axis=0).argmax())
    length = surface.code_phase_chips.max() * n / (n - 1)
    side = min(int(_ZOOM_CHIPS * n / length), n // 2 - 1)
    # delays fall as code phases grow
    columns = (peak - np.arange(-side, side + 1)) % n
    chips = surface.code_phase_chips[peak] + np.arange(-side, side + 1) * length / n
    return _map(ax, chips, surface.doppler_hz, surface.energy[:, columns])


def _map(ax: Axes, chips: np.ndarray, doppler_hz: np.ndarray, energy: np.ndarray) -> Axes:
    level = 10.0 * np.log10(np.maximum(energy, 1e-9))
    ax.pcolormesh(
        chips, doppler_hz / 1e3, level, shading="nearest", vmin=_LEAST_DB, cmap="viridis",
        rasterized=True,
    )  # fmt: skip
    ax.set_xlabel("code phase at the first sample [chips]")
    ax.set_ylabel("Doppler [kHz]")
    return ax
