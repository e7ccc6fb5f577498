"""Words on the plots: names of runs, title, and the outcome in one sentence."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from ultratight.consistency import TIGHT
from ultratight.results import Run

CLOSURES = {"scalar-ins": "scalar-INS", "vdll": "VDLL", "vdfll": "VDFLL"}
WITHOUT_IMU = {"scalar", "vdll", "vdfll"}
LOST_LOCK = " channels lost lock"
LINE = 134
"""Characters in a line of the title"""
TAPS = {"model": "taps in closed form", "samples": "taps from IF samples"}


def label(run: Run) -> str:
    """How a run is named in a legend: its filter, or its closure where that has none.

    The names of our filters are acronyms; a user's own class keeps its name.
    """
    name = run.summary.get("filter")
    closure = str(run.summary.get("closure", "run"))
    if name:
        name = str(name).upper() if str(name).islower() else str(name)
        return f"{name}, federated" if closure == "federated" else name
    return CLOSURES.get(closure, closure)


def title(runs: Sequence[Run], labels: Sequence[str], controls: Sequence[Run] = ()) -> str:
    """What was flown, and by what kind of receiver."""
    first = runs[0]
    s = first.summary
    closures = list(dict.fromkeys(str(run.summary.get("closure", "")) for run in runs))
    who = ", ".join(labels)
    if closures == ["ultra-tight"]:
        who = f"ultra-tight, {s.get('measurement')} ({who})"
    elif set(closures) <= set(TIGHT):
        who = f"{s.get('measurement')} ({who})"
    taps = TAPS.get(str(s.get("correlator")), "")
    how = ", ".join(part for part in (who, taps, f"seed {first.seed}") if part)
    if not WITHOUT_IMU.issuperset(closures):
        how += f"; accelerometer scale-factor error {_scale_factor(first)}"
        if any(_scale_factor(control) != _scale_factor(first) for control in controls):
            how += " (the cause)"
    return f"{s.get('scenario', '')}: {first.scenario.get('title', '')}\n{how}"


def outcome(runs: Sequence[Run], labels: Sequence[str], controls: Sequence[Run] = ()) -> str:
    """Who lost lock and who converged, from the summaries; empty where they do not say.

    Runs that fared alike share a clause.  ``controls`` are the runs without the cause.
    """
    if not all({"lost_lock_s", "converged"} <= run.summary.keys() for run in (*runs, *controls)):
        return ""
    clauses = _clauses(runs, labels)
    if controls:
        if all(run.summary["converged"] and not _n_lost(run) for run in controls):
            well = "all converge, none loses" if len(controls) > 1 else "it converges, no loss of"
            clauses.append(f"without the cause {well} lock")
        else:
            names = [label(run) for run in controls]
            clauses.append("without the cause " + "; ".join(_clauses(controls, names)))
    return "; ".join(clauses)


def typeset(text: str) -> str:
    """Units with exponents as they are printed, and lines that fit the page."""
    lines = text.replace("m/s2", "m/s²").strip().splitlines()
    return "\n".join(textwrap.fill(line, LINE) for line in lines)


def _clauses(runs: Sequence[Run], labels: Sequence[str]) -> list[str]:
    alike: dict[str, list[str]] = {}
    for run, name in zip(runs, labels, strict=True):
        alike.setdefault(_fate(run), []).append(name)
    clauses = [f"{', '.join(names)}: {fate}" for fate, names in alike.items()]
    return [c if k == 0 else c.replace(LOST_LOCK, "", 1) for k, c in enumerate(clauses)]


def _fate(run: Run) -> str:
    """One run's share of the sentence."""
    times = run.summary["lost_lock_s"]
    falls = run.summary.get("fall_backs", 0)
    fall_backs = f", {falls} fall-back{'s' if falls > 1 else ''}" if falls else ""
    verdict = "converged" if run.summary["converged"] else "not converged"
    return f"{_n_lost(run)} of {len(times)}{LOST_LOCK}{fall_backs}, {verdict}"


def _n_lost(run: Run) -> int:
    return sum(t is not None for t in run.summary["lost_lock_s"].values())


def _scale_factor(run: Run) -> str:
    imu = run.scenario.get("imu", {})
    if "accel_scale_factor_ppm" not in imu:
        return "as the grade has it"
    ppm = list(imu["accel_scale_factor_ppm"])
    if imu.get("accel_scale_factor_alternates") and run.seed % 2 == 0:
        ppm = [-value for value in ppm]
    if not any(ppm):
        return "0 ppm"
    axes = [f"{value:+g} ppm on {axis}" for value, axis in zip(ppm, "xyz", strict=True) if value]
    return ", ".join(axes)
