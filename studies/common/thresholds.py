"""Tracking thresholds: the C/N0 at which 10 % of the channels are lost, and differences of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from common.ledger import Must, Quantity
from common.statistics import interval

LOSS = 0.1


def crossing(levels: np.ndarray, share: np.ndarray, at: float = LOSS) -> np.ndarray:
    """C/N0 (...,) where the loss (..., n_level), made monotone, crosses ``at``.

    An end of the levels where it does not cross.
    """
    falling = np.maximum.accumulate(share[..., ::-1], axis=-1)[..., ::-1]
    k = np.clip((falling > at).sum(axis=-1), 1, levels.size - 1)[..., None]
    high, low = (np.take_along_axis(falling, i, axis=-1)[..., 0] for i in (k - 1, k))
    x0, x1 = levels[k - 1][..., 0], levels[k][..., 0]
    part = np.divide(high - at, high - low, out=np.zeros_like(high), where=high > low)
    inside = x0 + np.clip(part, 0.0, 1.0) * (x1 - x0)
    return np.where(falling[..., -1] > at, levels[-1], inside)


def threshold(name: str, share: xr.DataArray) -> Quantity:
    """Where the mean over the runs crosses 10 %; the bootstrap draws runs.

    No number where that is beyond the levels flown.
    """
    levels, loss = share["cn0_dbhz"].values, share.mean("run").values
    if loss[-1] > LOSS or loss.max() <= LOSS:
        side = f"above {levels[-1]:g}" if loss[-1] > LOSS else f"below {levels[0]:g}"
        return Quantity(f"{name} threshold {side}", None, None, None, "dB-Hz")
    return interval(
        f"{name} threshold", share.transpose("run", "cn0_dbhz").values,
        lambda drawn: crossing(levels, drawn.mean(axis=-2)), "dB-Hz",
    )  # fmt: skip


def gap(shares: Mapping[str, xr.DataArray], a: str, b: str, must: Must | None = None) -> Quantity:
    """Threshold of a less that of b; runs, which share seeds, are drawn in pairs."""
    levels = [shares[k]["cn0_dbhz"].values for k in (a, b)]
    runs = min(shares[k].sizes["run"] for k in (a, b))
    values = [shares[k].transpose("run", "cn0_dbhz").values[:runs] for k in (a, b)]
    n = levels[0].size

    def difference(drawn: np.ndarray) -> np.ndarray:
        average = drawn.mean(axis=-2)
        return crossing(levels[0], average[..., :n]) - crossing(levels[1], average[..., n:])

    return interval(f"{a} − {b}", np.concatenate(values, axis=1), difference, "dB", must)
