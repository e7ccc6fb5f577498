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

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from signals.compiled import FAST_SUM, kernel
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
    Omega: np.ndarray  # (m, m)


@dataclass(frozen=True)
class Rule:
    """One answer to "how are moments taken?"; a row of `RULES` or a user's own."""

    name: str
    space: Literal["jacobian", "projected", "full"]
    points: PointFunction | None
    source: str

    def linearise(self, density: Gaussian, measurement: Measurement) -> Linearisation:
        """SLR of the measurement at a density: one compiled step before and one after ``h``."""
        mean, cov, A = density.mean, density.cov, measurement.A
        nb, d, _ = A.shape
        k = measurement.R.shape[1]
        if self.points is None:
            zbar, J = measurement.h_jacobian(_project_mean(mean, A))
            if zbar.shape != (nb, k) or J.shape != (nb, k, d):
                raise ValueError(
                    f"h_jacobian: shapes {zbar.shape}, {J.shape}, expected {(nb, k)}, {(nb, k, d)}"
                )
            H = _chain(J, A)
            return Linearisation(zbar.reshape(-1), H, np.zeros((nb * k, nb * k)))
        projected = self.space == "projected"
        xi, w, w_xi = unit_points(self.points, d if projected else A.shape[2])
        place = _place_projected if projected else _place_full
        Y, root = place(mean, cov, A, xi)
        Z = measurement.h(Y)
        if Z.shape != (nb, w.size, k):
            raise ValueError(f"h: shape {Z.shape}, expected {(nb, w.size, k)}")
        if projected:
            return Linearisation(*_regress_projected(A, root, w, w_xi, Z))
        return Linearisation(*_regress_full(root, w, w_xi, Z))

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
    Rule("cubature", "full", cubature, f"third-degree cubature in R^n: {_CKF}"),
    Rule("unscented", "full", unscented, f"unscented in R^n: {_UKF}"),
    Rule("cubature-projected", "projected", cubature, f"cubature in the projected space: {_CKF}"),
    Rule("unscented-projected", "projected", unscented, f"unscented, projected space: {_UKF}"),
)
RULES = {rule.name: rule for rule in _ROWS}
"""Name -> rule.  gh7 unless there is a reason: gh3 fails above a phase s.d. of 0.7 rad.

gh3x7x3 is for d = 3 in the order range, phase, rate: 63 points in place of 343."""


def get_rule(name: str) -> Rule:
    """The row of that name; ValueError lists the names."""
    if name not in RULES:
        raise ValueError(f"rule: {name!r}, expected one of {', '.join(RULES)}")
    return RULES[name]


# ---------------------------------------------------------------------------------- kernels


@kernel
def psd_cholesky(S: np.ndarray, L: np.ndarray) -> None:
    """Lower L (n, n) with L L' = S for positive semidefinite S: columns without variance are 0.

    A pivot below 1e-14 of its diagonal is a linear dependence.  NaN stays NaN.
    """
    n = S.shape[0]
    for j in range(n):
        pivot = S[j, j]
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        for i in range(j):
            L[i, j] = 0.0
        if pivot <= 1e-14 * S[j, j] or pivot <= 0.0:
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


@kernel
def _solve_slope(L: np.ndarray, G: np.ndarray) -> None:
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


@kernel(fastmath=FAST_SUM)
def _project_mean(mean: np.ndarray, A: np.ndarray) -> np.ndarray:
    """y (nb, d) = A x."""
    nb, d, n = A.shape
    y = np.empty((nb, d))
    for b in range(nb):
        for j in range(d):
            s = 0.0
            for a in range(n):
                s += A[b, j, a] * mean[a]
            y[b, j] = s
    return y


@kernel(fastmath=FAST_SUM)
def _chain(J: np.ndarray, A: np.ndarray) -> np.ndarray:
    """H (nb k, n) = J A, block by block."""
    nb, k, d = J.shape
    n = A.shape[2]
    H = np.zeros((nb * k, n))
    for b in range(nb):
        for q in range(k):
            row = H[b * k + q]
            for j in range(d):
                g = J[b, q, j]
                for a in range(n):
                    row[a] += g * A[b, j, a]
    return H


@kernel(fastmath=FAST_SUM)
def _scatter(y: np.ndarray, L: np.ndarray, xi: np.ndarray, out: np.ndarray) -> None:
    """Points out (p, d) = y + L xi."""
    d, p = xi.shape
    for j in range(d):
        for i in range(p):
            out[i, j] = y[j]
        for c in range(L.shape[1]):
            g = L[j, c]
            if g != 0.0:
                for i in range(p):
                    out[i, j] += g * xi[c, i]


@kernel(fastmath=FAST_SUM)
def _place_projected(
    mean: np.ndarray, cov: np.ndarray, A: np.ndarray, xi: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points Y (nb, p, d) and roots L (nb, d, d) of A_i P A_i'."""
    nb, d, n = A.shape
    y = _project_mean(mean, A)
    Y = np.empty((nb, xi.shape[1], d))
    L = np.zeros((nb, d, d))
    S = np.empty((d, d))
    AP = np.empty(n)
    for b in range(nb):
        for j in range(d):
            AP[:] = 0.0
            for c in range(n):
                a = A[b, j, c]
                if a != 0.0:
                    for e in range(n):
                        AP[e] += a * cov[c, e]
            for i in range(j + 1):
                s = 0.0
                for e in range(n):
                    s += AP[e] * A[b, i, e]
                S[j, i] = s
                S[i, j] = s
        psd_cholesky(S, L[b])
        _scatter(y[b], L[b], xi, Y[b])
    return Y, L


@kernel(fastmath=FAST_SUM)
def _place_full(
    mean: np.ndarray, cov: np.ndarray, A: np.ndarray, xi: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points Y (nb, p, d) = A (m + L xi) and the root L (n, n) of P."""
    nb, d, n = A.shape
    p = xi.shape[1]
    y = _project_mean(mean, A)
    L = np.zeros((n, n))
    psd_cholesky(cov, L)
    X = np.zeros((n, p))
    for a in range(n):
        for c in range(a + 1):
            g = L[a, c]
            for i in range(p):
                X[a, i] += g * xi[c, i]
    Y = np.empty((nb, p, d))
    for b in range(nb):
        for j in range(d):
            Y[b, :, j] = y[b, j]
            for a in range(n):
                g = A[b, j, a]
                if g != 0.0:
                    for i in range(p):
                        Y[b, i, j] += g * X[a, i]
    return Y, L


@kernel(fastmath=FAST_SUM)
def _centre(Z: np.ndarray, w: np.ndarray, zbar: np.ndarray, dz: np.ndarray) -> None:
    """Weighted mean zbar (k,) of Z (p, k) and deviations dz (k, p)."""
    p, k = Z.shape
    for q in range(k):
        s = 0.0
        for i in range(p):
            s += w[i] * Z[i, q]
        zbar[q] = s
        for i in range(p):
            dz[q, i] = Z[i, q] - s


@kernel(fastmath=FAST_SUM)
def _moments(
    dz: np.ndarray, w: np.ndarray, w_xi: np.ndarray, C: np.ndarray, cov_z: np.ndarray
) -> None:
    """C (m, d) = E[dz xi'] and cov_z (m, m) = E[dz dz'] - C C', deviations dz (m, p)."""
    m, p = dz.shape
    w_dz = np.empty(p)
    for q in range(m):
        for j in range(w_xi.shape[0]):
            s = 0.0
            for i in range(p):
                s += dz[q, i] * w_xi[j, i]
            C[q, j] = s
        for i in range(p):
            w_dz[i] = w[i] * dz[q, i]
        for r in range(q + 1):
            s = 0.0
            for i in range(p):
                s += w_dz[i] * dz[r, i]
            for j in range(w_xi.shape[0]):
                s -= C[q, j] * C[r, j]
            cov_z[q, r] = s
            cov_z[r, q] = s


@kernel(fastmath=FAST_SUM)
def _regress_projected(
    A: np.ndarray, L: np.ndarray, w: np.ndarray, w_xi: np.ndarray, Z: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """SLR of every block: zbar (m,), H (m, n) = G A, Omega (m, m) block-diagonal."""
    nb, p, k = Z.shape
    d = A.shape[1]
    zbar = np.empty((nb, k))
    G = np.empty((nb, k, d))
    Omega = np.zeros((nb * k, nb * k))
    dz = np.empty((k, p))
    for b in range(nb):
        _centre(Z[b], w, zbar[b], dz)
        _moments(dz, w, w_xi, G[b], Omega[b * k : b * k + k, b * k : b * k + k])
        _solve_slope(L[b], G[b])
    return zbar.reshape(-1), _chain(G, A), Omega


@kernel(fastmath=FAST_SUM)
def _regress_full(
    L: np.ndarray, w: np.ndarray, w_xi: np.ndarray, Z: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """SLR of all blocks at once from points in R^n: zbar (m,), H (m, n), Omega (m, m)."""
    nb, p, k = Z.shape
    m = nb * k
    zbar = np.empty(m)
    dz = np.empty((m, p))
    for b in range(nb):
        _centre(Z[b], w, zbar[b * k : b * k + k], dz[b * k : b * k + k])
    H = np.empty((m, L.shape[0]))
    Omega = np.empty((m, m))
    _moments(dz, w, w_xi, H, Omega)
    _solve_slope(L, H)
    return zbar, H, Omega
