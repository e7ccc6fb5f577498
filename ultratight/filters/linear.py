"""A whole run of a linear Kalman filter in one compiled call, its noises adaptive or not.

    x_k = Phi_k x_k-1 + w_k,   z_k = H x_k + v_k

for models of small order over thousands of epochs; the covariance is updated in Joseph's form,
since an adapted gain need not be the best one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from signals.compiled import FAST_SUM, borrowing, kernel
from ultratight.filters.adaptive import (
    Codes,
    SageHusa,
    blend,
    bracket_of_Q,
    is_semidefinite,
    weight_at,
)
from ultratight.filters.conditioning import gain_matrix, predict_into
from ultratight.filters.door import covariance, whole_rows
from ultratight.filters.gaussian import Gaussian
from ultratight.filters.robust import Codes as Residuals
from ultratight.filters.robust import Ishakf, fresh, from_residual, inverse_of, judge, ratio

FIXED = SageHusa(R=False, Q=False)
"""No noise is estimated: the conventional filter"""
_PREVIOUS = SageHusa(R=False, Q=False, gain="previous")
_NO_RESIDUALS = Ishakf().codes(on=False)


class Epochs(NamedTuple):
    """First epoch (0 is the first of z) of each mishap, -1 where there was none."""

    R: int  # R^ not positive semi-definite; a step from residuals that would be is not made
    Q: int  # Q^ not positive semi-definite
    P: int  # P not positive semi-definite
    refused: int  # S not positive definite: the measurement was left out
    overflow: int  # a number was not finite: the run ended, what follows is NaN


class LinearRun(NamedTuple):
    """Estimates after each epoch; n states, m numbers measured."""

    mean: np.ndarray  # (n_epoch, n)
    variance: np.ndarray  # (n_epoch, n), diagonal of P
    R_epoch: np.ndarray  # (n_epoch, m, m) R^
    Q_variance: np.ndarray  # (n_epoch, n), diagonal of Q^
    weight: np.ndarray  # (n_epoch,) of the gain: 1, less for an outlier, 0 without measurement
    last: Gaussian
    R: np.ndarray  # (m, m) R^ at the end
    Q: np.ndarray  # (n, n) Q^ at the end
    first: Epochs

    @property
    def R_variance(self) -> np.ndarray:
        """(n_epoch, m) diagonal of R^."""
        return np.diagonal(self.R_epoch, axis1=1, axis2=2)


def run_linear(
    start: Gaussian,
    Phi: ArrayLike,
    Q: ArrayLike,
    H: ArrayLike,
    R: ArrayLike,
    z: ArrayLike,
    noise: SageHusa | Ishakf = FIXED,
) -> LinearRun:
    """Filter z (n_epoch, m); Phi (n_epoch, n, n), or (1, n, n) where it never changes.

    A row of NaN in z is an epoch without measurement: P_k = P_k/k-1, estimates of the noises
    and the count behind d are held.  Q and R are those of the first epoch when they are estimated.
    An update whose S is not positive definite is refused and noted, so that Q = 0, R = 0 and
    noises without a fix have a defined course.  So has an outlier of any size, which estimates of R
    take for noise: only ISHAKF's reduced gain leaves it out; without it the state may not come back
    (`robust`).

    Raises
    ------
    ValueError
        Shapes disagree, a matrix is not finite, symmetric and positive semi-definite, or a row of
        z has some numbers that are not finite, but not all NaN.
    """
    x0, P0 = _floats("start.mean", start.mean, 1), _floats("start.cov", start.cov, 2)
    Phi, Q, H, R = (
        _floats("Phi", Phi, 3),
        _floats("Q", Q, 2),
        _floats("H", H, 2),
        _floats("R", R, 2),
    )
    z = np.ascontiguousarray(z, dtype=float)
    n, m = x0.size, len(H)
    if z.ndim != 2 or z.shape[1] != m:
        raise ValueError(f"z: shape {z.shape}, expected (n_epoch, {m}), as many as H has rows")
    shapes = (
        ("start.cov", P0, (n, n)), ("Q", Q, (n, n)), ("H", H, (m, n)), ("R", R, (m, m)),
        ("Phi", Phi, (1 if len(Phi) == 1 else len(z), n, n)),
    )  # fmt: skip
    for name, value, expected in shapes:
        if value.shape != expected:
            raise ValueError(f"{name}: shape {value.shape}, expected {expected}")
    for name, value, _ in (shapes[0], shapes[1], shapes[3]):
        covariance(name, value)
    seen = whole_rows("z", z)
    mean, variance, Q_variance = (np.full((len(z), n), np.nan) for _ in range(3))
    R_epoch, weight = np.full((len(z), m, m), np.nan), np.full(len(z), np.nan)
    x, P, Rk, Qk, first = x0.copy(), P0.copy(), R.copy(), Q.copy(), np.full(5, -1)
    codes, residuals = (
        (_PREVIOUS.codes(), noise.codes())
        if isinstance(noise, Ishakf)
        else (noise.codes(), _NO_RESIDUALS)
    )
    _run(
        x, P, Phi, Qk, H, Rk, z, seen, codes, residuals, fresh(residuals.window), mean, variance,
        R_epoch, Q_variance, weight, first,
    )  # fmt: skip
    return LinearRun(
        mean, variance, R_epoch, Q_variance, weight, Gaussian(x, P), Rk, Qk,
        Epochs(*(int(k) for k in first)),
    )  # fmt: skip


def _floats(name: str, value: ArrayLike, ndim: int) -> np.ndarray:
    """Contiguous float64 of that many axes, all finite."""
    array = np.ascontiguousarray(value, dtype=float)
    if array.ndim != ndim or array.size == 0 or not np.isfinite(array).all():
        raise ValueError(f"{name}: shape {array.shape}, expected {ndim} axes of finite numbers")
    return array


# ---------------------------------------------------------------------------------- kernels


@kernel(fastmath=FAST_SUM)
def _run(
    x: np.ndarray,
    P: np.ndarray,
    Phi: np.ndarray,
    Q: np.ndarray,
    H: np.ndarray,
    R: np.ndarray,
    z: np.ndarray,
    seen: np.ndarray,
    codes: Codes,
    residuals: Residuals,
    memory: np.ndarray,
    mean: np.ndarray,
    variance: np.ndarray,
    R_epoch: np.ndarray,
    Q_variance: np.ndarray,
    weight: np.ndarray,
    first: np.ndarray,
) -> None:
    """All epochs; x, P, Q and R are left as those of the last one."""
    n, m = x.size, H.shape[0]
    Q0, R0, q, r = Q.copy(), R.copy(), np.zeros(n), np.zeros(m)
    x1, M, HM = np.empty(n), np.empty((n, n)), np.empty((m, n))
    v, HMH, vv, S, R1, R2 = (
        np.empty(m), np.empty((m, m)), np.empty((m, m)), np.empty((m, m)), np.empty((m, m)),
        np.empty((m, m)),
    )  # fmt: skip
    plus, minus, Q1 = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    A, KRK = np.empty((n, n)), np.empty((n, n))
    count = 0
    for k in range(z.shape[0]):
        predict_into(x, P, Phi[k if Phi.shape[0] > 1 else 0], Q, x1, M)
        for i in range(n):
            x1[i] += q[i]
        updated, weight[k] = False, 0.0
        if seen[k]:
            count += 1
            d1 = weight_at(codes.anchored, codes.weight_R, count)
            d2 = weight_at(codes.anchored, codes.weight_Q, count)
            _innovate(x1, M, H, z[k], v, HM, HMH)
            for a in range(m):
                if codes.mean_r:
                    r[a] = (1.0 - d1) * r[a] + d1 * v[a]
                    v[a] -= r[a]
            for a in range(m):
                for b in range(m):
                    vv[a, b] = v[a] * v[b]
                    R1[a, b] = R[a, b]
            base = R0 if codes.anchored else R
            if codes.R and not blend(base, d1, vv, HMH, codes.fix, R2, R1):
                _note(first, 0, k)
            gain_R = R1 if codes.current else R
            for a in range(m):
                for b in range(m):
                    S[a, b] = HMH[a, b] + gain_R[a, b]
            K, log_det = gain_matrix(S, H, M)
            updated = log_det == log_det
            if updated:
                weight[k] = 1.0
                if residuals.on:
                    weight[k], made = _by_residual(S, v, R, memory, residuals, K, R1)
                    if not made:
                        _note(first, 0, k)
                _joseph(x1, M, H, K, gain_R, A, KRK, x, P)
                for i in range(n):
                    s = 0.0
                    for a in range(m):
                        s += K[i, a] * v[a]
                    x[i] = x1[i] + s
                    if codes.mean_q:
                        q[i] = (1.0 - d2) * q[i] + d2 * (s + q[i])
                if codes.Q:
                    bracket_of_Q(K, v, HMH, R1, HM, M, P, Q, codes.complete, plus, minus)
                    if not blend(Q0 if codes.anchored else Q, d2, plus, minus, codes.fix, Q1, Q):
                        _note(first, 1, k)
            else:
                _note(first, 3, k)
            for a in range(m):
                for b in range(m):
                    R[a, b] = R1[a, b]
        if not updated:
            for i in range(n):
                x[i] = x1[i]
                for j in range(n):
                    P[i, j] = M[i, j]
        if not is_semidefinite(P):
            _note(first, 2, k)
        if not _is_finite(x, P, Q, R):
            _note(first, 4, k)
            return
        for i in range(n):
            mean[k, i], variance[k, i], Q_variance[k, i] = x[i], P[i, i], Q[i, i]
        for a in range(m):
            for b in range(m):
                R_epoch[k, a, b] = R[a, b]


@kernel(fastmath=FAST_SUM)
def _by_residual(
    S: np.ndarray,
    v: np.ndarray,
    R: np.ndarray,
    memory: np.ndarray,
    residuals: Residuals,
    K: np.ndarray,
    R1: np.ndarray,
) -> tuple[float, bool]:
    """R1 from the residual and K reduced in place; by how much, and whether R1 could be made."""
    m, made = v.size, True
    inverse = inverse_of(S)
    d, w = judge(ratio(inverse, v), memory, residuals)
    if residuals.R:
        u = np.zeros(m)
        for a in range(m):
            for b in range(m):
                u[a] += inverse[a, b] * v[b]
        made = from_residual(R, inverse, u, d, R1)
    for i in range(K.shape[0]):
        for a in range(m):
            K[i, a] *= w
    return w, made


@borrowing
def _note(first: np.ndarray, what: int, k: int) -> None:
    if first[what] < 0:
        first[what] = k


@borrowing(fastmath=FAST_SUM)
def _innovate(
    x: np.ndarray,
    M: np.ndarray,
    H: np.ndarray,
    z: np.ndarray,
    v: np.ndarray,
    HM: np.ndarray,
    HMH: np.ndarray,
) -> None:
    """v (m,) = z - H x, HM (m, n), H M H' (m, m)."""
    m, n = H.shape
    for a in range(m):
        s = z[a]
        for j in range(n):
            HM[a, j] = 0.0
        for i in range(n):
            g = H[a, i]
            if g != 0.0:
                s -= g * x[i]
                for j in range(n):
                    HM[a, j] += g * M[i, j]
        v[a] = s
    for a in range(m):
        for b in range(a + 1):
            s = 0.0
            for j in range(n):
                s += HM[a, j] * H[b, j]
            HMH[a, b] = s
            HMH[b, a] = s


@kernel(fastmath=FAST_SUM)
def _joseph(
    x1: np.ndarray,
    M: np.ndarray,
    H: np.ndarray,
    K: np.ndarray,
    R: np.ndarray,
    A: np.ndarray,
    KRK: np.ndarray,
    x: np.ndarray,
    P: np.ndarray,
) -> None:
    """P = A M A' + K R K', A = I - K H: for any gain K, in the form of a prediction by A."""
    n, m = K.shape
    for i in range(n):
        for j in range(n):
            s = 1.0 if i == j else 0.0
            t = 0.0
            for a in range(m):
                s -= K[i, a] * H[a, j]
                for b in range(m):
                    t += K[i, a] * R[a, b] * K[j, b]
            A[i, j] = s
            KRK[i, j] = t
    predict_into(x1, M, A, KRK, x, P)


@borrowing
def _is_finite(x: np.ndarray, P: np.ndarray, Q: np.ndarray, R: np.ndarray) -> bool:
    total = 0.0  # of magnitudes: none that is NaN or infinite can be cancelled by another
    for i in range(x.size):
        total += abs(x[i]) + abs(P[i, i]) + abs(Q[i, i])
    for a in range(R.shape[0]):
        total += abs(R[a, a])
    return bool(np.isfinite(total))
