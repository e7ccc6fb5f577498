"""Intervals for counts, means, medians and paired differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

RESAMPLES = 10_000
SEED = 1
_AT_ONCE = 1 << 22
"""Numbers resampled at a time: bounds the memory"""
STATISTICS: dict[str, Callable[..., Any]] = {"mean": np.mean, "median": np.median}


class Estimate(NamedTuple):
    """A value with its interval, from n values or pairs."""

    value: float
    low: float
    high: float
    n: int

    def __str__(self) -> str:
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


def wilson(k: int, n: int, level: float = 0.95) -> Estimate:
    """Share k/n of a binomial count with Wilson's score interval.

    E. B. Wilson, J. Am. Stat. Assoc. 22 (1927); recommended over the others by R. G. Newcombe,
    Statist. Med. 17 (1998).  Without trials the share is NaN, between 0 and 1.

    Raises
    ------
    ValueError
        Not 0 <= k <= n, or not 0 < level < 1.
    """
    if not 0 <= k <= n:
        raise ValueError(f"wilson: {k} of {n} given, expected 0 <= k <= n")
    _check_level(level)
    if n == 0:
        return Estimate(np.nan, 0.0, 1.0, 0)
    from scipy.special import ndtri  # slow to import

    z2, p = float(ndtri(0.5 + 0.5 * level)) ** 2, k / n
    middle = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = np.sqrt(z2 * (p * (1 - p) / n + z2 / (4 * n * n))) / (1 + z2 / n)
    low, high = max(0.0, float(middle - half)), min(1.0, float(middle + half))
    return Estimate(p, 0.0 if k == 0 else low, 1.0 if k == n else high, n)


def bootstrap(
    values: ArrayLike,
    statistic: str = "median",
    level: float = 0.95,
    *,
    resamples: int = RESAMPLES,
    seed: int = SEED,
) -> Estimate:
    """Mean or median with the percentile interval of the bootstrap (Efron & Tibshirani, ch. 13).

    Same seed, same interval.  Values that are not finite are left out, and n says how many stayed;
    without any all is NaN.  With fewer than some ten values the interval is too narrow.

    Raises
    ------
    ValueError
        Another statistic, a level outside (0, 1), values that are no list.
    """
    given = np.asarray(values, np.float64)
    if given.ndim != 1:
        raise ValueError(f"bootstrap: {given.ndim} axes given, expected 1")
    if statistic not in STATISTICS:
        raise ValueError(f"statistic: {statistic!r} given, expected mean or median")
    _check_level(level)
    kept, of = given[np.isfinite(given)], STATISTICS[statistic]
    if kept.size == 0:
        return Estimate(np.nan, np.nan, np.nan, 0)
    rng = np.random.Generator(np.random.Philox(seed))
    rows = max(1, _AT_ONCE // kept.size)
    found = []
    for first in range(0, resamples, rows):
        draw = rng.integers(0, kept.size, (min(rows, resamples - first), kept.size))
        found.append(of(kept[draw], axis=1))
    tail = 0.5 * (1.0 - level)
    low, high = np.quantile(np.concatenate(found), [tail, 1.0 - tail])
    return Estimate(float(of(kept)), float(low), float(high), int(kept.size))


def paired_difference(
    a: ArrayLike,
    b: ArrayLike,
    statistic: str = "median",
    level: float = 0.95,
    *,
    resamples: int = RESAMPLES,
    seed: int = SEED,
) -> Estimate:
    """Mean or median of a - b, pair by pair, with its bootstrap interval.

    For runs of two cells of a sweep, which share their noise run by run.  Pairs in which one is
    not finite are left out.
    """
    first, second = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if first.shape != second.shape:
        raise ValueError(f"pairs: shapes {first.shape} and {second.shape} given, expected the same")
    return bootstrap(first - second, statistic, level, resamples=resamples, seed=seed)


def _check_level(level: float) -> None:
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: {level} given, expected more than 0, less than 1")
