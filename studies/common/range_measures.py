"""Figures of merit of flights over range data, of all runs of a cell."""

from __future__ import annotations

import numpy as np

from common.ballistic_range import (
    BURSTS_S,
    DT,
    NOMINAL,
    SETTLED,
    Flown,
    between,
    peaks,
    response,
    rms,
    stepped,
)
from common.ledger import Must, Quantity
from common.range_cells import BURST_S, MISSILE
from common.statistics import interval, mean

QUIET = np.array([stepped(NOMINAL)[round(t / DT)] < 50.0 for t in BURSTS_S])
"""Bursts while the noise is 15 or 20 m"""


def pooled(error: np.ndarray, when: np.ndarray = SETTLED) -> float:
    """R.m.s. over all runs."""
    return float(np.sqrt(np.mean(rms(error, when) ** 2)))


def after(step_s: float, first_s: float, last_s: float) -> np.ndarray:
    """Epochs from first_s to last_s after a step of the noise."""
    return between(step_s - DT / 2 + first_s, step_s - DT / 2 + last_s)


def t80(f: Flown) -> np.ndarray:
    """Time (4,) [s] in which the mean sigma^ of all runs makes 80 % of each step."""
    return response(f.sigma.mean(axis=0))


def ratio(name: str, a: Flown, b: Flown, when: np.ndarray, must: Must | None = None) -> Quantity:
    """Of r.m.s. errors over all runs, paired."""
    squares = np.column_stack([rms(f.error, when) ** 2 for f in (a, b)])
    return interval(
        name, squares, lambda d: np.sqrt(d[..., 0].mean(axis=-1) / d[..., 1].mean(axis=-1)), "",
        must,
    )  # fmt: skip


def sooner(name: str, a: Flown, b: Flown, step: int, must: Must | None = None) -> Quantity:
    """By how much a's sigma^ responds later than b's, run by run; at most 20 s count."""
    each = [np.minimum(response(f.sigma)[:, step], 20.0) for f in (a, b)]
    return mean(name, each[0] - each[1], "s", must)


def burst_peaks(f: Flown) -> np.ndarray:
    """Mean peak (10,) [m] of each burst."""
    return peaks(f.error).mean(axis=0)


def length_peak(f: Flown, n: int) -> np.ndarray:
    """Peak (run,) [m] of one burst of n outliers, until 2 s after it."""
    return peaks(f.error, [BURST_S], 2.0 + n * DT)[:, 0]


def never_back(f: Flown) -> np.ndarray:
    """Runs (run,) whose error still exceeds the outliers' 200 m 20 s after the burst began."""
    return rms(f.error, after(BURST_S, 20.0, 25.0)) > 200.0


def removed(f: Flown) -> float:
    """Standard deviation of the error by that of the missile's noise."""
    return float(np.std(f.error[:, SETTLED].astype(float)) / np.sqrt(np.mean(MISSILE**2)))


def agreement(f: Flown) -> float:
    """Mean of sigma^ / sigma of the missile."""
    return float(np.mean(f.sigma[:, SETTLED] / MISSILE[SETTLED]))


def spaced(values: np.ndarray, digits: int = 1) -> str:
    """Numbers in columns."""
    return " ".join(f"{x:6.{digits}f}" for x in values)
