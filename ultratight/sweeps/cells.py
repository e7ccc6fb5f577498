"""What is swept: axes, and the cells that their products are.

An axis is a key with its values, or a name with named sets of changes (keys varied together).
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from ultratight import config, named_files
from ultratight.config import InvalidInput
from ultratight.filters.gaussian import Filter
from ultratight.filters.own import made_by
from ultratight.scenario import Scenario

Over = Mapping[str, Sequence[Any] | Mapping[str, Mapping[str, Any]]]
"""key -> values, or name -> {label: {key: value, ...}}"""
Factories = Mapping[str, Callable[[], Filter]]
RESERVED = ("run", "time_s", "window", "channel", "seed")
"""Dimensions and coordinates that a sweep has anyway"""
_PROBLEMS_SHOWN = 5


class Axis(NamedTuple):
    """One swept key, or one named set of changes."""

    dim: str
    key: str
    labels: tuple[Any, ...]
    changes: tuple[dict[str, Any], ...]
    """Dotted changes of each label"""


class Cell(NamedTuple):
    """One combination."""

    place: tuple[int, ...]
    """On each axis"""
    labels: dict[str, Any]
    """dimension -> label"""
    scenario: Scenario
    own: str | None = None
    """Name of its filter among those given as factories"""

    def __str__(self) -> str:
        return ", ".join(f"{dim} {label}" for dim, label in self.labels.items()) or "one cell"


def axes(over: Over) -> tuple[Axis, ...]:
    """Axes in the order given.  `InvalidInput`: no values, or one of them twice."""
    if not (isinstance(over, Mapping) and all(isinstance(key, str) for key in over)):
        raise InvalidInput(f"over: {config.show(over)} given, expected {{key: [value, ...], ...}}")
    found, problems = [], []
    for key, given in over.items():
        values = _plain(given)
        if isinstance(values, str) or not isinstance(values, Sequence | Mapping):
            problems.append(f"over {key}: {config.show(values)} given, expected a list of values")
            continue
        if isinstance(values, Mapping):
            none = [name for name, change in values.items() if not isinstance(change, Mapping)]
            if none:
                problems.append(
                    f"over {key}: {none[0]} is {config.show(values[none[0]])}, expected a table of "
                    "keys that are varied together"
                )
                continue
            labels = _labels(tuple(values))
            changes = tuple({k: _plain(v) for k, v in c.items()} for c in values.values())
        else:
            values = tuple(_plain(value) for value in values)
            labels = _labels(values)
            changes = tuple({key: value} for value in values)
        if not labels:
            problems.append(f"over {key}: nothing given, expected at least one value")
        twice = [label for i, label in enumerate(labels) if label in labels[:i]]
        if twice:
            problems.append(f"over {key}: {twice[0]} given twice, expected each value once")
        found.append(Axis("", key, labels, changes))
    if problems:
        raise InvalidInput(problems)
    return _named(found)


def _named(found: list[Axis]) -> tuple[Axis, ...]:
    """With names of dimensions: the last part of a key where that is clear, else the key."""
    last = [axis.key.rpartition(".")[2] for axis in found]
    return tuple(
        axis._replace(
            dim=axis.key if last.count(name) > 1 or name in RESERVED else name,
        )
        for axis, name in zip(found, last, strict=True)
    )


def _plain(value: Any) -> Any:
    """Numpy's numbers and arrays as Python's."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


def _labels(values: Sequence[Any]) -> tuple[Any, ...]:
    """Numbers as they are, all else as text."""
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return tuple(values)
    return tuple(label(value) for value in values)


def label(value: Any) -> str:
    """A value as the text that stands for it along its axis."""
    if value is None:
        return "none"
    return value if isinstance(value, str) else json.dumps(value, default=str)


def cells(
    base: Scenario, of: Sequence[Axis], factories: Factories, max_cells: int | None = None
) -> list[Cell]:
    """Every combination, the last axis first, each a valid scenario.

    Raises
    ------
    InvalidInput
        Too many cells, a key set by two axes, a scenario that cannot be, a file that is not there.
    """
    n_cell = 1
    for axis in of:
        n_cell *= len(axis.labels)
    if max_cells is not None and n_cell > max_cells:
        sizes = " x ".join(f"{len(axis.labels)} {axis.dim}" for axis in of)
        raise InvalidInput(
            f"over: {n_cell} cells ({sizes}), expected at most max_cells = {max_cells}"
        )
    for name, factory in factories.items():
        _check_factory(name, factory)
    made, problems = [], dict[str, None]()
    for index in product(*(range(len(axis.labels)) for axis in of)):
        try:
            made.append(cell_at(base, of, index, factories))
        except InvalidInput as error:
            problems |= dict.fromkeys(error.problems)
    if problems:
        lines = list(problems)
        more = (
            [f"over: {len(lines) - _PROBLEMS_SHOWN} more"] if len(lines) > _PROBLEMS_SHOWN else []
        )
        raise InvalidInput(lines[:_PROBLEMS_SHOWN] + more)
    return made


def cell_at(
    base: Scenario,
    of: Sequence[Axis],
    place: tuple[int, ...],
    own: Factories,
    moved: Callable[[str], str] | None = None,
) -> Cell:
    """One combination; ``moved`` says where the files are that its scenario names."""
    pairs = [pair for axis, i in zip(of, place, strict=True) for pair in axis.changes[i].items()]
    changes = dict(pairs)
    if len(changes) < len(pairs):
        twice = next(key for key, _ in pairs if sum(key == other for other, _ in pairs) > 1)
        raise InvalidInput(f"over {twice}: set by two axes, expected one")
    name = changes.get(named_files.FILTER)
    name = name if name in own else None
    if name is not None:
        del changes[named_files.FILTER]  # it is laid over the run, not over the scenario
    scenario = base.replace(changes) if changes else base
    if moved is not None:
        scenario = Scenario.from_dict(named_files.moved(scenario.to_dict(), moved))
    lines = named_files.problems(scenario.to_dict())
    if lines:
        raise InvalidInput(lines)
    labels = {axis.dim: axis.labels[i] for axis, i in zip(of, place, strict=True)}
    return Cell(place, labels, scenario, name)


def _check_factory(name: str, factory: Callable[[], Filter]) -> None:
    from ultratight.filters.catalog import CATALOG

    if name in CATALOG or ":" in name:
        raise InvalidInput(f"filters: {name} given, expected a name that is not taken")
    if not callable(factory):
        raise InvalidInput(
            f"filters: {name} is {config.show(factory)}, expected a class or function"
        )
    try:
        made_by(factory, name)
    except ValueError as error:
        raise InvalidInput(f"filters: {error}") from None


def parse_over(text: str) -> tuple[str, list[Any]]:
    """``cn0_dbhz=30,35`` -> ("cn0_dbhz", [30, 35]); commas in brackets and quotes do not part."""
    key, equals, values = (part.strip() for part in text.partition("="))
    if not (equals and key and values):
        raise InvalidInput(f"--over {text!r}: expected key=v1,v2,..., e.g. cn0_dbhz=30,35")
    parts = list(_split(values))
    if not all(part.strip() for part in parts):
        raise InvalidInput(f"--over {text!r}: an empty value, expected key=v1,v2,...")
    return key, [config.parse_override(f"{key}={part}")[1] for part in parts]


def _split(text: str) -> Iterator[str]:
    """Parts between the commas that are outside brackets and quotes."""
    depth, start = 0, 0
    for match in re.finditer(r"\"[^\"]*\"|'[^']*'|[\[\]{},]", text):
        sign = match.group()
        depth += (sign in "[{") - (sign in "]}")
        if sign == "," and depth == 0:
            yield text[start : match.start()]
            start = match.end()
    yield text[start:]


def plain(of: Sequence[Axis]) -> list[Any]:
    """Axes as plain data, in their order."""
    data: list[Any] = json.loads(json.dumps([axis._asdict() for axis in of]))
    return data


def from_plain(data: Sequence[Mapping[str, Any]]) -> tuple[Axis, ...]:
    """What `plain` made, back again."""
    return tuple(Axis(a["dim"], a["key"], tuple(a["labels"]), tuple(a["changes"])) for a in data)
