"""h of a data bit, models D and C, at eight points at a time, and its Jacobian.

Each of the three numbers is a product g(range, phase) f(rate); `measurements` has the formulas.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from signals.compiled import FAST_SUM, borrowing
from signals.eight import WIDTH, greatest, load, sin_cos, size, store
from ultratight.tracking.code_model import (
    CHIP,
    HALF,
    OFFSET,
    SPACING,
    WAVELENGTH,
    correlation,
    early_late,
    slope,
)

TINY = 1e-100
"""sin x / x is exactly 1 here"""


# ---- kernels ---------------------------------------------------------------------------------


@borrowing(fastmath=FAST_SUM)
def of_range(
    d: int, range_m: Any, phase: Any, params: np.ndarray, room: np.ndarray
) -> tuple[Any, Any, Any]:
    """What range, and phase [rad] where d = 3, do to the three numbers; room (16,)."""
    r, split = early_late(range_m, params, room)
    if d == 2:
        return r * r, r * r, r * split
    s, c = sin_cos(phase)
    return r * c, r * s, r * split


@borrowing(fastmath=FAST_SUM)
def of_rate(d: int, x: Any) -> tuple[Any, Any, Any]:
    """What the rate does to the three numbers; x: half the turn in a half bit [rad]."""
    far = greatest(TINY, size(x))  # NaN stays NaN
    s, c = sin_cos(far)
    sinc = s / far
    loss = sinc * sinc
    if d == 2:
        return loss * (c * c - s * s), loss * (2.0 * c) * (sinc * x), loss
    return sinc * c, sinc * c, loss  # sinc(2 x) = sinc(x) cos(x)


@borrowing
def values(y: np.ndarray, params: np.ndarray, room: np.ndarray, z: np.ndarray) -> None:
    """h of one channel: z (p, 3) at y (p, d); room (48,)."""
    p, d = y.shape
    to_x, to_phase = np.pi / params[WAVELENGTH] * params[HALF], 2.0 * np.pi / params[WAVELENGTH]
    for first in range(0, p, WIDTH):
        m = min(WIDTH, p - first)
        for i in range(WIDTH):
            at = first + min(i, m - 1)
            room[i], room[WIDTH + i], room[2 * WIDTH + i] = y[at, 0], y[at, 1], y[at, d - 1]
        range_m, phase, rate = load(room, 0), load(room, WIDTH), load(room, 2 * WIDTH)
        g0, g1, g2 = of_range(d, range_m, to_phase * phase, params, room[3 * WIDTH :])
        f0, f1, f2 = of_rate(d, to_x * rate)
        store(room, 0, g0 * f0)
        store(room, WIDTH, g1 * f1)
        store(room, 2 * WIDTH, g2 * f2)
        for i in range(m):
            for q in range(3):
                z[first + i, q] = room[q * WIDTH + i]


@borrowing
def jacobian(y: np.ndarray, params: np.ndarray, J: np.ndarray) -> None:
    """dz/dy (3, d) of one channel at y (d,)."""
    if y.size == 2:
        _jacobian_differential(y, params, J)
    else:
        _jacobian_coherent(y, params, J)


@borrowing
def _sinc(x: float) -> float:
    return 1.0 - x * x / 6.0 if abs(x) < 1e-4 else np.sin(x) / x


@borrowing
def _sinc_slope(x: float) -> float:
    return -x / 3.0 if abs(x) < 1e-4 else (np.cos(x) - np.sin(x) / x) / x


# In the Jacobians the prompt's R(d) counts as constant: its peak is a kink, whose one-sided slope
# would tell an extended Kalman filter a range error from the amplitude alone.


@borrowing
def _jacobian_differential(y: np.ndarray, params: np.ndarray, J: np.ndarray) -> None:
    half, spacing, wavelength_m = params[HALF], params[SPACING], params[WAVELENGTH]
    d = (y[0] + params[OFFSET]) / params[CHIP]
    to_x = np.pi / wavelength_m * half
    x = to_x * y[1]
    s = _sinc(x)
    ds = _sinc_slope(x)
    r = correlation(d, params)
    split = correlation(d - spacing, params) - correlation(d + spacing, params)
    split_slope = slope(d - spacing, params) - slope(d + spacing, params)
    c, q = np.cos(2.0 * x), np.sin(2.0 * x)
    J[:] = 0.0
    J[0, 1] = r * r * to_x * (2.0 * s * ds * c - 2.0 * s * s * q)
    J[1, 1] = r * r * to_x * (2.0 * s * ds * q + 2.0 * s * s * c)
    J[2, 0] = s * s * r * split_slope / params[CHIP]
    J[2, 1] = 2.0 * s * ds * to_x * r * split


@borrowing
def _jacobian_coherent(y: np.ndarray, params: np.ndarray, J: np.ndarray) -> None:
    half, spacing, wavelength_m = params[HALF], params[SPACING], params[WAVELENGTH]
    d = (y[0] + params[OFFSET]) / params[CHIP]
    phase = 2.0 * np.pi * y[1] / wavelength_m
    to_x = np.pi / wavelength_m * half
    x = to_x * y[2]
    s, s2 = _sinc(x), _sinc(2.0 * x)
    r = correlation(d, params)
    split = correlation(d - spacing, params) - correlation(d + spacing, params)
    split_slope = slope(d - spacing, params) - slope(d + spacing, params)
    c, q = np.cos(phase), np.sin(phase)
    J[:] = 0.0
    J[0, 1] = -r * s2 * q * 2.0 * np.pi / wavelength_m
    J[1, 1] = r * s2 * c * 2.0 * np.pi / wavelength_m
    J[0, 2] = r * c * _sinc_slope(2.0 * x) * 2.0 * to_x
    J[1, 2] = r * q * _sinc_slope(2.0 * x) * 2.0 * to_x
    J[2, 0] = s * s * r * split_slope / params[CHIP]
    J[2, 2] = 2.0 * s * _sinc_slope(x) * to_x * r * split
