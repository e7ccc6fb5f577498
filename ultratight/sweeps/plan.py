"""A sweep that is checked and of which nothing is flown yet."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from ultratight.config import InvalidInput, show
from ultratight.scenario import Scenario, load
from ultratight.sweeps import cells as cell
from ultratight.sweeps import dataset, series
from ultratight.sweeps.cells import Axis, Cell, Factories, Over

MAX_CELLS = 1000
MAX_RUNS = 100_000_000
"""Of all cells: their places and checksums take 40 bytes each"""
MAX_SEED = 2**63 - 1


class Plan(NamedTuple):
    """A sweep, checked, of which nothing is flown yet."""

    base: Scenario
    axes: tuple[Axis, ...]
    cells: list[Cell]
    runs: int
    seed: int
    keep: tuple[str, ...] = ()
    every_s: float = 0.1
    filters: Factories = MappingProxyType({})

    @property
    def n_run(self) -> int:
        """Runs of all cells."""
        return len(self.cells) * self.runs

    @property
    def seeds(self) -> range:
        """Of the runs."""
        return range(self.seed, self.seed + self.runs)


def plan(
    scenario: Scenario | str | Path,
    over: Over | None = None,
    runs: int = 1,
    seed: int = 1,
    *,
    keep: Sequence[str] = (),
    every_s: float = 0.1,
    filters: Factories | None = None,
    max_cells: int | None = MAX_CELLS,
) -> Plan:
    """Check a sweep, see `ultratight.sweep`.  `InvalidInput` lists what is wrong."""
    base = scenario if isinstance(scenario, Scenario) else load(scenario)
    if isinstance(runs, bool) or not isinstance(runs, int) or runs < 1:
        raise InvalidInput(f"runs: {runs} given, expected a whole number from 1")
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= MAX_SEED - runs:
        raise InvalidInput(f"seed: {seed} given, expected a whole number from 0 to 2^63 - 1 - runs")
    if not isinstance(filters, Mapping | None):
        raise InvalidInput(f"filters: {show(filters)} given, expected {{name: class or function}}")
    factories = dict(filters or {})
    axes = cell.axes({} if over is None else over)
    dataset.check_names(axes)
    if max_cells is not None and max_cells < 1:
        raise InvalidInput(f"max_cells: {max_cells} given, expected a whole number from 1")
    made = cell.cells(base, axes, factories, max_cells)
    if len(made) * runs > MAX_RUNS:
        raise InvalidInput(
            f"runs: {runs} of {len(made)} cells given, expected at most {MAX_RUNS} in all"
        )
    series.check(keep, every_s, max(one.scenario.duration_s for one in made))
    _check_skies(made, seed)
    return Plan(base, axes, made, runs, seed, tuple(keep), float(every_s), factories)


def _check_skies(of: Sequence[Cell], seed: int) -> None:
    """Refuse cells with too few satellites and the like before anything is flown."""
    from ultratight.world import World

    seen = set()
    for one in of:
        tree = one.scenario.to_dict()
        world = json.dumps({k: v for k, v in tree.items() if k != "receiver"}, sort_keys=True)
        if world not in seen:
            seen.add(world)
            try:
                World(one.scenario, seed)
            except InvalidInput as error:
                raise InvalidInput([f"{line} (cell: {one})" for line in error.problems]) from None
