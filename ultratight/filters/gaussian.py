"""Predict and condition a Gaussian: the two steps that every filter of the catalogue shares.

    predict   m- = Phi m,  P- = Phi P Phi' + Q
    update    zbar, H, Omega from a rule (`rules`) at the linearisation density (xl, Pl)
              nu = z - zbar - H (m- - xl),   S = H P- H' + Omega + R,   K = P- H' S^-1
              m  = m- + K nu,                P = P- - K S K'

With one iteration (xl, Pl) is the prior; each further one takes the posterior just found
(iterated posterior linearisation, Garcia-Fernandez et al., IEEE TSP 63, 2015).  The filter sees
physics only through ``Measurement.h``, a call on a whole array of projected points.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from signals.compiled import FAST_SUM, kernel
from ultratight.filters.rules import Linearisation, Rule

LOG_2PI = float(np.log(2.0 * np.pi))


class Gaussian(NamedTuple):
    """A normal density: of the error state in closed loop, of anything in general."""

    mean: np.ndarray  # (n,)
    cov: np.ndarray  # (n, n)


class Measurement(NamedTuple):
    """nb blocks (channels) of k numbers each, z_i = h_i(A_i x) + v_i, v_i ~ N(0, R_i)."""

    z: np.ndarray  # (nb, k)
    A: np.ndarray  # (nb, d, n): y_i = A_i x is all that block i sees of the state
    R: np.ndarray  # (nb, k, k)
    h: Callable[[np.ndarray], np.ndarray]  # y (nb, p, d) -> (nb, p, k)
    h_jacobian: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    """y (nb, d) -> predicted measurement (nb, k) and dh/dy (nb, k, d)"""
    channel: np.ndarray  # (nb,) int64: index of each block on the channel axis


class Update(NamedTuple):
    """Posterior and what led to it; m = nb k rows, block by block."""

    mean: np.ndarray  # (n,)
    cov: np.ndarray  # (n, n)
    innovation: np.ndarray  # (m,)
    S: np.ndarray  # (m, m) innovation covariance
    gain: np.ndarray  # (n, m)
    log_likelihood: float  # log N(innovation; 0, S); NaN where S is not positive definite
    nis: float  # innovation' S^-1 innovation
    H: np.ndarray  # (m, n) slope of the last linearisation
    lam: float = 1.0  # fading factor in use
    passes: int = 1  # linearisations made


class Prediction(NamedTuple):
    """The time update offered to a filter, with what it may want to know of the motion."""

    phi: np.ndarray  # (n, n)
    q: np.ndarray  # (n, n)
    t_s: float  # receiver time at the end of the epoch
    epoch: int
    T: float  # length of the epoch [s]
    f_b: np.ndarray  # (3,) mean specific force of the epoch, body axes [m/s2]
    df_b: np.ndarray  # (3,) its change since the epoch before [m/s2]
    C_b_e: np.ndarray  # (3, 3)
    layout: Any  # has the slices r, v, psi, accel_bias, gyro_bias, cb, cd, phase of the state
    n_channel: int


class Filter(Protocol):
    """What the receiver calls once per epoch: a recipe of the catalogue or a user's own."""

    def step(self, state: Gaussian, prediction: Prediction, measurement: Measurement) -> Update:
        """Predict, then update; ``measurement`` may have no blocks."""
        ...

    def reset(self) -> None:
        """Forget the innovations seen: the state or the measurement model has changed."""
        ...


def predict(gaussian: Gaussian, phi: np.ndarray, q: np.ndarray) -> Gaussian:
    """Exact linear time update: mean (n,), cov (n, n) symmetric to the last bit."""
    mean, cov = _matrix(gaussian.mean), _matrix(gaussian.cov)
    return Gaussian(*_predict(mean, cov, _matrix(phi), _matrix(q)))


def update(
    gaussian: Gaussian,
    measurement: Measurement,
    rule: Rule,
    iterations: int = 1,
    *,
    start: Gaussian | None = None,
    step_weight: np.ndarray | None = None,
) -> Update:
    """Condition on all blocks jointly.

    ``iterations``: at most so many linearisations.  ``start``: density of the first one (default
    the prior).  ``step_weight`` (d,): stop as soon as sum_j step_weight_j |A_i (x - xl)|_j < 1 in
    every block i, x the new posterior mean and xl the point of the last linearisation.
    """
    prior, measurement = _checked(gaussian, measurement)
    if iterations < 1:
        raise ValueError(f"iterations: {iterations}, expected at least 1")
    if measurement.A.shape[0] == 0:
        return _unchanged(prior)
    density = prior if start is None else Gaussian(_matrix(start.mean), _matrix(start.cov))
    for passes in range(1, iterations + 1):
        line = rule.linearise(density, measurement)
        posterior = _posterior(prior, density, line, measurement, passes)
        if passes == iterations:
            break
        if step_weight is not None:
            step = measurement.A @ (posterior.mean - density.mean)
            if float((np.abs(step) @ step_weight).max()) < 1.0:
                break
        density = Gaussian(posterior.mean, posterior.cov)
    return posterior


def update_sequential(gaussian: Gaussian, measurement: Measurement, rule: Rule) -> Update:
    """Condition block after block with the regression fixed at the prior.

    Algebraically the joint update, since Omega + R is block-diagonal; no (nb k) x (nb k) solve
    for the posterior.  ValueError for rules with points in the full space.
    """
    if not rule.block_diagonal:
        raise ValueError(f"rule: {rule.name!r} correlates blocks, expected a projected rule")
    prior, measurement = _checked(gaussian, measurement)
    if measurement.A.shape[0] == 0:
        return _unchanged(prior)
    zbar, H, Omega = rule.linearise(prior, measurement)
    z, R = measurement.z, measurement.R
    k = z.shape[1]
    nu, noise, none = z.ravel() - zbar, Omega.copy(), np.zeros((k, k))
    mean, cov, nis, log_det = prior.mean, prior.cov, 0.0, 0.0
    for b in range(len(z)):
        i = slice(b * k, b * k + k)
        noise[i, i] += R[b]
        mean, cov, _, _, _, part, part_det = _condition(
            mean, cov, prior.mean, zbar[i], H[i], none, noise[i, i].reshape(1, k, k), z[b : b + 1]
        )
        nis, log_det = nis + part, log_det + part_det
    log_likelihood = -0.5 * (nis + log_det + nu.size * LOG_2PI)
    gain = np.linalg.solve(noise, H @ cov).T  # K = P+ H' (Omega + R)^-1
    return Update(mean, cov, nu, H @ prior.cov @ H.T + noise, gain, log_likelihood, nis, H)


def _matrix(array: np.ndarray) -> np.ndarray:
    """Contiguous float64, so that one compiled version serves all callers."""
    return np.ascontiguousarray(array, dtype=np.float64)


def _checked(gaussian: Gaussian, measurement: Measurement) -> tuple[Gaussian, Measurement]:
    """The same with contiguous arrays; ValueError where shapes disagree."""
    mean, cov = _matrix(gaussian.mean), _matrix(gaussian.cov)
    z, A, R = _matrix(measurement.z), _matrix(measurement.A), _matrix(measurement.R)
    n = mean.size
    if mean.shape != (n,) or cov.shape != (n, n):
        raise ValueError(f"cov: shape {cov.shape} with mean {mean.shape}, expected (n,) and (n, n)")
    if z.ndim != 2 or R.shape != (*z.shape, z.shape[1]):
        raise ValueError(f"R: shape {R.shape} with z {z.shape}, expected (nb, k) and (nb, k, k)")
    if A.ndim != 3 or A.shape[0] != z.shape[0] or A.shape[2] != n:
        raise ValueError(f"A: shape {A.shape}, expected ({z.shape[0]}, d, {n})")
    return Gaussian(mean, cov), measurement._replace(z=z, A=A, R=R)


def _unchanged(prior: Gaussian) -> Update:
    """The update by no measurement."""
    n = prior.mean.size
    none, square = np.zeros(0), np.zeros((0, 0))
    return Update(*prior, none, square, np.zeros((n, 0)), 0.0, 0.0, np.zeros((0, n)))


def _posterior(
    prior: Gaussian, density: Gaussian, line: Linearisation, measurement: Measurement, passes: int
) -> Update:
    """Condition the prior on the affine model found at ``density``."""
    zbar, H, Omega = line
    mean, cov, nu, S, K, nis, log_det = _condition(
        prior.mean, prior.cov, density.mean, zbar, H, Omega, measurement.R, measurement.z
    )
    if np.isnan(log_det):  # S not positive definite (negative weights): the bare formulas
        K = np.linalg.solve(S, H @ prior.cov).T
        mean, cov = prior.mean + K @ nu, prior.cov - K @ S @ K.T
        cov, nis = 0.5 * (cov + cov.T), float(nu @ np.linalg.solve(S, nu))
    log_likelihood = -0.5 * (nis + log_det + nu.size * LOG_2PI)
    return Update(mean, cov, nu, S, K, log_likelihood, nis, H, 1.0, passes)


# ---------------------------------------------------------------------------------- kernels


@kernel(fastmath=FAST_SUM)
def _predict(
    mean: np.ndarray, cov: np.ndarray, phi: np.ndarray, q: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Phi m and Phi P Phi' + Q; Phi is mostly zero, hence the row sums skip zeros."""
    n = mean.size
    m1 = np.empty(n)
    X = np.zeros((n, n))
    P1 = np.zeros((n, n))
    for i in range(n):
        s = 0.0
        for k in range(n):
            g = phi[i, k]
            if g != 0.0:
                s += g * mean[k]
                for j in range(n):
                    P1[i, j] += g * cov[k, j]
        m1[i] = s
    X[:] = P1.T
    for i in range(n):
        for j in range(n):
            P1[i, j] = q[i, j]
    for i in range(n):
        for k in range(n):
            g = phi[i, k]
            if g != 0.0:
                for j in range(n):
                    P1[i, j] += g * X[k, j]
    for i in range(n):
        for j in range(i):
            s = 0.5 * (P1[i, j] + P1[j, i])
            P1[i, j] = s
            P1[j, i] = s
    return m1, P1


@kernel(fastmath=FAST_SUM)
def _innovation(
    mean: np.ndarray, lin_mean: np.ndarray, zbar: np.ndarray, H: np.ndarray, z: np.ndarray
) -> np.ndarray:
    """nu (m,) = z - zbar - H (mean - lin_mean)."""
    m, n = H.shape
    k = z.shape[1]
    nu = np.empty(m)
    for q in range(m):
        s = z[q // k, q % k] - zbar[q]
        for a in range(n):
            s -= H[q, a] * (mean[a] - lin_mean[a])
        nu[q] = s
    return nu


@kernel(fastmath=FAST_SUM)
def _slope_times_cov(H: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """H P (m, n)."""
    m, n = H.shape
    HP = np.zeros((m, n))
    for q in range(m):
        for c in range(n):
            g = H[q, c]
            if g != 0.0:
                for a in range(n):
                    HP[q, a] += g * cov[c, a]
    return HP


@kernel(fastmath=FAST_SUM)
def _factor(S: np.ndarray, L: np.ndarray) -> float:
    """Lower Cholesky factor of S by columns; returns log det S, NaN where S is not positive."""
    m = S.shape[0]
    log_det = 0.0
    for i in range(m):
        for j in range(i + 1):
            s = S[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 0.0:
                    return np.nan
                L[i, i] = np.sqrt(s)
                log_det += np.log(s)
            else:
                L[i, j] = s / L[j, j]
    return log_det


@kernel(fastmath=FAST_SUM)
def _innovation_cov(W: np.ndarray, H: np.ndarray, Omega: np.ndarray, R: np.ndarray) -> np.ndarray:
    """S (m, m) = W H' + Omega + blockdiag(R), W = H P."""
    m, n = H.shape
    k = R.shape[1]
    S = np.empty((m, m))
    for q in range(m):
        for r in range(q + 1):
            s = Omega[q, r]
            if q // k == r // k:
                s += R[q // k, q % k, r % k]
            for a in range(n):
                s += W[q, a] * H[r, a]
            S[q, r] = s
            S[r, q] = s
    return S


@kernel(fastmath=FAST_SUM)
def _whiten(L: np.ndarray, W: np.ndarray, e: np.ndarray) -> None:
    """W <- L^-1 W and e <- L^-1 e, in place."""
    m, n = W.shape
    for q in range(m):
        for r in range(q):
            g = L[q, r]
            e[q] -= g * e[r]
            for a in range(n):
                W[q, a] -= g * W[r, a]
        g = 1.0 / L[q, q]
        e[q] *= g
        for a in range(n):
            W[q, a] *= g


@kernel(fastmath=FAST_SUM)
def _gain(L: np.ndarray, W: np.ndarray) -> np.ndarray:
    """K (n, m) = (L^-T W)', W = L^-1 H P; W is overwritten."""
    m, n = W.shape
    K = np.empty((n, m))
    for q in range(m - 1, -1, -1):
        for r in range(q + 1, m):
            g = L[r, q]
            for a in range(n):
                W[q, a] -= g * W[r, a]
        for a in range(n):
            W[q, a] /= L[q, q]
            K[a, q] = W[q, a]
    return K


@kernel(fastmath=FAST_SUM)
def _condition(
    mean: np.ndarray,
    cov: np.ndarray,
    lin_mean: np.ndarray,
    zbar: np.ndarray,
    H: np.ndarray,
    Omega: np.ndarray,
    R: np.ndarray,
    z: np.ndarray,
) -> tuple[Any, ...]:
    """Joint update by the Cholesky factor of S: posterior, nu, S, K, NIS, log det S (or NaN)."""
    m, n = H.shape
    nu = _innovation(mean, lin_mean, zbar, H, z)
    W = _slope_times_cov(H, cov)
    S = _innovation_cov(W, H, Omega, R)
    m1, P1, L = mean.copy(), cov.copy(), np.zeros((m, m))
    log_det = _factor(S, L)
    if np.isnan(log_det):
        return m1, P1, nu, S, np.zeros((n, m)), np.nan, log_det
    e, nis = nu.copy(), 0.0
    _whiten(L, W, e)
    for q in range(m):
        nis += e[q] * e[q]
        for a in range(n):
            g = W[q, a]
            m1[a] += g * e[q]
            for c in range(a + 1):
                P1[a, c] -= g * W[q, c]
    for a in range(n):
        for c in range(a):
            P1[c, a] = P1[a, c]
    return m1, P1, nu, S, _gain(L, W), nis, log_det
