"""Sage and Husa's noise estimators: R and Q (and their means) from the innovations themselves.

With M = P_k/k-1 of Q^_k-1, d_k = (1 - b) / (1 - b^(k+1)) and the gain K of R^:

    R^_k = (1 - d1) R^_k-1 + d1 (v v' - H M H')
    Q^_k = (1 - d2) Q^_k-1 + d2 (K v v' K' + P_k - Phi P_k-1 Phi')

(Sage & Husa, JACC 1969; as printed by Wei, Qin, Zhang & Zhang, J. Chinese Inertial Technology
20(6), 2012, (3)-(13)).  The latter add to the bracket of Q^, their (28),

    - 2 K R^_k K' - 2 K H M H' K' + M H' K' + K H M  =  -2 K (R^_k - R_gain) K'

which is zero when the gain is made with R^_k; their improved algorithm 2, (29), blends with R_0,
Q_0 in place of the estimates before.  Brackets can be negative: see `FIXES`.  Since P_k holds
Q^_k-1, the sum for Q^ never forgets Q_0: it is Q^_k-1 + d2 K (v v' - S) K'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real
from typing import NamedTuple

import numpy as np

from signals.compiled import FAST_SUM, borrowing, kernel
from ultratight.filters.gaussian import Gaussian, Measurement, Prediction, Update, predict, update
from ultratight.filters.rules import Rule

FIXES = ("none", "second-term", "whole", "drop-minus", "skip")
"""What keeps R^ and Q^ definite: nothing; the bracket's diagonal by absolute value (the paper's);
that of the whole right-hand side; the brackets v v' and K v v' K' alone, their diagonal; a step
that would lose definiteness is not made"""
SKIP = FIXES.index("skip")
GAINS = ("current", "previous")
"""R^ in the gain: that of this epoch, or, as printed, that of the epoch before"""
_ZERO_PIVOT = 64 * np.finfo(float).eps  # times the order: pivots below are rounding


class Codes(NamedTuple):
    """`SageHusa` as a kernel reads it."""

    R: bool
    Q: bool
    mean_r: bool
    mean_q: bool
    complete: bool
    anchored: bool
    current: bool
    fix: int
    weight_R: float  # b, or the weight a of the present bracket where anchored
    weight_Q: float


@dataclass(frozen=True)
class SageHusa:
    """Which noise is estimated and how; the default is the algorithm of 1969 with fading memory."""

    R: bool = True
    Q: bool = True
    b: tuple[float, float] = (0.95, 0.95)  # forgetting of R^ and of Q^, 0 to 1; 1: plain mean
    a: tuple[float, float] | None = None  # (29): weights of the present brackets of R^ and Q^
    a_of_initial: bool = False  # the other reading of (29): a weighs R_0 and Q_0
    complete: bool = False  # (28b): with the four further terms
    fix: str = "second-term"  # row of `FIXES`
    gain: str = "current"  # row of `GAINS`
    mean_r: bool = False  # also the mean of the measurement noise, (5)
    mean_q: bool = False  # also the mean of the process noise, (11)

    def __post_init__(self) -> None:
        for name, pair in (("b", self.b), ("a", self.a)):
            if (name, pair) != ("a", None) and not _are_weights(pair):
                raise ValueError(f"{name}: {pair}, expected two numbers from 0 to 1, of R and of Q")
        if self.fix not in FIXES:
            raise ValueError(f"fix: {self.fix!r}, expected one of {', '.join(FIXES)}")
        if self.gain not in GAINS:
            raise ValueError(f"gain: {self.gain!r}, expected one of {', '.join(GAINS)}")

    def codes(self) -> Codes:
        """For a kernel."""
        weights = self.b if self.a is None else self.a
        if self.a is not None and self.a_of_initial:
            weights = (1.0 - self.a[0], 1.0 - self.a[1])
        return Codes(
            self.R, self.Q, self.mean_r, self.mean_q, self.complete, self.a is not None,
            self.gain == "current", FIXES.index(self.fix), float(weights[0]), float(weights[1]),
        )  # fmt: skip

    def memory(self) -> NoiseMemory:
        """What it needs in closed loop."""
        return NoiseMemory(self)


def _are_weights(pair: object) -> bool:
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        return False
    return all(isinstance(w, Real) and 0.0 <= float(w) <= 1.0 for w in pair)


class NoiseMemory:
    """R^ per channel and Q^ of one run in closed loop; ``step`` is predict and update with them.

    They begin with the R and Q that the receiver offers, R^ when a channel is first seen; d counts
    the updates of each.  What `FIXES` cannot keep definite and what needs an open loop (means of
    the noises) is refused with ValueError.
    """

    def __init__(self, options: SageHusa) -> None:
        if options.fix == "none":
            raise ValueError("fix: 'none' loses definiteness, expected a fix in closed loop")
        if options.mean_r or options.mean_q:
            raise ValueError("mean_r, mean_q: an error state fed back has no mean to estimate")
        self.codes = options.codes()
        self.reset()

    def reset(self) -> None:
        """Forget the estimates."""
        self.Q_hat: np.ndarray | None = None
        self.R_hat: dict[int, np.ndarray] = {}
        self._updates = 0
        self._seen: dict[int, int] = {}

    def step(
        self,
        state: Gaussian,
        prediction: Prediction,
        measurement: Measurement,
        rule: Rule,
        iterations: int = 1,
    ) -> Update:
        """One epoch, without measurement blocks too."""
        Q = prediction.q if self.Q_hat is None else self.Q_hat
        if Q.shape != prediction.q.shape:
            raise ValueError(
                f"Q^: {len(Q)} states, got {len(prediction.q)}: call reset() when the state changes"
            )
        prior = predict(state, prediction.phi, Q)
        channels = [int(c) for c in measurement.channel]
        R = np.array(
            [self.R_hat.get(c, R) for c, R in zip(channels, measurement.R, strict=True)]
        ).reshape(measurement.R.shape)
        found = update(prior, measurement._replace(R=R), rule, iterations)
        if not channels:
            return found
        R_gain, R_new = R, R
        if self.codes.R:
            R_new = self._estimate_R(found, measurement, R, channels)
            if self.codes.current:
                R_gain = R_new
                found = update(prior, measurement._replace(R=R_new), rule, iterations)
        if self.codes.Q:
            self._estimate_Q(found, prediction.q, Q, _stacked(R_gain), _stacked(R_new))
        return found

    def _estimate_R(
        self, found: Update, measurement: Measurement, R: np.ndarray, channels: list[int]
    ) -> np.ndarray:
        """R^_k (nb, k, k) from an update made with R."""
        new, k = R.copy(), R.shape[1]
        room = np.empty((k, k))
        for i, channel in enumerate(channels):
            rows = slice(i * k, i * k + k)
            v = found.innovation[rows]
            count = self._seen[channel] = self._seen.get(channel, 0) + 1
            before = measurement.R[i] if self.codes.anchored else R[i]
            weight = weight_at(self.codes.anchored, self.codes.weight_R, count)
            predicted = np.ascontiguousarray(found.S[rows, rows]) - R[i]
            blend(before, weight, np.outer(v, v), predicted, self.codes.fix, room, new[i])
            self.R_hat[channel] = new[i]
        return new

    def _estimate_Q(
        self, found: Update, Q0: np.ndarray, Q: np.ndarray, R_gain: np.ndarray, R: np.ndarray
    ) -> None:
        """Q^_k from the update and the Q of its prediction; R (m, m) in its gain and R^_k."""
        assert found.H is not None
        assert found.prior_cov is not None
        self._updates += 1
        plus, minus, room = np.empty(Q.shape), np.empty(Q.shape), np.empty(Q.shape)
        bracket_of_Q(
            found.gain, found.innovation, found.S - R_gain, R, found.H @ found.prior_cov,
            found.prior_cov, found.cov, Q, self.codes.complete, plus, minus,
        )  # fmt: skip
        weight = weight_at(self.codes.anchored, self.codes.weight_Q, self._updates)
        new = Q.copy()
        blend(Q0 if self.codes.anchored else Q, weight, plus, minus, self.codes.fix, room, new)
        self.Q_hat = new


def _stacked(blocks: np.ndarray) -> np.ndarray:
    """Blocks (nb, k, k) on the diagonal of (nb k, nb k)."""
    nb, k, _ = blocks.shape
    out = np.zeros((nb, k, nb, k))
    out[np.arange(nb), :, np.arange(nb), :] = blocks
    return out.reshape(nb * k, nb * k)


# ---------------------------------------------------------------------------------- kernels


@borrowing
def weight_at(anchored: bool, b: float, k: int) -> float:
    """d_k = (1 - b) / (1 - b^(k+1)), its limit 1/(k+1) at b = 1; the weight itself of (29)."""
    if anchored:
        return b
    return 1.0 / (k + 1.0) if b >= 1.0 else (1.0 - b) / (1.0 - math.pow(b, k + 1.0))


@kernel
def blend(
    old: np.ndarray,
    d: float,
    plus: np.ndarray,
    minus: np.ndarray,
    fix: int,
    room: np.ndarray,
    new: np.ndarray,
) -> bool:
    """new (n, n) = (1 - d) old + d (plus - minus) in the form of a row of `FIXES`.

    Is what came out positive semi-definite?  With "skip" new is left as it was where it is not.
    new may be old; room (n, n) is overwritten.
    """
    n = old.shape[0]
    for i in range(n):
        for j in range(n):
            kept = (1.0 - d) * old[i, j]
            if fix == 0 or fix == SKIP:
                room[i, j] = kept + d * (plus[i, j] - minus[i, j])
            elif i != j:
                room[i, j] = 0.0 if fix == 2 else kept
            elif fix == 1:
                room[i, i] = kept + d * abs(plus[i, i] - minus[i, i])
            elif fix == 2:
                room[i, i] = abs(kept + d * (plus[i, i] - minus[i, i]))
            else:
                room[i, i] = kept + d * plus[i, i]
    definite = is_semidefinite(room)
    if fix == SKIP and not definite:
        return True
    for i in range(n):
        for j in range(n):
            new[i, j] = room[i, j]
    return definite


@kernel(fastmath=FAST_SUM)
def bracket_of_Q(
    K: np.ndarray,
    v: np.ndarray,
    HMH: np.ndarray,
    R: np.ndarray,
    HM: np.ndarray,
    M: np.ndarray,
    P: np.ndarray,
    Q: np.ndarray,
    complete: bool,
    plus: np.ndarray,
    minus: np.ndarray,
) -> None:
    """plus (n, n) = K v v' K', minus = Phi P_k-1 Phi' - P [- the terms of (28b)]; R is R^_k."""
    n, m = K.shape
    e, T = np.zeros(n), np.zeros((n, m))  # T: M H' - K (R + H M H')
    for i in range(n):
        for q in range(m):
            e[i] += K[i, q] * v[q]
    if complete:
        for i in range(n):
            for q in range(m):
                s = HM[q, i]
                for r in range(m):
                    s -= K[i, r] * (R[r, q] + HMH[r, q])
                T[i, q] = s
    for i in range(n):
        for j in range(i + 1):
            s = M[i, j] - Q[i, j] - P[i, j]
            if complete:  # T K' + K T' is the sum of the four
                for q in range(m):
                    s -= T[i, q] * K[j, q] + K[i, q] * T[j, q]
            plus[i, j] = e[i] * e[j]
            minus[i, j] = s
            plus[j, i], minus[j, i] = plus[i, j], s


@kernel
def is_semidefinite(P: np.ndarray) -> bool:
    """No pivot of the Cholesky factorisation is below zero by more than rounding."""
    return semidefinite_rank(P) >= 0


@kernel
def semidefinite_rank(P: np.ndarray) -> int:
    """Pivots of the Cholesky factorisation above rounding, -1 where P is not semi-definite."""
    n, rank = P.shape[0], 0
    L = np.zeros((n, n))
    for j in range(n):
        s = P[j, j]
        for i in range(j):
            s -= L[j, i] * L[j, i]
        least = _ZERO_PIVOT * n * abs(P[j, j])
        if not s >= -least:
            return -1
        L[j, j] = np.sqrt(s) if s > least else 0.0
        rank += s > least
        for r in range(j + 1, n):
            t = P[r, j]
            for i in range(j):
                t -= L[r, i] * L[j, i]
            if s > least:
                L[r, j] = t / L[j, j]
            elif t * t > 4.0 * least * abs(P[r, r]):  # no variance, yet a covariance
                return -1
    return rank
