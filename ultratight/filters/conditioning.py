"""The compiled time update and conditioning of a Gaussian; `gaussian` has the sentences above them.

A joint update by blocks of numbers with uncorrelated noise is the same as one block after the
other, the linearisation held: that needs no solve of the size of the whole measurement.  Loops
are sums of rows, and zero entries of Phi and H are passed over.
"""

from __future__ import annotations

import numpy as np

from signals.compiled import FAST_SUM, borrowing, kernel


@kernel(fastmath=FAST_SUM)
def predict_into(
    mean: np.ndarray,
    cov: np.ndarray,
    phi: np.ndarray,
    q: np.ndarray,
    m1: np.ndarray,
    P1: np.ndarray,
) -> None:
    """m1 = Phi m and P1 = Phi P Phi' + Q; Phi is mostly zero, hence the row sums skip zeros."""
    _predict(mean, cov, phi, q, np.empty(cov.shape), m1, P1)


@borrowing(fastmath=FAST_SUM)
def _predict(
    mean: np.ndarray,
    cov: np.ndarray,
    phi: np.ndarray,
    q: np.ndarray,
    X: np.ndarray,
    m1: np.ndarray,
    P1: np.ndarray,
) -> None:
    """X (n, n) is room for (Phi P)'."""
    n = mean.size
    for i in range(n):
        s = 0.0
        for j in range(n):
            X[i, j] = 0.0
        for k in range(n):
            g = phi[i, k]
            if g != 0.0:
                s += g * mean[k]
                for j in range(n):
                    X[i, j] += g * cov[k, j]
        m1[i] = s
    for i in range(n):
        for j in range(i):
            s = X[i, j]
            X[i, j] = X[j, i]
            X[j, i] = s
    for i in range(n):
        for j in range(n):
            P1[i, j] = q[i, j]
        for k in range(n):
            g = phi[i, k]
            if g != 0.0:
                for j in range(n):
                    P1[i, j] += g * X[k, j]
    _symmetrise(P1)


@borrowing
def _symmetrise(P: np.ndarray) -> None:
    for i in range(P.shape[0]):
        for j in range(i):
            s = 0.5 * (P[i, j] + P[j, i])
            P[i, j] = s
            P[j, i] = s


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
        s = z[q // k, q % k] - zbar[q]
        for a in range(n):
            s -= H[q, a] * (mean[a] - lin_mean[a])
        nu[q] = s


@kernel(fastmath=FAST_SUM)
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
    k = noise.shape[1]
    W, S, e = np.empty((k, mean.size)), np.empty((k, k)), np.empty(k)
    return _sweep(mean, cov, nu, H, noise, W, S, e, m1, P1)


@borrowing(fastmath=FAST_SUM)
def _sweep(
    mean: np.ndarray,
    cov: np.ndarray,
    nu: np.ndarray,
    H: np.ndarray,
    noise: np.ndarray,
    W: np.ndarray,
    S: np.ndarray,
    e: np.ndarray,
    m1: np.ndarray,
    P1: np.ndarray,
) -> float:
    """`condition` with room for L^-1 H P (k, n), S and L (k, k), L^-1 nu (k,) of one block."""
    n = mean.size
    k = noise.shape[1]
    for a in range(n):
        m1[a] = 0.0
        for c in range(n):
            P1[a, c] = cov[a, c]
    nis = 0.0
    for b in range(noise.shape[0]):
        first = b * k
        _project(P1, m1, nu, H, noise[b], first, W, S, e)
        if not _whiten(S, W, e):
            return np.nan
        for q in range(k):
            nis += e[q] * e[q]
            for a in range(n):
                m1[a] += e[q] * W[q, a]
        _deflate(W, P1)
    for a in range(n):
        m1[a] += mean[a]
    _symmetrise(P1)
    return nis


@borrowing(fastmath=FAST_SUM)
def _project(
    P: np.ndarray,
    x: np.ndarray,
    nu: np.ndarray,
    H: np.ndarray,
    noise: np.ndarray,
    first: int,
    W: np.ndarray,
    S: np.ndarray,
    e: np.ndarray,
) -> None:
    """Of the rows from ``first`` on: W (k, n) = H P, lower S (k, k) = W H' + noise, e."""
    n = x.size
    for q in range(W.shape[0]):
        s = nu[first + q]
        for a in range(n):
            W[q, a] = 0.0
            s -= H[first + q, a] * x[a]
        e[q] = s
        for c in range(n):
            g = H[first + q, c]
            if g != 0.0:
                for a in range(n):
                    W[q, a] += g * P[c, a]
        for r in range(q + 1):
            s = noise[q, r]
            for a in range(n):
                s += W[q, a] * H[first + r, a]
            S[q, r] = s


@borrowing(fastmath=FAST_SUM)
def _whiten(S: np.ndarray, W: np.ndarray, e: np.ndarray) -> bool:
    """W <- L^-1 W, e <- L^-1 e with L L' = S; in place of S its L, the diagonal inverted."""
    k, n = W.shape
    for q in range(k):
        for r in range(q):
            g = S[q, r]
            for i in range(r):
                g -= S[q, i] * S[r, i]
            g *= S[r, r]
            S[q, r] = g
            e[q] -= g * e[r]
            for a in range(n):
                W[q, a] -= g * W[r, a]
        s = S[q, q]
        for i in range(q):
            s -= S[q, i] * S[q, i]
        if not s > 0.0:
            return False
        g = 1.0 / np.sqrt(s)
        S[q, q] = g
        e[q] *= g
        for a in range(n):
            W[q, a] *= g
    return True


@borrowing(fastmath=FAST_SUM)
def _deflate(W: np.ndarray, P: np.ndarray) -> None:
    """P <- P - W' W; three rows at once, a channel's."""
    k, n = W.shape
    q = 0
    while q + 3 <= k:
        for a in range(n):
            g0, g1, g2 = W[q, a], W[q + 1, a], W[q + 2, a]
            for c in range(n):
                P[a, c] -= g0 * W[q, c] + g1 * W[q + 1, c] + g2 * W[q + 2, c]
        q += 3
    while q < k:
        for a in range(n):
            g = W[q, a]
            for c in range(n):
                P[a, c] -= g * W[q, c]
        q += 1


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
def _slope_times_cov(H: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """H P (m, n)."""
    m, n = H.shape
    W = np.zeros((m, n))
    for q in range(m):
        for c in range(n):
            g = H[q, c]
            if g != 0.0:
                for a in range(n):
                    W[q, a] += g * cov[c, a]
    return W


@kernel(fastmath=FAST_SUM)
def innovation_cov(H: np.ndarray, cov: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """S (m, m) = H P H' + blockdiag(noise)."""
    m, n = H.shape
    k = noise.shape[1]
    W = _slope_times_cov(H, cov)
    S = np.empty((m, m))
    for q in range(m):
        for r in range(q + 1):
            s = noise[q // k, q % k, r % k] if q // k == r // k else 0.0
            for a in range(n):
                s += W[q, a] * H[r, a]
            S[q, r] = s
            S[r, q] = s
    return S


@kernel(fastmath=FAST_SUM)
def gain_matrix(S: np.ndarray, H: np.ndarray, cov: np.ndarray) -> tuple[np.ndarray, float]:
    """K (n, m) = P H' S^-1 and log det S; NaN where S is not positive definite."""
    m, n = H.shape
    L, W = S.copy(), _slope_times_cov(H, cov)
    if not _whiten(L, W, np.zeros(m)):
        return np.full((n, m), np.nan), np.nan
    K, log_det = np.empty((n, m)), 0.0
    for q in range(m - 1, -1, -1):
        log_det -= 2.0 * np.log(L[q, q])
        for r in range(q + 1, m):
            for a in range(n):
                W[q, a] -= L[r, q] * W[r, a]
        for a in range(n):
            W[q, a] *= L[q, q]
            K[a, q] = W[q, a]
    return K, log_det


@borrowing(fastmath=FAST_SUM)
def innovation_variance(
    H: np.ndarray, cov: np.ndarray, noise: np.ndarray, first: int, step: int, out: np.ndarray
) -> None:
    """Diagonal of S, of the rows from ``first`` on in steps, see `innovation_cov`."""
    k = noise.shape[1]
    for i in range(out.size):
        q = first + i * step
        out[i] = noise[q // k, q % k, q % k] + quadratic_form(H[q], cov)


@borrowing(fastmath=FAST_SUM)
def quadratic_form(h: np.ndarray, P: np.ndarray) -> float:
    """h P h' for a mostly zero h (n,)."""
    total = 0.0
    for c in range(h.size):
        if h[c] != 0.0:
            s = 0.0
            for a in range(h.size):
                s += P[c, a] * h[a]
            total += h[c] * s
    return total
