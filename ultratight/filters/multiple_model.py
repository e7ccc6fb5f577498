"""A bank of hypotheses over one state: weights, moment-matching merge, mixing; IMM and MMAE.

Hypothesis j is a Gaussian (x_j, P_j) with the log weight log mu_j.  A bank of several hypotheses
reports the first two moments of its mixture,

    x = sum_j mu_j x_j,     P = sum_j mu_j (P_j + (x_j - x)(x_j - x)'),

and its weights follow the likelihoods, log mu_j += log N(nu_j; 0, S_j).  Where a hypothesis may
give way to another (a Markov chain with the transition matrix p), the bank is mixed before each
prediction: hypothesis j starts from the mixture with the weights p_ij mu_i / c_j, c_j = sum_i
p_ij mu_i (Blom & Bar-Shalom, IEEE TAC 33, 1988).  Without switching nothing is mixed and the
weights alone decide (multiple-model adaptive estimation, Magill, IEEE TAC 10, 1965).

Closed loop: the mean of the mixture is fed back to the one INS and the one set of NCOs that all
hypotheses share, and is subtracted from each of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from signals.compiled import kernel
from ultratight.filters.door import check_step, whole
from ultratight.filters.gaussian import Gaussian, Measurement, Prediction, Update, predict, update
from ultratight.filters.interval import add_white_noise
from ultratight.filters.rules import Rule

WEIGHT_FLOOR = 1e-12
"""No hypothesis is ever excluded for good: its weight stays at or above this"""


class Bank(NamedTuple):
    """nh hypotheses over the same n states; ``exp(log_weight)`` sums to 1."""

    log_weight: np.ndarray  # (nh,)
    mean: np.ndarray  # (nh, n)
    cov: np.ndarray  # (nh, n, n)


def bank_of(gaussian: Gaussian, weight: np.ndarray) -> Bank:
    """The same Gaussian under every hypothesis, with the weights (nh,), which sum to 1."""
    nh = weight.size
    if not (nh > 0 and weight.min() >= 0.0 and abs(weight.sum() - 1.0) < 1e-6):
        raise ValueError(f"weights: {weight.tolist()}, expected one or more >= 0, of sum 1")
    with np.errstate(divide="ignore"):
        log_weight = np.log(weight)
    return Bank(
        log_weight, np.tile(gaussian.mean, (nh, 1)), np.tile(gaussian.cov, (nh, 1, 1))
    )  # fmt: skip


def normalised(log_weight: np.ndarray, floor: float = WEIGHT_FLOOR) -> np.ndarray:
    """Log weights (nh,) shifted so that the weights sum to 1, each raised to ``floor``.

    A weight that is not a number (a hypothesis without a likelihood) counts as none; where no
    hypothesis has any, all are alike.
    """
    with np.errstate(divide="ignore"):
        return _normalised(log_weight, floor)


def _normalised(log_weight: np.ndarray, floor: float) -> np.ndarray:
    log_weight = np.where(np.isnan(log_weight), -np.inf, log_weight)
    top = log_weight.max()
    if not np.isfinite(top):
        return np.full(log_weight.size, -np.log(log_weight.size))
    weight = np.exp(log_weight - top)
    weight = np.maximum(weight / weight.sum(), floor)
    return np.asarray(np.log(weight / weight.sum()))


def merged(bank: Bank) -> Gaussian:
    """Mean and covariance of the mixture."""
    n = bank.mean.shape[1]
    mean, cov = np.empty(n), np.empty((n, n))
    merge_into(np.exp(bank.log_weight), bank.mean, bank.cov, mean, cov)
    return Gaussian(mean, cov)


def mixed(bank: Bank, transition: np.ndarray) -> Bank:
    """The bank one step of the Markov chain later; transition (nh, nh), row: from, column: to."""
    joint = transition * np.exp(bank.log_weight)[:, None]
    weight = joint.sum(axis=0)
    mean, cov = np.empty_like(bank.mean), np.empty_like(bank.cov)
    for j in range(weight.size):
        if weight[j] > 0.0:
            merge_into(joint[:, j] / weight[j], bank.mean, bank.cov, mean[j], cov[j])
        else:
            mean[j], cov[j] = bank.mean[j], bank.cov[j]
    with np.errstate(divide="ignore"):
        return Bank(np.log(weight), mean, cov)


def weighed(bank: Bank, updates: list[Update], floor: float = WEIGHT_FLOOR) -> Bank:
    """The bank after the updates of its hypotheses."""
    gained = np.array([u.log_likelihood for u in updates])
    mean = np.stack([u.mean for u in updates])
    cov = np.stack([u.cov for u in updates])
    return Bank(normalised(bank.log_weight + gained, floor), mean, cov)


def report(bank: Bank, updates: list[Update]) -> Update:
    """The `Update` of the whole: moments of the mixture, evidence of the heaviest hypothesis."""
    heaviest = updates[int(np.argmax(bank.log_weight))]
    mean, cov = merged(bank)
    return heaviest._replace(mean=mean, cov=cov)


def fed_back(bank: Bank, mean: np.ndarray) -> Bank:
    """The bank relative to a reference that was corrected by ``mean`` (n,)."""
    return bank._replace(mean=bank.mean - mean)


def stay(probabilities: tuple[float, ...]) -> np.ndarray:
    """Transition matrix (nh, nh) of a chain that leaves state i with 1 - p_i, evenly to others."""
    nh = len(probabilities)
    p = np.array(probabilities)
    if nh < 2 or not ((p > 0.0) & (p < 1.0)).all():
        raise ValueError(f"stay probabilities: {probabilities}, expected two or more in (0, 1)")
    out = np.repeat(((1.0 - p) / (nh - 1))[:, None], nh, axis=1)
    np.fill_diagonal(out, p)
    return out


@dataclass(frozen=True)
class ImmOptions:
    """Hypotheses that differ in the velocity noise density which they add, in two models."""

    coherent_q: tuple[float, ...] = (0.0, 0.01)  # [m2/s3]
    differential_q: tuple[float, ...] = (0.0, 0.1)  # [m2/s3]
    stay: tuple[float, ...] | None = (0.99, 0.95)  # probability per epoch; None: not mixed
    floor: float = WEIGHT_FLOOR

    def __post_init__(self) -> None:
        n = len(self.coherent_q if self.stay is None else self.stay)
        if not (n == len(self.coherent_q) == len(self.differential_q) and n > 0):
            raise ValueError(f"{self}: expected as many densities in both models as probabilities")
        if not all(0.0 <= q < np.inf for q in self.coherent_q + self.differential_q):
            raise ValueError(f"velocity noise densities: {self}, expected none below 0 or infinite")
        if not 0.0 <= self.floor < 1.0 / n:
            raise ValueError(f"floor: {self.floor}, expected 0 <= floor < 1 / {n}")

    def make(self, rule: Rule, iterations: int) -> Imm:
        """The filter with these options."""
        return Imm(self, rule, iterations)


IMM3 = ImmOptions((0.0, 0.01, 0.1), (0.0, 0.1, 0.3), (0.99, 0.95, 0.95))
_DECADES = (0.0, 0.001, 0.01, 0.1, 1.0)
MMAE = ImmOptions(_DECADES, _DECADES, None, 1e-6)


class Imm:
    """Multiple models, mixed or not; between epochs it keeps the hypotheses and their weights."""

    def __init__(self, options: ImmOptions, rule: Rule, iterations: int = 1) -> None:
        self.options, self.rule, self.iterations = options, rule, iterations
        self.transition = None if options.stay is None else stay(options.stay)
        self.bank: Bank | None = None

    def reset(self) -> None:
        """Start again from one Gaussian: the state or the measurement model has changed."""
        self.bank = None

    def step(self, state: Gaussian, prediction: Prediction, measurement: Measurement) -> Update:
        """Mix, predict and update each hypothesis, weigh, merge."""
        check_step(state, prediction, measurement, definite=False)
        options = self.options
        before = self.bank
        if before is None:
            nh = len(options.coherent_q)
            before = bank_of(state, np.full(nh, 1.0 / nh))
        if self.transition is not None:
            before = mixed(before, self.transition)
        coherent = has_phases(prediction.layout)
        updates = []
        for j, q_v in enumerate(options.coherent_q if coherent else options.differential_q):
            q = with_noise(prediction, prediction.layout.v, q_v)
            prior = predict(Gaussian(before.mean[j], before.cov[j]), prediction.phi, q)
            updates.append(update(prior, measurement, self.rule, self.iterations))
        bank = weighed(before, updates, options.floor)
        result = report(bank, updates)
        self.bank = fed_back(bank, result.mean)
        return result


def has_phases(layout: Any) -> bool:
    """Is this the layout of the coherent model?"""
    return bool(layout.phase.stop > layout.phase.start)


def with_noise(prediction: Prediction, block: slice, density: float) -> np.ndarray:
    """Q (n, n) with white noise of that density added to three states, as Q itself is made."""
    if density == 0.0:
        return prediction.q
    q = np.array(prediction.q)
    add_white_noise(prediction.phi, block.start, 0.5 * prediction.T * density, q)
    return q


def hammersley(n: int) -> np.ndarray:
    """(n, 2) points of the Hammersley set at the middles of its cells, in the unit square.

    The second coordinate is the radical inverse to base 2 (Hammersley, Ann. NY Acad. Sci. 86,
    1960); the half cell keeps it off (0, 0), which would be a model without noise.
    """
    whole("points", n, 1)
    inverse = [sum(0.5 ** (k + 1) for k in range(i.bit_length()) if i >> k & 1) for i in range(n)]
    return np.stack([np.arange(n) / n, inverse], axis=1) + 0.5 / n


# ---------------------------------------------------------------------------------- kernels

normalise = kernel(_normalised)
"""`normalised` for kernels; the last bit may differ"""


@kernel
def merge_into(
    weight: np.ndarray, means: np.ndarray, covs: np.ndarray, mean: np.ndarray, cov: np.ndarray
) -> None:
    """Moments of the mixture with weights (nh,); a hypothesis of weight 0 is not looked at."""
    nh, n = means.shape
    mean[:] = 0.0
    cov[:] = 0.0
    for j in range(nh):
        if weight[j] > 0.0:
            for i in range(n):
                mean[i] += weight[j] * means[j, i]
    for j in range(nh):
        if weight[j] > 0.0:
            for i in range(n):
                a = means[j, i] - mean[i]
                for k in range(i + 1):
                    cov[i, k] += weight[j] * (covs[j, i, k] + a * (means[j, k] - mean[k]))
    for i in range(n):
        for k in range(i):
            cov[k, i] = cov[i, k]
