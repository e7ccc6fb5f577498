"""Square-root form: a triangular L with L L' = P is what lasts, so P cannot become indefinite.

    predict   L-: the triangle of the QR decomposition of [Phi L, Q^(1/2)]'
    update    per number, whitened by the root of its block of Omega + R,
              [1  h L]          [s  0 ]      s^2 = h P h' + 1,
              [0   L ] Theta =  [g  L+],     K = g / s,   P+ = L+ L+'

with Theta orthogonal: Givens rotations, last column first, which keep L triangular (Carlson, AIAA
J. 11, 1973; as an array: Kailath, Sayed & Hassibi, Linear Estimation, ch. 12).  By statistical
linear regression h is a row of G A and Omega goes with R, so it is the square-root quadrature
filter of Arasaratnam & Haykin (Proc. IEEE 95, 2007), with an update equal to the joint one.  Same
figures in float64, half the digits needed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from signals.compiled import FAST_SUM, borrowing, kernel
from ultratight.filters.rules import psd_cholesky
from ultratight.filters.ud import columns_of


def first_root(cov: np.ndarray) -> np.ndarray:
    """Lower L (n, n) with L L' = P; zero columns for states without variance of their own."""
    root = np.empty(cov.shape)
    _factor(np.ascontiguousarray(cov, dtype=np.float64), root)
    scale = np.sqrt(np.abs(np.diag(cov)))
    if not np.all(np.abs(root @ root.T - cov) <= 1e-9 * np.outer(scale, scale)):
        raise np.linalg.LinAlgError("the covariance is not positive semidefinite")
    return root


def predict_root(root: np.ndarray, phi: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Lower L- (n, n) with L- L-' = Phi L L' Phi' + Q, in the precision of L."""
    n = len(root)
    G, weight = np.empty((n, n), root.dtype), np.empty(n, root.dtype)
    r = columns_of(np.ascontiguousarray(q, root.dtype), G, weight)
    if r < 0:
        raise ValueError("Q: expected a finite, symmetric, positive semi-definite matrix")
    stack = np.empty((n + r, n), root.dtype)
    stack[:n] = (phi.astype(root.dtype, copy=False) @ root).T
    stack[n:] = (G[:, :r] * np.sqrt(weight[:r])).T
    out = np.empty((n, n), root.dtype)
    triangle(stack, out)
    return out


def cov_root(root: np.ndarray) -> np.ndarray:
    """P (n, n) = L L'."""
    return root @ root.T


# ---------------------------------------------------------------------------------- kernels


@kernel
def triangle(X: np.ndarray, L: np.ndarray) -> None:
    """Lower L (n, n), diagonal >= 0, with L L' = X' X, by Householder; X (m, n) is used up."""
    m, n = X.shape
    zero = np.zeros(1, X.dtype)[0]  # literals would turn single precision into double
    for j in range(n):
        s = zero
        for i in range(j, m):
            s += X[i, j] * X[i, j]
        length = np.sqrt(s)
        for k in range(j):
            L[k, j] = 0.0
        L[j, j] = length
        if length == 0.0:  # nothing to turn: the row stands as it is
            for k in range(j + 1, n):
                L[k, j] = X[j, k]
            continue
        # v = x + sign(x_0) |x| e_0 sends x to -sign(x_0) |x| e_0: no cancellation in v_0
        head = X[j, j] + length if X[j, j] >= 0.0 else X[j, j] - length
        half = length * (length + abs(X[j, j]))  # v'v / 2
        for k in range(j + 1, n):
            s = head * X[j, k]
            for i in range(j + 1, m):
                s += X[i, j] * X[i, k]
            s /= half
            L[k, j] = s * head - X[j, k] if X[j, j] >= 0.0 else X[j, k] - s * head
            for i in range(j + 1, m):
                X[i, k] -= s * X[i, j]


@kernel(fastmath=FAST_SUM)
def condition_root(
    mean: np.ndarray, L: np.ndarray, nu: np.ndarray, H: np.ndarray, noise: np.ndarray
) -> float:
    """Condition mean (n,) and L (n, n) in place on nu (m,) = H (x - mean) + e; returns the NIS.

    noise (nb, k, k): covariance of e, block by block.  NaN where one is not positive definite.
    """
    n, k = mean.size, noise.shape[1]
    rows, e, C = np.empty((k, n), L.dtype), np.empty(k, L.dtype), np.empty((k, k), L.dtype)
    g, moved = np.empty(n, L.dtype), np.zeros(n, L.dtype)
    unit = np.ones(1, L.dtype)[0]
    nis = 0.0
    for b in range(noise.shape[0]):
        if not _whiten_rows(H, nu, noise[b], b * k, C, rows, e):
            return np.nan
        for q in range(k):
            s = e[q]
            for a in range(n):
                s -= rows[q, a] * moved[a]
            deviation = _rotate(L, rows[q], unit, g)
            s /= deviation
            nis += s * s
            for a in range(n):
                moved[a] += g[a] * s
    for a in range(n):
        mean[a] += moved[a]
    return nis


@borrowing
def _whiten_rows(
    H: np.ndarray,
    nu: np.ndarray,
    noise: np.ndarray,
    first: int,
    C: np.ndarray,
    rows: np.ndarray,
    e: np.ndarray,
) -> bool:
    """rows (k, n) = C^-1 H and e (k,) = C^-1 nu of one block, C C' its noise (k, k)."""
    k, n = rows.shape
    for q in range(k):
        e[q] = nu[first + q]
        for a in range(n):
            rows[q, a] = H[first + q, a]
        for r in range(q + 1):
            s = noise[q, r]
            for i in range(r):
                s -= C[q, i] * C[r, i]
            if r < q:
                s /= C[r, r]
                C[q, r] = s
                e[q] -= s * e[r]
                for a in range(n):
                    rows[q, a] -= s * rows[r, a]
        if not s > 0.0:
            return False
        s = np.sqrt(s)
        C[q, q] = s
        e[q] /= s
        for a in range(n):
            rows[q, a] /= s
    return True


@borrowing(fastmath=FAST_SUM)
def _rotate(L: np.ndarray, h: np.ndarray, unit: Any, g: np.ndarray) -> Any:
    """L <- L+ for a number h x + N(0, 1); g (n,) = P h' / s, returns s.  unit: 1 as L has it."""
    n = h.size
    zero = unit - unit
    for i in range(n):
        g[i] = zero
    s = unit
    for j in range(n - 1, -1, -1):
        f = zero
        for i in range(j, n):
            f += h[i] * L[i, j]
        if f == 0.0:
            continue
        grown = np.sqrt(s * s + f * f)
        c, t = s / grown, f / grown
        for i in range(j, n):
            old = L[i, j]
            L[i, j] = c * old - t * g[i]
            g[i] = t * old + c * g[i]
        s = grown
    return s


@kernel
def _factor(P: np.ndarray, L: np.ndarray) -> None:
    psd_cholesky(P, L)
