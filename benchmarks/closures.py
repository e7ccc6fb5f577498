"""Time per second of signal: every closure in closed form, and scalar tracking of a recording."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import ultratight
from benchmarks import baselines
from benchmarks.harness import Case
from benchmarks.scene import N_CHANNEL, make
from ultratight.simulation import fly, new_closure
from ultratight.tracking import from_samples
from ultratight.tracking.acquisition import acquire
from ultratight.world import World

CLOSURES = ("ultra-tight", "federated", "scalar", "scalar-ins", "vdll", "vdfll")
FLOWN_S, TRACKED_S = 5.0, 2.0
UNIT = "x real time"


def groups() -> Iterator[tuple[str, list[Case]]]:
    """Eight satellites in closed form; twelve on samples, beside a plain correlator alone."""
    yield "closures in closed form, 8 satellites", [_closure(name) for name in CLOSURES]
    yield f"a recording of 4 Msps, {N_CHANNEL} satellites", _recording()


def _closure(name: str) -> Case:
    changes = {
        "receiver.closure": name, "receiver.measurement": "differential", "duration_s": FLOWN_S,
        "receiver.filter": "qkf", "max_satellites": 8,
    }  # fmt: skip
    scenario = ultratight.load("uniform", changes | {"profile": []})
    world = World(scenario, seed=1)
    world.correlator(), world.imu  # made before the clock runs

    def flight() -> object:
        closure = new_closure(scenario, world.knows)
        return fly(closure, world.correlator(), world.imu[0], scenario.duration_s)

    baseline = "" if name == CLOSURES[0] else CLOSURES[0]
    return Case(name, flight, FLOWN_S, UNIT, 1.0, baseline=baseline)


def _recording() -> list[Case]:
    plain = "plain loop, three taps, correlation alone"
    scene = make(4e6, 0.001, TRACKED_S)
    found = [row for row in acquire(scene.recording) if row.found]
    offsets, n = np.array([-0.5, 0.0, 0.5]), 8000
    return [
        Case(plain, lambda: baselines.plain_correlator(scene, offsets, n), n / 4e6, UNIT, 1.0),
        Case(
            "tracked from samples, loops of 5 ms",
            lambda: from_samples.track(scene.recording, found, scene.recording.end_sample),
            TRACKED_S, UNIT, 1.0, baseline=plain,
        ),
    ]  # fmt: skip
