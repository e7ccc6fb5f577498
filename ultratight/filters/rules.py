"""How moments are taken: each rule is a row of `RULES`, a set of unit points and where they live.

A rule replaces z = h(A x) + v, x ~ N(m, P), by the affine model z = zbar + H (x - m) + e with
Cov(e) = Omega + R (statistical linear regression, SLR; Garcia-Fernandez et al., IEEE TSP 63,
2015).  Then P_xz = P H' and S = H P H' + Omega + R, whatever the rule.

"projected": block i of the measurement depends on x through y_i = A_i x (d numbers) only, hence

    P_xz,i = P A_i' S_i^-1 C_i,   C_i = E[(y_i - ybar_i)(z_i - zbar_i)'],   S_i = A_i P A_i'

holds exactly and a d-dimensional rule gives all moments of one block, at m^d instead of m^n
points (linear substructure: arXiv 2009.07571).  Off-diagonal blocks of S are the first (Price)
term H_i P H_j'.  "full": points in R^n, cross-block covariance included in Omega.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from signals.compiled import FAST_SUM, borrowing, kernel
from ultratight.filters.quadrature import (
    PointFunction,
    cubature,
    gauss_hermite,
    unit_points,
    unscented,
)

if TYPE_CHECKING:
    from ultratight.filters.gaussian import Gaussian, Measurement


class Linearisation(NamedTuple):
    """The affine model z = zbar + H (x - mean) + e, Cov(e) = Omega + R; m = nb k rows."""

    zbar: np.ndarray  # (m,)
    H: np.ndarray  # (m, n)
    Omega: np.ndarray  # its blocks: (nb, k, k), or (1, m, m) where a rule correlates them


@dataclass(frozen=True)
class Rule:
    """One answer to "how are moments taken?"; a row of `RULES` or a user's own."""

    name: str
    space: Literal["jacobian", "projected", "full"]
    points: PointFunction | None
    source: str
    closed_form: bool = False  # a model with moments in closed form is to use them, not the points

    def linearise(self, density: Gaussian, measurement: Measurement) -> Linearisation:
        """SLR of the measurement at a density: one compiled step before and one after ``h``."""
        mean, cov, A = density.mean, density.cov, measurement.A
        nb, d, _ = A.shape
        k = measurement.R.shape[1]
        if self.points is None:
            zbar, J = measurement.h_jacobian(project_means(mean, A))
            if zbar.shape != (nb, k) or J.shape != (nb, k, d):
                raise ValueError(
                    f"h_jacobian: shapes {zbar.shape}, {J.shape}, expected {(nb, k)}, {(nb, k, d)}"
                )
            H = np.empty((nb * k, A.shape[2]))
            chain(J, A, H)
            return Linearisation(zbar.reshape(-1), H, np.zeros((nb, k, k)))
        projected = self.space == "projected"
        table, _ = self.table(d if projected else A.shape[2])
        place = place_projected if projected else _place_full
        Y, root = place(mean, cov, A, table)
        Z = measurement.h(Y)
        if Z.shape != (nb, table.shape[1], k):
            raise ValueError(f"h: shape {Z.shape}, expected {(nb, table.shape[1], k)}")
        if projected:
            return Linearisation(*regress_projected(A, root, table, Z))
        return Linearisation(*_regress_full(root, table, Z))

    def table(self, d: int) -> tuple[np.ndarray, int]:
        """`UnitPoints` table and inner in d dimensions; a rule without points has no columns.

        inner < 0 asks a compiled model for its closed form, where it has one for that d.
        """
        if self.points is None:
            return np.empty((d + 1, 0)), 1
        points = unit_points(self.points, d)
        return points.table, -points.inner if self.closed_form else points.inner

    @property
    def block_diagonal(self) -> bool:
        """True where Omega has no cross-block terms, as a sequential update needs."""
        return self.space != "full"


def _hermite_rule(name: str, orders: int | tuple[int, ...]) -> Rule:
    source = "Gauss-Hermite tensor (Ito & Xiong, IEEE TAC 45, 2000) in the projected space"
    return Rule(name, "projected", partial(gauss_hermite, orders), source)


_CKF = "Arasaratnam & Haykin, IEEE TAC 54 (2009)"
_UKF = "Julier & Uhlmann (1997), kappa = 3 - dimension"
_ROWS = (
    Rule("linearised", "jacobian", None, "extended Kalman filter: Jacobian at the mean"),
    _hermite_rule("gh3", 3),
    _hermite_rule("gh5", 5),
    _hermite_rule("gh7", 7),
    _hermite_rule("gh3x7x3", (3, 7, 3)),
    replace(_hermite_rule("gh7", 7), name="closed-form", closed_form=True),
    Rule("cubature", "full", cubature, f"third-degree cubature in R^n: {_CKF}"),
    Rule("unscented", "full", unscented, f"unscented in R^n: {_UKF}"),
    Rule("cubature-projected", "projected", cubature, f"cubature in the projected space: {_CKF}"),
    Rule("unscented-projected", "projected", unscented, f"unscented, projected space: {_UKF}"),
)
RULES = {rule.name: rule for rule in _ROWS}
"""Name -> rule.  gh7 unless there is a reason: gh3 fails above a phase s.d. of 0.7 rad.

gh3x7x3 is for d = 3 in the order range, phase, rate: 63 points in place of 343.  closed-form is
gh7 but for the coherent tap model, whose mean over phase and rate is exact
(`ultratight.tracking.closed_form`)."""


def get_rule(name: str) -> Rule:
    """The row of that name; ValueError lists the names."""
    if name not in RULES:
        raise ValueError(f"rule: {name!r}, expected one of {', '.join(RULES)}")
    return RULES[name]


# ---------------------------------------------------------------------------------- kernels


@borrowing(fastmath=FAST_SUM)
def psd_cholesky(S: np.ndarray, L: np.ndarray) -> None:
    """Lower L (n, n) with L L' = S for positive semidefinite S: columns without variance are 0.

    L may be S: only the lower triangle is read, each entry before it is written.

    A pivot below 1e-14 of its diagonal is a linear dependence.  NaN stays NaN.
    """
    n = S.shape[0]
    for j in range(n):
        floor = 1e-14 * S[j, j]
        pivot = S[j, j]
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        for i in range(j):
            L[i, j] = 0.0
        if pivot <= floor or pivot <= 0.0:
            for i in range(j, n):
                L[i, j] = 0.0
            continue
        root = np.sqrt(pivot)
        L[j, j] = root
        for i in range(j + 1, n):
            s = S[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = s / root


@borrowing(fastmath=FAST_SUM)
def solve_slope(L: np.ndarray, G: np.ndarray) -> None:
    """Overwrite G (k, d) by G L^-1; no slope along directions without variance."""
    d = L.shape[0]
    for j in range(d - 1, -1, -1):
        if L[j, j] == 0.0:
            G[:, j] = 0.0
            continue
        for q in range(G.shape[0]):
            s = G[q, j]
            for i in range(j + 1, d):
                s -= G[q, i] * L[i, j]
            G[q, j] = s / L[j, j]


@borrowing(fastmath=FAST_SUM)
def project_mean(A: np.ndarray, mean: np.ndarray, y: np.ndarray) -> None:
    """y (d,) = A x of one block."""
    for j in range(A.shape[0]):
        s = 0.0
        for a in range(A.shape[1]):
            s += A[j, a] * mean[a]
        y[j] = s


@borrowing(fastmath=FAST_SUM)
def project_root(A: np.ndarray, cov: np.ndarray, AP: np.ndarray, L: np.ndarray) -> None:
    """Root L (d, d) of A P A' of one block; AP (n,) is room for a row of A P."""
    d, n = A.shape
    for j in range(d):
        for a in range(n):
            AP[a] = 0.0
        for c in range(n):
            g = A[j, c]
            if g != 0.0:
                for a in range(n):
                    AP[a] += g * cov[c, a]
        for i in range(j + 1):
            s = 0.0
            for a in range(n):
                s += AP[a] * A[i, a]
            L[j, i] = s
    psd_cholesky(L, L)


@borrowing(fastmath=FAST_SUM)
def scatter(y: np.ndarray, L: np.ndarray, table: np.ndarray, Y: np.ndarray) -> None:
    """Points Y (d, p) = y + L xi."""
    d, p = Y.shape
    for j in range(d):
        for i in range(p):
            Y[j, i] = y[j]
        for c in range(j + 1):
            g = L[j, c]
            if g != 0.0:
                for i in range(p):
                    Y[j, i] += g * table[1 + c, i]


@borrowing(fastmath=FAST_SUM)
def regress(
    L: np.ndarray,
    table: np.ndarray,
    Z: np.ndarray,
    w_dz: np.ndarray,
    zbar: np.ndarray,
    G: np.ndarray,
    Omega: np.ndarray,
) -> None:
    """SLR of values Z (k, p) at points of root L (d, d): zbar (k,), slope G (k, d), Omega (k, k).

    Z is left with its deviations from zbar; w_dz (p,) is room for them, weighted.
    """
    moments(table, Z, w_dz, zbar, G, Omega)
    solve_slope(L, G)


@borrowing(fastmath=FAST_SUM)
def moments(
    table: np.ndarray,
    Z: np.ndarray,
    w_dz: np.ndarray,
    zbar: np.ndarray,
    C: np.ndarray,
    rest: np.ndarray,
) -> None:
    """Mean zbar (k,), C (k, d) = E[dz xi'] and rest (k, k) = E[dz dz'] - C C'; see `regress`."""
    k, p = Z.shape
    d = table.shape[0] - 1
    for q in range(k):
        s = 0.0
        for i in range(p):
            s += table[0, i] * Z[q, i]
        zbar[q] = s
        for i in range(p):
            Z[q, i] -= s
            w_dz[i] = table[0, i] * Z[q, i]
        for j in range(d):
            s = 0.0
            for i in range(p):
                s += w_dz[i] * table[1 + j, i]
            C[q, j] = s
        for r in range(q + 1):
            s = 0.0
            for i in range(p):
                s += w_dz[i] * Z[r, i]
            for j in range(d):
                s -= C[q, j] * C[r, j]
            rest[q, r] = s
            rest[r, q] = s


@borrowing(fastmath=FAST_SUM)
def chain(G: np.ndarray, A: np.ndarray, H: np.ndarray) -> None:
    """H (nb k, n) = G A, block by block."""
    nb, k, d = G.shape
    n = A.shape[2]
    for b in range(nb):
        for q in range(k):
            row = b * k + q
            for a in range(n):
                H[row, a] = 0.0
            for j in range(d):
                g = G[b, q, j]
                for a in range(n):
                    H[row, a] += g * A[b, j, a]


@kernel
def project_means(mean: np.ndarray, A: np.ndarray) -> np.ndarray:
    """y (nb, d) = A x of all blocks."""
    y = np.empty(A.shape[:2])
    for b in range(A.shape[0]):
        project_mean(A[b], mean, y[b])
    return y


@kernel
def place_projected(
    mean: np.ndarray, cov: np.ndarray, A: np.ndarray, table: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points Y (nb, p, d) and roots L (nb, d, d) of A_i P A_i'."""
    nb, d, _ = A.shape
    p = table.shape[1]
    y, L = np.empty(d), np.empty((nb, d, d))
    Y, points, AP = np.empty((nb, p, d)), np.empty((d, p)), np.empty(mean.size)
    for b in range(nb):
        project_mean(A[b], mean, y)
        project_root(A[b], cov, AP, L[b])
        scatter(y, L[b], table, points)
        Y[b] = points.T
    return Y, L


@kernel
def _place_full(
    mean: np.ndarray, cov: np.ndarray, A: np.ndarray, table: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points Y (nb, p, d) = A (m + L xi) and the root L (n, n) of P."""
    nb, d, n = A.shape
    p = table.shape[1]
    L, X = np.empty((n, n)), np.empty((n, p))
    psd_cholesky(cov, L)
    scatter(mean, L, table, X)
    Y, points = np.empty((nb, p, d)), np.empty((d, p))
    for b in range(nb):
        points[:] = 0.0
        for j in range(d):
            for a in range(n):
                g = A[b, j, a]
                if g != 0.0:
                    for i in range(p):
                        points[j, i] += g * X[a, i]
        Y[b] = points.T
    return Y, L


@kernel
def regress_projected(
    A: np.ndarray, L: np.ndarray, table: np.ndarray, Z: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """SLR of every block: zbar (m,), H (m, n) = G A, Omega (nb, k, k)."""
    nb, p, k = Z.shape
    d, n = A.shape[1:]
    zbar, G, Omega = np.empty((nb, k)), np.empty((nb, k, d)), np.empty((nb, k, k))
    H, values, w_dz = np.empty((nb * k, n)), np.empty((k, p)), np.empty(p)
    for b in range(nb):
        values[:] = Z[b].T
        regress(L[b], table, values, w_dz, zbar[b], G[b], Omega[b])
    chain(G, A, H)
    return zbar.reshape(-1), H, Omega


@kernel
def _regress_full(
    L: np.ndarray, table: np.ndarray, Z: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """SLR of all blocks at once from points in R^n: zbar (m,), H (m, n), Omega (1, m, m)."""
    nb, p, k = Z.shape
    m = nb * k
    zbar, H, Omega = np.empty(m), np.empty((m, L.shape[0])), np.empty((1, m, m))
    values = np.empty((m, p))
    for b in range(nb):
        values[b * k : b * k + k] = Z[b].T
    regress(L, table, values, np.empty(p), zbar, H, Omega[0])
    return zbar, H, Omega
