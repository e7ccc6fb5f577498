"""How long a sweep will take: the first steps of one run of each kind, timed."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from ultratight.scenario import Scenario
from ultratight.simulation import run as simulate
from ultratight.sweeps.flights import was_interrupted

SAMPLE_S = 1.0
"""A kind of run is timed for about so long"""
_MOST_KINDS = 12
_FEWEST = 8
"""Steps of half a second: beyond the hand-over"""


class _EnoughError(Exception):
    """Ends a run that has been timed."""


def run_s(scenarios: Sequence[Scenario], seed: int) -> list[float]:
    """Seconds per run of each scenario on one core.

    Scenarios of one kind (closure, filter, measurement, correlator, signals, epoch) share a timing
    per simulated second; of kinds beyond the twelfth the mean of the others stands.
    """
    rates: dict[tuple[object, ...], float] = {}
    for scenario in scenarios:
        if _kind(scenario) not in rates and len(rates) < _MOST_KINDS:
            rates[_kind(scenario)] = _rate(scenario, seed)
    mean = sum(rates.values()) / len(rates)
    return [rates.get(_kind(s), mean) * s.duration_s for s in scenarios]


def _kind(s: Scenario) -> tuple[object, ...]:
    r = s.receiver
    return (r.closure, r.filter, r.measurement, r.epoch_s, r.integration_s, s.correlator.kind,
            s.front_end.sample_rate_hz, s.signals, s.max_satellites)  # fmt: skip


def _rate(scenario: Scenario, seed: int) -> float:
    """Wall time per simulated time: median over the steps, some of which compile."""
    marks: list[tuple[float, float]] = []

    def report(share: float) -> None:
        marks.append((time.perf_counter(), share * scenario.duration_s))
        if len(marks) > _FEWEST and marks[-1][0] - marks[0][0] > SAMPLE_S:
            raise _EnoughError

    try:
        simulate(scenario, seed, progress=report)
    except (OSError, MemoryError):
        raise
    except Exception as error:  # timed, or a run that a sweep would record as failed
        if was_interrupted(error):
            raise KeyboardInterrupt from None
    rates = np.diff(np.array(marks).reshape(-1, 2), axis=0)
    rates = rates[rates[:, 1] > 0.0]
    return float(np.median(rates[:, 0] / rates[:, 1])) if rates.size else 0.0
