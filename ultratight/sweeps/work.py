"""A sweep at work: its folder, its journal, the runs that are left, the Dataset at the end."""

from __future__ import annotations

import hashlib
import inspect
import json
import logging
import os
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ultratight import named_files
from ultratight.config import InvalidInput
from ultratight.filters.gaussian import Filter
from ultratight.provenance import provenance
from ultratight.sweeps import cells as cell
from ultratight.sweeps import dataset, flights, workers
from ultratight.sweeps.flights import Input, Item, Task
from ultratight.sweeps.journal import Journal
from ultratight.sweeps.plan import Plan

INPUTS = "inputs"
"""Folder of copies of the files that scenarios name"""
_log = logging.getLogger(__name__)


def writable(out: str | Path) -> Path:
    """A folder that can be written to."""
    if not str(out):
        raise InvalidInput('out: "" given, expected a folder')
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        raise InvalidInput(
            f"{folder}: cannot be written to ({error.strerror}), expected a folder"
        ) from None


class Work:
    """A plan, its folder and its journal."""

    def __init__(self, planned: Plan, folder: Path, fresh: bool) -> None:
        self.plan, self.folder = planned, folder
        shas = {name: factory_sha256(f, name) for name, f in planned.filters.items()}
        self.factories = {name: (f, shas[name]) for name, f in planned.filters.items()}
        self.inputs, self.texts = self._copy_inputs()
        made = _made(planned, shas, {path: entry.path for path, entry in self.inputs.items()})
        self.journal = Journal(folder, made, (len(planned.cells), planned.runs), fresh)
        if self.journal.damaged:
            _log.warning(
                "%s: %d damaged lines are left out", self.journal.path, self.journal.damaged
            )
        self._clear(fresh)

    def _clear(self, fresh: bool) -> None:
        """Away with what a killed process was writing, and with what is no longer the result."""
        gone = [*self.folder.glob(dataset.PARTS), *([self.folder / dataset.NAME] * fresh)]
        for path in gone:  # nobody else is at it: the journal is ours
            path.unlink(missing_ok=True)

    def _copy_inputs(self) -> tuple[dict[str, Input], list[str]]:
        """Copies of the files that scenarios name, and the scenarios that name the copies."""
        found: dict[str, Input] = {}

        def copied(path: str) -> str:
            if path not in found:
                data = Path(path).read_bytes()
                sha = hashlib.sha256(data).hexdigest()
                place = self.folder.resolve() / INPUTS / sha[:16] / Path(path).name
                if not (place.is_file() and place.read_bytes() == data):
                    place.parent.mkdir(parents=True, exist_ok=True)
                    part = place.with_name(f".{place.name}.{os.getpid()}.part")
                    part.write_bytes(data)
                    os.replace(part, place)
                found[path] = Input(str(place), sha, data)
            return found[path].path

        texts = [
            json.dumps(named_files.moved(one.scenario.to_dict(), copied)) for one in self.plan.cells
        ]
        return found, texts

    def task(self, places: np.ndarray, local: bool) -> Task:
        """Some runs (n, 2: run, cell) with all that they need."""
        p = self.plan
        items = [Item(i, r, p.seed + r, self.texts[i], p.cells[i].own) for r, i in places.tolist()]
        owns = {item.own for item in items if item.own is not None}
        return Task(
            items=tuple(items),
            factories={name: self.factories[name] for name in owns},
            keep=self.plan.keep,
            every_s=self.plan.every_s,
            code=flights.code(),
            inputs=() if local else tuple(self.inputs.values()),
        )

    def fly(
        self, executor: Any, jobs: int | None, progress: Callable[[float], None] | None
    ) -> None:
        """Fly what is not finished."""
        n, journal = self.plan.n_run, self.journal
        task = partial(self.task, local=workers.is_local(executor))
        if progress is not None:
            progress(journal.n_done / n)
        try:
            for records in workers.fly_all(journal.left, task, executor, jobs):
                for record in records:
                    journal.add(record)
                if progress is not None:
                    progress(journal.n_done / n)
            journal.sync()
        except OSError as error:
            raise OSError(f"{error}; {self.kept()}") from error
        except KeyboardInterrupt:
            raise KeyboardInterrupt(self.kept()) from None

    def kept(self) -> str:
        """What is finished, and how it goes on."""
        n_done, n = self.journal.n_done, self.plan.n_run
        return f"{n_done} of {n} runs are kept in {self.folder}, the same command goes on there"

    def write(self) -> None:
        """The Dataset of all that is asked for."""
        p, journal = self.plan, self.journal
        layout = dataset.Layout(journal.records())
        attributes = {
            "scenario": p.base.to_dict(),
            "over": cell.plain(p.axes),
            "seed": p.seed,
            "runs": p.runs,
            "digest": journal.digest(),
            "cpu_paths": list(layout.cpu_paths),
            "provenance": provenance(p.base, p.seed),
        }
        path = self.folder / dataset.NAME
        try:
            dataset.write(
                path, p.axes, p.cells, p.seeds, journal.records(), layout, p.keep, p.every_s,
                attributes,
            )  # fmt: skip
        except OSError as error:
            why = os.strerror(error.errno) if error.errno else error
            raise OSError(f"{path}: cannot be written ({why}); {self.kept()}") from error


def _made(p: Plan, shas: Mapping[str, str], copies: Mapping[str, str]) -> dict[str, Any]:
    """What every run depends on, and what one needs to fly one alone."""
    return {
        "scenario": named_files.by_content(p.base.to_dict()),
        "over": {axis.key: list(axis.labels) for axis in p.axes},
        "cells_sha256": hashlib.sha256(
            "".join(one.scenario.digest() for one in p.cells).encode()
        ).hexdigest(),
        "seed": p.seed,
        "keep": list(p.keep),
        "every_s": p.every_s if p.keep else None,
        "filters": dict(shas),
        "code": flights.code(),
        "about": {
            "scenario": p.base.to_dict(),
            "axes": cell.plain(p.axes),
            "inputs": {path: "/".join(Path(copy).parts[-3:]) for path, copy in copies.items()},
            "began": time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime()),
        },
    }  # fmt: skip


def factory_sha256(factory: Callable[[], Filter], name: str) -> str:
    """Of the file that a factory is written in and its name there, and of what is bound to it.

    `InvalidInput`: it has no source to be known by, or is bound to what has no plain text.
    """
    bound = ""
    if isinstance(factory, partial):
        bound = _bound(name, (factory.args, sorted(factory.keywords.items())))
        factory = factory.func
    if held := _held(factory):
        bound += _bound(name, held)
    try:
        path = inspect.getsourcefile(factory)
        source = Path(path).read_bytes() if path and Path(path).is_file() else None
        text = source if source is not None else inspect.getsource(factory).encode()
    except (OSError, TypeError):
        raise InvalidInput(
            f"filters: {name} has no source file, expected a class or function from one"
        ) from None
    what = f"{getattr(factory, '__qualname__', '')}{bound}"
    return hashlib.sha256(text + b"\0" + what.encode()).hexdigest()


def _held(factory: Callable[..., Any]) -> list[Any]:
    """What a function takes from where it was made: ``lambda: Mine(sigma)`` is known by sigma."""
    if not inspect.isfunction(factory):
        return []
    held = [one.cell_contents for one in factory.__closure__ or ()]
    held += [*(factory.__defaults__ or ()), *(factory.__kwdefaults__ or {}).values()]
    above = (factory.__globals__.get(used) for used in factory.__code__.co_names)
    return held + [value for value in above if isinstance(value, int | float | str)]


def _bound(name: str, values: Any) -> str:
    """What a factory is bound to, as text; of classes and functions their names."""
    text = repr(_named(values))
    if " at 0x" in text:
        raise InvalidInput(
            f"filters: {name} is bound to {' '.join(text.split())[:200]}, expected plain values"
        )
    return text


def _named(value: Any) -> Any:
    """``value`` with the full names of classes and functions, and arrays as lists, in it."""
    if isinstance(value, list | tuple):
        return type(value)(map(_named, value)) if type(value) in (list, tuple) else value
    if isinstance(value, dict):
        return {key: _named(inner) for key, inner in value.items()}
    if inspect.isclass(value) or inspect.isroutine(value):
        return f"{value.__module__}.{value.__qualname__}"
    return value.tolist() if isinstance(value, np.ndarray) else value
