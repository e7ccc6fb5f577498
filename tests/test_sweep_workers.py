"""One process, two, a Dask cluster: same code, same bits; a worker that is lost costs nothing."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import xarray

import ultratight
from ultratight.sweeps.flights import COST

SCENARIO = {"duration_s": 1.0, "prns": [2, 6, 17, 28], "jump_window_s": [0.2, 0.5]}
OVER = {"receiver.filter": ["kf", "fiqkf-r"], "cn0_dbhz": [35.0, 45.0]}
RUNS = 4


def sweep(**changes: object) -> xarray.Dataset:
    arguments: dict = {"over": OVER, "runs": RUNS, "keep": ("velocity_error",)} | changes
    return ultratight.sweep(ultratight.load("uniform", SCENARIO), **arguments)


@pytest.fixture(scope="module")
def alone() -> xarray.Dataset:
    return sweep(jobs=1)


def assert_same(one: xarray.Dataset, other: xarray.Dataset) -> None:
    """Every bit but the cost."""
    assert one.attrs["digest"] == other.attrs["digest"]
    cost = [name for name in (*COST, "took_s") if name in one]
    xarray.testing.assert_identical(
        one.drop_vars(cost).drop_attrs(), other.drop_vars(cost).drop_attrs()
    )


def test_two_processes(alone: xarray.Dataset) -> None:
    assert_same(sweep(jobs=2), alone)


LETHAL = """
import os, signal
from pathlib import Path
from ultratight.filters.catalog import make_filter
def make():
    if os.getpid() != {parent} and not Path({mark!r}).exists():
        Path({mark!r}).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return make_filter("kf")
"""
"""Ends the first worker that makes one, as the system does when memory is out"""


def test_a_lost_local_worker(tmp_path: Path) -> None:
    file, mark = tmp_path / "lethal.py", tmp_path / "mark"
    file.write_text(LETHAL.format(parent=os.getpid(), mark=str(mark)))
    over = {"receiver.filter": ["qkf", f"{file}:make"]}
    data = sweep(over=over, jobs=2, out=tmp_path / "out")
    assert mark.exists()
    expected = sweep(over={"receiver.filter": ["qkf", "kf"]}, jobs=1)
    assert data.estimate_sha256.values.tolist() == expected.estimate_sha256.values.tolist()
    lines = (tmp_path / "out" / "journal.txt").read_text().splitlines()
    assert len(lines) == 1 + 2 * RUNS


@contextmanager
def cluster(folder: Path) -> Iterator[tuple[str, list[subprocess.Popen]]]:
    """A scheduler and two workers of one thread, processes of their own on this machine."""
    file = folder / "scheduler.json"
    program = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1"]
    started = [
        subprocess.Popen(
            [*program, "--port", "0", "--no-dashboard", "--scheduler-file", str(file)],
            stderr=subprocess.DEVNULL,
        )
    ]
    try:
        until = time.monotonic() + 60.0
        while not (file.exists() and file.read_text()):
            assert time.monotonic() < until, "no scheduler"
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        program = [sys.executable, "-m", "distributed.cli.dask_worker", address]
        options = ["--nthreads", "1", "--no-dashboard", "--no-nanny"]
        options += ["--local-directory", str(folder)]
        started += [
            subprocess.Popen([*program, *options], stderr=subprocess.DEVNULL, cwd=folder)
            for _ in range(2)
        ]
        from distributed import Client

        with Client(address) as client:
            client.wait_for_workers(2, timeout=60)
        yield address, started[1:]
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()


def test_a_dask_cluster(tmp_path: Path, alone: xarray.Dataset) -> None:
    """By address, with both workers; then one is lost while it flies."""
    with cluster(tmp_path) as (address, workers):
        assert_same(sweep(executor=address), alone)
        many: list[float] = []

        def progress(share: float) -> None:
            many.append(share)
            if len(many) == 4:
                workers[0].kill()

        from distributed import Client

        with Client(address) as client:
            data = sweep(executor=client, runs=3 * RUNS, progress=progress)
        assert len(many) > 4
    first = data.isel(run=slice(RUNS)).estimate_sha256.values
    assert first.tolist() == alone.estimate_sha256.values.tolist()
    assert (data.failure == "").all()
    assert len(np.unique(data.estimate_sha256)) == data.estimate_sha256.size


def test_an_own_filter_and_files_reach_a_cluster(tmp_path: Path) -> None:
    """Its workers do not see the file, which is gone by then: it has come with the task."""
    from ultratight.sweeps.flights import Input, Item, Task, code, fly

    text = "from ultratight.filters import catalog\ndef mine(): return catalog.make_filter('kf')\n"
    tree = ultratight.load("uniform", SCENARIO).to_dict()
    gone = str(tmp_path / "gone" / "mine.py")
    tree["receiver"]["filter"] = f"{gone}:mine"
    task = Task(
        items=(Item(0, 0, 5, json.dumps(tree), None),),
        factories={}, keep=(), every_s=1.0, code=code(),
        inputs=(Input(gone, hashlib.sha256(text.encode()).hexdigest(), text.encode()),),
    )  # fmt: skip
    (record,) = fly(task)
    assert record["failure"] == ""
    plain = ultratight.load("uniform", SCENARIO | {"receiver.filter": "kf"})
    assert (
        record["summary"]["velocity_rms_mps"]
        == ultratight.run(plain, 5).summary["velocity_rms_mps"]
    )
    with pytest.raises(ultratight.InvalidInput, match="other numpy than where"):
        fly(task._replace(code=code() | {"numpy": "0.1"}))


def test_threads_load_an_own_filter_once(tmp_path: Path) -> None:
    """A worker of several threads: none of them finds half of a module that another one loads."""
    from concurrent.futures import ThreadPoolExecutor

    from ultratight.filters import own

    file = tmp_path / "slow.py"
    file.write_text(
        "import time\ntime.sleep(0.2)\nfrom ultratight.filters.catalog import make_filter\n"
        "def make():\n    return make_filter('kf')\n"
    )
    with ThreadPoolExecutor(4) as threads:
        made = list(threads.map(lambda _: own.make(f"{file}:make"), range(4)))
    assert all(callable(one.step) for one in made)


def test_a_cluster_that_goes_is_no_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was there when the sweep began: what is finished is kept, and the exit code is 1."""
    from ultratight.sweeps import workers

    monkeypatch.setattr(workers, "CONNECT_S", 1)
    with (
        pytest.raises(OSError, match="cannot be reached"),
        workers._client("tcp://127.0.0.1:9", began=True),
    ):
        pass


@pytest.mark.parametrize(("jobs", "n_run", "n"), [(500, 3, 3), (500, 1, 2), (1, 9, 1), (2, 9, 2)])
def test_no_more_processes_than_runs(jobs: int, n_run: int, n: int) -> None:
    """But two at least where two were asked for: one that is killed leaves this one alone."""
    from ultratight.sweeps.workers import _backend

    with _backend(None, jobs, n_run, began=False) as n_worker:
        assert n_worker == n


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        (
            {"executor": "tcp://127.0.0.1:9"},
            ultratight.InvalidInput,
            "cluster: 'tcp://127.0.0.1:9' given, expected the address of a Dask scheduler",
        ),
        ({"executor": "host"}, ultratight.InvalidInput, "cluster: 'host' given, expected"),
        ({"executor": ""}, ultratight.InvalidInput, "cluster: '' given, expected"),
        ({"executor": "tcp://127.0.0.1:9", "jobs": 2}, ultratight.InvalidInput, "jobs: 2 given"),
        ({"executor": 3}, ultratight.InvalidInput, "executor: a int given"),
        ({"jobs": 0}, ultratight.InvalidInput, "jobs: 0 given"),
        ({"runs": 0}, ultratight.InvalidInput, "runs: 0 given"),
        ({"seed": -1}, ultratight.InvalidInput, "seed: -1 given"),
        ({"keep": ("speed",)}, ultratight.InvalidInput, "keep: 'speed' given"),
        ({"max_cells": 3}, ultratight.InvalidInput, "4 cells (2 filter x 2 cn0_dbhz)"),
    ],
)
def test_what_cannot_be_is_refused(
    arguments: dict, error: type[Exception], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ultratight.sweeps.flights.simulate", None)
    monkeypatch.setattr("ultratight.sweeps.workers.CONNECT_S", 1)
    with pytest.raises(error) as refused:
        sweep(**arguments)
    assert words in str(refused.value)
