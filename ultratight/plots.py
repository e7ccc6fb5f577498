"""Plots: functions of (run, ax) that return ax; `figure` puts them together.

Nothing here shows or saves.  Colours are those of Okabe and Ito, told apart by the colour-blind;
runs that are compared also differ in line width and style.  Legends stand above the axes, where
they hide nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from ultratight import plots_text
from ultratight.consistency import TIGHT
from ultratight.plots_text import label
from ultratight.results import Event, Run

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
IQ_COLOURS = ("#000000", "#E69F00")
STYLES = ("-", "--", "-.", ":")
MARKERS = ("o", "s", "^", "v", "D", "P", "*")
LOST, REGAINED, LOCKED = "loss of lock", "lock regained", "phase lock"
"""Kinds of event; a scalar closure has no lock at the start, hence a word of its own"""
OVER, BACK, DIVERGED = "hand-over", "fall-back", "diverged"
RECEIVER_EVENTS = {OVER: ("^", -1), BACK: ("v", 1), DIVERGED: ("D", 0)}
"""Kinds of event of the receiver as a whole: marker, and on which side of the bar it stands"""
FLOOR_MPS = 1e-5
"""Smallest error that a logarithmic axis shows"""
DECADES = 3
"""A logarithmic axis has at least so many"""
SMALL = 8.0
"""Size of legends and panel titles [pt]"""

Panel = tuple[float, Callable[[Axes], Axes]]
"""Height [in] and what is drawn"""


def speed(run: Run, ax: Axes, name: str | None = None, colour: str = COLOURS[0]) -> Axes:
    """True speed and the one that the run, called ``name``, estimates."""
    estimate = np.linalg.norm(run["v_eb_e"], axis=1)
    text = f"estimated ({name or label(run)})"
    ax.plot(run.t_s, run["speed_true"], color="black", linewidth=2.5, alpha=0.4, label="true")
    ax.plot(run.t_s, estimate, color=colour, linewidth=1.0, label=text)
    ax.set_ylabel("speed [m/s]")
    return _finish(ax, [run])


def velocity_error(
    runs: Sequence[Run],
    ax: Axes,
    labels: Sequence[str] | None = None,
    controls: Sequence[Run] = (),
) -> Axes:
    """Length of the velocity error of several runs, logarithmic.

    ``controls`` are the same runs with the cause switched off: same colours, thin, with
    markers in turn, so that curves that coincide are all seen.
    """
    labels = labels or [label(run) for run in runs]
    for k, run in enumerate(runs):
        width = max(0.8, 2.0 - 0.5 * k)  # the later ones lie on top
        ax.plot(
            run.t_s, _error(run), STYLES[k % 4], color=COLOURS[k % 7], linewidth=width,
            label=labels[k],
        )  # fmt: skip
    for k, run in enumerate(controls):
        n, text = run.t_s.size, f"{labels[k]}, cause off" if k < len(labels) else "cause off"
        turn = (n * k // (16 * len(controls)), max(1, n // 16))
        ax.plot(
            run.t_s, _error(run), STYLES[k % 4], color=COLOURS[k % 7], linewidth=0.6, alpha=0.8,
            marker=MARKERS[k % 7], markevery=turn, markersize=4.0, markerfacecolor="white",
            label=text,
        )  # fmt: skip
    _logarithmic(ax, np.concatenate([_error(run) for run in (*runs, *controls)]))
    ax.set_ylabel("velocity error [m/s]")
    return _finish(ax, runs)


def channel_iq(run: Run, ax: Axes, channel: str, name: str | None = None) -> Axes:
    """Prompt I and Q of one channel: every dump, or the data bits that the rows have."""
    i = _index(run, channel)
    if "tap_i" in run:
        mine, prompt = run["dump_channel"] == i, run["tap_i"].shape[1] // 2
        t, prompts = run["dump_end"][mine], [run[tap][mine, prompt] for tap in ("tap_i", "tap_q")]
    else:
        t, prompts = run.t_s, [run["prompt_i"][:, i], run["prompt_q"][:, i]]
    reach = 1.1 * max(np.abs(v[np.isfinite(v)]).max(initial=1.0) for v in prompts)
    for values, colour, text in zip(prompts, IQ_COLOURS, "IQ", strict=True):
        ax.plot(t, values, ".", markersize=1.5, color=colour, label=text)
    over = f" over {1e3 * np.median(np.diff(t)):.0f} ms" if t.size > 1 else ""
    text = f"{_short(channel)}, {name or label(run)}: prompt I and Q{over}"
    _heading(ax, f"{text}, in standard deviations of the noise (s.d.)")
    ax.set_ylim(-reach, reach)
    ax.set_ylabel("prompt\n[noise s.d.]")
    return _finish(ax, [run], markerscale=5.0)


def cn0(
    runs: Sequence[Run],
    ax: Axes,
    channel: str,
    labels: Sequence[str] | None = None,
    colours: Sequence[str] = COLOURS,
) -> Axes:
    """C/N0 of one channel as the receivers estimate it."""
    labels = labels or [label(run) for run in runs]
    for k, run in enumerate(runs):
        values = run["cn0"][:, _index(run, channel)]
        ax.plot(run.t_s, values, color=colours[k % len(colours)], linewidth=1.2, label=labels[k])
    _heading(ax, f"{_short(channel)}: carrier-to-noise density ratio as the receiver estimates it")
    ax.set_ylabel("C/N0\n[dB-Hz]")
    return _finish(ax, runs)


def lock_events(runs: Sequence[Run], ax: Axes, labels: Sequence[str] | None = None) -> Axes:
    """A row per channel: a bar while it is in lock, a cross at each loss; a bar per run.

    The row above shows the receiver as a whole: a bar while it measures coherently, hand-overs
    below it and fall-backs above.
    """
    labels = labels or [label(run) for run in runs]
    names = [str(name) for name in runs[0]["channel"]]
    height, width = 0.75 / len(runs), max(1.0, 4.0 / len(runs) ** 0.6)
    seen = {event.kind for run in runs for event in run.events}
    ticks: dict[float, str] = dict(enumerate(map(_short, names)))
    if seen & RECEIVER_EVENTS.keys():
        ticks[len(names) + 0.4] = "coherent"
    for k, run in enumerate(runs):
        colour, shift = COLOURS[k % 7], ((len(runs) - 1) / 2.0 - k) * height
        ax.plot([], [], color=colour, linewidth=width, label=labels[k])
        for i, name in enumerate(names):
            _bars(ax, _locked(run, name), i + shift, colour, width)
            lost = [e.t_s for e in run.events if e.channel == name and e.kind == LOST]
            ax.plot(lost, [i + shift] * len(lost), "x", color="black", markersize=1.5 + width)
        y = len(names) + 0.4 + 1.6 * shift
        _bars(ax, _coherent(run), y, colour, 0.5 * width)
        for kind, (marker, side) in RECEIVER_EVENTS.items():
            t = [e.t_s for e in run.events if e.kind == kind]
            ax.plot(t, [y + 0.4 * height * side] * len(t), marker, color=colour, markersize=3.5)
    for kind, (marker, _) in {LOST: ("x", 0), **RECEIVER_EVENTS}.items():
        if kind in seen:
            ax.plot([], [], marker, color="black", markersize=4.0, label=kind)
    ax.set_yticks([*ticks], [*ticks.values()], fontsize=7.0)
    ax.set_ylabel("in lock")
    ax.set_ylim(-0.7, max(ticks) + 0.8)
    return _finish(ax, runs)


def background(runs: Sequence[Run], ax: Axes, named: bool = True) -> Axes:
    """What happens to the receiver, behind the curves; to be drawn before them.

    Acceleration is shaded; a dotted line stands at the first change to coherent measurements.
    """
    for k, (start, stop) in enumerate(_accelerated(runs[0])):
        text = "acceleration" if named and k == 0 else None
        ax.axvspan(start, stop, color="black", alpha=0.08, linewidth=0.0, zorder=0.0, label=text)
    over = {event.t_s for run in runs for event in run.events if event.kind == OVER}
    if over:
        text = "hand-over" if len(over) == 1 else "first hand-over"
        line = ax.axvline(min(over), color="black", linestyle=":", linewidth=1.0)
        if named:
            line.set_label(text)
    return ax


def figure(
    runs: Sequence[Run],
    labels: Sequence[str] | None = None,
    channel: str | None = None,
    controls: Sequence[Run] = (),
    title: str | None = None,
) -> Figure:
    """Speed, velocity errors, one channel's I/Q and C/N0, lock: the page that explains a run.

    The channel shown is, unless it is named, the first of the first run that loses lock; of
    several runs that one and the last are shown.  The outcome is told below the title.
    """
    names = list(labels or [label(run) for run in runs])
    told = _loser(runs)
    channel = channel or _telling_channel(runs[told])
    pair = [k for k in dict.fromkeys((told, len(runs) - 1)) if channel in runs[k]["channel"]]
    heard = [k for k in pair if "cn0" in runs[k]]
    panels: list[Panel] = [
        (1.3, partial(speed, runs[told], name=names[told], colour=COLOURS[told % 7])),
        (2.6, partial(velocity_error, runs, labels=names, controls=controls)),
    ]
    for k in pair:
        if "tap_i" in runs[k] or "prompt_i" in runs[k]:
            panels.append((1.3, partial(channel_iq, runs[k], channel=channel, name=names[k])))
    if heard:
        voices = [runs[k] for k in heard]
        said, colours = [names[k] for k in heard], [COLOURS[k % 7] for k in heard]
        draw = partial(cn0, voices, channel=channel, labels=said, colours=colours)
        panels.append((1.2, draw))
    n_bar = min(40, len(runs[0]["channel"]) * len(runs))
    panels.append((1.0 + 0.06 * n_bar, partial(lock_events, runs, labels=names)))
    words = title or plots_text.title(runs, names, controls)
    return _page(runs, panels, f"{words}\n{plots_text.outcome(runs, names, controls)}")


def _page(runs: Sequence[Run], panels: Sequence[Panel], words: str) -> Figure:
    heights = [inches for inches, _ in panels]
    page = Figure(figsize=(9.0, 1.0 + 1.25 * sum(heights)), layout="constrained")
    axes = page.subplots(len(panels), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    for k, ((_, draw), ax) in enumerate(zip(panels, axes, strict=True)):
        draw(background(runs, ax, named=k == 0)).set_xlabel("")
    axes[-1].set_xlabel("receiver time [s]")
    page.suptitle(plots_text.typeset(words), fontsize=9.0, x=0.01, ha="left")
    return page


def _finish(ax: Axes, runs: Sequence[Run], markerscale: float = 1.0) -> Axes:
    """Time axis, grid, and the legend above the axes, on the right."""
    ax.set_xlabel("receiver time [s]")
    ax.set_xlim(0.0, max(float(run.t_s[-1]) for run in runs))
    ax.grid(True, which="major", alpha=0.3)
    handles, _ = ax.get_legend_handles_labels()
    ax.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, borderpad=0.1,
        fontsize=SMALL, frameon=False, ncols=_columns(len(handles)), columnspacing=1.2,
        handlelength=1.8, handletextpad=0.5, markerscale=markerscale,
    )  # fmt: skip
    return ax


def _columns(n_entry: int) -> int:
    """Of a legend with rows of up to eight."""
    n_row = -(-n_entry // 8)
    return -(-n_entry // max(1, n_row))


def _heading(ax: Axes, text: str) -> None:
    ax.set_title(text, loc="left", fontsize=SMALL, pad=3.0)


def _logarithmic(ax: Axes, values: np.ndarray) -> None:
    """Whole decades around the values, at least `DECADES`, all of them labelled."""
    good = values[np.isfinite(values)]
    low, high = (np.log10(good.min()), np.log10(good.max())) if good.size else (-2.0, 0.0)
    bottom, top = np.floor(low), np.ceil(high)
    bottom, top = min(bottom, top - DECADES), max(top, bottom + 1.0)
    ax.set_yscale("log")
    ax.set_ylim(10.0**bottom, 10.0**top)
    ax.yaxis.set_major_locator(LogLocator(10.0, numticks=20))
    ax.yaxis.set_minor_locator(LogLocator(10.0, subs=range(2, 10), numticks=20))
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.grid(True, which="minor", axis="y", alpha=0.12)


def _accelerated(run: Run) -> list[tuple[float, float]]:
    """Spans (start, stop) of the profile, those that touch joined; else the window named."""
    spans: list[tuple[float, float]] = []
    for segment in run.scenario.get("profile", ()):
        start, stop = segment["t0_s"], segment["t1_s"]
        if spans and start <= spans[-1][1]:
            spans[-1] = (spans[-1][0], stop)
        else:
            spans.append((start, stop))
    window = run.scenario.get("jump_window_s")
    return spans or ([(window[0], window[1])] if window else [])


def _error(run: Run) -> np.ndarray:
    error = np.linalg.norm(run["v_eb_e_true"] - run["v_eb_e"], axis=1)
    return np.maximum(error, FLOOR_MPS)


def _index(run: Run, channel: str) -> int:
    names = [str(name) for name in run["channel"]]
    if channel not in names:
        raise ValueError(f"channel: {channel!r} given, expected one of {', '.join(names)}")
    return names.index(channel)


def _short(channel: str) -> str:
    """Satellite of a channel: the signal is the same for all."""
    return channel.partition(":")[0]


def _losses(run: Run) -> list[str]:
    return [event.channel for event in run.events if event.kind == LOST and event.channel]


def _loser(runs: Sequence[Run]) -> int:
    """The first run that loses lock, or the first."""
    return next((k for k, run in enumerate(runs) if _losses(run)), 0)


def _telling_channel(run: Run) -> str:
    return str([*_losses(run), *run["channel"]][0])


def _locked(run: Run, channel: str) -> list[tuple[float, float]]:
    """Spans (start, stop) in lock; where carrier loops pull in first, a run begins without."""
    begins = run.scenario["receiver"]["closure"] in (*TIGHT, "vdfll")
    mine = [event for event in run.events if event.channel in (channel, "")]
    return _spans(run, mine, (REGAINED, LOCKED), (LOST, DIVERGED), begins)


def _coherent(run: Run) -> list[tuple[float, float]]:
    """Spans (start, stop) of coherent measurement."""
    return _spans(run, run.events, (OVER,), (BACK, DIVERGED), False)


def _spans(
    run: Run, events: Sequence[Event], on: Sequence[str], off: Sequence[str], begins: bool
) -> list[tuple[float, float]]:
    """Spans (start, stop) between the kinds of event that begin and those that end one."""
    spans: list[tuple[float, float]] = []
    since = 0.0 if begins else None
    for event in events:
        if event.kind in off and since is not None:
            spans.append((since, event.t_s))
            since = None
        elif event.kind in on and since is None:
            since = event.t_s
    return spans if since is None else [*spans, (since, float(run.t_s[-1]))]


def _bars(
    ax: Axes, spans: Sequence[tuple[float, float]], y: float, colour: str, width: float
) -> None:
    """Lines that end where the spans do: butt, not projecting caps."""
    for span in spans:
        ax.plot(span, (y, y), color=colour, linewidth=width, solid_capstyle="butt")
