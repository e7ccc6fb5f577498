"""Cases that take turns, their best CPU time, and the rows that come of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any

ROUNDS = 7


@dataclass
class Case:
    """Something to be timed.

    ``work`` units are done by one ``call``; the figure is work / time x ``scale`` in ``unit``
    (``per_time``) or time / work x ``scale`` (a cost: less is better).
    """

    name: str
    call: Callable[[], object]
    """What is timed; with ``reports``, gives its own time in seconds"""
    work: float
    unit: str
    scale: float
    target: float | None = None
    limit: float | None = None
    peer: str = ""
    baseline: str = ""
    """Name of the case of the same group to which the ratio is taken"""
    ratio_target: float | None = None
    cost: bool = False
    wall: bool = False
    """Wall time: for what uses several threads or processes"""
    reports: bool = False
    calls: int = 1
    """Calls in a row per turn: for what takes microseconds"""
    error: Callable[[], float] | None = None
    error_target: float | None = None
    note: str = ""


@dataclass
class Row:
    """The figure of a case and what it is to be compared with."""

    name: str
    figure: float
    unit: str
    target: float | None
    met: bool | None
    limit: float | None
    ratio: float | None
    """Median over the turns of the ratio to the baseline, above 1 is faster"""
    ratio_target: float | None
    ratio_met: bool | None
    baseline: str
    error: float | None
    error_target: float | None
    peer: str
    note: str
    cost: bool = False
    seconds: list[float] = field(default_factory=list)
    """Time of each turn"""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def measure(cases: Sequence[Case], rounds: int = ROUNDS) -> Iterator[Row]:
    """Warm each case up once, let them take turns, and give a row for each."""
    for case in cases:
        case.call()
    seconds: dict[str, list[float]] = {case.name: [] for case in cases}
    for _ in range(rounds):
        for case in cases:
            seconds[case.name].append(_time(case))
    work = {case.name: case.work for case in cases}
    for case in cases:
        yield _row(case, seconds, work)


def _time(case: Case) -> float:
    if case.reports:
        return float(str(case.call()))
    clock = time.perf_counter if case.wall else time.thread_time
    began = clock()
    for _ in range(case.calls):
        case.call()
    return (clock() - began) / case.calls


def _row(case: Case, seconds: dict[str, list[float]], work: dict[str, float]) -> Row:
    mine = seconds[case.name]
    rate = case.work / min(mine)
    figure = case.scale / rate if case.cost else case.scale * rate
    ratio = None
    if case.baseline:
        share = case.work / work[case.baseline]
        ratio = median(share * o / m for o, m in zip(seconds[case.baseline], mine, strict=True))
    error = None if case.error is None else case.error()
    met = None
    if case.target is not None:
        met = figure <= case.target if case.cost else figure >= case.target
    ratio_met = None
    if ratio is not None and case.ratio_target is not None:
        ratio_met = ratio >= case.ratio_target
    if error is not None and case.error_target is not None:
        met = (met is None or met) and error <= case.error_target
    return Row(
        case.name, figure, case.unit, case.target, met, case.limit, ratio,
        case.ratio_target, ratio_met, case.baseline, error,
        case.error_target, case.peer, case.note, case.cost, mine,
    )  # fmt: skip
