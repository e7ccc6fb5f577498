"""Matrices whose rows are padded with zeros to whole registers, see `signals.eight`."""

from __future__ import annotations

import numpy as np

from signals.compiled import FAST_SUM, borrowing
from signals.eight import WIDTH, fill, load, load_part, store, total

# ---- kernels ---------------------------------------------------------------------------------


@borrowing
def widen(rows: np.ndarray, out: np.ndarray) -> None:
    """Rows (m, n) with zeros behind, to a padded width: out (m, w)."""
    m, n = rows.shape
    w = out.shape[1]
    for i in range(m):
        for v in range(0, w, WIDTH):
            store(out, i * w + v, load_part(rows, i * n + v, min(WIDTH, n - v)))


@borrowing
def symmetric_part(X: np.ndarray, P: np.ndarray) -> None:
    """P (n, n), symmetric to the last bit, of the first n columns of X (n, w)."""
    for i in range(P.shape[0]):
        for j in range(i + 1):
            s = 0.5 * (X[i, j] + X[j, i])
            P[i, j] = s
            P[j, i] = s


@borrowing(fastmath=FAST_SUM)
def rows_times(H: np.ndarray, P: np.ndarray, W: np.ndarray) -> None:
    """W (k, w) = H P for padded rows H (k, w) and P (n, w); three rows at once, a channel's."""
    k, w = H.shape
    n = P.shape[0]
    for v in range(0, w, WIDTH):
        q = 0
        while q + 3 <= k:
            x, y, z = fill(0.0), fill(0.0), fill(0.0)
            for c in range(n):
                p = load(P, c * w + v)
                x += H[q, c] * p
                y += H[q + 1, c] * p
                z += H[q + 2, c] * p
            store(W, q * w + v, x)
            store(W, (q + 1) * w + v, y)
            store(W, (q + 2) * w + v, z)
            q += 3
        while q < k:
            x = fill(0.0)
            for c in range(n):
                x += H[q, c] * load(P, c * w + v)
            store(W, q * w + v, x)
            q += 1


@borrowing(fastmath=FAST_SUM)
def dot(a: np.ndarray, i: int, b: np.ndarray, j: int) -> float:
    """a_i' b_j of padded rows (m, w)."""
    w = a.shape[1]
    s = fill(0.0)
    for v in range(0, w, WIDTH):
        s += load(a, i * w + v) * load(b, j * w + v)
    return total(s)
