"""One run of a sweep again, alone, from what its folder says."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ultratight import config
from ultratight.config import InvalidInput
from ultratight.filters.gaussian import Filter
from ultratight.results import Run
from ultratight.scenario import Scenario
from ultratight.sweeps import cells, flights, journal
from ultratight.sweeps.cells import Axis, Factories
from ultratight.sweeps.flights import Item, Record, Task
from ultratight.sweeps.work import factory_sha256


class Rerun(NamedTuple):
    """A run flown again, and what the sweep kept of it."""

    run: Run | None
    """None: it failed"""
    now: Record
    then: Record | None
    """None: the sweep has not finished it"""
    other: dict[str, tuple[Any, Any]]
    """What has changed since, of versions, sources and CPU path: (then, now)"""

    @property
    def agrees(self) -> bool | None:
        """Every bit of trajectory and figures; None where there is nothing to compare with."""
        return None if self.then is None else self.now["sha256"] == self.then["sha256"]


def rerun(
    folder: str | Path,
    run: int,
    cell: Mapping[str, Any] | None = None,
    *,
    filters: Factories | None = None,
) -> Rerun:
    """Fly one run of a sweep again.

    Parameters
    ----------
    folder : of the sweep.
    run : its number.
    cell : dimension (or key) -> label, for each axis with more than one.
    filters : those that were given to the sweep.

    Raises
    ------
    InvalidInput
        No sweep there, no such cell, a filter that is missing or not the same.
    """
    folder = Path(folder)
    header = journal.read_header(folder)
    if isinstance(run, bool) or not isinstance(run, int) or run < 0:
        raise InvalidInput(f"run: {run} given, expected a whole number from 0")
    about = header["about"]
    axes = cells.from_plain(about["axes"])
    place = _place(axes, cell or {})
    factories = _factories(header["filters"], filters or {})
    copies = {path: _copy(folder / copy) for path, copy in about["inputs"].items()}
    chosen = cells.cell_at(
        Scenario.from_dict(about["scenario"]), axes, place, factories,
        lambda path: copies.get(path, path),
    )  # fmt: skip
    number = int(np.ravel_multi_index(place, [len(axis.labels) for axis in axes])) if axes else 0
    text = json.dumps(chosen.scenario.to_dict())
    task = Task(
        items=(Item(number, run, header["seed"] + run, text, chosen.own),),
        factories={name: (f, header["filters"][name]) for name, f in factories.items()},
        keep=tuple(header["keep"]),
        every_s=header["every_s"] or 1.0,
        code=flights.code(),
    )
    now, flown = flights.fly_one(task.items[0], task)
    then = journal.find(folder, number, run)
    return Rerun(flown, now, then, _changed(header["code"], then, now))


def _copy(path: Path) -> str:
    """A copy of a file that scenarios name; its folder is called by what it held."""
    try:
        sha = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InvalidInput(
            f"{path}: cannot be read ({error.strerror}), expected the sweep's copy"
        ) from None
    if not sha.startswith(path.parent.name):
        raise InvalidInput(f"{path}: has been changed, expected the copy that the sweep flew with")
    return str(path)


def _place(axes: Sequence[Axis], chosen: Mapping[str, Any]) -> tuple[int, ...]:
    """The cell that is meant, by dimension or key."""
    names = {name for axis in axes for name in (axis.dim, axis.key)}
    problems = [
        f"cell: {name} given, expected one of {', '.join(axis.dim for axis in axes) or 'nothing'}"
        for name in chosen
        if name not in names
    ]
    place = []
    for axis in axes:
        given = chosen.get(axis.dim, chosen.get(axis.key))
        texts = [str(label) for label in axis.labels]
        if given is None and len(texts) == 1:
            place.append(0)
        elif given in axis.labels:
            place.append(axis.labels.index(given))
        elif given is not None and cells.label(given) in texts:
            place.append(texts.index(cells.label(given)))
        else:
            said = "missing" if given is None else f"{config.show(given)} given"
            problems.append(f"cell: {axis.dim} {said}, expected one of {', '.join(texts)}")
    if problems:
        raise InvalidInput(problems)
    return tuple(place)


def _factories(then: Mapping[str, str], given: Factories) -> dict[str, Callable[[], Filter]]:
    """The user's own filters, which must be those of the sweep."""
    for name, sha in then.items():
        if name not in given:
            raise InvalidInput(
                f"filters: the sweep had {name} given in Python, expected it from Python here too "
                "(ultratight.rerun, filters=)"
            )
        if factory_sha256(given[name], name) != sha:
            raise InvalidInput(f"filters: {name} has another source than then, expected the same")
    return {name: given[name] for name in then}


def _changed(code: Mapping[str, Any], then: Record | None, now: Record) -> dict[str, Any]:
    """What decides the bits and is not as it was: name -> (then, now)."""
    here = flights.code()
    found = {k: (v, here.get(k)) for k, v in code.items() if here.get(k) != v}
    paths = [record["cost"].get("cpu_path") for record in (then, now) if record is not None]
    if len(set(paths)) > 1:
        found["cpu_path"] = (paths[0], paths[1])
    return found
