"""Score test: do the innovations look like an unknown step of velocity and clock drift?

Such a step delta = (dv, dcd) before the epoch moves the innovations by B delta with
B = H Phi[:, (v, cd)] (m, 4): minus the lines of sight, and 1.  The score of delta and its
information are

    g = B' S^-1 nu,     M = B' S^-1 B,

and g' M^-1 g is chi-square with 4 degrees of freedom where the filter is consistent (Rao's score
test).  Over a window with the memory a: G := a G + g, W := a W + M; since Cov(G) is W / (1 + a)
in the steady state, (1 + a) G' W^-1 G is chi-square(4) too.

S is never inverted: with the noise N (its blocks), S^-1 = N^-1 - N^-1 H P+ H' N^-1, P+ the
posterior covariance.
"""

from __future__ import annotations

import numpy as np

from signals.compiled import FAST_SUM, borrowing, kernel
from ultratight.filters.gaussian import Prediction, Update

MEMORY = 0.8
N_COLUMN = 4


class ScoreTest:
    """Remembers the window; `watch` takes in one epoch."""

    def __init__(self, memory: float = MEMORY) -> None:
        if not 0.0 <= memory < 1.0:
            raise ValueError(f"memory of the score test: {memory}, expected 0 <= memory < 1")
        self.memory = memory
        self.reset()

    def reset(self) -> None:
        """Forget the window."""
        self.window = np.zeros((N_COLUMN, N_COLUMN + 1))  # W and, last column, G

    def watch(self, prediction: Prediction, update: Update) -> tuple[float, float]:
        """Both about chi-square(4): of the window, and of this epoch alone."""
        if update.H is None or update.noise is None:
            raise AttributeError("score test: the update has no H and noise")
        layout = prediction.layout
        windowed, single = _watch(
            prediction.phi, layout.v.start, layout.cd.start, update.H, update.noise,
            update.innovation, update.cov, self.memory, self.window,
        )  # fmt: skip
        return (1.0 + self.memory) * windowed, single


def score(
    B: np.ndarray, H: np.ndarray, noise: np.ndarray, nu: np.ndarray, cov: np.ndarray
) -> np.ndarray:
    """(c, c + 1): M = B' S^-1 B and, last column, g = B' S^-1 nu; ``cov`` is the posterior.

    B (m, c), H (m, n), noise (nb, k, k) blocks of Omega + R, nu (m,).
    """
    c = B.shape[1]
    out = np.empty((c, c + 1))
    _score(np.ascontiguousarray(B), H, noise, nu, cov, out)
    return out


# ---------------------------------------------------------------------------------- kernels


@kernel
def _watch(
    phi: np.ndarray,
    v: int,
    cd: int,
    H: np.ndarray,
    noise: np.ndarray,
    nu: np.ndarray,
    cov: np.ndarray,
    memory: float,
    window: np.ndarray,
) -> tuple[float, float]:
    """G' W^-1 G of the window with this epoch, which is taken in, and g' M^-1 g."""
    m, n = H.shape
    B, now = np.zeros((m, 4)), np.empty((4, 5))
    for q in range(m):
        for a in range(n):
            if H[q, a] != 0.0:
                for j in range(4):
                    B[q, j] += H[q, a] * phi[a, cd if j == 3 else v + j]
    _score(B, H, noise, nu, cov, now)
    for i in range(4):
        for j in range(5):
            window[i, j] = memory * window[i, j] + now[i, j]
    return _quadratic(window), _quadratic(now)


@kernel
def _quadratic(found: np.ndarray) -> float:
    """g' M^-1 g of (M, g); directions without information count for nothing."""
    c = found.shape[0]
    L, total = np.zeros((c, c)), 0.0
    e = np.empty(c)
    for j in range(c):
        pivot = found[j, j]
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        if not pivot > 1e-12 * found[j, j]:
            e[j] = 0.0
            continue
        root = np.sqrt(pivot)
        s = found[j, c]
        for k in range(j):
            s -= L[j, k] * e[k]
        e[j] = s / root
        total += e[j] * e[j]
        for i in range(j + 1, c):
            s = found[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = s / root
    return total


@kernel(fastmath=FAST_SUM)
def _score(
    B: np.ndarray,
    H: np.ndarray,
    noise: np.ndarray,
    nu: np.ndarray,
    cov: np.ndarray,
    out: np.ndarray,
) -> None:
    m, c = B.shape
    n = H.shape[1]
    k = noise.shape[1]
    X = np.empty((m, c + 1))  # (B, nu), then N^-1 (B, nu)
    L = np.empty((k, k))
    for q in range(m):
        for j in range(c):
            X[q, j] = B[q, j]
        X[q, c] = nu[q]
    for b in range(noise.shape[0]):
        _solve_block(noise[b], X[b * k : b * k + k], L)
    Y = np.zeros((c + 1, n))  # (B, nu)' N^-1 H
    for q in range(m):
        for j in range(c + 1):
            for a in range(n):
                Y[j, a] += X[q, j] * H[q, a]
    PY = np.zeros((c + 1, n))
    for j in range(c + 1):
        for a in range(n):
            g = Y[j, a]
            for e in range(n):
                PY[j, e] += g * cov[a, e]
    for i in range(c):
        for j in range(c + 1):
            s = 0.0
            for q in range(m):
                s += B[q, i] * X[q, j]
            for a in range(n):
                s -= Y[i, a] * PY[j, a]
            out[i, j] = s


@borrowing
def _solve_block(N: np.ndarray, X: np.ndarray, L: np.ndarray) -> None:
    """X (k, c) <- N^-1 X by Cholesky; L (k, k) is room."""
    k, c = X.shape
    for i in range(k):
        for j in range(i + 1):
            s = N[i, j]
            for r in range(j):
                s -= L[i, r] * L[j, r]
            if i == j:
                L[i, i] = np.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for col in range(c):
        for i in range(k):
            s = X[i, col]
            for r in range(i):
                s -= L[i, r] * X[r, col]
            X[i, col] = s / L[i, i]
        for i in range(k - 1, -1, -1):
            s = X[i, col]
            for r in range(i + 1, k):
                s -= L[r, i] * X[r, col]
            X[i, col] = s / L[i, i]
