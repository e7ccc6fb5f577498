"""A factor of P in place of P: a drop-in pair for `gaussian.predict` and `gaussian.update`.

Each form of a factor is a row: how it begins, is predicted and conditioned, see `square_root` and
`ud`.  By statistical linear regression any rule that does not correlate channels can be used.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from ultratight.filters.gaussian import Gaussian, Measurement, Update, predict, update
from ultratight.filters.rules import Rule
from ultratight.filters.square_root import condition_root, cov_root, first_root, predict_root
from ultratight.filters.ud import condition_ud, cov_ud, factor_ud, predict_ud


class Pair(Protocol):
    """The two steps, with the signatures of `gaussian`'s."""

    def predict(self, gaussian: Gaussian, phi: np.ndarray, q: np.ndarray) -> Gaussian:
        """Time update."""
        ...

    def update(
        self, gaussian: Gaussian, measurement: Measurement, rule: Rule, iterations: int = 1
    ) -> Update:
        """Condition on all blocks jointly."""
        ...


class Form(NamedTuple):
    """One way to keep a covariance."""

    first: Callable[[np.ndarray], np.ndarray]  # P -> factor
    predict: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # factor, Phi, Q -> factor
    condition: Callable[..., float]  # mean, factor, nu, H, noise, in place -> NIS
    cov: Callable[[np.ndarray], np.ndarray]  # factor -> P


FORMS = {
    "square-root": Form(first_root, predict_root, condition_root, cov_root),
    "ud": Form(factor_ud, predict_ud, condition_ud, cov_ud),
}
"""Name -> form"""
PLAIN = "plain"
"""P itself"""


class Plain:
    """`gaussian`'s own."""

    predict = staticmethod(predict)
    update = staticmethod(update)


class Factored:
    """The pair of one run.

    The factors of the last covariances that it gave out are known by the arrays; any other
    covariance, of a hand-over or a widening, is factored anew (ValueError: indefinite).
    """

    def __init__(self, form: Form) -> None:
        self.form = form
        self._known: list[tuple[np.ndarray, np.ndarray]] = []  # covariance, factor; newest first

    def predict(self, gaussian: Gaussian, phi: np.ndarray, q: np.ndarray) -> Gaussian:
        """Exact linear time update."""
        factor = self.form.predict(self._factor(gaussian.cov), phi, q)
        return Gaussian(phi @ gaussian.mean, self._remember(factor))

    def update(
        self, gaussian: Gaussian, measurement: Measurement, rule: Rule, iterations: int = 1
    ) -> Update:
        """Condition on all blocks; at most ``iterations`` linearisations."""
        if iterations < 1:
            raise ValueError(f"iterations: {iterations}, expected at least 1")
        if not rule.block_diagonal:
            raise ValueError(f"rule: {rule.name}, expected one whose Omega is block-diagonal")
        if measurement.A.shape[0] == 0:
            return update(gaussian, measurement, rule)
        factor, density = self._factor(gaussian.cov), gaussian
        for _ in range(iterations):
            zbar, H, Omega = rule.linearise(density, measurement)
            noise = Omega + measurement.R
            nu = measurement.z.reshape(-1) - zbar - H @ (gaussian.mean - density.mean)
            mean, found = gaussian.mean.astype(np.float64), factor.copy()
            nis = self.form.condition(mean, found, nu, H, noise)
            if not np.isfinite(nis):
                raise np.linalg.LinAlgError(
                    "z, R: expected finite numbers and positive semi-definite noise, "
                    f"got z = {measurement.z.tolist()}"
                )
            density = Gaussian(mean, self.form.cov(found))
        self._known.insert(0, (density.cov, found))
        return Update(
            *density, nu, nis=float(nis), H=H, passes=iterations, prior_cov=gaussian.cov,
            noise=noise,
        )  # fmt: skip

    def _factor(self, cov: np.ndarray) -> np.ndarray:
        for known, factor in self._known:
            if known is cov:
                return factor
        factor = self.form.first(cov)
        self._known.insert(0, (cov, factor))
        return factor

    def _remember(self, factor: np.ndarray) -> np.ndarray:
        cov = self.form.cov(factor)
        self._known[:] = [(cov, factor), *self._known[:2]]
        return cov


def make_pair(name: str) -> Pair:
    """The pair of a row of `FORMS`, or that of P itself, for one run."""
    if name == PLAIN:
        return Plain()
    if name not in FORMS:
        raise ValueError(f"form: {name!r}, expected one of {', '.join((PLAIN, *FORMS))}")
    return Factored(FORMS[name])
