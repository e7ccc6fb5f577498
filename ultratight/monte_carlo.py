"""Sweeps: many runs of many scenarios, on all cores or a cluster, gone on with when cut short.

    from ultratight import sweep

    data = sweep(
        "jump-1",
        over={
            "receiver.filter": ["qkf", "fiqkf-r"],
            "cause": {  # keys that are varied together
                "none": {"imu.accel_scale_factor_ppm": [0, 0, 0]},
                "late": {"imu.accel_scale_factor_ppm": [0, 0, 0], "imu.lag_s": 0.01},
            },
        },
        runs=50,
        out="results/jump-1",
    )
    data.velocity_rms_mps.sel(window="jump").median("run")

Run r has the seed ``seed + r`` in every cell, whatever else is asked for: filters and settings see
the same noise (common random numbers), and differences between cells are paired by run.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ultratight import named_files
from ultratight.config import InvalidInput
from ultratight.filters.gaussian import Filter
from ultratight.provenance import provenance
from ultratight.scenario import Scenario, load
from ultratight.sweeps import cells as cell
from ultratight.sweeps import dataset, flights, series, workers
from ultratight.sweeps.cells import Axis, Cell, Factories, Over
from ultratight.sweeps.flights import Input, Item, Task
from ultratight.sweeps.journal import Journal

if TYPE_CHECKING:
    import xarray

MAX_CELLS = 1000
MAX_SEED = 2**63 - 1
INPUTS = "inputs"
"""Folder of copies of the files that scenarios name"""


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
    """Check a sweep: see `sweep` for the parameters.  `InvalidInput` lists what is wrong."""
    base = scenario if isinstance(scenario, Scenario) else load(scenario)
    if isinstance(runs, bool) or not isinstance(runs, int) or runs < 1:
        raise InvalidInput(f"runs: {runs} given, expected a whole number from 1")
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= MAX_SEED - runs:
        raise InvalidInput(f"seed: {seed} given, expected a whole number from 0 to 2^63 - 1 - runs")
    series.check(keep, every_s)
    factories = dict(filters or {})
    axes = cell.axes(over or {})
    made = cell.cells(base, axes, factories, max_cells)
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


def sweep(
    scenario: Scenario | str | Path,
    over: Over | None = None,
    runs: int = 1,
    seed: int = 1,
    *,
    executor: Any = None,
    jobs: int | None = None,
    out: str | Path | None = None,
    keep: Sequence[str] = (),
    every_s: float = 0.1,
    filters: Factories | None = None,
    max_cells: int | None = MAX_CELLS,
    fresh: bool = False,
    progress: Callable[[float], None] | None = None,
) -> xarray.Dataset:
    """Fly every cell ``runs`` times.

    Parameters
    ----------
    scenario : Scenario, preset or TOML file
    over : mapping, optional
        key -> values, e.g. ``{"receiver.filter": ["kf", "qkf"]}``, or name -> {label: {key: value,
        ...}} for keys that are varied together.  All are combined.  The dimension is called like
        the last part of the key, or like the whole key where two keys end alike.
    runs, seed : int
        Run r = 0, 1, ... has the seed ``seed + r``.
    executor : optional
        None: the local cores.  The address of a Dask scheduler, "tcp://...", or a
        ``distributed.Client``: its workers.  Same bits.
    jobs : int, optional
        Local processes, all cores by default; 1: this process.
    out : folder, optional
        Finished runs are kept there at once.  The same call goes on with what was cut short, or
        adds runs; with another sweep it is refused.  Without it the result is in memory only.
    keep : names of `sweeps.series.SERIES`, optional
        Kept over time, every ``every_s`` seconds, with the dimension ``time_s``.
    filters : mapping, optional
        Your own: name -> class or function that makes one; the name then serves as a value of
        ``"receiver.filter"``.
    max_cells : int, optional
        Refuse more.
    fresh : bool
        Forget what the folder holds.
    progress : callable, optional
        Called with the share that is done, 0 to 1.

    Returns
    -------
    xarray.Dataset
        A variable for each figure of `Run.summary` with the dimensions (swept ..., run), tables
        with ``window`` or ``channel`` besides; ``failure`` says why a run has no figures;
        ``attrs["digest"]`` is one SHA-256 over all science in it.  With ``out`` its arrays stay in
        ``out/sweep.nc`` until they are used.

    Raises
    ------
    InvalidInput
        Anything that is wrong with the arguments, before anything is flown.
    OSError
        The disk is full, workers are lost for good: what is finished is kept.
    """
    planned = plan(
        scenario, over, runs, seed, keep=keep, every_s=every_s, filters=filters, max_cells=max_cells
    )
    return carry_out(planned, executor=executor, jobs=jobs, out=out, fresh=fresh, progress=progress)


def carry_out(
    planned: Plan,
    *,
    executor: Any = None,
    jobs: int | None = None,
    out: str | Path | None = None,
    fresh: bool = False,
    progress: Callable[[float], None] | None = None,
) -> xarray.Dataset:
    """Fly a plan; see `sweep`."""
    if jobs is not None and (isinstance(jobs, bool) or not isinstance(jobs, int) or jobs < 1):
        raise InvalidInput(f"jobs: {jobs} given, expected a whole number from 1")
    with ExitStack() as stack:
        folder = _folder(out or stack.enter_context(tempfile.TemporaryDirectory()))
        work = _Work(planned, folder, fresh)
        stack.callback(work.journal.close)
        work.fly(executor, jobs, progress)
        work.write()
        data: xarray.Dataset = dataset.open_sweep(folder, load=out is None)
    return data


def _folder(out: str | Path) -> Path:
    """A folder that can be written to."""
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        raise InvalidInput(
            f"{folder}: cannot be written to ({error.strerror}), expected a folder"
        ) from None


class _Work:
    """A plan, its folder and its journal."""

    def __init__(self, planned: Plan, folder: Path, fresh: bool) -> None:
        self.plan, self.folder = planned, folder
        shas = {name: factory_sha256(f, name) for name, f in planned.filters.items()}
        self.factories = {name: (f, shas[name]) for name, f in planned.filters.items()}
        made = _made(planned, shas)
        self.journal = Journal(folder, made, (len(planned.cells), planned.runs), fresh)
        self.inputs, self.texts = self._inputs()

    def _inputs(self) -> tuple[tuple[Input, ...], list[str]]:
        """Copies of the files that scenarios name, and the scenarios that name the copies."""
        found: dict[str, Input] = {}

        def copied(path: str) -> str:
            if path not in found:
                data = Path(path).read_bytes()
                sha = hashlib.sha256(data).hexdigest()
                place = self.folder.resolve() / INPUTS / sha[:16] / Path(path).name
                if not place.exists():
                    place.parent.mkdir(parents=True, exist_ok=True)
                    part = place.with_name(f".{place.name}.{os.getpid()}.part")
                    part.write_bytes(data)
                    os.replace(part, place)
                found[path] = Input(str(place), sha, data)
            return found[path].path

        texts = [
            json.dumps(named_files.moved(one.scenario.to_dict(), copied)) for one in self.plan.cells
        ]
        return tuple(found.values()), texts

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
            inputs=() if local else self.inputs,
            parent=os.getpid() if local else None,
        )

    def fly(
        self, executor: Any, jobs: int | None, progress: Callable[[float], None] | None
    ) -> None:
        """Fly what is not finished."""
        n, journal = self.plan.n_run, self.journal
        task = partial(self.task, local=workers.is_local(executor))
        try:
            for records in workers.fly_all(journal.left, task, executor, jobs):
                for record in records:
                    journal.add(record)
                if progress is not None:
                    progress(journal.n_done / n)
        except (OSError, KeyboardInterrupt) as error:
            kept = f"{journal.n_done} of {n} runs are kept in {self.folder}: the same goes on there"
            if isinstance(error, OSError):
                raise OSError(f"{error}; {kept}") from error
            raise KeyboardInterrupt(kept) from None
        journal.sync()

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
        dataset.write(
            path, p.axes, p.cells, p.seeds, journal.records(), layout, p.keep, p.every_s, attributes
        )


def _made(p: Plan, shas: Mapping[str, str]) -> dict[str, Any]:
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
        "about": {"scenario": p.base.to_dict(), "axes": cell.plain(p.axes), "began": time.time()},
    }  # fmt: skip


def factory_sha256(factory: Callable[[], Filter], name: str) -> str:
    """Of the file that a factory is written in and its name there, and of arguments bound to it.

    `InvalidInput`: it has no source to be known by.
    """
    bound = ""
    if isinstance(factory, partial):
        bound = repr((factory.args, sorted(factory.keywords.items())))
        factory = factory.func
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
