"""Moments of model C without points in phase and rate: sines of Gaussian angles have means.

The coherent prompt is the mean, over the bit, of a phasor that turns (`measurements` has h):

    R(d) sinc(2 f T_h) exp(j k p) = R(d) mean of exp(j k (p + dv t)) over -T_h < t < T_h
    sinc(f T_h)^2                 = mean of cos(k dv t), t of triangular density on (-T_h, T_h)

with k = 2 pi / wavelength.  At each instant the angle is a linear combination of range, phase and
rate, hence Gaussian; its part b xi that goes with the range (xi its standard normal) meets R, of
which the Hermite coefficients f_n = E[f He_n(xi)] / n! are enough:

    E f(xi) exp(j (a + b xi)) = exp(j E a - (var a + b^2) / 2) (f_0 + j b f_1 - b^2 f_2 - j b^3 f_3)

So mean, slope (E dh/dp and E dh/dv by Stein's lemma) and second moments (angles a_i +- a_j) are
exact in phase and rate, whatever the phase's standard deviation.  Three things are not:

* the integrals over t are Gauss rules of four instants and of three pairs.  Their errors fall like
  (k s T_h)^(2 n) / (2 n)!: below 1e-8 for rates of s = 1 m/s, 1e-5 for 3 m/s;
* f_n are sums over eight points of xi, with the kink of R at its peak made good: those of |xi - a|
  are known.  From points alone E |xi| would be 0.04 off, and E R by that many sigma / chip;
* f_n beyond n = 3 are left out: they come to less than b^4 / 30 sigma / chip.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.polynomial.hermite_e import hermevander
from numpy.polynomial.legendre import leggauss

from signals.compiled import FAST_SUM, borrowing
from signals.eight import WIDTH, load, size, total
from ultratight.filters.quadrature import gauss_rule, hermite_nodes
from ultratight.filters.rules import solve_slope
from ultratight.tracking.code_model import CHIP, HALF, OFFSET, STEPS, TABLE, WAVELENGTH, early_late

TIMES, PAIRS, ORDERS = 4, 3, 4
N = TIMES + PAIRS
"""Instants: those of the prompt, then those of late minus early"""
ROOM = 6 * N + 2 * WIDTH + 5 * ORDERS
"""Numbers of room for one channel"""
LARGEST = 600.0
"""Variance [rad2] beyond which exp() would leave the numbers there are; means are 0 long before"""
FAR = 9.0
"""A kink farther than so many sigma from the mean makes no difference"""


def _instants() -> tuple[np.ndarray, np.ndarray]:
    """Instants in units of T_h and their weights (N,): uniform density, then triangular."""
    t, w = leggauss(TIMES)
    x, weight = leggauss(32)
    x, weight = 0.5 * (1.0 + x), 0.5 * weight * (1.0 - 0.5 * (1.0 + x))
    s, v = gauss_rule(np.append(-x, x), np.append(weight, weight), 2 * PAIRS)
    return np.append(t, s[PAIRS:]), np.append(0.5 * w, 2.0 * v[PAIRS:])


INSTANT, WEIGHT = _instants()
POINT, _WEIGHT = hermite_nodes(WIDTH)
HERMITE = (hermevander(POINT, WIDTH - 1) / [math.factorial(n) for n in range(WIDTH)]).T.copy()
"""He_n(xi) / n! at the points (WIDTH, WIDTH), n first"""
WEIGHTED = _WEIGHT * HERMITE[:ORDERS]


# ---------------------------------------------------------------------------------- kernels


@borrowing(fastmath=FAST_SUM)
def regress_closed(
    y: np.ndarray,
    L: np.ndarray,
    params: np.ndarray,
    work: np.ndarray,
    zbar: np.ndarray,
    G: np.ndarray,
    Omega: np.ndarray,
) -> None:
    """SLR of model C at N(y, L L'): zbar (3,), slope G (3, 3), Omega (3, 3); work (ROOM,)."""
    angles = work[: 6 * N].reshape((6, N))
    f = work[6 * N : 6 * N + 5 * ORDERS].reshape((5, ORDERS))
    _ranges(y, L, params, work[6 * N + 5 * ORDERS :], f)
    _phasors(y, L, params, angles)
    _first_moments(L, params, angles, f, zbar, G)
    _second_moments(angles, f, Omega)
    for q in range(3):
        for p in range(3):
            told = G[q, 0] * G[p, 0] + G[q, 1] * G[p, 1] + G[q, 2] * G[p, 2]
            Omega[q, p] -= zbar[q] * zbar[p] + told
    solve_slope(L, G)


@borrowing(fastmath=FAST_SUM)
def _ranges(
    y: np.ndarray, L: np.ndarray, params: np.ndarray, room: np.ndarray, f: np.ndarray
) -> None:
    """Coefficients f (5, ORDERS) of R, R split, and of their products RR, RS, SS; room (16,)."""
    r, split = early_late(y[0] + L[0, 0] * load(POINT, 0), params, room)
    if L[0, 0] > 0.0:
        kink = -(y[0] + params[OFFSET]) / L[0, 0]
        if abs(kink) < FAR:
            bend = (params[TABLE] - params[TABLE + 1]) * params[STEPS] * L[0, 0] / params[CHIP]
            r += bend * _beside_series(kink)
    s = r * split
    rr, rs, ss = r * r, r * s, s * s
    for n in range(ORDERS):
        w = load(WEIGHTED, n * WIDTH)
        f[0, n], f[1, n] = total(w * r), total(w * s)
        f[2, n], f[3, n], f[4, n] = total(w * rr), total(w * rs), total(w * ss)


@borrowing(fastmath=FAST_SUM)
def _beside_series(kink: float) -> Any:
    """|xi - kink| at the points minus its Hermite series there.

    E |xi - a| = a (2 Phi(a) - 1) + 2 phi(a), E xi |xi - a| = 1 - 2 Phi(a), and by parts
    E He_n |xi - a| = 2 phi(a) He_(n-2)(a).
    """
    density = math.sqrt(2.0 / math.pi) * math.exp(-0.5 * kink * kink)  # 2 phi
    beyond = math.erf(kink * math.sqrt(0.5))  # 2 Phi - 1
    xi = load(POINT, 0)
    rest = size(xi - kink) - (kink * beyond + density) + beyond * xi
    before, now = 0.0, density
    for n in range(2, WIDTH):
        rest -= now * load(HERMITE, n * WIDTH)
        before, now = now, kink * now - (n - 2) * before
    return rest


@borrowing
def _phasors(y: np.ndarray, L: np.ndarray, params: np.ndarray, angles: np.ndarray) -> None:
    """Rows of angles (6, N): deviations with xi_0 (range), xi_1, xi_2; E exp(j a) / f, k t.

    The mean phasors are cosine and sine, times the weight of the instant.
    """
    b, u, v, cosine, sine, turn = (
        angles[0], angles[1], angles[2], angles[3], angles[4], angles[5],
    )  # fmt: skip
    k = 2.0 * math.pi / params[WAVELENGTH]
    largest = 0.0
    for i in range(N):
        seen, turn[i] = (k if i < TIMES else 0.0), k * params[HALF] * INSTANT[i]
        b[i] = seen * L[1, 0] + turn[i] * L[2, 0]
        u[i] = seen * L[1, 1] + turn[i] * L[2, 1]
        v[i] = turn[i] * L[2, 2]
        largest = max(largest, b[i] * b[i] + u[i] * u[i] + v[i] * v[i])
    shrink = 1.0 if largest <= LARGEST else math.sqrt(LARGEST / largest)
    for i in range(N):
        b[i] *= shrink
        u[i] *= shrink
        v[i] *= shrink
        mean = turn[i] * y[2] + (k * y[1] if i < TIMES else 0.0)
        size = WEIGHT[i] * math.exp(-0.5 * (b[i] * b[i] + u[i] * u[i] + v[i] * v[i]))
        cosine[i] = size * math.cos(mean)
        sine[i] = size * math.sin(mean)


@borrowing(fastmath=FAST_SUM)
def _first_moments(
    L: np.ndarray,
    params: np.ndarray,
    angles: np.ndarray,
    f: np.ndarray,
    zbar: np.ndarray,
    G: np.ndarray,
) -> None:
    """Mean zbar (3,) and E[dz xi'] in G (3, 3)."""
    k = 2.0 * math.pi / params[WAVELENGTH]
    i0, i1, iv, q0, q1, qv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    s0, s1, sv = 0.0, 0.0, 0.0
    for i in range(N):
        b, c, s, turn = angles[0, i], angles[3, i], angles[4, i], angles[5, i]
        row = f[0] if i < TIMES else f[1]
        # E f exp(j b xi) and E f xi exp(j b xi), without the factor exp(-b^2 / 2)
        re, im = row[0] - b * b * row[2], b * (row[1] - b * b * row[3])
        xi_re, xi_im = row[1] - 3.0 * b * b * row[3] - b * im, 2.0 * b * row[2] + b * re
        cosine, sine = c * re - s * im, s * re + c * im
        xi_cosine, xi_sine = c * xi_re - s * xi_im, s * xi_re + c * xi_im
        if i < TIMES:
            i0 += cosine
            q0 += sine
            i1 += xi_cosine
            q1 += xi_sine
            iv -= turn * sine
            qv += turn * cosine
        else:
            s0 += cosine
            s1 += xi_cosine
            sv -= turn * sine
    zbar[0], zbar[1], zbar[2] = i0, q0, s0
    G[0, 0], G[0, 1], G[0, 2] = i1, -k * q0 * L[1, 1] + iv * L[2, 1], iv * L[2, 2]
    G[1, 0], G[1, 1], G[1, 2] = q1, k * i0 * L[1, 1] + qv * L[2, 1], qv * L[2, 2]
    G[2, 0], G[2, 1], G[2, 2] = s1, sv * L[2, 1], sv * L[2, 2]


@borrowing(fastmath=FAST_SUM)
def _second_moments(angles: np.ndarray, f: np.ndarray, M: np.ndarray) -> None:
    """M (3, 3) = E z z'; of each pair of instants the angles' sum and difference."""
    ii, iq, qq, si, sq, ss = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(N):
        for j in range(i + 1):
            bi, bj = angles[0, i], angles[0, j]
            e = math.exp(bi * bj + angles[1, i] * angles[1, j] + angles[2, i] * angles[2, j])
            row = f[2] if i < TIMES else (f[3] if j < TIMES else f[4])
            cc, s_s = angles[3, i] * angles[3, j], angles[4, i] * angles[4, j]
            sc, cs = angles[4, i] * angles[3, j], angles[3, i] * angles[4, j]
            b, d = bi + bj, bi - bj
            re, im = row[0] - b * b * row[2], b * (row[1] - b * b * row[3])
            real, imag = (cc - s_s) / e, (sc + cs) / e
            sum_re, sum_im = real * re - imag * im, real * im + imag * re
            re, im = row[0] - d * d * row[2], d * (row[1] - d * d * row[3])
            real, imag = (cc + s_s) * e, (sc - cs) * e
            apart_re, apart_im = real * re - imag * im, real * im + imag * re
            if i < TIMES:
                twice = 0.5 if i == j else 1.0
                ii += twice * (apart_re + sum_re)
                qq += twice * (apart_re - sum_re)
                iq += twice * sum_im
            elif j < TIMES:
                si += 0.5 * (apart_re + sum_re)
                sq += 0.5 * (sum_im - apart_im)
            else:
                ss += (0.5 if i == j else 1.0) * (apart_re + sum_re)
    M[0, 0], M[1, 1], M[2, 2] = ii, qq, ss
    M[0, 1] = M[1, 0] = iq
    M[0, 2] = M[2, 0] = si
    M[1, 2] = M[2, 1] = sq
