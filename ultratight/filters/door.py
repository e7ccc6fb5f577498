"""What a filter refuses before it works: shapes, numbers and variances that cannot be meant.

A channel without a measurement has no block; NaN is no way to say so.
"""

from __future__ import annotations

import math
from numbers import Real

import numpy as np

from signals.compiled import borrowing, kernel
from ultratight.filters.adaptive import is_semidefinite
from ultratight.filters.gaussian import Gaussian, Measurement, Prediction, Update

_ROUNDING = 1e-9  # of a covariance, in units of the product of its standard deviations
_NAMES = ("mean", "cov", "phi", "q", "z", "A", "R")
_NOT_FINITE, _NEGATIVE, _LOPSIDED, _BEYOND = 10, 20, 30, 40  # kinds of fault, plus a place in those
_WHY = {
    _NOT_FINITE: "finite numbers whose squares are finite",
    _NEGATIVE: "no variance below 0",
    _LOPSIDED: "a symmetric matrix",
    _BEYOND: "a positive semi-definite matrix",
}


def whole(name: str, value: object, least: int) -> None:
    """ValueError where an option is no whole number of at least that much."""
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    if not (math.isfinite(number) and int(number) == number and number >= least):
        raise ValueError(f"{name}: {value}, expected a whole number, at least {least}")


def covariance(name: str, P: np.ndarray) -> None:
    """ValueError where P (n, n) is not symmetric to the last bit and positive semi-definite."""
    if not np.array_equal(P, P.T) or not is_semidefinite(P):
        raise ValueError(f"{name}: expected a symmetric positive semi-definite matrix")


def whole_rows(name: str, z: np.ndarray) -> np.ndarray:
    """Mask (n,) of the rows of z (n, m) that were measured; those of NaN were not.

    ValueError where a row is neither.
    """
    seen = np.isfinite(z).all(axis=1)
    torn = np.flatnonzero(~seen & ~np.isnan(z).all(axis=1))
    if torn.size:
        raise ValueError(
            f"{name}: row {torn[0]} is {z[torn[0]]}, expected finite numbers or all NaN"
        )
    return np.asarray(seen)


def check_step(
    state: Gaussian, prediction: Prediction, measurement: Measurement, definite: bool = True
) -> None:
    """Refuse an epoch that no filter can make sense of, before any memory of it is kept.

    ``definite``: also a covariance with a variance below zero, which a rule with negative weights
    may have handed out itself.

    Raises
    ------
    ValueError
        Shapes disagree; R or Q is not symmetric, has a variance below zero or a covariance beyond
        its variances.
    numpy.linalg.LinAlgError
        (a ValueError, which the receiver takes for divergence) A number is not finite, or its
        square is not; a variance of the state is below zero.
    """
    arrays = tuple(
        np.ascontiguousarray(x, dtype=np.float64)
        for x in (*state, prediction.phi, prediction.q, measurement.z, measurement.A, measurement.R)
    )
    mean, cov, phi, q, z, A, R = arrays
    n, k = mean.size, z.shape[-1] if z.ndim else 0
    nb, d = len(z) if z.ndim else 0, A.shape[1] if A.ndim == 3 else 0
    expected = ((n,), (n, n), (n, n), (n, n), (nb, k), (nb, d, n), (nb, k, k))
    for name, array, shape in zip(_NAMES, arrays, expected, strict=True):
        if array.shape != shape:
            raise ValueError(f"{name}: shape {array.shape}, expected {shape}")
    if np.shape(measurement.channel) != (nb,):
        raise ValueError(f"channel: shape {np.shape(measurement.channel)}, expected {(nb,)}")
    fault = _fault(mean, cov, phi, q, z, A, R, definite)
    if fault:
        kind, which = fault // 10 * 10, fault % 10
        text = f"{_NAMES[which]}: {_seen(arrays[which], kind)}expected {_WHY[kind]}"
        if kind == _NOT_FINITE or _NAMES[which] == "cov":
            raise np.linalg.LinAlgError(text)
        raise ValueError(text)


def finite(found: Update, measurement: Measurement) -> Update:
    """The same, if it is one: LinAlgError where squares of residuals have left the doubles."""
    if not (np.isfinite(found.mean).all() and np.isfinite(found.cov).all()):
        size = np.abs(measurement.z).max(initial=0.0)
        raise np.linalg.LinAlgError(f"update: not finite, numbers measured up to {size:.2g}")
    return found


def _seen(array: np.ndarray, kind: int) -> str:
    """The entry at fault, where it is one."""
    if kind == _NOT_FINITE:
        with np.errstate(over="ignore"):
            where = np.argmin(np.isfinite(array * array))
        at = tuple(int(i) for i in np.unravel_index(where, array.shape))
        return f"{array[at]} at {at}, "
    if kind == _NEGATIVE:
        return f"{np.diagonal(array, axis1=-2, axis2=-1).min()} on the diagonal, "
    return ""


# ---------------------------------------------------------------------------------- kernels


@kernel
def _fault(
    mean: np.ndarray,
    cov: np.ndarray,
    phi: np.ndarray,
    q: np.ndarray,
    z: np.ndarray,
    A: np.ndarray,
    R: np.ndarray,
    definite: bool,
) -> int:
    """Kind of the first fault plus its place in `_NAMES`, 0 where there is none."""
    if not (_squares(mean) < np.inf):
        return _NOT_FINITE
    for i in range(cov.shape[0]):
        for j in range(cov.shape[1]):
            if not abs(cov[i, j]) < np.inf:
                return _NOT_FINITE + 1
        if definite and cov[i, i] < 0.0:
            return _NEGATIVE + 1
    if not _squares(phi.ravel()) < np.inf:
        return _NOT_FINITE + 2
    if not _squares(q.ravel()) < np.inf:
        return _NOT_FINITE + 3
    if not _squares(z.ravel()) < np.inf:
        return _NOT_FINITE + 4
    if not _squares(A.ravel()) < np.inf:
        return _NOT_FINITE + 5
    if not _squares(R.ravel()) < np.inf:
        return _NOT_FINITE + 6
    kind = _of_pairs(q)
    if kind != 0:
        return kind + 3
    for b in range(R.shape[0]):
        kind = _of_pairs(R[b])
        if kind != 0:
            return kind + 6
    return 0


@borrowing
def _squares(x: np.ndarray) -> float:
    s = 0.0
    for i in range(x.size):
        s += x[i] * x[i]
    return s


@borrowing
def _of_pairs(C: np.ndarray) -> int:
    """What can be seen of a covariance (k, k) by pairs of its numbers; a singular one is none."""
    for i in range(C.shape[0]):
        if C[i, i] < 0.0:
            return _NEGATIVE
        for j in range(i):
            product = C[i, i] * C[j, j]
            if (C[i, j] - C[j, i]) ** 2 > _ROUNDING**2 * product:
                return _LOPSIDED
            if C[i, j] * C[j, i] > (1.0 + _ROUNDING) * product:
                return _BEYOND
    return 0
