"""What a code delay does to the taps of a channel: R near its peak, as rows of numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from signals.compiled import FAST_SUM, borrowing
from signals.constants import C_MPS
from signals.eight import WIDTH, least, load, size, store
from ultratight.tracking.channels import Channels

LAG1, OFFSET, HALF, SPACING, WAVELENGTH, CHIP, STEPS, TABLE = range(8)
"""Columns of the parameters of h, see `code_rows`"""


def code_rows(channels: Channels) -> np.ndarray:
    """Parameters of h that are the channel's own (n_channel, TABLE + n).

    R at one chip, wavelength and chip [m], steps per chip, R at lags of these steps.
    """
    rows = np.zeros((len(channels.carrier_hz), TABLE + channels.correlation.shape[1]))
    rows[:, LAG1] = channels.correlation[:, -1]
    rows[:, WAVELENGTH] = channels.wavelength_m
    rows[:, CHIP] = C_MPS / channels.chip_rate_hz
    rows[:, STEPS] = channels.per_chip
    rows[:, TABLE:] = channels.correlation
    return rows


# ---- kernels ---------------------------------------------------------------------------------


@borrowing
def _triangle(d: float, lag1: float) -> float:
    """R(d) of rectangular chips: linear between the code's own values at lags 0 and 1."""
    return 1.0 - min(abs(d), 1.0) * (1.0 - lag1)


@borrowing
def correlation(d: float, params: np.ndarray) -> float:
    """R(d): linear between the code's own values at its steps, flat beyond one chip."""
    if params[STEPS] == 1.0:
        return _triangle(d, params[LAG1])
    x, steps = min(abs(d), 1.0) * params[STEPS], params[STEPS]
    k = int(x) if x < steps else int(steps) - 1  # NaN stays inside the table
    low, high = params[TABLE + k], params[TABLE + k + 1]
    return low + (x - k) * (high - low)


@borrowing(fastmath=FAST_SUM)
def early_late(y: Any, params: np.ndarray, room: np.ndarray) -> tuple[Any, Any]:
    """R(d) and R(d - spacing) - R(d + spacing) at eight points y [m]; room (16,)."""
    spacing, d = params[SPACING], (y + params[OFFSET]) * (1.0 / params[CHIP])
    if params[STEPS] == 1.0:
        drop = 1.0 - params[LAG1]
        r = 1.0 - drop * least(size(d), 1.0)
        return r, drop * (least(size(d + spacing), 1.0) - least(size(d - spacing), 1.0))
    store(room, 0, d)
    for i in range(WIDTH):
        at = room[i]
        room[i] = correlation(at, params)
        room[WIDTH + i] = correlation(at - spacing, params) - correlation(at + spacing, params)
    return load(room, 0), load(room, WIDTH)


@borrowing
def slope(d: float, params: np.ndarray) -> float:
    """dR/dd: zero at the peak, at a kink the mean of both sides, zero beyond one chip."""
    x = abs(d) * params[STEPS]
    if not 0.0 < x < params[STEPS]:
        return 0.0
    k = int(x)
    after = params[TABLE + k + 1] - params[TABLE + k]
    before = params[TABLE + k] - params[TABLE + k - 1] if x == k and k > 0 else after
    return np.sign(d) * 0.5 * (before + after) * params[STEPS]
