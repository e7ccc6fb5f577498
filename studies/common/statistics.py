"""Medians, counts and paired differences, each with a 95 % interval.

A run that diverged has no number, and counts as an infinite error; to leave it out, as
`ultratight.statistics.bootstrap` does, would make a filter that diverges look good.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from common.ledger import Must, Quantity
from ultratight.statistics import wilson

LEVEL = 0.95
RESAMPLES = 2000


def count(name: str, hits: np.ndarray, must: Must | None = None) -> Quantity:
    """Number of true entries, with Wilson's interval as numbers; ``must`` bounds the share."""
    k, n = int(np.sum(hits)), int(np.size(hits))
    if n == 0:
        return Quantity(name, None, None, None, "of 0", must)
    if must is not None:
        must = replace(must, bound=round(n * must.bound, 6))
    share = wilson(k, n, LEVEL)
    return Quantity(name, k, n * share.low, n * share.high, f"of {n}", must)


def typical(name: str, values: np.ndarray, unit: str, must: Must | None = None) -> Quantity:
    """Median, with a bootstrap interval; runs without a number count as infinite."""
    full = np.where(np.isfinite(values), values, np.inf)
    return interval(name, full, lambda drawn: np.median(drawn, axis=-1), unit, must)


def mean(name: str, values: np.ndarray, unit: str, must: Must | None = None) -> Quantity:
    """Mean of the runs that have a number, with a bootstrap interval."""
    good = values[np.isfinite(values)]
    return interval(name, good, lambda drawn: np.mean(drawn, axis=-1), unit, must)


def interval(
    name: str,
    values: np.ndarray,
    statistic: Callable[[np.ndarray], np.ndarray],
    unit: str,
    must: Must | None = None,
) -> Quantity:
    """Percentile bootstrap over the first axis, the runs, with draws that are always the same.

    ``statistic`` takes (..., n_run, *rest) and gives (...,).
    """
    if values.shape[0] == 0:
        return Quantity(name, None, None, None, unit, must)
    n = values.shape[0]
    draws = np.random.default_rng(0).integers(0, n, (RESAMPLES, n))
    tail = 50.0 * (1.0 - LEVEL)
    low, high = np.percentile(statistic(values[draws]), [tail, 100.0 - tail], method="nearest")
    ends = (float(statistic(values)), float(low), float(high))
    return Quantity(name, *(x if np.isfinite(x) else None for x in ends), unit, must)


def number(name: str, value: float, must: Must | None = None, unit: str = "") -> Quantity:
    """A number that comes without an interval."""
    return Quantity(name, float(value), None, None, unit, must)
