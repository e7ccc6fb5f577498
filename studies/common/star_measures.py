"""Errors and gains over all flights of a cell."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from common.ledger import Must, Quantity
from common.star_cells import FOUR, TIMES, Merits
from common.statistics import interval


def gain(m: dict[str, Merits], cell: str, of: str, over: str, must: Must | None = None) -> Quantity:
    """Per cent by which the r.m.s. error after 50 s is smaller."""
    both = np.stack([m[f"{cell} {n}"]["settled"][:, 0] for n in (of, over)], axis=1)
    return interval(f"{cell}, {of} over {over}", both, smaller, "%", must)


def smaller(squares: np.ndarray) -> np.ndarray:
    """(..., run, 2) mean squares -> by how many per cent the first r.m.s. is below the second."""
    a, b = np.moveaxis(squares.mean(axis=-2), -1, 0)
    return 100.0 * (1.0 - np.sqrt(a / b))


def excess(m: dict[str, Merits], cell: str, a: str, b: str, must: Must) -> Quantity:
    """Gain of a over the EKF less that of b."""
    three = np.stack([m[f"{cell} {n}"]["settled"][:, 0] for n in (a, b, "EKF")], axis=1)

    def statistic(squares: np.ndarray) -> np.ndarray:
        return smaller(squares[..., [0, 2]]) - smaller(squares[..., [1, 2]])

    return interval(f"{cell}, {a}: gain less that of {b}", three, statistic, "points", must)


def rms(name: str, squares: np.ndarray, unit: str, factor: float = 1.0, must: Must | None = None
        ) -> Quantity:  # fmt: skip
    """Root of a mean square (run,)."""
    return interval(name, squares, root(factor), unit, must)


def root(factor: float = 1.0) -> Callable[[np.ndarray], np.ndarray]:
    """Statistic of mean squares."""
    return lambda drawn: factor * np.sqrt(drawn.mean(axis=-1))


def scale(m: dict[str, Merits], key: str, t: int, must: Must | None = None) -> Quantity:
    """The estimate of wgt / wgt0 at a time."""
    values = m[key]["scale"][:, TIMES.index(t)]
    return interval(f"{key}: wgt / wgt0 at {t} s", values, lambda d: d.mean(axis=-1), "", must)


def spread(m: dict[str, Merits]) -> np.ndarray:
    """(run, 3) by how many per cent the four filters' r.m.s. differ at 100 Hz, by angle."""
    each = np.sqrt(np.stack([m[f"100 Hz {n}"]["all"] for n in FOUR]))
    return 100.0 * (each.max(axis=0) / each.min(axis=0) - 1.0)
