"""Plots: functions of (run, ax) that return ax; `figure` puts them together.

Nothing here shows or saves.  Colours are those of Okabe and Ito, told apart by the colour-blind;
runs that are compared also differ in line style.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ultratight.results import Run

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
STYLES = ("-", "--", "-.", ":")
LOST, REGAINED, LOCKED = "loss of lock", "lock regained", "phase lock"
"""Kinds of event; a scalar closure has no lock at the start, hence a word of its own"""
FLOOR_MPS = 1e-5
"""Smallest error that a logarithmic axis shows"""


def speed(run: Run, ax: Axes) -> Axes:
    """True speed and the estimated one."""
    estimate = np.linalg.norm(run["v_eb_e"], axis=1)
    ax.plot(run.t_s, run["speed_true"], color="black", linewidth=2.5, alpha=0.4, label="true")
    ax.plot(run.t_s, estimate, color=COLOURS[0], linewidth=1.0, label="estimated")
    ax.set_ylabel("speed [m/s]")
    ax.legend(loc="best", fontsize="small")
    return _time_axis(ax, run)


def velocity_error(
    runs: Sequence[Run],
    ax: Axes,
    labels: Sequence[str] | None = None,
    controls: Sequence[Run] = (),
) -> Axes:
    """Length of the velocity error of several runs, logarithmic.

    ``controls`` are the same runs with the cause switched off: same colours, thin and pale.
    """
    labels = labels or [label(run) for run in runs]
    for k, run in enumerate(runs):
        ax.plot(run.t_s, _error(run), STYLES[k % 4], color=COLOURS[k % 7], label=labels[k])
    for k, run in enumerate(controls):
        off = f"{labels[k]}, cause off" if k < len(labels) else "cause off"
        ax.plot(run.t_s, _error(run), color=COLOURS[k % 7], linewidth=0.7, alpha=0.6, label=off)
    ax.set_yscale("log")
    ax.set_ylabel("velocity error [m/s]")
    ax.legend(loc="best", fontsize="small", ncols=1 + bool(controls))
    return _time_axis(ax, runs[0])


def channel_iq(run: Run, ax: Axes, channel: str) -> Axes:
    """Prompt I and Q of one channel, of every dump or else row, in standard deviations of noise."""
    i = _index(run, channel)
    if "tap_i" in run:
        mine, prompt = run["dump_channel"] == i, run["tap_i"].shape[1] // 2
        t, prompts = run["dump_end"][mine], [run[tap][mine, prompt] for tap in ("tap_i", "tap_q")]
    else:
        t, prompts = run.t_s, [run["prompt_i"][:, i], run["prompt_q"][:, i]]
    for values, colour, text in zip(prompts, COLOURS, "IQ", strict=False):
        ax.plot(t, values, ".", markersize=1.5, color=colour, label=text)
    ax.set_ylabel(f"{channel} prompt\n({label(run)}) [noise s.d.]")
    ax.legend(loc="upper right", fontsize="small", markerscale=5.0, framealpha=1.0)
    return _time_axis(ax, run)


def cn0(run: Run, ax: Axes, channel: str) -> Axes:
    """C/N0 of one channel as the receiver estimates it."""
    ax.plot(run.t_s, run["cn0"][:, _index(run, channel)], color=COLOURS[2])
    ax.set_ylabel(f"{channel} C/N0\n({label(run)}) [dB-Hz]")
    return _time_axis(ax, run)


def lock_events(runs: Sequence[Run], ax: Axes, labels: Sequence[str] | None = None) -> Axes:
    """A row per channel: a line while it is locked, a gap while it is not, one line per run.

    Hand-over (triangle) and fall-back (cross) of the whole receiver stand above the rows.
    """
    labels = labels or [label(run) for run in runs]
    names = [str(name) for name in runs[0]["channel"]]
    height = 0.6 / len(runs)
    for k, run in enumerate(runs):
        colour = COLOURS[k % 7]
        for i, name in enumerate(names):
            y = i + (k - (len(runs) - 1) / 2.0) * height
            for start, stop in _locked(run, name):
                ax.plot([start, stop], [y, y], color=colour, linewidth=max(1.0, 5.0 / len(runs)))
            lost = [e.t_s for e in run.events if e.channel == name and e.kind == LOST]
            ax.plot(lost, [y] * len(lost), "x", color=colour, markersize=4.0)
        for kind, marker in (("hand-over", "^"), ("fall-back", "X")):
            t = [e.t_s for e in run.events if e.kind == kind]
            ax.plot(t, [len(names)] * len(t), marker, color=colour, linestyle="none")
        ax.plot([], [], color=colour, label=labels[k])
    ax.set_yticks(range(len(names)), [name.partition(":")[0] for name in names], fontsize="small")
    ax.set_ylabel("in lock")
    ax.set_ylim(-0.6, len(names) + 1.2)
    ax.legend(loc="upper right", fontsize="small", ncols=len(runs))
    return _time_axis(ax, runs[0])


def figure(
    runs: Sequence[Run],
    labels: Sequence[str] | None = None,
    channel: str | None = None,
    controls: Sequence[Run] = (),
    title: str | None = None,
) -> Figure:
    """Speed, velocity errors, one channel's I/Q and C/N0, lock: the page that explains a run.

    The channel shown is, unless it is named, the first of the first run that loses lock.
    """
    first = runs[0]
    channel = channel or _telling_channel(first)
    has_prompts = "tap_i" in first or "prompt_i" in first
    rows = [
        lambda ax: speed(first, ax),
        lambda ax: velocity_error(runs, ax, labels, controls),
        *([lambda ax: channel_iq(first, ax, channel)] if has_prompts else []),
        *([lambda ax: cn0(first, ax, channel)] if "cn0" in first else []),
        lambda ax: lock_events(runs, ax, labels),
    ]
    ratios = [2.0, 3.0, *([1.7] * (len(rows) - 3)), 2.6]
    page = Figure(figsize=(9.0, 2.4 * len(rows)), layout="constrained")
    axes = page.subplots(len(rows), 1, sharex=True, height_ratios=ratios)
    for draw, ax in zip(rows, axes, strict=True):
        draw(ax)
        ax.set_xlabel("")
    axes[-1].set_xlabel("receiver time [s]")
    page.suptitle(title or _title(first), fontsize="medium")
    return page


def label(run: Run) -> str:
    """How a run is named in a legend: its filter, or its closure where that has none."""
    return str(run.summary.get("filter") or run.summary.get("closure", "run")).upper()


def _title(run: Run) -> str:
    s = run.summary
    how = [s.get("closure"), s.get("measurement"), f"taps from {s.get('correlator')}"]
    imu = run.scenario.get("imu", {})
    cause = imu.get("accel_scale_factor_ppm", ["grade's own"])[0]
    if imu.get("accel_scale_factor_alternates") and run.seed % 2 == 0:
        cause = -cause
    return (
        f"{s.get('scenario')}: {run.scenario.get('title', '')}\n"
        f"{', '.join(x for x in how if x)}; seed {run.seed}; accelerometer scale factor, x axis: "
        f"{cause} ppm"
    )


def _time_axis(ax: Axes, run: Run) -> Axes:
    ax.set_xlabel("receiver time [s]")
    ax.set_xlim(0.0, float(run.t_s[-1]))
    ax.grid(True, alpha=0.3)
    return ax


def _error(run: Run) -> np.ndarray:
    error = np.linalg.norm(run["v_eb_e_true"] - run["v_eb_e"], axis=1)
    return np.maximum(error, FLOOR_MPS)


def _index(run: Run, channel: str) -> int:
    names = [str(name) for name in run["channel"]]
    if channel not in names:
        raise ValueError(f"channel: {channel!r} given, expected one of {', '.join(names)}")
    return names.index(channel)


def _telling_channel(run: Run) -> str:
    lost = [e.channel for e in run.events if e.kind == LOST and e.channel]
    return lost[0] if lost else str(run["channel"][0])


def _locked(run: Run, channel: str) -> list[tuple[float, float]]:
    """Spans (start, stop) in which the channel is in lock; without a first lock it starts so."""
    mine = [e for e in run.events if e.channel == channel and e.kind in (LOST, REGAINED, LOCKED)]
    starts_so = run.t_s.size and not (mine and mine[0].kind == LOCKED)
    spans, since = [], 0.0 if starts_so else None
    for event in mine:
        if event.kind == LOST and since is not None:
            spans.append((since, event.t_s))
            since = None
        elif event.kind != LOST and since is None:
            since = event.t_s
    if since is not None:
        spans.append((since, float(run.t_s[-1])))
    return spans
