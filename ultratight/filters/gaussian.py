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
from copy import copy
from typing import Any, NamedTuple, Protocol

import numpy as np

from signals.compiled import kernel
from ultratight.filters.conditioning import (
    condition_on,
    gain_matrix,
    innovation_cov,
    innovation_variance,
    predict_into,
)
from ultratight.filters.rules import Rule

LOG_2PI = float(np.log(2.0 * np.pi))
_contiguous, _FLOAT64 = np.ascontiguousarray, np.dtype(np.float64)


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
    span: np.ndarray | None = None
    """(nb, 2 or more) middle [receiver time, s] and half length [s] of what was integrated"""


class Update:
    """Posterior and what led to it; m = nb k rows, block by block.

    mean (n,), cov (n, n), innovation (m,), S (m, m) its covariance, gain (n, m), log_likelihood
    log N(innovation; 0, S) (NaN where S is not positive definite), nis = innovation' S^-1
    innovation, H (m, n) slope of the last linearisation, lam the fading factor in use, passes the
    linearisations made.

    S, gain and log_likelihood cost more than the update itself and the receiver's loop needs none
    of them: left out, they are worked out from ``prior_cov`` (n, n), H and ``noise`` when first
    asked for.  noise: the blocks of Omega + R, (nb, k, k), or (1, m, m) where a rule correlates
    them.
    """

    __slots__ = (
        "H",
        "_S",
        "_gain",
        "_log_likelihood",
        "cov",
        "innovation",
        "lam",
        "mean",
        "nis",
        "noise",
        "passes",
        "prior_cov",
    )  # fmt: skip

    def __init__(
        self,
        mean: np.ndarray,
        cov: np.ndarray,
        innovation: np.ndarray,
        S: np.ndarray | None = None,
        gain: np.ndarray | None = None,
        log_likelihood: float | None = None,
        nis: float = np.nan,
        H: np.ndarray | None = None,
        lam: float = 1.0,
        passes: int = 1,
        *,
        prior_cov: np.ndarray | None = None,
        noise: np.ndarray | None = None,
    ) -> None:
        self.mean, self.cov, self.innovation, self.nis = mean, cov, innovation, nis
        self._S, self._gain, self._log_likelihood = S, gain, log_likelihood
        self.H, self.lam, self.passes = H, lam, passes
        self.prior_cov, self.noise = prior_cov, noise

    @property
    def S(self) -> np.ndarray:
        """(m, m) innovation covariance H P- H' + Omega + R."""
        if self._S is None:
            H, prior_cov, noise = self._evidence("S")
            self._S = innovation_cov(H, prior_cov, noise)
        return self._S

    def variance(self, first: int = 0, step: int = 1) -> np.ndarray:
        """Diagonal of S, of the rows from ``first`` on in steps, for a fraction of its cost."""
        if self._S is not None:
            return np.diag(self._S)[first::step]
        out = np.empty(len(range(first, self.innovation.size, step)))
        innovation_variance(*self._evidence("S"), first, step, out)
        return out

    @property
    def gain(self) -> np.ndarray:
        """(n, m) gain P- H' S^-1."""
        if self._gain is None:
            H, prior_cov, _ = self._evidence("gain")
            self._gain, _ = gain_matrix(self.S, H, prior_cov)
            if np.isnan(self._gain).any():
                self._gain = np.linalg.solve(self.S, H @ prior_cov).T
        return self._gain

    @property
    def log_likelihood(self) -> float:
        """log N(innovation; 0, S)."""
        if self._log_likelihood is None:
            H, prior_cov, _ = self._evidence("log_likelihood")
            _, log_det = gain_matrix(self.S, H, prior_cov)
            self._log_likelihood = -0.5 * (self.nis + log_det + self.innovation.size * LOG_2PI)
        return self._log_likelihood

    def _evidence(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the lazy fields are made of; AttributeError where the filter has left it out."""
        if self.H is None or self.prior_cov is None or self.noise is None:
            raise AttributeError(
                f"{name}: neither given nor H, prior_cov and noise to find it from"
            )
        return self.H, self.prior_cov, self.noise

    def _replace(self, **changes: Any) -> Update:
        """A copy with some attributes changed, as of a NamedTuple."""
        new = copy(self)
        for name, value in changes.items():
            setattr(new, f"_{name}" if f"_{name}" in self.__slots__ else name, value)
        return new


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


class CompiledModel(Protocol):
    """An h that brings its own compiled update, see `tracking.tap_model`: one call, same figures.

    Any other h is a plain function, called from Python between two compiled steps.
    """

    def condition(self, inner: int, *arrays: np.ndarray) -> float:
        """Linearise by projected points (or the Jacobian, where there are none) and condition.

        Arguments: `UnitPoints.inner`, prior mean and covariance, those of the density, z, A, R,
        `UnitPoints.table`; to be filled: innovation, H, noise, posterior mean and covariance.
        Returns the NIS.
        """
        ...


def predict(gaussian: Gaussian, phi: np.ndarray, q: np.ndarray) -> Gaussian:
    """Exact linear time update: mean (n,), cov (n, n) symmetric to the last bit."""
    mean, cov = _matrix(gaussian.mean), _matrix(gaussian.cov)
    m1, P1 = np.empty(mean.size), np.empty(cov.shape)
    predict_into(mean, cov, _matrix(phi), _matrix(q), m1, P1)
    return Gaussian(m1, P1)


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
        posterior = _posterior(prior, density, measurement, rule, passes)
        if passes == iterations:
            break
        x, xl = posterior.mean, density.mean
        if step_weight is not None and _largest_step(measurement.A, x, xl, step_weight) < 1.0:
            break
        density = Gaussian(posterior.mean, posterior.cov)
    return posterior


def _matrix(array: np.ndarray) -> np.ndarray:
    """Contiguous float64, so that one compiled version serves all callers."""
    return _contiguous(array, _FLOAT64)


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
    return Gaussian(mean, cov), Measurement(
        z, A, R, measurement.h, measurement.h_jacobian, measurement.channel
    )


def _unchanged(prior: Gaussian) -> Update:
    """The update by no measurement."""
    n = prior.mean.size
    none, square = np.zeros(0), np.zeros((0, 0))
    return Update(*prior, none, square, np.zeros((n, 0)), 0.0, 0.0, np.zeros((0, n)))


def _posterior(
    prior: Gaussian, density: Gaussian, measurement: Measurement, rule: Rule, passes: int
) -> Update:
    """Condition the prior on the affine model found at ``density``."""
    z, A, R, h = measurement.z, measurement.A, measurement.R, measurement.h
    n, m = prior.mean.size, z.size
    mean, cov, nu = np.empty(n), np.empty((n, n)), np.empty(m)
    compiled = getattr(h, "condition", None)
    if compiled is not None and rule.block_diagonal:
        H, noise = np.empty((m, n)), np.empty(R.shape)
        table, inner = rule.table(A.shape[1])
        nis = compiled(
            inner, prior.mean, prior.cov, density.mean, density.cov, z, A, R, table, nu, H, noise,
            mean, cov,
        )  # fmt: skip
    else:
        zbar, H, Omega = rule.linearise(density, measurement)
        noise = np.array(Omega if np.ndim(Omega) == 3 else [Omega])
        nis = condition_on(prior.mean, prior.cov, density.mean, zbar, H, z, R, nu, noise, mean, cov)
    found = Update(mean, cov, nu, nis=nis, H=H, passes=passes, prior_cov=prior.cov, noise=noise)
    return found if nis == nis else _bare(prior, found)


def _bare(prior: Gaussian, update: Update) -> Update:
    """The bare formulas, for an S that is not positive definite (negative weights)."""
    K, S, nu = update.gain, update.S, update.innovation
    cov = prior.cov - K @ S @ K.T
    return update._replace(
        mean=prior.mean + K @ nu, cov=0.5 * (cov + cov.T), nis=float(nu @ np.linalg.solve(S, nu))
    )


# ---------------------------------------------------------------------------------- kernels


@kernel
def _largest_step(A: np.ndarray, x: np.ndarray, xl: np.ndarray, weight: np.ndarray) -> float:
    """max over blocks i of sum_j weight_j |A_i (x - xl)|_j; NaN where one is NaN."""
    largest = 0.0
    for i in range(A.shape[0]):
        size = 0.0
        for j in range(A.shape[1]):
            step = 0.0
            for a in range(x.size):
                step += A[i, j, a] * (x[a] - xl[a])
            size += weight[j] * abs(step)
        if not size <= largest:
            largest = size
            if size != size:
                break
    return largest
