"""Figures of the loop study: jitter, thresholds and slips, S-curves, C/N0 estimators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from signals.codes import GPS_L1CA
from ultratight.plots import COLOURS
from ultratight.tracking import loop_theory as theory
from ultratight.tracking.discriminators import CODE_DISCRIMINATORS, PHASE_DISCRIMINATORS

SMALL = 8.0
FINE_DBHZ = np.linspace(18.0, 51.0, 100)
MARKS = ("o", "s", "^", "v", "D", "x")


def tidy(ax: Axes, xlabel: str, ylabel: str, title: str = "") -> None:
    """Labels and grid."""
    ax.set_xlabel(xlabel, fontsize=SMALL)
    ax.set_ylabel(ylabel, fontsize=SMALL)
    ax.set_title(title, fontsize=SMALL)
    ax.grid(True, alpha=0.3)
    ax.tick_params(which="both", labelsize=7.0)


def jitter_page(
    levels: Sequence[float], loops: Mapping[str, Any], flown: Mapping[str, Any], clear_db: float
) -> Figure:
    """Measured points on lines of theory: phase, frequency, code."""
    page = Figure(figsize=(7.5, 9.0), layout="constrained")
    phase, frequency, code = page.subplots(3, 1, sharex=True, height_ratios=(3, 2, 3))
    for k, (name, loop) in enumerate(loops.items()):
        colour, style = COLOURS[k % len(COLOURS)], MARKS[k % len(MARKS)]
        ax, unit = (frequency, 1.0) if loop.fll else (phase, 360.0)
        for where, which, sigma, scale in (
            (ax, "carrier", loop.carrier_sigma, unit),
            (code, "code", lambda x, loop=loop: loop.code_sigma(x, 7), 1.0),
        ):
            squares = getattr(flown[name], which)
            seen = np.isfinite(squares).any(axis=0)
            at = np.array(levels)[seen]
            measured = [
                scale * np.sqrt(np.nanmean(x)) * sigma(c)
                for x, c in zip(squares[:, seen].T, at, strict=True)
            ]
            line = [scale * sigma(c) for c in FINE_DBHZ]
            where.plot(FINE_DBHZ, line, color=colour, linewidth=0.9)
            where.plot(at, measured, style, color=colour, markersize=4.0, label=name)
        ax.axvline(loop.threshold(), color=colour, linewidth=0.6, linestyle=":")
    tidy(phase, "", "phase jitter [deg]", "lines: theory; points: measured while lock was held; "
         "dotted: threshold by the 3-sigma rule")  # fmt: skip
    tidy(frequency, "", "frequency jitter [Hz]")
    tidy(code, "C/N0 [dB-Hz]", "code jitter [chips]")
    for ax in (phase, frequency, code):
        ax.set_yscale("log")
        ax.legend(fontsize=7.0, loc="upper right")
    page.suptitle(f"Closed loops, theory held to its word {clear_db:g} dB above the threshold",
                  fontsize=SMALL + 1.0)  # fmt: skip
    return page


def threshold_page(
    loops: Mapping[str, Any], flown: Mapping[str, Any], slips: Mapping[Any, tuple[float, int]]
) -> Figure:
    """Shares lost over C/N0 less the rule's threshold, and mean times to slip."""
    page = Figure(figsize=(7.5, 6.5), layout="constrained")
    (calm, moved), (slip, rest) = page.subplots(2, 2)
    for k, (name, loop) in enumerate(loops.items()):
        f, colour = flown[name], COLOURS[k % len(COLOURS)]
        mark = MARKS[k % len(MARKS)]
        calm.plot(f.around - loop.threshold(), f.lost.mean(axis=0), mark + "-", color=colour,
                  markersize=3.0, linewidth=0.8, label=name)  # fmt: skip
        if f.around_stress.size:
            rule = loop.threshold(0.5 * theory.COSTAS_LIMIT_CYCLES)
            moved.plot(f.around_stress - rule, f.lost_stress.mean(axis=0), mark + "-",
                       color=colour, markersize=3.0, linewidth=0.8)  # fmt: skip
    for ax, title in ((calm, "no motion"), (moved, "22.5 deg of dynamic stress")):
        tidy(ax, "C/N0 less the rule's threshold [dB]", "channels lost in 10 s", title)
        ax.axvline(0.0, color="black", linewidth=0.6)
        ax.axhline(0.1, color="black", linewidth=0.6, linestyle=":")
    handles, labels = calm.get_legend_handles_labels()
    rest.axis("off")
    db = sorted({key[1] for key in slips})
    for k, order in enumerate(sorted({key[0] for key in slips})):
        slip.plot(db, [slips[order, x][0] for x in db], MARKS[k], color=COLOURS[k],
                  label=f"order {order}")  # fmt: skip
    fine = np.linspace(db[0], db[-1], 50)
    slip.plot(fine, [theory.mean_time_to_slip_s(10.0 ** (0.1 * x), 1.0) for x in fine], "k-",
              linewidth=0.9, label="Viterbi, order 1")  # fmt: skip
    slip.set_yscale("log")
    tidy(slip, "loop SNR of the doubled angle [dB]", "mean time to slip, Bn = 1 Hz [s]",
         "Costas loops, product of I and Q")  # fmt: skip
    slip.legend(fontsize=7.0)
    rest.legend(handles, labels, fontsize=SMALL, loc="center", title="upper panels",
                title_fontsize=SMALL)  # fmt: skip
    return page


def code_loop_page(
    levels: Sequence[float], loops: Mapping[str, Any], flown: Mapping[str, Any]
) -> Figure:
    """Code loops without aid: jitter on lines of theory, losses around the rule's threshold."""
    page = Figure(figsize=(7.5, 7.5), layout="constrained")
    jitter, loss = page.subplots(2, 1, height_ratios=(3, 2))
    for k, (name, loop) in enumerate(loops.items()):
        f, colour, mark = flown[name], COLOURS[k % len(COLOURS)], MARKS[k % len(MARKS)]
        root = [np.sqrt(np.nanmean(x)) if np.isfinite(x).any() else np.nan for x in f.code.T]
        measured = np.array(root) * [loop.sigma(x) for x in levels]
        jitter.plot(FINE_DBHZ, [loop.sigma(x) for x in FINE_DBHZ], color=colour, linewidth=0.9)
        jitter.plot(levels, measured, mark, color=colour, markersize=4.0, label=name)
        jitter.axvline(loop.threshold(), color=colour, linewidth=0.6, linestyle=":")
        loss.plot(f.around - loop.threshold(), f.lost.mean(axis=0), mark + "-", color=colour,
                  markersize=3.0, linewidth=0.8)  # fmt: skip
    jitter.set_yscale("log")
    jitter.legend(fontsize=7.0, loc="upper right")
    tidy(jitter, "C/N0 [dB-Hz]", "code jitter [chips]",
         "code loops without aid; lines: theory; points: measured; dotted: the rule")  # fmt: skip
    tidy(loss, "C/N0 less the rule's threshold [dB]", "channels a chip off within 10 s")
    loss.axvline(0.0, color="black", linewidth=0.6)
    loss.axhline(0.1, color="black", linewidth=0.6, linestyle=":")
    return page


def curve_page(curves: tuple[Mapping[str, Any], Any]) -> Figure:
    """S-curves: lines by formula, dots without noise, crosses in the mean of noise."""
    code, phase = curves
    page = Figure(figsize=(7.5, 9.5), layout="constrained")
    axes = page.subplots(3, 2).ravel()
    for ax, (name, c) in zip(axes, code.items(), strict=False):
        for k, kind in enumerate(CODE_DISCRIMINATORS):
            ax.plot(c.error_chips, c.formula[k], color=COLOURS[k], linewidth=0.9, label=kind)
            ax.plot(c.error_chips[::2], c.quiet[k][::2], ".", color=COLOURS[k], markersize=4.0)
            ax.plot(c.error_chips[::4], c.noisy[k][::4], "x", color=COLOURS[k], markersize=4.0)
        ax.set_ylim(-0.65, 0.65)
        tidy(ax, "delay error [chips]", "output [chips]", name)
    axes[0].legend(fontsize=7.0, loc="upper left")
    ax = axes[len(code)]
    for k, kind in enumerate(PHASE_DISCRIMINATORS):
        ax.plot(phase.error_cycles, phase.formula[k], color=COLOURS[k], linewidth=0.9, label=kind)
        ax.plot(phase.error_cycles[::2], phase.noisy[k][::2], "x", color=COLOURS[k],
                markersize=4.0)  # fmt: skip
    ax.legend(fontsize=7.0, loc="upper left")
    tidy(ax, "phase error [cycles]", "mean output [cycles]", "phase, in noise")
    for spare in axes[len(code) + 1 :]:
        spare.axis("off")
    page.suptitle(f"{GPS_L1CA.modulation.name} and BOC(1,1): lines by formula, dots without noise, "
                  "crosses mean at 30 dB-Hz, 10 ms", fontsize=SMALL + 1.0)  # fmt: skip
    return page


def cn0_page(levels: Sequence[float], cn0: Mapping[str, np.ndarray]) -> Figure:
    """Bias and 10-90 % band of each estimator in one second."""
    page = Figure(figsize=(7.0, 4.0), layout="constrained")
    ax = page.subplots()
    for k, (kind, values) in enumerate(cn0.items()):
        full = np.array(levels) + 0.3 * (k - 1.5)
        low, high = np.nanpercentile(values, [10.0, 90.0], axis=1)
        middle = np.nanmean(values, axis=1)
        ax.errorbar(full, middle, [np.maximum(middle - low, 0.0), np.maximum(high - middle, 0.0)],
                    fmt=MARKS[k], color=COLOURS[k], markersize=4.0, linewidth=0.8,
                    label=kind)  # fmt: skip
    ax.axhline(0.0, color="black", linewidth=0.6)
    title = "one second of perfect lock: mean and 10-90 % band of those that have an answer"
    tidy(ax, "true C/N0 [dB-Hz]", "estimate less truth [dB]", title)
    ax.legend(fontsize=7.0)
    return page
