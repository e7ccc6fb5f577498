"""A run of a sweep where it is flown: in this process, a local worker or a worker of a cluster.

Everything that a run depends on comes with its task, and what goes back is a record: plain data,
with a SHA-256 of what is science in it.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ultratight import named_files
from ultratight.config import InvalidInput
from ultratight.filters.gaussian import Filter
from ultratight.provenance import sources_sha256, versions
from ultratight.results import Run
from ultratight.scenario import Scenario
from ultratight.simulation import run as simulate
from ultratight.sweeps.series import series

COST = ("wall_s", "loop_s", "realtime_factor", "cpu_path")
"""Of a summary: what belongs to the machine"""
_STATE = ("r_eb_e", "v_eb_e", "C_b_e")
"""What a receiver estimates; a scalar closure has no attitude"""
Record = dict[str, Any]


class Input(NamedTuple):
    """A file that scenarios name."""

    path: str
    sha256: str
    data: bytes | None = None
    """For workers that may not see the path"""


class Item(NamedTuple):
    """One run of one cell."""

    cell: int
    run: int
    seed: int
    scenario: str  # JSON
    own: str | None


class Task(NamedTuple):
    """Some runs in a row, with all that they need."""

    items: tuple[Item, ...]
    factories: Mapping[str, tuple[Callable[[], Filter], str]]
    """The user's own filters: factory, SHA-256 of its source"""
    keep: tuple[str, ...]
    every_s: float
    code: dict[str, Any]
    """`code` of the process that asks"""
    inputs: tuple[Input, ...] = ()


@cache
def code() -> dict[str, Any]:
    """What decides the bits, apart from the CPU: versions and sources."""
    return {**versions(), "sources_sha256": sources_sha256()}


def fly(task: Task) -> list[Record]:
    """Fly the runs of a task; one that fails is recorded with its reason.

    Raises
    ------
    InvalidInput
        Here are other versions or sources than where the task comes from.
    OSError, MemoryError
        No fault of the run.
    """
    if task.code != code():
        other = ", ".join(k for k in task.code if task.code[k] != code().get(k))
        raise InvalidInput(
            f"worker on {os.uname().nodename if hasattr(os, 'uname') else 'a machine'}: other "
            f"{other} than where the sweep was started, expected the same"
        )
    return [fly_one(item, task, whole=False)[0] for item in task.items]


def fly_one(item: Item, task: Task, whole: bool = True) -> tuple[Record, Run | None]:
    """The record of a run, and the run, see `simulation.run`; None where it failed."""
    began = time.perf_counter()
    scenario, digest = _scenario(item.scenario, task.inputs)
    factory, own_sha = task.factories[item.own] if item.own is not None else (None, None)
    failure, flown = "", None
    try:
        filter_ = None if factory is None else factory()
        flown = simulate(scenario, item.seed, filter=filter_, whole=whole)
    except (OSError, MemoryError):
        raise
    except Exception as error:
        if was_interrupted(error):
            raise KeyboardInterrupt from None
        failure = reason(error)
    kept = {} if flown is None else {
        name: series(flown, name, scenario.duration_s, task.every_s) for name in task.keep
    }  # fmt: skip
    made = _record(item, (digest, own_sha), flown, failure, kept)
    made["cost"]["took_s"] = time.perf_counter() - began
    return made, flown


def was_interrupted(error: BaseException | None) -> bool:
    """Is Ctrl-C behind it?  Inside a call of a compiled kernel it comes out as a SystemError."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


def _record(
    item: Item,
    digests: tuple[str, str | None],
    flown: Run | None,
    failure: str,
    kept: Mapping[str, np.ndarray],
) -> Record:
    """What is kept of a run; ``digests``: of its scenario and of the source of its own filter."""
    summary = dict(flown.summary) if flown is not None else {}
    cost = {key: summary.pop(key) for key in COST if key in summary}
    if item.own is not None and summary:
        summary["filter"] = item.own
    texts = {name: base64.b64encode(values.astype("<f8").tobytes()).decode("ascii")
             for name, values in kept.items()}  # fmt: skip
    estimate = None if flown is None else _estimate_sha256(flown)
    science = {
        "scenario_sha256": digests[0],
        "filter_sha256": digests[1],
        "seed": item.seed,
        "failure": failure.partition(":")[0],
        "summary": {k: v for k, v in summary.items() if k != "filter"},  # its name may be a path
        "estimate_sha256": estimate,
        "series": texts,
    }
    text = json.dumps(science, sort_keys=True, separators=(",", ":"))
    return {
        "cell": item.cell,
        "run": item.run,
        "seed": item.seed,
        "failure": failure,
        "summary": summary,
        "estimate_sha256": estimate,
        "cost": cost,
        "series": texts,
        "sha256": hashlib.sha256(text.encode()).hexdigest(),
    }


def reason(error: Exception) -> str:
    """An exception in one line: kind, message and the place where it was raised."""
    said = " ".join(str(error).split()) or "no message"
    frames = traceback.extract_tb(error.__traceback__)
    at = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {said}{at}"


def values_of(text: str) -> np.ndarray:
    """A series of a record as numbers."""
    return np.frombuffer(base64.b64decode(text), "<f8")


def _estimate_sha256(run: Run) -> str:
    """Of the whole trajectory that the receiver has estimated."""
    digest = hashlib.sha256()
    for values in (run.t_s, *(run[name] for name in _STATE if name in run)):
        digest.update(np.ascontiguousarray(values, "<f8").data)
    return digest.hexdigest()


@lru_cache(maxsize=256)
def _scenario(text: str, inputs: tuple[Input, ...]) -> tuple[Scenario, str]:
    """A scenario and its digest; what it names is where this process finds it."""
    places = {entry.path: _found(entry) for entry in inputs if entry.data is not None}
    tree = named_files.moved(json.loads(text), lambda path: places.get(path, path))
    scenario = Scenario.from_dict(tree)
    return scenario, scenario.digest()


def _found(entry: Input) -> str:
    """A path with the content of an input: its own, or that of a copy made here."""
    path = Path(entry.path)
    try:
        if hashlib.sha256(path.read_bytes()).hexdigest() == entry.sha256:
            return entry.path
    except OSError:
        pass
    folder = Path(tempfile.mkdtemp(prefix="ultratight-input-"))
    copy = folder / path.name
    copy.write_bytes(entry.data or b"")
    return str(copy)
