"""Many runs: what a sweep costs beside the runs alone, and what a second process brings."""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks.harness import Case
from ultratight.monte_carlo import sweep
from ultratight.scenario import load
from ultratight.simulation import run

RUNS = 40
SCENARIO = {
    "receiver.filter": "fiqkf-r", "receiver.measurement": "differential", "max_satellites": 8,
}  # fmt: skip
TARGET = 1_000 / 75.0
"""1000 runs in 75 s"""


def groups() -> Iterator[tuple[str, list[Case]]]:
    """The same runs in a loop, in a sweep of one process, and of two."""
    scenario = load("jump-1", SCENARIO)

    def alone() -> None:
        for seed in range(1, RUNS + 1):
            run(scenario, seed)

    title = (
        f"{RUNS} closed-form runs of {scenario.duration_s:g} s: fiqkf-r, differential, 8 channels"
    )
    yield title, [
        Case("run, one by one", alone, RUNS, "runs/s", 1.0, wall=True),
        Case(
            "sweep, in this process", lambda: sweep(scenario, runs=RUNS, jobs=1), RUNS, "runs/s",
            1.0, wall=True, baseline="run, one by one", ratio_target=0.95,
        ),
        Case(
            "sweep, two processes", lambda: sweep(scenario, runs=RUNS, jobs=2), RUNS, "runs/s",
            1.0, TARGET, wall=True, baseline="sweep, in this process", ratio_target=1.85,
            note="1000 runs in 75 s; needs two idle cores",
        ),
    ]  # fmt: skip
