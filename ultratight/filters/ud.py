"""UD form: P = U D U' with U unit upper triangular and D diagonal is what lasts (Bierman, 1977).

    predict   the rows of W = [Phi U, G] are made orthogonal under the weights [D, q], last row
              first, Q = G q G': weighted Gram-Schmidt (Thornton & Bierman, 1976)
    update    per number h x + e of variance r, f = U' h, g_j = D_j f_j, a_0 = r + f_0 g_0 ...:
              D_j <- D_j a_{j-1} / a_j,   U_ij <- U_ij - f_j k_i / a_{j-1},   k_i += g_j U_ij

(Bierman, *Factorization Methods for Discrete Sequential Estimation*, 1977, V.3 and VI.4; Grewal &
Andrews, *Kalman Filtering*, 3rd ed., 6.5).  No square root, and D cannot fall below zero: P stays
definite, with half the digits that the plain form needs.  Numbers of one block whose noises are
correlated are first freed of that (L D L' of their covariance), so that the update is equal to the
joint one.  A noise of zero is no obstacle; a number with no variance at all says nothing and is
left out.

A factor is one matrix: U above the diagonal, D on it, in double or single precision.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from signals.compiled import FAST_SUM, borrowing, kernel


def factor_ud(cov: np.ndarray) -> np.ndarray:
    """Factor (n, n) of P; states without variance of their own get D = 0.

    ValueError where P is not finite, symmetric and positive semi-definite, by more than rounding.
    """
    P = np.ascontiguousarray(cov, dtype=np.float64)
    out = np.empty(P.shape)
    square = P.ndim == 2 and P.shape[0] == P.shape[1] and np.isfinite(P).all()
    if not (square and _is_symmetric(P) and factor_into(P, out)):
        raise ValueError(
            f"covariance of {P.shape}: expected finite, symmetric and positive semi-definite"
        )
    return out


def _is_symmetric(P: np.ndarray) -> bool:
    """But for rounding."""
    scale = np.sqrt(np.abs(np.diag(P)))
    return bool(np.all(np.abs(P - P.T) <= 1e-9 * np.outer(scale, scale)))


def predict_ud(factor: np.ndarray, phi: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Factor of Phi P Phi' + Q, in the precision of the one given.

    ValueError where Q is indefinite by more than rounding, or a number is not finite.
    """
    out = np.empty(factor.shape, factor.dtype)
    phi, q = (np.ascontiguousarray(x, dtype=factor.dtype) for x in (phi, q))
    if not phi.shape == q.shape == factor.shape:
        raise ValueError(f"Phi, Q: shapes {phi.shape}, {q.shape}, expected {factor.shape}")
    if not predict_ud_into(factor, phi, q, out):
        raise ValueError("Phi, Q: expected finite numbers, Q positive semi-definite")
    return out


def cov_ud(factor: np.ndarray) -> np.ndarray:
    """P (n, n) = U D U', symmetric to the last bit."""
    P = np.empty(factor.shape, factor.dtype)
    multiply_ud(factor, P)
    return P


# ---------------------------------------------------------------------------------- kernels


@kernel(fastmath=FAST_SUM)
def columns_of(Q: np.ndarray, G: np.ndarray, weight: np.ndarray) -> int:
    """G (n, n), weight (n,): Q = G diag(weight) G' of the first r columns; r is returned.

    Cholesky's elimination of the correlations, largest pivot first, without roots: the rest is
    bounded by its diagonal, so that rounding shows.  -1: Q is indefinite or not finite.
    """
    n = Q.shape[0]
    zero = np.zeros(1, G.dtype)[0]  # literals would turn single precision into double
    tiny = 8.0 * n * np.finfo(G.dtype).eps
    X, scale = np.empty((n, n), G.dtype), np.empty(n, G.dtype)
    for i in range(n):
        if not 0.0 <= Q[i, i] < np.inf:
            return -1
        scale[i] = np.sqrt(Q[i, i])
    for i in range(n):
        for j in range(n):
            if scale[i] > zero and scale[j] > zero:
                X[i, j] = Q[i, j] / scale[i] / scale[j]
            elif Q[i, j] == zero:
                X[i, j] = zero
            else:  # no variance, yet a covariance
                return -1
    for r in range(n + 1):
        p = 0
        for i in range(n):
            if X[i, i] > X[p, p]:
                p = i
        if r == n or not X[p, p] > tiny:
            for i in range(n):
                for j in range(n):
                    if not abs(X[i, j]) <= 100.0 * tiny:
                        return -1
            return r
        weight[r] = X[p, p]
        for i in range(n):
            G[i, r] = X[i, p] / weight[r]
        for i in range(n):
            g = weight[r] * G[i, r]
            if g != zero:
                for j in range(n):
                    X[i, j] -= g * G[j, r]
        for i in range(n):
            X[i, p] = zero
            X[p, i] = zero
            G[i, r] *= scale[i]
    return n


@kernel
def factor_into(P: np.ndarray, F: np.ndarray) -> bool:
    """Factor of P (n, n); False where it is indefinite or not finite."""
    n = P.shape[0]
    G, weight = np.empty((n, n), F.dtype), np.empty(n, F.dtype)
    r = columns_of(P, G, weight)
    if r < 0:
        return False
    orthogonalise(G[:, :r].copy(), weight[:r], F)
    return True


@kernel(fastmath=FAST_SUM)
def multiply_ud(F: np.ndarray, P: np.ndarray) -> None:
    """P = U D U'."""
    n = F.shape[0]
    for i in range(n):
        for j in range(i, n):
            s = F[j, j] if i == j else F[i, j] * F[j, j]
            for k in range(j + 1, n):
                s += F[i, k] * F[k, k] * F[j, k]
            P[i, j] = s
            P[j, i] = s


@kernel(fastmath=FAST_SUM)
def predict_ud_into(F: np.ndarray, phi: np.ndarray, q: np.ndarray, out: np.ndarray) -> bool:
    """Factor ``out`` of Phi U D U' Phi' + Q; False: Q is indefinite, or something not finite."""
    n = F.shape[0]
    G, noise = np.empty((n, n), F.dtype), np.empty(n, F.dtype)
    r = columns_of(q, G, noise)
    if r < 0:
        return False
    W, weight = np.empty((n, n + r), F.dtype), np.empty(n + r, F.dtype)
    for i in range(n):
        for j in range(n):
            W[i, j] = phi[i, j]
        for k in range(n):
            a = phi[i, k]
            if a != 0.0:
                for j in range(k + 1, n):
                    W[i, j] += a * F[k, j]
        for j in range(r):
            W[i, n + j] = G[i, j]
        weight[i] = F[i, i]
    for j in range(r):
        weight[n + j] = noise[j]
    orthogonalise(W, weight, out)
    finite = True
    for j in range(n):
        finite = finite and out[j, j] < np.inf
    return finite


@kernel(fastmath=FAST_SUM)
def orthogonalise(W: np.ndarray, weight: np.ndarray, F: np.ndarray) -> None:
    """Factor of W diag(weight) W'; W (n, r) is used up."""
    n, r = W.shape
    zero = np.zeros(1, F.dtype)[0]
    v = np.empty(r, F.dtype)
    for j in range(n - 1, -1, -1):
        d = zero
        for k in range(r):
            v[k] = weight[k] * W[j, k]
            d += v[k] * W[j, k]
        F[j, j] = d
        for i in range(j):
            F[j, i] = zero
            t = zero
            for k in range(r):
                t += v[k] * W[i, k]
            u = t / d if d > zero else zero
            F[i, j] = u
            if u != zero:
                for k in range(r):
                    W[i, k] -= u * W[j, k]


@kernel(fastmath=FAST_SUM)
def condition_ud(
    mean: np.ndarray, F: np.ndarray, nu: np.ndarray, H: np.ndarray, noise: np.ndarray
) -> float:
    """Condition mean (n,) and F (n, n) in place on nu (m,) = H (x - mean) + e; returns the NIS.

    noise (nb, k, k): covariance of e, block by block.  NaN where one is not positive semi-definite.
    """
    n, k = mean.size, noise.shape[1]
    rows, e, C = np.empty((k, n), F.dtype), np.empty(k, F.dtype), np.empty((k, k), F.dtype)
    f, g, gain = np.empty(n, F.dtype), np.empty(n, F.dtype), np.empty(n, F.dtype)
    moved = np.zeros(n, F.dtype)
    nis = 0.0
    for b in range(noise.shape[0]):
        if not _decorrelate(H, nu, noise[b], b * k, C, rows, e):
            return np.nan
        for q in range(k):
            s = e[q]
            for a in range(n):
                s -= rows[q, a] * moved[a]
            variance = bierman(F, rows[q], C[q, q], f, g, gain)
            if variance > 0.0:
                s /= variance
                nis += s * s * variance
                for a in range(n):
                    moved[a] += gain[a] * s
    for a in range(n):
        mean[a] += moved[a]
    return nis


@borrowing(fastmath=FAST_SUM)
def _decorrelate(
    H: np.ndarray,
    nu: np.ndarray,
    noise: np.ndarray,
    first: int,
    C: np.ndarray,
    rows: np.ndarray,
    e: np.ndarray,
) -> bool:
    """rows (k, n) = L^-1 H, e (k,) = L^-1 nu of one block, L D L' its noise; D: diagonal of C."""
    k, n = rows.shape
    floor = k * np.finfo(C.dtype).eps
    for q in range(k):
        e[q] = nu[first + q]
        for a in range(n):
            rows[q, a] = H[first + q, a]
        for r in range(q + 1):
            s = noise[q, r]
            for i in range(r):
                s -= C[q, i] * C[i, i] * C[r, i]
            if r < q:
                if C[r, r] > 0.0:
                    s /= C[r, r]
                elif s * s > 1e4 * floor * noise[q, q] * noise[r, r]:
                    return False
                C[q, r] = s
                if s != 0.0:
                    e[q] -= s * e[r]
                    for a in range(n):
                        rows[q, a] -= s * rows[r, a]
            else:
                if not -100.0 * floor * noise[q, q] <= s < np.inf:
                    return False
                C[q, q] = s if s > floor * noise[q, q] else 0.0
    return True


@borrowing(fastmath=FAST_SUM)
def bierman(
    F: np.ndarray, h: np.ndarray, r: Any, f: np.ndarray, g: np.ndarray, gain: np.ndarray
) -> Any:
    """F <- that of P+ for a number h x + e, Var e = r >= 0; returns its variance a.

    gain (n,) = P h', so that K = gain / a; f and g (n,) are overwritten.
    """
    n = h.size
    rounding = 4.0 * n * np.finfo(F.dtype).eps
    for j in range(n):
        s, size = h[j], abs(h[j])
        for i in range(j):
            s += F[i, j] * h[i]
            size += abs(F[i, j] * h[i])
        if r == 0.0 and abs(s) <= rounding * size:
            s = s - s  # cancelled: without noise to hide it, rounding would pass for variance
        f[j] = s
        g[j] = F[j, j] * s
        gain[j] = g[j]
    before = r
    for j in range(n):
        a = before + f[j] * g[j]
        if before > 0.0:
            # also where a rounds to before: what f_j brings to the gain may be all there is
            F[j, j] *= before / a
            c = f[j] / before
            for i in range(j):
                u = F[i, j]
                F[i, j] = u - c * gain[i]
                gain[i] += g[j] * u
        elif a > 0.0:  # a number without noise takes all that the column had
            F[j, j] = before
            for i in range(j):
                gain[i] += g[j] * F[i, j]
        before = a
    return before
