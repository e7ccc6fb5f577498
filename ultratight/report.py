"""Runs and keys as lines of text, for people."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from ultratight import config, consistency
from ultratight.scenario import Scenario

if TYPE_CHECKING:
    from ultratight.results import Run


def report(flown: Run) -> list[str]:
    """The summary in words and numbers."""
    s: dict[str, Any] = flown.summary
    if "velocity_rms_mps" not in s:  # on a recording there is no truth to compare with
        return [line for k, v in s.items() for line in _wrapped(f"{k:21}{v}", 21)]

    def number(value: float | None, unit: str = "") -> str:
        return "-" if value is None else f"{value:.3g}{unit}"

    taps = "taps from samples" if s["correlator"] == "samples" else "taps in closed form"
    how = [s["closure"], s["filter"], s["measurement"], taps]
    velocity = "  ".join(f"{k} {number(v)}" for k, v in s["velocity_rms_mps"].items())
    lost = ", ".join(f"{k} at {v:g} s" for k, v in s["lost_lock_s"].items() if v is not None)
    rows = {
        "receiver": ", ".join(str(x) for x in how if x),
        "sky": f"{_sky(s)}, seed {s['seed']}",
        "velocity r.m.s. m/s": velocity,
        "  windows": _windows(flown.scenario),
        "position r.m.s. end": number(s["position_rms_end_m"], " m"),
        "NEES/3 of velocity": f"{number(s['nees_velocity'])} (median in the jump; consistent: 0.8)",
        "NIS/m": f"{number(s['nis_per_measurement'])} (mean outside the jump; consistent: 1)",
        "converged": ("yes" if s["converged"] else "no") + _divergence(flown),
        "lost lock": f"{lost or 'never'} (fall-backs: {s['fall_backs']})",
        "time": f"{s['duration_s']:g} s in {s['wall_s']:g} s "
        f"({number(s['realtime_factor'])} x real time, {s['cpu_path']})",
    }
    title = flown.scenario.get("title", "")
    lines = [title if title.startswith(s["scenario"]) else f"{s['scenario']}: {title}"]
    for name, text in rows.items():
        lines += _wrapped(f"{name:21}{text}", 21)
    return lines


def _sky(summary: dict[str, Any]) -> str:
    n, n_channel = summary["n_satellites"], len(summary["lost_lock_s"])
    return f"{n} satellites" if n_channel == n else f"{n} satellites in {n_channel} channels"


def _divergence(flown: Run) -> str:
    for event in flown.events:
        if event.kind == "diverged":
            return f"; the filter diverged at {event.t_s:g} s and was stopped: {event.reason}"
    return ""


def _wrapped(text: str, indent: int) -> list[str]:
    return textwrap.wrap(
        text, 79, subsequent_indent=" " * indent, break_on_hyphens=False, break_long_words=False
    )


def _windows(scenario: dict[str, Any]) -> str:
    """Which epochs the windows of the summary hold."""
    from ultratight.metrics import AFTER_S, END_S, SETTLED_S  # slow to load

    profile = scenario.get("profile") or []
    jump = scenario.get("jump_window_s") or (
        (profile[0]["t0_s"], profile[-1]["t1_s"]) if profile else None
    )
    end = f"end: the last {END_S:g} s"
    if jump is None:
        return f"before: all after {SETTLED_S:g} s; {end}"
    start, stop = jump
    return (
        f"before: {SETTLED_S:g} s to the jump; jump: {start:g} to {stop:g} s; "
        f"after: {AFTER_S:g} s from then; {end}"
    )


def made_with(provenance: dict[str, Any]) -> list[str]:
    """Versions in a line, then what else is needed to repeat the run."""
    versions = ", ".join(f"{k} {v}" for k, v in provenance.get("versions", {}).items())
    rest = [f"{k} {v}" for k, v in provenance.items() if k != "versions"]
    return _wrapped(f"{'made with':21}{versions}", 21) + [" " * 21 + line for line in rest]


def keys() -> Iterator[str]:
    """Every key of a scenario, and the names that some of them take."""
    names = consistency.names()
    for key in config.keys(Scenario):
        if key.expected == "table":
            yield f"\n[{key.name}]  {key.meaning}"
            continue
        choices = names.get(key.name)
        expected = ", ".join(choices) if choices else key.expected
        unit = f" [{key.unit}]" if key.unit else ""
        name = key.name.rpartition(".")[2]
        yield from _wrapped(f"{name}{unit}: {expected}; default: {key.default}", 4)
        if key.meaning:
            yield from _wrapped(f"    {key.meaning}", 4)
