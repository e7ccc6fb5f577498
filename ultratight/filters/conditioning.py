"""The compiled time update and conditioning of a Gaussian; `gaussian` has the sentences above them.

A joint update by blocks of numbers with uncorrelated noise is the same as one block after the
other, the linearisation held: that needs no solve of the size of the whole measurement.  Loops
are sums of rows, and zero entries of Phi and H are passed over.
"""

from __future__ import annotations

import math

import numpy as np

from signals.compiled import FAST_SUM, borrowing, kernel
from signals.eight import WIDTH, fill, load, load_part, padded, store, total
from ultratight.filters.padded_rows import dot, rows_times, symmetric_part, widen


@kernel(fastmath=FAST_SUM)
def predict_into(
    mean: np.ndarray,
    cov: np.ndarray,
    phi: np.ndarray,
    q: np.ndarray,
    m1: np.ndarray,
    P1: np.ndarray,
) -> None:
    """m1 = Phi m and P1 = Phi P Phi' + Q; most entries of Phi are zero and are passed over."""
    n = mean.size
    w = padded(n)
    _predict(mean, cov, phi, q, np.empty((3 * n, w)), np.empty((n + 1) * (n + 1), np.int64), m1, P1)


@borrowing(fastmath=FAST_SUM)
def _predict(
    mean: np.ndarray,
    cov: np.ndarray,
    phi: np.ndarray,
    q: np.ndarray,
    room: np.ndarray,
    index: np.ndarray,
    m1: np.ndarray,
    P1: np.ndarray,
) -> None:
    """room (3 n, padded n); index (n + 1 + n n,): where rows of entries begin, their columns."""
    n = mean.size
    X, Y, Q, first, column = (
        room[:n],
        room[n : 2 * n],
        room[2 * n :],
        index[: n + 1],
        index[n + 1 :],
    )
    at = 0
    for i in range(n):
        first[i] = at
        s = 0.0
        for k in range(n):
            column[at] = k
            at += phi[i, k] != 0.0
            s += phi[i, k] * mean[k]
        m1[i] = s
    first[n] = at
    widen(cov, X)
    for i in range(n):
        for v in range(0, X.shape[1], WIDTH):
            store(Q, i * X.shape[1] + v, fill(0.0))
    _sparse_times(phi, first, column, X, Q, Y)
    for i in range(n):
        for j in range(n):
            X[j, i] = Y[i, j]
    widen(q, Q)
    _sparse_times(phi, first, column, X, Q, Y)
    symmetric_part(Y, P1)


@borrowing(fastmath=FAST_SUM)
def _sparse_times(
    phi: np.ndarray,
    first: np.ndarray,
    column: np.ndarray,
    X: np.ndarray,
    Q: np.ndarray,
    Y: np.ndarray,
) -> None:
    """Y (n, w) = Q + Phi X, of the entries of Phi that `_predict` has listed."""
    n, w = X.shape
    for i in range(n):
        v = 0
        while v + 3 * WIDTH <= w:
            at = i * w + v
            x, y, z = load(Q, at), load(Q, at + WIDTH), load(Q, at + 2 * WIDTH)
            for t in range(first[i], first[i + 1]):
                g, k = phi[i, column[t]], column[t] * w + v
                x += g * load(X, k)
                y += g * load(X, k + WIDTH)
                z += g * load(X, k + 2 * WIDTH)
            store(Y, at, x)
            store(Y, at + WIDTH, y)
            store(Y, at + 2 * WIDTH, z)
            v += 3 * WIDTH
        while v < w:
            x = load(Q, i * w + v)
            for t in range(first[i], first[i + 1]):
                x += phi[i, column[t]] * load(X, column[t] * w + v)
            store(Y, i * w + v, x)
            v += WIDTH


@borrowing(fastmath=FAST_SUM)
def innovate(
    mean: np.ndarray,
    lin_mean: np.ndarray,
    zbar: np.ndarray,
    H: np.ndarray,
    z: np.ndarray,
    nu: np.ndarray,
) -> None:
    """nu (m,) = z - zbar - H (mean - lin_mean)."""
    m, n = H.shape
    k = z.shape[1]
    for q in range(m):
        s = fill(0.0)
        for v in range(0, n, WIDTH):
            c = min(WIDTH, n - v)
            step = load_part(mean, v, c) - load_part(lin_mean, v, c)
            s += load_part(H, q * n + v, c) * step
        nu[q] = z[q // k, q % k] - zbar[q] - total(s)


@kernel
def condition(
    mean: np.ndarray,
    cov: np.ndarray,
    nu: np.ndarray,
    H: np.ndarray,
    noise: np.ndarray,
    m1: np.ndarray,
    P1: np.ndarray,
) -> float:
    """Posterior m1, P1 by nu = H (x - mean) + e, block after block of noise; returns the NIS.

    Since Cov(e) is block-diagonal this is the joint update, without a solve of m x m.  Each block
    is whitened by the root of its own S; NaN where that is not positive definite.
    """
    n, k = mean.size, noise.shape[1]
    room, S, e = np.empty((n + 1 + 2 * k, padded(n))), np.empty((k, k)), np.empty(k)
    return _sweep(mean, cov, nu, H, noise, room, S, e, m1, P1)


@borrowing(fastmath=FAST_SUM)
def _sweep(
    mean: np.ndarray,
    cov: np.ndarray,
    nu: np.ndarray,
    H: np.ndarray,
    noise: np.ndarray,
    room: np.ndarray,
    S: np.ndarray,
    e: np.ndarray,
    m1: np.ndarray,
    P1: np.ndarray,
) -> float:
    """`condition`; room (n + 1 + 2 k, w): P, x, rows of H and L^-1 H P; S (k, k), e (k,)."""
    n, w = mean.size, room.shape[1]
    k = noise.shape[1]
    P, x, rows, W = room[:n], room[n : n + 1], room[n + 1 : n + 1 + k], room[n + 1 + k :]
    widen(cov, P)
    for v in range(0, w, WIDTH):
        store(x, v, fill(0.0))
    nis = 0.0
    for b in range(noise.shape[0]):
        widen(H[b * k : b * k + k], rows)
        if k == 3:
            nis += _three_rows(P, x, rows, W, nu[3 * b : 3 * b + 3], noise[b])
            continue
        rows_times(rows, P, W)
        for q in range(k):
            e[q] = nu[b * k + q] - dot(rows, q, x, 0)
            for r in range(q + 1):
                S[q, r] = noise[b, q, r] + dot(W, q, rows, r)
        if not _whiten(S, W, e):
            return np.nan
        for q in range(k):
            nis += e[q] * e[q]
            for v in range(0, w, WIDTH):
                a = load(W, q * w + v)
                store(x, v, load(x, v) + e[q] * a)
                for i in range(n):
                    store(P, i * w + v, load(P, i * w + v) - W[q, i] * a)
    for a in range(n):
        m1[a] = mean[a] + x[0, a]
    symmetric_part(P, P1)
    return nis


@borrowing(fastmath=FAST_SUM)
def _three_rows(
    P: np.ndarray, x: np.ndarray, H: np.ndarray, W: np.ndarray, nu: np.ndarray, noise: np.ndarray
) -> float:
    """One block of three numbers: x <- x + W' e, P <- P - W' W; returns e' e, NaN without a root.

    Padded rows: P (n, w), x (1, w), H (3, w), room W (3, w).
    """
    n, w = P.shape
    s00, s10, s11, s20, s21, s22 = (
        fill(0.0), fill(0.0), fill(0.0), fill(0.0), fill(0.0), fill(0.0),
    )  # fmt: skip
    t0, t1, t2 = fill(0.0), fill(0.0), fill(0.0)
    for v in range(0, w, WIDTH):
        a, b, c = fill(0.0), fill(0.0), fill(0.0)
        for i in range(n):
            p = load(P, i * w + v)
            a += H[0, i] * p
            b += H[1, i] * p
            c += H[2, i] * p
        store(W, v, a)
        store(W, w + v, b)
        store(W, 2 * w + v, c)
        h0, h1, h2, mean = load(H, v), load(H, w + v), load(H, 2 * w + v), load(x, v)
        s00 += a * h0
        s10 += b * h0
        s11 += b * h1
        s20 += c * h0
        s21 += c * h1
        s22 += c * h2
        t0 += mean * h0
        t1 += mean * h1
        t2 += mean * h2
    # L of S, its diagonal inverted; NaN of a negative pivot goes through to the NIS
    l00 = 1.0 / math.sqrt(total(s00) + noise[0, 0])
    l10 = (total(s10) + noise[1, 0]) * l00
    l20 = (total(s20) + noise[2, 0]) * l00
    l11 = 1.0 / math.sqrt(total(s11) + noise[1, 1] - l10 * l10)
    l21 = (total(s21) + noise[2, 1] - l20 * l10) * l11
    l22 = 1.0 / math.sqrt(total(s22) + noise[2, 2] - l20 * l20 - l21 * l21)
    e0 = (nu[0] - total(t0)) * l00
    e1 = (nu[1] - total(t1) - l10 * e0) * l11
    e2 = (nu[2] - total(t2) - l20 * e0 - l21 * e1) * l22
    for v in range(0, w, WIDTH):
        a = l00 * load(W, v)
        b = l11 * (load(W, w + v) - l10 * a)
        c = l22 * (load(W, 2 * w + v) - l20 * a - l21 * b)
        store(W, v, a)
        store(W, w + v, b)
        store(W, 2 * w + v, c)
        store(x, v, load(x, v) + (e0 * a + e1 * b + e2 * c))
    for v in range(0, w, WIDTH):
        a, b, c = load(W, v), load(W, w + v), load(W, 2 * w + v)
        for i in range(n):
            p = load(P, i * w + v) - (W[0, i] * a + W[1, i] * b + W[2, i] * c)
            store(P, i * w + v, p)
    return e0 * e0 + e1 * e1 + e2 * e2


@borrowing(fastmath=FAST_SUM)
def _whiten(S: np.ndarray, W: np.ndarray, e: np.ndarray) -> bool:
    """W <- L^-1 W, e <- L^-1 e with L L' = S; in place of S its L, the diagonal inverted."""
    k, w = W.shape
    for q in range(k):
        for r in range(q):
            g = S[q, r]
            for i in range(r):
                g -= S[q, i] * S[r, i]
            g *= S[r, r]
            S[q, r] = g
            e[q] -= g * e[r]
        s = S[q, q]
        for i in range(q):
            s -= S[q, i] * S[q, i]
        if not s > 0.0:
            return False
        g = 1.0 / np.sqrt(s)
        S[q, q] = g
        e[q] *= g
    for v in range(0, w, WIDTH):
        for q in range(k):
            row = load(W, q * w + v)
            for r in range(q):
                row -= S[q, r] * load(W, r * w + v)
            store(W, q * w + v, S[q, q] * row)
    return True


@kernel
def condition_on(
    mean: np.ndarray,
    cov: np.ndarray,
    lin_mean: np.ndarray,
    zbar: np.ndarray,
    H: np.ndarray,
    z: np.ndarray,
    R: np.ndarray,
    nu: np.ndarray,
    noise: np.ndarray,
    m1: np.ndarray,
    P1: np.ndarray,
) -> float:
    """Condition on a linearisation; ``noise`` comes as Omega and leaves as Omega + R."""
    _add_noise(R, noise)
    innovate(mean, lin_mean, zbar, H, z, nu)
    return condition(mean, cov, nu, H, noise, m1, P1)


@borrowing
def _add_noise(R: np.ndarray, noise: np.ndarray) -> None:
    k = R.shape[1]
    per_block = noise.shape[1] // k  # blocks of R in one of noise: 1, or all of them
    for b in range(R.shape[0]):
        f = b % per_block * k
        for q in range(k):
            for r in range(k):
                noise[b // per_block, f + q, f + r] += R[b, q, r]


@kernel(fastmath=FAST_SUM)
def _slope_times_cov(H: np.ndarray, cov: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """H and H P, rows padded (m, w)."""
    w = padded(cov.shape[0])
    rows, P, W = np.empty((H.shape[0], w)), np.empty((cov.shape[0], w)), np.empty((H.shape[0], w))
    widen(H, rows)
    widen(cov, P)
    rows_times(rows, P, W)
    return rows, W


@kernel(fastmath=FAST_SUM)
def innovation_cov(H: np.ndarray, cov: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """S (m, m) = H P H' + blockdiag(noise)."""
    m = H.shape[0]
    k = noise.shape[1]
    rows, W = _slope_times_cov(H, cov)
    S = np.empty((m, m))
    for q in range(m):
        for r in range(q + 1):
            s = dot(W, q, rows, r)
            if q // k == r // k:
                s += noise[q // k, q % k, r % k]
            S[q, r] = s
            S[r, q] = s
    return S


@kernel(fastmath=FAST_SUM)
def gain_matrix(S: np.ndarray, H: np.ndarray, cov: np.ndarray) -> tuple[np.ndarray, float]:
    """K (n, m) = P H' S^-1 and log det S; NaN where S is not positive definite."""
    m, n = H.shape
    L = S.copy()
    _, W = _slope_times_cov(H, cov)
    if not _whiten(L, W, np.zeros(m)):
        return np.full((n, m), np.nan), np.nan
    w = W.shape[1]
    K, log_det = np.empty((n, m)), 0.0
    for q in range(m - 1, -1, -1):
        log_det -= 2.0 * np.log(L[q, q])
        for v in range(0, w, WIDTH):
            row = load(W, q * w + v)
            for r in range(q + 1, m):
                row -= L[r, q] * load(W, r * w + v)
            store(W, q * w + v, L[q, q] * row)
        for a in range(n):
            K[a, q] = W[q, a]
    return K, log_det


@kernel(fastmath=FAST_SUM)
def innovation_variance(
    H: np.ndarray, cov: np.ndarray, noise: np.ndarray, first: int, step: int, out: np.ndarray
) -> None:
    """Diagonal of S, of the rows from ``first`` on in steps, see `innovation_cov`."""
    k = noise.shape[1]
    chosen = np.empty((out.size, H.shape[1]))
    for i in range(out.size):
        for a in range(H.shape[1]):
            chosen[i, a] = H[first + i * step, a]
    rows, W = _slope_times_cov(chosen, cov)
    for i in range(out.size):
        q = first + i * step
        out[i] = noise[q // k, q % k, q % k] + dot(W, i, rows, i)
