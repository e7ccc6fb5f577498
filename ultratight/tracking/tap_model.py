"""What the taps of a data bit would say at given errors: h and its Jacobian, models D and C.

`measurements` has the formulas.  The filter's moments are sums of h over points of its own
choosing, channel after channel: `TapModel.condition` finds them, linearises and updates in one
compiled call, eight points at a time.
"""

from __future__ import annotations

import numpy as np

from signals.compiled import FAST_SUM, borrowing, kernel
from signals.eight import (
    WIDTH,
    fill,
    load,
    padded,
    store_part,
    total,
)
from ultratight.filters.conditioning import condition_on, dot, rows_times, widen
from ultratight.filters.rules import psd_cholesky, solve_slope
from ultratight.tracking.closed_form import ROOM, regress_closed
from ultratight.tracking.code_model import (
    HALF,
    TABLE,
    WAVELENGTH,
)
from ultratight.tracking.tap_functions import jacobian, of_range, of_rate, values


class TapModel:
    """h of model D for y = (dr, dv), of model C for y = (dr, p, dv).

    ``params`` (nb, TABLE + n) are `code_rows` with the known code offset [m], T_h [s] and the
    spacing [chips] of each bit filled in.
    """

    def __init__(self, params: np.ndarray) -> None:
        if params.shape[1] < TABLE + 2:  # kernels do not look where they read
            raise ValueError(f"params is {params.shape}: expected (nb, {TABLE + 2} or more)")
        self.params = params

    def __call__(self, y: np.ndarray) -> np.ndarray:
        """Predicted z (nb, p, 3) at points y (nb, p, d)."""
        z = np.empty((y.shape[0], y.shape[1], 3))
        _evaluate(y, self.params, z)
        return z

    def jacobian(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """z (nb, 3) and dz/dy (nb, 3, d) at y (nb, d)."""
        J = np.empty((y.shape[0], 3, y.shape[1]))
        _jacobians(y, self.params, J)
        return self(y[:, None, :])[:, 0], J

    def condition(self, inner: int, *arrays: np.ndarray) -> float:
        """The update in one call, see `ultratight.filters.gaussian.CompiledModel`."""
        return condition_taps(self.params, inner, *arrays)


# ---------------------------------------------------------------------------------- kernels


@kernel
def condition_taps(
    params: np.ndarray,
    inner: int,
    mean: np.ndarray,
    cov: np.ndarray,
    lin_mean: np.ndarray,
    lin_cov: np.ndarray,
    z: np.ndarray,
    A: np.ndarray,
    R: np.ndarray,
    table: np.ndarray,
    nu: np.ndarray,
    H: np.ndarray,
    noise: np.ndarray,
    m1: np.ndarray,
    P1: np.ndarray,
) -> float:
    """Arguments after the parameters: `ultratight.filters.gaussian.CompiledModel`."""
    nb, d, n = A.shape
    closed, inner = inner < 0 and d == 3, abs(inner)
    zbar, small = np.empty((nb, 3)), np.empty((7, d))
    outer = table.shape[1] // inner
    room, points = np.empty((n + 1 + 2 * d, padded(n))), np.empty((d + inner, padded(outer)))
    shares = np.empty(inner + max(6 * WIDTH, ROOM))
    _linearise(
        params, lin_mean, lin_cov, A, table, closed, room, points, shares, small, zbar, H, noise
    )  # fmt: skip
    return condition_on(mean, cov, lin_mean, zbar.reshape(-1), H, z, R, nu, noise, m1, P1)


@borrowing(fastmath=FAST_SUM)
def _linearise(
    params: np.ndarray,
    mean: np.ndarray,
    cov: np.ndarray,
    A: np.ndarray,
    table: np.ndarray,
    closed: bool,
    room: np.ndarray,
    points: np.ndarray,
    shares: np.ndarray,
    small: np.ndarray,
    zbar: np.ndarray,
    H: np.ndarray,
    Omega: np.ndarray,
) -> None:
    """SLR, or Jacobian, of every channel: zbar (nb, 3), H (3 nb, n), Omega (nb, 3, 3).

    Room: room (n + 1 + 2 d, padded n), points and shares as `_arrange` has them, small (7, d).
    """
    nb, d, n = A.shape
    w = room.shape[1]
    P, x, rows, AP = room[:n], room[n : n + 1], room[n + 1 : n + 1 + d], room[n + 1 + d :]
    y, L, G = small[0], small[1 : 1 + d], small[4:]
    inner = points.shape[0] - d
    spare = shares[inner:]
    widen(cov, P)
    widen(mean.reshape((1, n)), x)
    if not closed:
        _arrange(table, inner, d, points, shares)
    for b in range(nb):
        widen(A[b], rows)
        for j in range(d):
            y[j] = dot(rows, j, x, 0)
        if table.shape[1] == 0:
            values(y.reshape((1, d)), params[b], spare, zbar[b : b + 1])
            jacobian(y, params[b], G)
            Omega[b] = 0.0
        else:
            rows_times(rows, P, AP)
            for j in range(d):
                for i in range(j + 1):
                    L[j, i] = dot(AP, j, rows, i)
            psd_cholesky(L, L)
            if closed:
                regress_closed(y, L, params[b], spare, zbar[b], G, Omega[b])
            else:
                _regress(y, L, points, shares, spare, params[b], zbar[b], G, Omega[b])
        for q in range(3):
            for v in range(0, w, WIDTH):
                row = G[q, 0] * load(rows, v)
                for j in range(1, d):
                    row += G[q, j] * load(rows, j * w + v)
                store_part(H, (3 * b + q) * n + v, min(WIDTH, n - v), row)


@borrowing
def _arrange(table: np.ndarray, inner: int, d: int, points: np.ndarray, shares: np.ndarray) -> None:
    """Points of a rule, (d + 1, p) with its last axis a factor of ``inner``, as `_regress` goes.

    Rows of points (d + inner, padded p / inner): weight and first d - 1 coordinates of the outer
    points, zeros behind; then the last coordinate of each inner one, for all outer ones.  Shares
    (inner,): weights of the inner points.
    """
    p = table.shape[1]
    points[:] = 0.0
    if p == 0:
        return
    total_k = 0.0
    for k in range(inner):
        total_k += table[0, k]
    for i in range(p // inner):
        for j in range(d):
            points[j, i] = table[j, i * inner]
        if inner > 1:
            points[0, i] *= total_k / table[0, 0]
        for k in range(inner):
            points[d + k, i] = table[d, i * inner + k]
    for k in range(inner):
        shares[k] = table[0, k] / total_k if inner > 1 else 1.0


@borrowing(fastmath=FAST_SUM)
def _regress(
    y: np.ndarray,
    L: np.ndarray,
    points: np.ndarray,
    shares: np.ndarray,
    room: np.ndarray,
    params: np.ndarray,
    zbar: np.ndarray,
    G: np.ndarray,
    Omega: np.ndarray,
) -> None:
    """SLR of h at y + L xi: zbar (3,), slope G (3, d), Omega (3, 3).

    L is lower triangular and h_q = g_q(range, phase) f_q(rate), hence only the f depend on the
    inner points.  Sums over these come first: E[f], E[f xi] and E[f f'] given the outer point.
    """
    d, width = y.size, points.shape[1]
    to_x, to_phase = np.pi / params[WAVELENGTH] * params[HALF], 2.0 * np.pi / params[WAVELENGTH]
    last = to_x * L[d - 1, d - 1]
    z0, z1, z2 = fill(0.0), fill(0.0), fill(0.0)
    c00, c10, c20 = fill(0.0), fill(0.0), fill(0.0)
    c01, c11, c21 = fill(0.0), fill(0.0), fill(0.0)
    c02, c12, c22 = fill(0.0), fill(0.0), fill(0.0)
    m00, m10, m11 = fill(0.0), fill(0.0), fill(0.0)
    m20, m21, m22 = fill(0.0), fill(0.0), fill(0.0)
    for o in range(0, width, WIDTH):
        weight, xi, more = load(points, o), load(points, width + o), fill(0.0)
        phase, rate = fill(0.0), to_x * (y[d - 1] + L[d - 1, 0] * xi)
        if d == 3:
            more = load(points, 2 * width + o)
            phase = to_phase * (y[1] + L[1, 0] * xi + L[1, 1] * more)
            rate += (to_x * L[2, 1]) * more
        g0, g1, g2 = of_range(d, y[0] + L[0, 0] * xi, phase, params, room)
        a0, a1, a2 = fill(0.0), fill(0.0), fill(0.0)
        b0, b1, b2 = fill(0.0), fill(0.0), fill(0.0)
        s00, s10, s11 = fill(0.0), fill(0.0), fill(0.0)
        s20, s21, s22 = fill(0.0), fill(0.0), fill(0.0)
        for k in range(points.shape[0] - d):
            step = load(points, (d + k) * width + o)
            f0, f1, f2 = of_rate(d, rate + last * step)
            v0, v1, v2 = shares[k] * f0, shares[k] * f1, shares[k] * f2
            a0 += v0
            a1 += v1
            a2 += v2
            b0 += step * v0
            b1 += step * v1
            b2 += step * v2
            s00 += v0 * f0
            s10 += v1 * f0
            s11 += v1 * f1
            s20 += v2 * f0
            s21 += v2 * f1
            s22 += v2 * f2
        w0, w1, w2 = weight * g0, weight * g1, weight * g2
        a0, a1, a2 = w0 * a0, w1 * a1, w2 * a2
        z0 += a0
        z1 += a1
        z2 += a2
        c00 += a0 * xi
        c10 += a1 * xi
        c20 += a2 * xi
        c01 += a0 * more
        c11 += a1 * more
        c21 += a2 * more
        c02 += w0 * b0
        c12 += w1 * b1
        c22 += w2 * b2
        m00 += w0 * g0 * s00
        m10 += w1 * g0 * s10
        m11 += w1 * g1 * s11
        m20 += w2 * g0 * s20
        m21 += w2 * g1 * s21
        m22 += w2 * g2 * s22
    zbar[0], zbar[1], zbar[2] = total(z0), total(z1), total(z2)
    G[0, 0], G[1, 0], G[2, 0] = total(c00), total(c10), total(c20)
    if d == 3:
        G[0, 1], G[1, 1], G[2, 1] = total(c01), total(c11), total(c21)
    G[0, d - 1], G[1, d - 1], G[2, d - 1] = total(c02), total(c12), total(c22)
    Omega[0, 0], Omega[1, 0], Omega[1, 1] = total(m00), total(m10), total(m11)
    Omega[2, 0], Omega[2, 1], Omega[2, 2] = total(m20), total(m21), total(m22)
    for q in range(3):
        for r in range(q + 1):
            s = Omega[q, r] - zbar[q] * zbar[r] - G[q, 0] * G[r, 0] - G[q, 1] * G[r, 1]
            if d == 3:
                s -= G[q, 2] * G[r, 2]
            Omega[q, r] = s
            Omega[r, q] = s
    solve_slope(L, G)


@kernel
def _evaluate(y: np.ndarray, params: np.ndarray, z: np.ndarray) -> None:
    """z (nb, p, 3) at y (nb, p, d)."""
    room = np.empty(6 * WIDTH)
    for b in range(y.shape[0]):
        values(y[b], params[b], room, z[b])


@kernel
def _jacobians(y: np.ndarray, params: np.ndarray, J: np.ndarray) -> None:
    for b in range(y.shape[0]):
        jacobian(y[b], params[b], J[b])
