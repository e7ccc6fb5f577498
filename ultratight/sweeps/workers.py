"""Who flies: this process, its workers on all cores, or the workers of a Dask cluster.

All through joblib, which keeps the queue; here are the backends, the size of a task and what
happens when a worker is lost.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import joblib
import numpy as np

from ultratight.config import InvalidInput
from ultratight.sweeps import local_worker
from ultratight.sweeps.flights import Record, Task, fly

TASK_S = 1.0
"""A task is as many runs as take this long: handing one out costs milliseconds"""
CONNECT_S = 10
_MOST = 64
_SHARE = 4
"""Every worker has at least so many tasks still before it, so that all end together"""
_LOST_IN_A_ROW = 3
ADDRESS = "the address of a Dask scheduler that runs, e.g. tcp://host:8786"


def check(executor: Any, jobs: int | None) -> None:
    """`InvalidInput`: no such number of processes, or one for a cluster, which has its own."""
    if jobs is not None and (isinstance(jobs, bool) or not isinstance(jobs, int) or jobs < 1):
        raise InvalidInput(f"jobs: {jobs} given, expected a whole number from 1")
    if jobs is not None and executor is not None:
        raise InvalidInput(f"jobs: {jobs} given, expected none: a cluster has its own workers")
    if isinstance(executor, str) and not executor.strip():
        raise InvalidInput(f"cluster: {executor!r} given, expected {ADDRESS}")


class Pace:
    """How long a run takes, of late."""

    def __init__(self) -> None:
        self.run_s: float | None = None

    def saw(self, took_s: Sequence[float]) -> None:
        mean = sum(took_s) / len(took_s)
        self.run_s = mean if self.run_s is None else 0.7 * self.run_s + 0.3 * mean

    def size(self, left: int, n_worker: int) -> int:
        """Runs of the next task: one until something is known."""
        if self.run_s is None:
            return 1
        fair = math.ceil(left / (_SHARE * n_worker))
        return max(1, min(_MOST, fair, round(TASK_S / max(self.run_s, 1e-3))))


def fly_all(
    left: Callable[[], np.ndarray],
    task: Callable[[np.ndarray], Task],
    executor: Any = None,
    jobs: int | None = None,
) -> Iterator[list[Record]]:
    """Records in the order in which tasks end.

    ``left()`` (n, 2) are the runs still to be flown: asked again when a worker was lost.

    Raises
    ------
    InvalidInput
        There is no cluster at the address.
    OSError
        Workers are lost again and again, or the cluster can no longer be reached.
    """
    lost, pace = 0, Pace()
    while (runs := left()).size:
        try:
            with _backend(executor, jobs, len(runs), began=pace.run_s is not None) as n_worker:
                for records in _parallel(n_worker)(
                    joblib.delayed(fly)(t) for t in _tasks(runs, task, pace, n_worker)
                ):
                    pace.saw([record["cost"]["took_s"] for record in records])
                    lost = 0
                    yield records
        except Exception as error:
            if "un-serialize" in str(error):
                raise InvalidInput(
                    "filters: a worker cannot load what was given, expected FILE.py:NAME as "
                    "receiver.filter, or a module that can be imported"
                ) from error
            if not _is_loss(error):
                raise
            lost += 1
            if lost == _LOST_IN_A_ROW:
                raise OSError(
                    f"workers were lost {lost} times in a row ({_said(error)})"
                ) from error


def _parallel(n_worker: int) -> Any:
    return joblib.Parallel(
        n_jobs=n_worker, return_as="generator_unordered", batch_size=1, pre_dispatch="2*n_jobs"
    )


def _tasks(
    left: np.ndarray, task: Callable[[np.ndarray], Task], pace: Pace, n_worker: int
) -> Iterator[Task]:
    """Tasks are cut off when they are asked for, by the pace known then."""
    start = 0
    while start < len(left):
        end = start + pace.size(len(left) - start, n_worker)
        yield task(left[start:end])
        start = end


@contextmanager
def _backend(executor: Any, jobs: int | None, n_run: int, began: bool) -> Iterator[int]:
    """The joblib backend in force, and how many workers it has."""
    if executor is None:
        n = joblib.cpu_count() if jobs is None else jobs
        # no idle processes; but a run that kills its process must not kill this one
        n = min(n, max(2, n_run))
        if n == 1:  # this process
            yield n
            return
        with joblib.parallel_config(
            backend="loky",
            inner_max_num_threads=1,
            initializer=local_worker.begin,
            initargs=(os.getpid(),),
        ):
            yield n
        return
    with _client(executor, began) as client:
        n = sum(client.nthreads().values())
        if n == 0:
            raise OSError(f"cluster {client.scheduler.address}: has no workers")
        with joblib.parallel_config(backend="dask", client=client):
            yield n


@contextmanager
def _client(executor: Any, began: bool) -> Iterator[Any]:
    """A client of the cluster; ``began``: it was there before."""
    try:
        import distributed
    except ImportError:
        raise InvalidInput(
            "cluster: distributed is not installed, expected `pip install ultratight[cluster]`"
        ) from None
    if isinstance(executor, distributed.Client):
        yield executor
    elif isinstance(executor, str):
        try:
            client = distributed.Client(executor, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            if began:
                raise OSError(f"cluster {executor}: cannot be reached ({_said(error)})") from None
            raise InvalidInput(
                f"cluster: {executor!r} given, expected {ADDRESS} ({_said(error)})"
            ) from None
        with client:
            yield client
    else:
        raise InvalidInput(
            f"executor: a {type(executor).__name__} given, expected None (local cores), the "
            "address of a Dask scheduler or a distributed.Client"
        )


def _is_loss(error: Exception) -> bool:
    """Has a worker gone, rather than something in it gone wrong?"""
    return type(error).__name__ in (
        "TerminatedWorkerError",
        "BrokenProcessPool",
        "KilledWorker",
        "CancelledError",
        "FutureCancelledError",
    )


def _said(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def is_local(executor: Any) -> bool:
    """Do the workers see this machine's files, and end with this process?"""
    return executor is None
