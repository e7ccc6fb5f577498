"""Weights of the measurement noise, from residuals that are compared with their covariance.

A block of m numbers (a GNSS receiver's, or one channel's) with innovation e, S0 = H P- H' + R and
diagonals of R, S0 and of a sample covariance M is updated with the noise R + L R L', where
L^2 = diag(lambda):

    d_i = (M_ii - S0_ii) / R_ii,   alpha_i = max(0, d_i),   alpha = max(0, mean of d)
    lambda_i = max(alpha, alpha_i)                            (the least that covers M; Frobenius)
    eta = sum e_i^2 / R_ii  over  sum S0_ii / R_ii

normal where eta <= 1 + xi, lambda = 0; class B up to eta1, M from the last residuals without the
present one; class A beyond, M = e e'.  (ACEKF: Guo, Liu, Shi & Sun, adaptive classified
fault-tolerant EKF for SINS/GNSS; its equations are lost, these are reconstructed from the text.)
The same formula with other M serves REKF (Soken & Hajiyev, 2010, 2014: alpha_i where the NIS is
beyond its 95 % point, M with the present residual) and AEKF (one weight alpha for all numbers, at
every epoch).  A plain test of the NIS that leaves the block out stands beside them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from signals.compiled import FAST_SUM, kernel
from ultratight.filters.conditioning import gain_matrix
from ultratight.filters.door import whole
from ultratight.filters.factored import Pair
from ultratight.filters.gaussian import Gaussian, Measurement, Prediction, Update
from ultratight.filters.rules import Rule

DETECTORS = ("classes", "nis", "always")
"""When lambda may differ from zero: by eta; beyond the NIS's limit; at every epoch"""
MEASURES = ("trace-weighted", "nis", "trace")
"""eta: weighted by R, which frees it of units; e' S0^-1 e / m; raw traces"""
COMBINATIONS = ("max", "channel", "scalar")
"""lambda_i: max(alpha, alpha_i), alpha_i or alpha"""
UNITS = ("relative", "absolute")
"""What lambda multiplies: R; one, so that lambda has the units of R"""
NORMAL, CLASS_B, CLASS_A = 0, 1, 2
LEFT_OUT = 1e12
"""Noise of a block that is left out, in units of its S0"""


class Codes(NamedTuple):
    """`Classified` as a kernel reads it."""

    detector: int
    measure: int
    combine: int
    absolute: bool
    current: bool
    centred: bool
    reject: bool
    large_by_window: bool
    small_by_both: bool
    eta1: float
    xi: float


@dataclass(frozen=True)
class Classified:
    """Which residuals are suspect, and how R is raised for them; the default is ACEKF."""

    detector: str = "classes"  # row of `DETECTORS`
    window: int = 10  # residuals in M
    current: bool = False  # the present one among them: (31) in place of (42)
    combine: str = "max"  # row of `COMBINATIONS`
    eta1: float = 334.2  # class A above
    xi: float = 0.1  # normal up to 1 + xi
    measure: str = "trace-weighted"  # row of `MEASURES`
    units: str = "relative"  # row of `UNITS`
    centred: bool = False  # M about the mean of the window
    swapped: bool = False  # class A is treated as B and B as A
    both: bool = False  # class B by the larger of both values of lambda
    probability: float = 0.95  # of the chi-square limit of the NIS
    reject: bool = False  # beyond that limit the block is left out

    def __post_init__(self) -> None:
        for name, value, rows in (
            ("detector", self.detector, DETECTORS), ("combine", self.combine, COMBINATIONS),
            ("measure", self.measure, MEASURES), ("units", self.units, UNITS),
        ):  # fmt: skip
            if value not in rows:
                raise ValueError(f"{name}: {value!r}, expected one of {', '.join(rows)}")
        whole("window", self.window, 1)
        if not (self.xi >= 0.0 and 1.0 + self.xi < self.eta1 < math.inf):
            raise ValueError(f"xi, eta1: {self.xi}, {self.eta1}, expected 0 <= xi < eta1 - 1")
        if not 0.0 < self.probability < 1.0:
            raise ValueError(f"probability: {self.probability}, expected between 0 and 1")

    def codes(self) -> Codes:
        """For a kernel."""
        return Codes(
            DETECTORS.index(self.detector), MEASURES.index(self.measure),
            COMBINATIONS.index(self.combine), self.units == "absolute", self.current, self.centred,
            self.reject, self.swapped, self.both, float(self.eta1), float(self.xi),
        )  # fmt: skip

    def memory(self, pair: Pair) -> Weights:
        """What it needs in closed loop, with the predict and update of a form."""
        return Weights(self, pair)


REKF = Classified(detector="nis", current=True, combine="channel")
AEKF = Classified(detector="always", current=True, combine="scalar")
GATE = Classified(detector="nis", reject=True)


class Weights:
    """Residuals of the channels of one run; ``step`` is predict, weigh and update.

    ``kind`` (nb,), ``eta`` (nb,) and ``weight`` (nb, k) are those of the last step's channels;
    kind is `NORMAL`, `CLASS_B` or `CLASS_A` (what is left out too), weight is lambda.
    """

    def __init__(self, options: Classified, pair: Pair) -> None:
        self.options, self.codes, self.pair = options, options.codes(), pair
        self.reset()

    def reset(self) -> None:
        """Forget the residuals seen."""
        self._seen: dict[int, np.ndarray] = {}
        self._limit: dict[int, float] = {}
        self.kind, self.eta, self.weight = np.zeros(0, int), np.zeros(0), np.zeros((0, 0))

    def step(
        self,
        state: Gaussian,
        prediction: Prediction,
        measurement: Measurement,
        rule: Rule,
        iterations: int = 1,
    ) -> Update:
        """Innovation, S and NIS are those of the weighted noise."""
        nb, k = measurement.R.shape[:2]
        for R in measurement.R:
            if not np.diag(R).min() > 0.0:
                raise ValueError(
                    f"R: diagonal {np.diag(R).tolist()}, expected above 0: weights are relative "
                    "to it"
                )
        prior = self.pair.predict(state, prediction.phi, prediction.q)
        found = self.pair.update(prior, measurement, rule, iterations)
        more, self.kind = np.zeros(measurement.R.shape), np.zeros(nb, int)
        self.eta, self.weight = np.zeros(nb), np.zeros((nb, k))
        if not nb:
            return found
        S0 = found.S
        for i in range(nb):
            memory, rows = self._memory(int(measurement.channel[i]), k), slice(i * k, i * k + k)
            self.kind[i], self.eta[i] = weigh(
                found.innovation[rows], np.ascontiguousarray(S0[rows, rows]), measurement.R[i],
                memory, self._limit[k], self.codes, self.weight[i], more[i],
            )  # fmt: skip
        if not more.any():
            return found
        return self.pair.update(
            prior, measurement._replace(R=measurement.R + more), rule, iterations
        )

    def _memory(self, channel: int, k: int) -> np.ndarray:
        """(1 + window, k): the count, then the last residuals."""
        memory = self._seen.get(channel)
        if memory is None or memory.shape[1] != k:
            memory = self._seen[channel] = np.zeros((1 + self.options.window, k))
            self._limit[k] = float(chdtri(k, 1.0 - self.options.probability))
        return memory


# ---------------------------------------------------------------------------------- kernels


@kernel(fastmath=FAST_SUM)
def weigh(
    e: np.ndarray,
    S0: np.ndarray,
    R: np.ndarray,
    memory: np.ndarray,
    limit: float,
    codes: Codes,
    weight: np.ndarray,
    more: np.ndarray,
) -> tuple[int, float]:
    """Class and eta of a residual e (k,); lambda (k,) and what R (k, k) is raised by.

    The residual joins the memory.
    """
    k, nis = e.size, np.nan
    if codes.detector == 1 or codes.measure == 1:
        nis = _nis(e, S0)
    eta = nis / k if codes.measure == 1 else _ratio(e, S0, R, codes.measure == 0)
    kind = CLASS_B
    if codes.detector == 0:
        kind = NORMAL if eta <= 1.0 + codes.xi else (CLASS_B if eta <= codes.eta1 else CLASS_A)
    elif codes.detector == 1:
        kind = CLASS_B if nis > limit else NORMAL
    if codes.current:
        _join(e, memory)
    if kind != NORMAL:
        if codes.reject:
            kind = CLASS_A
        else:
            by_window = (kind == CLASS_B) != codes.large_by_window
            if by_window:
                _cover_window(memory, S0, R, codes, weight)
            if not by_window or codes.small_by_both:
                _cover_present(e, S0, R, codes, weight)
        for i in range(k):
            for j in range(k):
                if codes.reject:
                    more[i, j] = LEFT_OUT * S0[i, j]
                elif codes.absolute:
                    more[i, j] = weight[i] if i == j else 0.0
                else:
                    more[i, j] = math.sqrt(weight[i] * weight[j]) * R[i, j]
    if not codes.current:
        _join(e, memory)
    return kind, eta


@kernel(fastmath=FAST_SUM)
def _nis(e: np.ndarray, S0: np.ndarray) -> float:
    one = np.eye(e.size)
    inverse = gain_matrix(S0, one, one)[0]
    s = 0.0
    for i in range(e.size):
        for j in range(e.size):
            s += e[i] * inverse[i, j] * e[j]
    return s


@kernel(fastmath=FAST_SUM)
def _ratio(e: np.ndarray, S0: np.ndarray, R: np.ndarray, weighted: bool) -> float:
    """tr(W e e') / tr(W S0), W = diag(R)^-1 or one."""
    above, below = 0.0, 0.0
    for i in range(e.size):
        w = 1.0 / R[i, i] if weighted else 1.0
        above += w * e[i] * e[i]
        below += w * S0[i, i]
    return above / below


@kernel
def _join(e: np.ndarray, memory: np.ndarray) -> None:
    row = 1 + int(memory[0, 0]) % (memory.shape[0] - 1)
    memory[0, 0] += 1.0
    for i in range(e.size):
        memory[row, i] = e[i]


@kernel(fastmath=FAST_SUM)
def _cover_window(
    memory: np.ndarray, S0: np.ndarray, R: np.ndarray, codes: Codes, weight: np.ndarray
) -> None:
    """(31), (42): M of the residuals in the memory; lambda = 0 where there are none."""
    n, k = min(int(memory[0, 0]), memory.shape[0] - 1), weight.size
    degrees = n - 1 if codes.centred else n
    if degrees < 1:
        return
    d = np.empty(k)
    for i in range(k):
        s, mean = 0.0, 0.0
        if codes.centred:
            for r in range(1, n + 1):
                mean += memory[r, i] / n
        for r in range(1, n + 1):
            s += (memory[r, i] - mean) * (memory[r, i] - mean)
        d[i] = s / degrees - S0[i, i]
    _cover(d, R, codes, weight)


@kernel
def _cover_present(
    e: np.ndarray, S0: np.ndarray, R: np.ndarray, codes: Codes, weight: np.ndarray
) -> None:
    """(27): M = e e'."""
    d = np.empty(e.size)
    for i in range(e.size):
        d[i] = e[i] * e[i] - S0[i, i]
    _cover(d, R, codes, weight)


@kernel(fastmath=FAST_SUM)
def _cover(d: np.ndarray, R: np.ndarray, codes: Codes, weight: np.ndarray) -> None:
    """Raise lambda (k,) to what covers the excess d (k,) of the variances; (30), (41)."""
    k = d.size
    alpha = 0.0
    for i in range(k):
        d[i] /= 1.0 if codes.absolute else R[i, i]
        alpha += d[i] / k
    for i in range(k):
        own = max(alpha, d[i]) if codes.combine == 0 else d[i]
        weight[i] = max(weight[i], alpha if codes.combine == 2 else own)
