"""Figures of the star tracker's study: flight, errors, weights, gains."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from common.ledger import Quantity
from common.star_flight import SWITCH_S, flight
from ultratight.plots import COLOURS

SMALL = 8.0
ANGLES = ("roll", "heading", "pitch")


def _finish(*axes: Axes) -> None:
    for ax in axes:
        ax.grid(True, alpha=0.3)
        ax.tick_params(labelsize=7.0)


def _title(page: Figure, text: str) -> None:
    page.suptitle(text, fontsize=9.0, x=0.01, ha="left")


def flight_page(points: np.ndarray) -> Figure:
    """The missile's path, what it feels, and the bank's points."""
    flown, page = flight(), Figure(figsize=(9.0, 5.2), layout="constrained")
    (path, speed), (felt, scales) = page.subplots(2, 2)
    km = 1e-3
    path.plot(km * flown.ground_range_m, km * flown.height_m, color=COLOURS[0])
    path.set_xlabel("arc on the ground [km]", fontsize=SMALL)
    path.set_ylabel("height [km]", fontsize=SMALL)
    speed.plot(flown.t_s, km * np.hypot(*flown.velocity_mps.T), color=COLOURS[0])
    speed.set_ylabel("speed [km/s]", fontsize=SMALL)
    boost = flown.t_s <= 160.0
    felt.plot(flown.t_s[boost], np.linalg.norm(flown.force_mps2[boost], axis=1), color=COLOURS[0],
              label="specific force")  # fmt: skip
    felt.set_ylabel("specific force [m/s²]", fontsize=SMALL)
    pitch = felt.twinx()
    pitch.plot(flown.t_s[boost], np.degrees(flown.pitch[boost]), "--", color=COLOURS[1])
    pitch.set_ylabel("pitch [deg] (dashed)", fontsize=SMALL, color=COLOURS[1])
    pitch.tick_params(labelsize=7.0)
    for ax in (speed, felt):
        ax.set_xlabel("time [s]", fontsize=SMALL)
    scales.plot(*points.T, "o", color=COLOURS[0], label="models")
    scales.plot([0.5, 2.0], [0.5, 2.0], "*", color=COLOURS[1], markersize=9.0, label="truth")
    scales.plot(1.0, 1.0, "s", color=COLOURS[2], label="EKF, UKF")
    scales.set_xlabel("gyro noise / wgt0", fontsize=SMALL)
    scales.set_ylabel("accelerometer noise / wga0", fontsize=SMALL)
    scales.legend(fontsize=7.0, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    _finish(path, speed, felt, scales)
    _title(page, "Flight of the missile; below: powered flight, and the bank of ten models")
    return page


def running(x: np.ndarray, n: int) -> np.ndarray:
    """R.m.s. over n values before each, of (m,), from the n-th on."""
    total = np.concatenate([[0.0], np.cumsum(x**2)])
    return np.sqrt((total[n:] - total[:-n]) / n)


def errors(t_s: np.ndarray, found: Mapping[str, np.ndarray]) -> Figure:
    """Errors of the three angles: the first seconds, and their running r.m.s. after them."""
    page = Figure(figsize=(9.0, 6.0), layout="constrained")
    axes = page.subplots(3, 2, sharex="col", width_ratios=(1.0, 2.2))
    n = round(20.0 / (t_s[1] - t_s[0]))
    for k, (name, angle) in enumerate(found.items()):
        style = ("-", "--")[k % 2]
        for i in range(3):
            early = t_s <= 5.0
            axes[i, 0].plot(t_s[early], 1e6 * np.abs(angle[early, i]), style, color=COLOURS[k],
                            linewidth=1.0, label=name)  # fmt: skip
            late = running(1e6 * angle[:, i], n)
            keep = t_s[n - 1 :] >= 25.0
            axes[i, 1].plot(t_s[n - 1 :][keep], late[keep], style, color=COLOURS[k], linewidth=1.0)
    for i, name in enumerate(ANGLES):
        axes[i, 0].set_yscale("log")
        axes[i, 0].set_ylabel(f"{name} error [µrad]", fontsize=SMALL)
        axes[i, 1].set_ylabel("r.m.s. over 20 s [µrad]", fontsize=SMALL)
        axes[i, 1].set_xlim(0.0, t_s[-1])
        axes[i, 1].set_ylim(bottom=0.0)
        axes[i, 1].axvline(SWITCH_S, color="k", linewidth=0.6, linestyle=":")
        _finish(*axes[i])
    for ax in axes[-1]:
        ax.set_xlabel("time [s]", fontsize=SMALL)
    page.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=SMALL, ncols=len(found),
                loc="outside upper right")  # fmt: skip
    _title(page, "One flight from 10, 6, 10 deg; dotted: noise x 4")
    return page


def course(
    found: Mapping[str, tuple[np.ndarray, np.ndarray]],
    points: np.ndarray,
    truth: tuple[float, float],
    switch_s: float,
) -> Figure:
    """Weights of the models over time, by their gyro noise, with the estimate and the truth."""
    page = Figure(figsize=(9.0, 2.4 * len(found) + 0.6), layout="constrained")
    axes = page.subplots(len(found), 1, sharex=True, sharey=True)
    half = 0.5 * (points[1] - points[0])
    for ax, (name, (weight, scale)) in zip(axes, found.items(), strict=True):
        n = len(scale)
        per_s = weight.reshape(1000, n // 1000, -1).mean(axis=1)
        shown = ax.imshow(
            np.log10(np.maximum(per_s.T, 1e-4)), aspect="auto", origin="lower", cmap="Blues",
            vmin=-4.0, vmax=0.0, extent=(0.0, 1000.0, points[0] - half, points[-1] + half),
            interpolation="nearest",
        )  # fmt: skip
        t = np.arange(1, n + 1) * 1000.0 / n
        ax.plot(t, scale, color=COLOURS[1], linewidth=0.9, label="weighted mean")
        ax.plot([0, switch_s, switch_s, 1000], np.repeat(truth, 2), "k--", linewidth=1.0,
                label="truth")  # fmt: skip
        ax.set_ylabel("gyro noise / wgt0", fontsize=SMALL)
        ax.set_title(name, fontsize=SMALL, loc="left")
        ax.tick_params(labelsize=7.0)
    axes[-1].set_xlabel("time [s]", fontsize=SMALL)
    bar = page.colorbar(shown, ax=axes, label="weight (mean of a second)")
    bar.set_ticks([-4, -3, -2, -1, 0], labels=["≤1e-4", "1e-3", "1e-2", "0.1", "1"])
    bar.ax.tick_params(labelsize=7.0)
    page.legend(*axes[0].get_legend_handles_labels(), fontsize=SMALL, ncols=2,
                loc="outside upper right")  # fmt: skip
    _title(page, "Weights of the ten models of one flight from 10, 6, 10 arcmin")
    return page


def gains(found: Mapping[str, Mapping[str, Quantity]]) -> Figure:
    """Gain over the EKF by cell, with 95 % intervals."""
    page = Figure(figsize=(9.0, 3.8), layout="constrained")
    ax = page.subplots()
    names = list(dict.fromkeys(name for cell in found.values() for name in cell))
    for k, name in enumerate(names):
        at = [c for c, cell in enumerate(found.values()) if name in cell]
        q = [cell[name] for cell in found.values() if name in cell]
        middle = np.array([x.value for x in q], float)
        ends = np.abs(np.array([[x.low, x.high] for x in q], float).T - middle)
        ax.errorbar(np.array(at) + 0.13 * (k - 1.5), middle, ends, fmt="o^sD"[k],
                    color=COLOURS[k], markersize=4.5, elinewidth=0.9, label=name)  # fmt: skip
    ax.axhline(0.0, color="k", linewidth=0.6)
    ax.set_xticks(range(len(found)), [c.replace("star ", "star\n") for c in found], fontsize=7.5)
    ax.set_ylabel("gain over the EKF [%]", fontsize=SMALL)
    ax.legend(fontsize=7.0, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    _finish(ax)
    _title(page, "R.m.s. attitude error after 50 s: by how much it is smaller than the EKF's")
    return page
