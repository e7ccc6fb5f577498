"""The closed loop: an epoch, a run in closed form, a run from samples, two threads."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import ultratight
from benchmarks.harness import Case
from benchmarks.scene import N_CHANNEL, make
from signals.correlator import SampleCorrelator
from signals.front_end import SyntheticIf
from ultratight.scenario import Scenario
from ultratight.simulation import fly, new_closure
from ultratight.world import World

LONG_S, SHORT_S = 50.0, 5.0
EPOCH_S = 0.02


def groups() -> Iterator[tuple[str, list[Case]]]:
    """Eight satellites, 20 ms epochs; `ultratight.run` as a user calls it, and the loop alone."""
    yield "closed form, one epoch of the loop, 8 satellites", _epochs()
    yield "whole runs, CPU time", _runs()
    yield "two threads, wall time", _threads()


def _scenario(name: str, duration_s: float, **changes: object) -> Scenario:
    flown = {"receiver.filter": name, "max_satellites": 8, "duration_s": duration_s}
    if duration_s < LONG_S:
        flown["profile"] = []
    return ultratight.load("jump-1", flown | changes)


def _epochs() -> list[Case]:
    cases = []
    for name, measurement, target in (
        ("qkf", "differential", 45.0),
        ("fiqkf-r", "differential", 60.0),
        ("qkf", "coherent", None),
        ("fiqkf-r", "coherent", None),
    ):
        scenario = _scenario(name, 10.0, **{"receiver.measurement": measurement})
        world = World(scenario, seed=1)
        world.correlator(), world.imu  # made before the clock runs

        def flight(world: World = world, scenario: Scenario = scenario) -> object:
            closure = new_closure(scenario, world.knows)
            return fly(closure, world.correlator(), world.imu[0], scenario.duration_s)

        epochs = round(scenario.duration_s / EPOCH_S)
        cases.append(Case(f"{name}, {measurement}", flight, epochs, "us", 1e6, target, cost=True))
    return cases


def _runs() -> list[Case]:
    model = _scenario("fiqkf-r", LONG_S, **{"receiver.measurement": "differential"})
    coherent = _scenario("fiqkf-r", LONG_S)
    samples = _scenario(
        "fiqkf-r", SHORT_S,
        **{"correlator.kind": "samples", "receiver.measurement": "differential"},
    )  # fmt: skip
    return [
        Case(
            "closed form, 50 s, fiqkf-r, differential", lambda: ultratight.run(model, 1),
            1.0, "s", 1.0, 0.15, cost=True,
        ),
        Case(
            "the same as a sweep flies it", lambda: ultratight.run(model, 1, whole=False),
            1.0, "s", 1.0, 0.15, cost=True,
        ),
        Case("closed form, 50 s, fiqkf-r, coherent", lambda: ultratight.run(coherent, 1),
             1.0, "s", 1.0, cost=True),
        Case("set-up of the world and summary alone", lambda: _set_up(model), 1.0, "s", 1.0,
             cost=True),
        Case(
            "samples at 4 Msps, fiqkf-r, differential", lambda: ultratight.run(samples, 1),
            SHORT_S, "x real time", 1.0, 25.0,
        ),
    ]  # fmt: skip


def _set_up(scenario: Scenario) -> None:
    world = World(scenario, seed=1)
    world.correlator(), world.imu, world.knows


def _threads() -> list[Case]:
    scene = make(25e6, 0.02, 0.2)
    offsets = np.array([-0.5, 0.0, 0.5])
    n = scene.recording.end_sample
    cases = []
    for workers in (1, 2):
        correlator = SampleCorrelator(scene.recording, scene.chips, offsets, workers=workers)
        source = SyntheticIf(scene.state, scene.chips, scene.fs, seed=1, workers=workers)
        for name, call in (
            ("correlator", lambda c=correlator: c(scene.nco)),
            ("generator", lambda s=source: s.record(n)),
        ):
            cases.append(
                Case(
                    f"{name}, {workers} thread{'s'[: workers - 1]}", call, N_CHANNEL * n,
                    "G channel-samples/s", 1e-9, wall=True,
                    baseline=f"{name}, 1 thread" if workers == 2 else "",
                    ratio_target=1.8 if workers == 2 else None,
                )
            )  # fmt: skip
    return cases
