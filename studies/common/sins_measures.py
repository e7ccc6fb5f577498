"""Gains and errors over all flights of a cell."""

from __future__ import annotations

import numpy as np

from common.ledger import Must, Quantity
from common.sins_cells import Merits
from common.statistics import interval

VELOCITY, POSITION = slice(0, 3), slice(3, 6)


def gain(
    m: dict[str, Merits], cell: str, over: str, worst: bool, must: Must | None = None,
    of: str = "ACEKF",
) -> Quantity:  # fmt: skip
    """Per cent by which errors are smaller, of means over the runs; worst or mean of the 12."""
    both = np.stack([m[f"{cell} {n}"]["twelve"] for n in (of, over)], axis=1)

    def statistic(drawn: np.ndarray) -> np.ndarray:
        mean = drawn.mean(axis=-3)
        each = 100.0 * (1.0 - mean[..., 0, :] / mean[..., 1, :])
        return each.min(axis=-1) if worst else each.mean(axis=-1)

    name = f"{cell}, {of} over {over}, {'worst' if worst else 'mean'} of 12"
    return interval(name, both, statistic, "%", must)


def averaged(
    name: str, values: np.ndarray, unit: str, must: Must | None = None, worst: str = "max"
) -> Quantity:
    """Largest or smallest, over the channels or windows, of means over the runs."""
    pick = np.max if worst == "max" else np.min
    flat = values.reshape(len(values), -1)
    return interval(name, flat, lambda d: pick(d.mean(axis=-2), axis=-1), unit, must)


def peaks(m: Merits, part: slice) -> np.ndarray:
    """(run,) the largest error of velocity or position in any window."""
    return m["peak"][:, :, part].max(axis=(1, 2))
