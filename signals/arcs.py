"""Orbits as short polynomials: what to evaluate where the same satellites are asked for often.

Kepler's equation and a dozen sines per satellite and instant are the price of `orbit`.  Over a
minute a satellite's position and clock are polynomials of the fifth degree, fixed here by values
and derivatives at three instants: their error is h^6 |x^(6)| 4 / (27 720) <= 1e-10 m for
h = 30 s (|x^(6)| <= 1e-15 m/s^6), below the rounding of `orbit` itself.
"""

from __future__ import annotations

import math

import numpy as np

from signals.compiled import borrowing, kernel
from signals.satellites import N_ELEMENT, orbit

ARC_S = 60.0
"""Length of an arc [s]"""
DEGREE = 5
# rows of an arc: coefficients of x, y, z [m], clock [s], ascending; then the middle's time of week
X, Y, Z, CLOCK = 0, DEGREE + 1, 2 * (DEGREE + 1), 3 * (DEGREE + 1)
MIDDLE = 4 * (DEGREE + 1)
N_ROW = MIDDLE + 1


def arcs(rows: np.ndarray, from_tow_s: float, to_tow_s: float) -> np.ndarray:
    """Arcs of every row of elements over a span of GPS time of week.

    Parameters
    ----------
    rows : (n_channel, N_ELEMENT)
        Ephemerides from `Constellation.select`.
    from_tow_s, to_tow_s
        Times of reception [s]; the arcs reach as far as light and clocks need beyond.

    Returns
    -------
    (n_arc, N_ROW, n_channel)
        Arc k serves `ARC_S` seconds from ``from_tow_s + k ARC_S`` on.

    Raises
    ------
    ValueError
        Elements of another shape, a span that is not finite or runs backwards.
    """
    rows = np.ascontiguousarray(rows, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != N_ELEMENT:
        raise ValueError(f"rows has shape {rows.shape}, expected (n_channel, {N_ELEMENT})")
    if not (math.isfinite(from_tow_s) and 0.0 <= to_tow_s - from_tow_s < math.inf):
        raise ValueError(f"arcs from {from_tow_s} s to {to_tow_s} s: expected a finite span >= 0")
    n_arc = max(1, math.ceil((to_tow_s - from_tow_s) / ARC_S))
    out = np.empty((n_arc, N_ROW, len(rows)))
    _fit(rows, float(from_tow_s), out)
    return out


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def _fit(rows: np.ndarray, from_tow_s: float, out: np.ndarray) -> None:
    """Quintics through values and slopes at -h, 0, h from each middle."""
    h = 0.5 * ARC_S
    for k in range(out.shape[0]):
        middle = from_tow_s + (k + 0.5) * ARC_S
        for i in range(rows.shape[0]):
            x0, y0, z0, vx0, vy0, vz0, b0, d0 = orbit(rows[i], middle - h)
            x1, y1, z1, vx1, vy1, vz1, b1, d1 = orbit(rows[i], middle)
            x2, y2, z2, vx2, vy2, vz2, b2, d2 = orbit(rows[i], middle + h)
            _quintic(out[k, X:Y, i], h, x0, x1, x2, vx0, vx1, vx2)
            _quintic(out[k, Y:Z, i], h, y0, y1, y2, vy0, vy1, vy2)
            _quintic(out[k, Z:CLOCK, i], h, z0, z1, z2, vz0, vz1, vz2)
            _quintic(out[k, CLOCK:MIDDLE, i], h, b0, b1, b2, d0, d1, d2)
            out[k, MIDDLE, i] = middle


@kernel
def _quintic(
    out: np.ndarray, h: float, f0: float, f1: float, f2: float, v0: float, v1: float, v2: float
) -> None:
    """Coefficients (6,) of the quintic with f at -h, 0, h and slopes v there."""
    a, b = 0.5 * (f2 + f0) - f1, 0.5 * h * (v2 - v0)
    c, d = 0.5 * (f2 - f0) - h * v1, 0.5 * h * (v2 + v0) - h * v1
    out[0] = f1
    out[1] = v1
    out[2] = (2.0 * a - 0.5 * b) / h**2
    out[3] = 0.5 * (5.0 * c - d) / h**3
    out[4] = (0.5 * b - a) / h**4
    out[5] = 0.5 * (d - 3.0 * c) / h**5


@borrowing
def arc_index(arcs: np.ndarray, tow_s: float) -> int:
    """Index of the arc that serves receiver time of week tow_s; the first or last one beyond."""
    k = math.floor((tow_s - arcs[0, MIDDLE, 0]) / ARC_S + 0.5)
    return int(min(max(k, 0.0), arcs.shape[0] - 1.0))


@borrowing(inline="always")
def arc_at(arc: np.ndarray, i: int, s: float) -> tuple[float, ...]:
    """`orbit` of channel i of an arc (N_ROW, n_channel), s seconds from its middle."""
    return (
        _value(arc, X, i, s), _value(arc, Y, i, s), _value(arc, Z, i, s),
        _slope(arc, X, i, s), _slope(arc, Y, i, s), _slope(arc, Z, i, s),
        _value(arc, CLOCK, i, s), _slope(arc, CLOCK, i, s),
    )  # fmt: skip


@borrowing(inline="always")
def _value(arc: np.ndarray, row: int, i: int, s: float) -> float:
    a = arc[row + 3, i] + s * (arc[row + 4, i] + s * arc[row + 5, i])
    return arc[row, i] + s * (arc[row + 1, i] + s * (arc[row + 2, i] + s * a))


@borrowing(inline="always")
def _slope(arc: np.ndarray, row: int, i: int, s: float) -> float:
    a = 3.0 * arc[row + 3, i] + s * (4.0 * arc[row + 4, i] + s * 5.0 * arc[row + 5, i])
    return arc[row + 1, i] + s * (2.0 * arc[row + 2, i] + s * a)
