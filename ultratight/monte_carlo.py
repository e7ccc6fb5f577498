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

import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ultratight.scenario import Scenario
from ultratight.sweeps import dataset, workers
from ultratight.sweeps.cells import Factories, Over
from ultratight.sweeps.plan import MAX_CELLS, Plan, plan
from ultratight.sweeps.rerun import Rerun, rerun
from ultratight.sweeps.work import Work, writable

if TYPE_CHECKING:
    import xarray

__all__ = ["MAX_CELLS", "Plan", "Rerun", "carry_out", "plan", "rerun", "sweep"]


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
    workers.check(executor, jobs)
    with ExitStack() as stack:
        folder = writable(
            stack.enter_context(tempfile.TemporaryDirectory()) if out is None else out
        )
        work = Work(planned, folder, fresh)
        stack.callback(work.journal.close)
        work.fly(executor, jobs, progress)
        work.write()
        data: xarray.Dataset = dataset.open_sweep(folder, load=out is None)
    return data
