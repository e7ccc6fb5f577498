"""Figures of merit of flights of the platform INS, of all runs of a cell."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from common.ledger import Must, Quantity
from common.platform_cells import FIRST_SEED, NAMES, Merits, algorithm, one_flight
from common.platform_flight import Q0
from common.statistics import interval, number


def middle(values: np.ndarray) -> float:
    """Geometric mean."""
    return float(np.exp(np.mean(np.log(values))))


def both(m: Merits) -> np.ndarray:
    """Peak of each run: the geometric mean of both velocities'."""
    return np.sqrt(m["peak_x"] * m["peak_y"])


def ratio(name: str, a: np.ndarray, b: np.ndarray, must: Must | None = None) -> Quantity:
    """Geometric mean of the ratios run by run."""
    with np.errstate(invalid="ignore"):  # two runs that both diverged have no ratio
        logs = np.log(a) - np.log(b)
    return interval(name, logs[~np.isnan(logs)], lambda d: np.exp(d.mean(axis=-1)), "", must)


def typical(name: str, values: np.ndarray, unit: str, must: Must | None = None) -> Quantity:
    """Geometric mean over the runs."""
    return interval(name, np.log(values), lambda d: np.exp(d.mean(axis=-1)), unit, must)


def single(name: str, values: np.ndarray, unit: str, theirs: float) -> Quantity:
    """Geometric mean, with the range of 95 % of single runs: does it cover theirs, a single run?"""
    low, high = np.percentile(values, [2.5, 97.5])
    return Quantity(name, middle(values), float(low), float(high), unit, Must("covers", theirs))


def more(bound: float = 1.0) -> Must:
    """Of a ratio: larger beyond doubt."""
    return Must("above", bound, "low")


def less(bound: float = 1.0) -> Must:
    """Of a ratio: smaller beyond doubt."""
    return Must("below", bound, "high")


def pairs(
    m: dict[str, Merits], where: str, of: Iterable[str], to: Iterable[str], must: Must,
    keys: Iterable[str] = ("peak", "rms"),
) -> tuple[Quantity, ...]:  # fmt: skip
    """Ratios of filters ``of`` over filters ``to``; of peaks and of r.m.s. errors."""
    out = []
    for key in keys:
        for a in of:
            for b in to:
                first, second = m[f"{where} {a}"], m[f"{where} {b}"]
                values = (both(first), both(second)) if key == "peak" else (first[key], second[key])
                out.append(ratio(f"{key} {NAMES[a]} / {NAMES[b]}", *values, must))
    return tuple(out)


def equal_b(first_seed: int = FIRST_SEED) -> Quantity:
    """Largest relative difference between the states of 1 and improved 1 with one b, scenario 2."""
    worst = []
    for Q in Q0.values():
        for seed in range(first_seed, first_seed + 3):
            one, two = (one_flight("2", Q, algorithm(n, "2"), seed).run.mean for n in "12")
            worst.append(np.max(np.abs(two - one) / np.abs(one).max(axis=0)))
    return number("states of improved 1 against 1, equal b, gain with R^_k", max(worst),
                  Must("above", 1e-6), "relative")  # fmt: skip
