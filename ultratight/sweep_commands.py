"""The commands that fly many runs, and one of them again."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultratight.options import (
    Json,
    Override,
    Quiet,
    Seed,
    Source,
    duration,
    interruptible,
    number,
    progress,
    whole,
)

if TYPE_CHECKING:
    from ultratight.monte_carlo import Plan


def sweep(
    source: Source,
    over: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=V1,V2,...", help="one axis, e.g. receiver.filter=kf,qkf"),
    ] = None,
    runs: Annotated[int, typer.Option(metavar="N", parser=whole, help="runs of each cell")] = 1,
    seed: Seed = 1,
    jobs: Annotated[
        int | None, typer.Option(metavar="J", parser=whole, help="processes; default: all")
    ] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler, e.g. tcp://host:8786")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="folder: goes on there when cut short")
    ] = None,
    keep: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="keep over time, e.g. velocity_error")
    ] = None,
    every: Annotated[
        float, typer.Option(metavar="S", parser=number, help="time between kept values")
    ] = 0.1,
    changes: Override = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="list cells and estimated time; fly nothing")
    ] = False,
    max_cells: Annotated[
        int, typer.Option(metavar="N", parser=whole, help="refuse more cells")
    ] = 1000,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="start anew: forget what the folder holds")
    ] = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Fly every combination of values, each with N seeds.

    On all cores, or a Dask cluster.

    Run r has the seed S + r in every cell. Finished runs are kept in DIR at once: the same command
    goes on with what was cut short, and with a larger --runs it adds runs.
    """
    from ultratight import config, monte_carlo
    from ultratight.scenario import load
    from ultratight.sweeps import workers
    from ultratight.sweeps.cells import parse_over

    workers.check(cluster, jobs)
    if out is None and not dry_run:
        raise config.InvalidInput("--out: missing, expected a folder (or --dry-run)")
    pairs = [parse_over(text) for text in over or []]
    keys = [key for key, _ in pairs]
    twice = [key for key in keys if keys.count(key) > 1]
    if twice:
        raise config.InvalidInput(f"--over {twice[0]}: given twice, expected all values in one")
    plan = monte_carlo.plan(
        load(source, changes or []),
        dict(pairs),
        runs,
        seed,
        keep=keep or (),
        every_s=every,
        max_cells=max_cells,
    )
    if dry_run:
        _tell_plan(plan, jobs, as_json)
        return
    with interruptible(), progress(f"{plan.n_run} runs", quiet) as report:
        data = monte_carlo.carry_out(
            plan, executor=cluster, jobs=jobs, out=out, fresh=fresh, progress=report
        )
    _tell(data, out, as_json, quiet)


def rerun(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="folder of a sweep")],
    run: Annotated[int, typer.Option(metavar="N", parser=whole, help="number of the run, from 0")],
    cell: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="which cell, e.g. filter=qkf; one per axis"),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.nc", help="write the run (netCDF)")
    ] = None,
    as_json: Json = False,
) -> None:
    """Fly one run of a sweep again; say whether the bits agree.

    From what the folder says alone: scenario, seed and copies of the files that it names.
    """
    from ultratight import config, monte_carlo, report, results

    if out:
        results.check_writable(out)
    chosen = dict(config.parse_override(text, "--cell") for text in cell or [])
    again = monte_carlo.rerun(folder, run, chosen)
    if out and again.run is not None:
        again.run.save(out)
    if as_json:
        told = {
            "agrees": again.agrees,
            "sha256": again.now["sha256"],
            "failure": again.now["failure"],
            "other": again.other,
            "summary": None if again.run is None else again.run.summary,
        }
        print(json.dumps(told))
    elif again.run is None:
        print(f"run {run} failed: {again.now['failure']}")
    else:
        print("\n".join(report.report(again.run)))
    if not as_json:
        for name, (then, now) in again.other.items():
            print(f"{name}: {then} then, {now} now")
        print(_VERDICTS[again.agrees])
    if again.agrees is False:
        raise typer.Exit(1)


_VERDICTS = {
    True: "bits agree with the sweep's",
    False: "bits differ from the sweep's",
    None: "the sweep has not finished this run: nothing to compare with",
}


def _tell(data: Any, out: Path | None, as_json: bool, quiet: bool) -> None:
    from ultratight.sweeps import dataset, table

    if as_json:
        cells = list(table.rows(data))
        print(json.dumps({"out": str(out), "digest": data.attrs["digest"], "cells": cells}))
        return
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else 160).print(table.table(data))
    paths = json.loads(data.attrs["cpu_paths"])
    if len(paths) > 1 and not quiet:
        print(f"warning: flown on {', '.join(paths)}, which agree to rounding only",
              file=sys.stderr)  # fmt: skip
    print(f"digest {data.attrs['digest']}")
    if not quiet and out is not None:
        print(f"written: {out / dataset.NAME}")


def _tell_plan(plan: Plan, jobs: int | None, as_json: bool) -> None:
    """Cells, and how long they would take."""
    import joblib

    from ultratight.sweeps.estimate import run_s

    each = run_s([cell.scenario for cell in plan.cells], plan.seed)
    n_worker = jobs or joblib.cpu_count()
    total = sum(each) * plan.runs / n_worker
    if as_json:
        cells = [
            {"labels": cell.labels, "run_s": s} for cell, s in zip(plan.cells, each, strict=True)
        ]
        print(json.dumps({"cells": cells, "runs": plan.n_run, "jobs": n_worker, "total_s": total}))
        return
    for cell, s in zip(plan.cells, each, strict=True):
        print(f"{cell}: {plan.runs} runs of about {s:.2g} s")
    what = f"{len(plan.cells)} cells, {plan.n_run} runs"
    print(f"{what}: about {duration(total)} with {n_worker} at a time; nothing flown")
