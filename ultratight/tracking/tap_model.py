"""What the taps of a data bit would say at given errors: h and its Jacobian, models D and C.

`measurements` has the formulas.  The filter's moments are sums of h over points of its own
choosing, channel after channel: `TapModel.condition` finds them, linearises and updates in one
compiled call.  Points lie in rows, (d, p), so that h is a handful of loops over p.
"""

from __future__ import annotations

import numpy as np

from signals.compiled import FAST_SUM, borrowing, kernel
from ultratight.filters.conditioning import condition_on
from ultratight.filters.rules import (
    chain,
    moments,
    project_mean,
    project_root,
    regress,
    scatter,
    solve_slope,
)
from ultratight.tracking.code_model import (
    CHIP,
    HALF,
    OFFSET,
    SPACING,
    TABLE,
    WAVELENGTH,
    correlation,
    early_late,
    slope,
)

TINY = 1e-100
"""sin x / x is exactly 1 here"""
ROOM = 22
"""Rows of room that the moments of h need"""


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
        return _condition(self.params, inner, *arrays)


# ---------------------------------------------------------------------------------- kernels


@kernel
def _condition(
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
    nb, d, n = A.shape
    zbar, G = np.empty((nb, 3)), np.empty((nb, 3, d))
    work = np.empty(ROOM * max(table.shape[1], 1))
    small = np.empty((d + 2, max(n, d)))
    _linearise(params, inner, lin_mean, lin_cov, A, table, small, work, zbar, G, noise)
    chain(G, A, H)
    return condition_on(mean, cov, lin_mean, zbar.reshape(-1), H, z, R, nu, noise, m1, P1)


@borrowing
def _linearise(
    params: np.ndarray,
    inner: int,
    mean: np.ndarray,
    cov: np.ndarray,
    A: np.ndarray,
    table: np.ndarray,
    small: np.ndarray,
    work: np.ndarray,
    zbar: np.ndarray,
    G: np.ndarray,
    Omega: np.ndarray,
) -> None:
    """SLR, or Jacobian, of every channel: zbar (nb, 3), G (nb, 3, d), Omega (nb, 3, 3).

    small (d + 2, n) and work (ROOM p,): room.
    """
    nb, d, n = A.shape
    p = table.shape[1]
    y, AP, L = small[0, :d], small[1, :n], small[2 : 2 + d, :d]
    rows = work.reshape((ROOM, -1))
    Y, Z, rest = rows[:d], rows[d : d + 3], rows[d + 3 :]
    for b in range(nb):
        project_mean(A[b], mean, y)
        if p == 0:
            for j in range(d):
                Y[j, 0] = y[j]
            _taps(Y, params[b], rest, Z)
            for q in range(3):
                zbar[b, q] = Z[q, 0]
            _jacobian(y, params[b], G[b])
            Omega[b] = 0.0
        else:
            project_root(A[b], cov, AP, L)
            if d == 3 and inner > 1:
                _regress_coherent(y, L, table, inner, params[b], work, zbar[b], G[b], Omega[b])
                continue
            scatter(y, L, table, Y)
            _taps(Y, params[b], rest, Z)
            regress(L, table, Z, rest[0], zbar[b], G[b], Omega[b])


@kernel
def _evaluate(y: np.ndarray, params: np.ndarray, z: np.ndarray) -> None:
    """z (nb, p, 3) at y (nb, p, d)."""
    p = y.shape[1]
    points, values, work = np.empty((y.shape[2], p)), np.empty((3, p)), np.empty((8, p))
    for b in range(y.shape[0]):
        points[:] = y[b].T
        _taps(points, params[b], work, values)
        z[b] = values.T


@kernel
def _jacobians(y: np.ndarray, params: np.ndarray, J: np.ndarray) -> None:
    for b in range(y.shape[0]):
        _jacobian(y[b], params[b], J[b])


@borrowing
def _taps(y: np.ndarray, params: np.ndarray, work: np.ndarray, z: np.ndarray) -> None:
    """h of one channel: z (3, p) at y (d, p); work (8, p)."""
    if y.shape[0] == 2:
        _differential(y, params, work, z)
    else:
        _coherent(y, params, work, z)


@borrowing
def _jacobian(y: np.ndarray, params: np.ndarray, J: np.ndarray) -> None:
    """dz/dy (3, d) of one channel at y (d,)."""
    if y.size == 2:
        _jacobian_differential(y, params, J)
    else:
        _jacobian_coherent(y, params, J)


@borrowing(fastmath={"contract"})
def sin_cos(x: np.ndarray, s: np.ndarray, c: np.ndarray) -> None:
    """Sine and cosine of x (p,), without branches or tables so that the loop is vectorised.

    x = k pi + r, |r| <= pi/2, and Taylor polynomials of r whose remainders are below 2e-17.  The
    second part of pi needs the sums as they stand, hence no reassociation; |x| < 1e6.
    """
    for i in range(x.size):
        k = np.floor(x[i] * (1.0 / np.pi) + 0.5)
        r = (x[i] - k * np.pi) - k * 1.2246467991473532e-16
        sign = 1.0 - 2.0 * (k - 2.0 * np.floor(0.5 * k))
        q = r * r
        u = 1.0 / 51090942171709440000.0
        u = u * q - 1.0 / 121645100408832000.0
        u = u * q + 1.0 / 355687428096000.0
        u = u * q - 1.0 / 1307674368000.0
        u = u * q + 1.0 / 6227020800.0
        u = u * q - 1.0 / 39916800.0
        u = u * q + 1.0 / 362880.0
        u = u * q - 1.0 / 5040.0
        u = u * q + 1.0 / 120.0
        u = u * q - 1.0 / 6.0
        s[i] = sign * (r + r * q * u)
        u = 1.0 / 2432902008176640000.0
        u = u * q - 1.0 / 6402373705728000.0
        u = u * q + 1.0 / 20922789888000.0
        u = u * q - 1.0 / 87178291200.0
        u = u * q + 1.0 / 479001600.0
        u = u * q - 1.0 / 3628800.0
        u = u * q + 1.0 / 40320.0
        u = u * q - 1.0 / 720.0
        u = u * q + 1.0 / 24.0
        c[i] = sign * (1.0 - 0.5 * q + q * q * u)


@borrowing(fastmath=FAST_SUM)
def _differential(y: np.ndarray, params: np.ndarray, work: np.ndarray, z: np.ndarray) -> None:
    p = y.shape[1]
    x, s, c, r, split = work[0], work[1], work[2], work[3], work[4]
    to_x = np.pi / params[WAVELENGTH] * params[HALF]
    early_late(y[0], params, r, split)
    for i in range(p):
        turn = to_x * y[1, i]
        x[i] = turn if abs(turn) > TINY else TINY
    sin_cos(x, s, c)
    for i in range(p):
        loss = r[i] * (s[i] / x[i]) ** 2
        z[0, i] = r[i] * loss * (c[i] * c[i] - s[i] * s[i])
        z[1, i] = r[i] * loss * 2.0 * c[i] * s[i]
        z[2, i] = loss * split[i]


@borrowing(fastmath=FAST_SUM)
def _coherent(y: np.ndarray, params: np.ndarray, work: np.ndarray, z: np.ndarray) -> None:
    p = y.shape[1]
    x, s, c, phase, cos_x, sinc = work[0], work[1], work[2], work[3], work[4], work[5]
    r, split = work[6], work[7]
    to_x, per_m = np.pi / params[WAVELENGTH] * params[HALF], 2.0 * np.pi / params[WAVELENGTH]
    early_late(y[0], params, r, split)
    for i in range(p):
        turn = to_x * y[2, i]
        x[i] = turn if abs(turn) > TINY else TINY
        phase[i] = per_m * y[1, i]
    sin_cos(x, s, cos_x)
    for i in range(p):
        sinc[i] = s[i] / x[i]
    sin_cos(phase, s, c)
    for i in range(p):
        amplitude = r[i] * sinc[i] * cos_x[i]  # sinc(2 x) = sinc(x) cos(x)
        z[0, i] = amplitude * c[i]
        z[1, i] = amplitude * s[i]
        z[2, i] = sinc[i] * sinc[i] * r[i] * split[i]


@borrowing(fastmath=FAST_SUM)
def _regress_coherent(
    y: np.ndarray,
    L: np.ndarray,
    table: np.ndarray,
    inner: int,
    params: np.ndarray,
    work: np.ndarray,
    zbar: np.ndarray,
    G: np.ndarray,
    Omega: np.ndarray,
) -> None:
    """SLR of model C by a rule whose last axis is a factor: the same sums in another order.

    L is lower triangular, hence range and phase depend on the outer points alone and only the two
    losses s = sinc(2 x) and c = sinc(x)^2 on the inner ones.  Their mean, slope and covariance
    given the outer point are found first; then Cov(z) = Cov(E[z | outer]) + E[Cov(z | outer)].
    """
    n = table.shape[1] // inner
    rows = work[: ROOM * n].reshape((ROOM, n))
    outer, Z = rows[0:3], rows[3:6]
    x, sine, cosine, rate, s, c = rows[6], rows[7], rows[8], rows[9], rows[10], rows[11]
    ds, dc, es, ec = rows[12], rows[13], rows[14], rows[15]
    vss, vsc, vcc = rows[16], rows[17], rows[18]
    a, b, t = rows[19], rows[20], rows[21]
    total = 0.0
    for k in range(inner):
        total += table[0, k]
    share = total / table[0, 0]
    turn, radian_m = np.pi / params[WAVELENGTH] * params[HALF], 2.0 * np.pi / params[WAVELENGTH]
    ranges, r, split = rows[12], rows[13], rows[14]
    for i in range(n):
        for j in range(3):
            outer[j, i] = table[j, i * inner]
        outer[0, i] *= share
    for i in range(n):
        ranges[i] = y[0] + L[0, 0] * outer[1, i]
        x[i] = radian_m * (y[1] + L[1, 0] * outer[1, i] + L[1, 1] * outer[2, i])
        rate[i] = turn * (y[2] + L[2, 0] * outer[1, i] + L[2, 1] * outer[2, i])
    sin_cos(x, sine, cosine)
    early_late(ranges, params, r, split)
    for i in range(n):
        a[i] = r[i] * cosine[i]
        b[i] = r[i] * sine[i]
        t[i] = r[i] * split[i]
    rows[12:19] = 0.0
    for k in range(inner):
        at = (k + inner // 2) % inner  # from the middle one on, whose values are taken off
        v, step = table[0, at] / total, table[3, at]
        for i in range(n):
            angle = rate[i] + turn * L[2, 2] * step
            x[i] = angle if abs(angle) > TINY else TINY
        sin_cos(x, sine, cosine)
        if k == 0:
            for i in range(n):
                sinc = sine[i] / x[i]
                s[i] = sinc * cosine[i]
                c[i] = sinc * sinc
        for i in range(n):
            sinc = sine[i] / x[i]
            off_s, off_c = sinc * cosine[i] - s[i], sinc * sinc - c[i]
            ds[i] += v * off_s
            dc[i] += v * off_c
            es[i] += v * step * off_s
            ec[i] += v * step * off_c
            vss[i] += v * off_s * off_s
            vsc[i] += v * off_s * off_c
            vcc[i] += v * off_c * off_c
    for i in range(n):
        Z[0, i] = a[i] * (s[i] + ds[i])
        Z[1, i] = b[i] * (s[i] + ds[i])
        Z[2, i] = t[i] * (c[i] + dc[i])
    moments(outer, Z, x, zbar, G, Omega)
    for q in range(3):
        G[q, 2] = 0.0
    for i in range(n):
        w = outer[0, i]
        G[0, 2] += w * a[i] * es[i]
        G[1, 2] += w * b[i] * es[i]
        G[2, 2] += w * t[i] * ec[i]
        ss, sc = w * (vss[i] - ds[i] * ds[i]), w * (vsc[i] - ds[i] * dc[i])
        Omega[0, 0] += a[i] * a[i] * ss
        Omega[1, 0] += a[i] * b[i] * ss
        Omega[1, 1] += b[i] * b[i] * ss
        Omega[2, 0] += a[i] * t[i] * sc
        Omega[2, 1] += b[i] * t[i] * sc
        Omega[2, 2] += t[i] * t[i] * w * (vcc[i] - dc[i] * dc[i])
    for q in range(3):
        for r in range(q + 1):
            Omega[q, r] -= G[q, 2] * G[r, 2]
            Omega[r, q] = Omega[q, r]
    solve_slope(L, G)


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
