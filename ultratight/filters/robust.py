"""R from residuals, a memory that shortens when the noise changes, a gain that outliers lose.

With S = H M H' + R_k-1, the innovation v of m numbers and the ratio eps = v' S^-1 v / m:

    R_k = (1 - d) R_k-1 + d (e e' + H P_k H'),   e = z - H x_k = R_k-1 S^-1 v             (13)
    d   = (1 - b) / (1 - b^(k+1)),   b = b0 + db min(g_low, g_high)                  (15), (16)
    K   = w M H' S^-1                                                                 (17), (18)

The bracket is a square and a covariance, R - R S^-1 R, so that R_k stays definite; that of
`adaptive`, v v' - H M H', does not where H M H' exceeds R.  Its mean is zero for the same S, but
the step is shrunk, R S^-1 (E[v v'] - S) S^-1 R: a far too small R_0 grows slowly, R_0 = 0 never.
e and R - R S^-1 R are mean and covariance of the measurement's noise given all innovations, which
serves any rule and any block of a larger measurement.

b falls at once when a single eps is large, and when the mean of the last ones is small; beyond c3
R is held, the gain reduced, beyond c4 the measurement is left out.  With hardly any Q everything
that the model lacks is taken for noise: R_k grows, the gain falls, and so on without end.  So does
an outlier of some hundred sigma where the gain is not reduced: it throws the state off, what
follows is taken for noise, and the state may never come back, nor does it with `adaptive`'s R.
A step of R that doubles cannot hold (e of 10^7 sigma and more) is not made.

After Duan, Gong, Xu & Zhao (Unit 63861), an improved Sage-Husa filter for ballistic range data.
Only the formula of d has survived legibly; the others are reconstructed from the text, with its
numbers and properties of c1 ... c4, b0 and db.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from signals.compiled import FAST_SUM, borrowing, kernel
from ultratight.filters.adaptive import semidefinite_rank, weight_at
from ultratight.filters.conditioning import gain_matrix
from ultratight.filters.door import whole
from ultratight.filters.gaussian import Gaussian, Measurement, Prediction, Update, predict, update
from ultratight.filters.rules import Rule

LOW_SIDES = ("mean", "single")
"""What tells that the noise fell: the mean of the last eps; each eps alone, which biases R_k"""
LEAST_WEIGHT = 1e-12
"""Of a block among others: its noise is then so many times its S, as good as left out"""
_EPOCHS, _BETA, _REJECTED, _ACCEPTED, _RING = range(5)  # places in a memory


class Codes(NamedTuple):
    """`Ishakf` as a kernel reads it."""

    on: bool
    R: bool
    adaptive: bool
    robust: bool
    single: bool
    recursive: bool
    b0: float
    b1: float
    c1: float
    c2: float
    c3: float
    c4: float
    window: int
    max_reject: int


@dataclass(frozen=True)
class Ishakf:
    """How R is estimated and outliers treated; the default is the whole of ISHAKF."""

    R: bool = True  # estimated from residuals
    adaptive: bool = True  # b follows eps; else b = b0 + db
    robust: bool = True  # the gain gives way beyond c3
    b0: float = 0.70  # least forgetting factor
    db: float = 0.27  # its range
    c1: float = 1.8  # b falls with a mean eps below 1 / c1
    c2: float = 8.0  # and with a single one above
    c3: float = 12.0  # R is held, the gain reduced
    c4: float = 16.0  # left out
    window: int = 20  # accepted eps in the mean
    low_side: str = "mean"  # row of `LOW_SIDES`
    recursive: bool = False  # d_k = d_k-1 / (d_k-1 + b): exact for a b that varies
    max_reject: int = 0  # after so many beyond c3 in a row all are taken, b = b0; 0: never

    def __post_init__(self) -> None:
        if not (self.b0 > 0.0 and self.db >= 0.0 and self.b0 + self.db <= 1.0):
            raise ValueError(f"b0, db: {self.b0}, {self.db}, expected 0 < b0 <= b0 + db <= 1")
        limits = (self.c2, self.c3, self.c4)
        if not (0.0 < self.c2 < self.c3 < self.c4 < math.inf):
            raise ValueError(f"c2, c3, c4: {limits}, expected rising numbers above 0")
        if not 0.0 < self.c1 < math.inf:
            raise ValueError(f"c1: {self.c1}, expected a number above 0")
        whole("window", self.window, 1)
        whole("max_reject", self.max_reject, 0)
        if self.low_side not in LOW_SIDES:
            raise ValueError(f"low_side: {self.low_side!r}, expected one of {', '.join(LOW_SIDES)}")

    def codes(self, on: bool = True) -> Codes:
        """For a kernel."""
        return Codes(
            on, self.R, self.adaptive, self.robust, self.low_side == "single", self.recursive,
            float(self.b0), float(self.b0 + self.db), float(self.c1), float(self.c2),
            float(self.c3), float(self.c4), int(self.window), int(self.max_reject),
        )  # fmt: skip

    def memory(self) -> ResidualMemory:
        """What it needs in closed loop."""
        return ResidualMemory(self)


def fresh(window: int) -> np.ndarray:
    """Memory of one block: nothing seen, and the last eps all as expected."""
    out = np.ones(_RING + window)
    out[[_EPOCHS, _REJECTED, _ACCEPTED]] = 0.0
    return out


class ResidualMemory:
    """R per channel of one run in closed loop, and how its eps went; ``step`` is one epoch.

    A channel is judged by its own eps.  The gain of one that is reduced by w is what the noise
    R + (1/w - 1) S of that channel gives; the covariance is Joseph's with R, as in (17), (18).
    """

    def __init__(self, options: Ishakf) -> None:
        self.codes = options.codes()
        self.reset()

    def reset(self) -> None:
        """Forget the estimates."""
        self.R_hat: dict[int, np.ndarray] = {}
        self._seen: dict[int, np.ndarray] = {}

    def step(
        self,
        state: Gaussian,
        prediction: Prediction,
        measurement: Measurement,
        rule: Rule,
        iterations: int = 1,
    ) -> Update:
        """Predict and update; innovation, S and NIS are those before any gain was reduced."""
        prior = predict(state, prediction.phi, prediction.q)
        channels = [int(c) for c in measurement.channel]
        R = np.array(
            [self.R_hat.get(c, R) for c, R in zip(channels, measurement.R, strict=True)]
        ).reshape(measurement.R.shape)
        found = used = update(prior, measurement._replace(R=R), rule, iterations)
        if not channels:
            return found
        d, w = self._judge(found, channels, measurement.R.shape[1])
        if w.min() < 1.0:
            times = 1.0 / np.maximum(w, LEAST_WEIGHT) - 1.0
            more = times.reshape(-1, 1, 1) * _blocks(found.S, R)
            used = update(prior, measurement._replace(R=R + more), rule, iterations)
        if self.codes.R:
            self._estimate(used, found.innovation, R, d, channels)
        return found if used is found else _believed(found, used, more)

    def _judge(self, found: Update, channels: list[int], k: int) -> tuple[np.ndarray, np.ndarray]:
        """d and w of each channel."""
        out = np.empty((2, len(channels)))
        for i, channel in enumerate(channels):
            rows = slice(i * k, i * k + k)
            inverse = inverse_of(np.ascontiguousarray(found.S[rows, rows]))
            eps = ratio(inverse, found.innovation[rows])
            memory = self._seen.setdefault(channel, fresh(self.codes.window))
            out[:, i] = judge(eps, memory, self.codes)
        return out[0], out[1]

    def _estimate(
        self, used: Update, v: np.ndarray, R: np.ndarray, d: np.ndarray, channels: list[int]
    ) -> None:
        """R of each channel from its share of S^-1 v, which the reduced ones do not spoil."""
        k = R.shape[1]
        inverse = inverse_of(used.S)
        u = inverse @ v
        own = _blocks(inverse, R)
        for i, channel in enumerate(channels):
            new = np.empty((k, k))
            from_residual(R[i], own[i], u[i * k : i * k + k], d[i], new)
            self.R_hat[channel] = new


def _blocks(S: np.ndarray, R: np.ndarray) -> np.ndarray:
    """The blocks (nb, k, k) on the diagonal of S (nb k, nb k)."""
    nb, k, _ = R.shape
    return np.ascontiguousarray(S.reshape(nb, k, nb, k)[np.arange(nb), :, np.arange(nb), :])


def _believed(found: Update, used: Update, more: np.ndarray) -> Update:
    """The estimate of a reduced gain, whose covariance counts the noise without ``more``."""
    n = used.mean.size
    nb, k, _ = more.shape
    K = np.ascontiguousarray(used.gain)
    K_blocks = K.reshape(n, nb, k)
    less = np.einsum("aik,ikl,bil->ab", K_blocks, more, K_blocks)
    cov = used.cov - 0.5 * (less + less.T)
    return found._replace(mean=used.mean, cov=cov, gain=K)


# ---------------------------------------------------------------------------------- kernels


@kernel
def inverse_of(S: np.ndarray) -> np.ndarray:
    """S^-1, NaN where S is not positive definite."""
    one = np.eye(S.shape[0])
    return gain_matrix(S, one, one)[0]


@borrowing(fastmath=FAST_SUM)
def ratio(inverse: np.ndarray, v: np.ndarray) -> float:
    """eps = v' S^-1 v / m, (14)."""
    m, s = v.size, 0.0
    for a in range(m):
        for b in range(m):
            s += v[a] * inverse[a, b] * v[b]
    return s / m


@borrowing
def judge(eps: float, memory: np.ndarray, codes: Codes) -> tuple[float, float]:
    """d, (15) and (16), and w, (18), of the next eps of a block; NaN is an outlier."""
    memory[_EPOCHS] += 1.0
    b, w = codes.b1, 1.0
    if codes.adaptive or codes.robust:
        if eps <= codes.c3:
            memory[_REJECTED] = 0.0
            memory[_RING + int(memory[_ACCEPTED]) % codes.window] = eps
            memory[_ACCEPTED] += 1.0
            if codes.adaptive:
                b = codes.b0 + (codes.b1 - codes.b0) * _steadiness(eps, memory, codes)
        else:
            memory[_REJECTED] += 1.0
            if codes.max_reject == 0 or memory[_REJECTED] <= codes.max_reject or eps != eps:
                return 0.0, gain_weight(eps, codes.c3, codes.c4) if codes.robust else 1.0
            b = codes.b0
    if codes.recursive:
        memory[_BETA] = memory[_BETA] / (memory[_BETA] + b)
        return memory[_BETA], w
    return weight_at(False, b, int(memory[_EPOCHS])), w


@borrowing
def _steadiness(eps: float, memory: np.ndarray, codes: Codes) -> float:
    """min(g_low, g_high) of (15): 1 while the noise is steady, 0 at c3."""
    high = 1.0 if eps <= codes.c2 else (codes.c3 - eps) / (codes.c3 - codes.c2)
    if codes.single:
        return min(high, eps / codes.c1)
    mean = 0.0
    for i in range(codes.window):
        mean += memory[_RING + i]
    return min(high, codes.c1 * mean / codes.window)


@borrowing
def gain_weight(eps: float, c3: float, c4: float) -> float:
    """w of (18): 1 up to c3, 0 from c4, between them in the form of IGG III."""
    if eps <= c3:
        return 1.0
    if not eps <= c4:
        return 0.0
    return c3 / eps * ((c4 - eps) / (c4 - c3)) ** 2


@borrowing(fastmath=FAST_SUM)
def from_residual(
    R: np.ndarray, inverse: np.ndarray, u: np.ndarray, d: float, new: np.ndarray
) -> bool:
    """new (m, m) of (13), R + d (e e' - R S^-1 R), e = R u; its block of S^-1, u = S^-1 v.

    False, and new = R, where rounding would cost the new one a direction, or definiteness.
    """
    m, made = R.shape[0], True
    if d != 0.0:
        for i in range(m):
            for j in range(i + 1):
                e, f, s = 0.0, 0.0, 0.0
                for a in range(m):
                    e += R[i, a] * u[a]
                    f += R[j, a] * u[a]
                    for b in range(m):
                        s += R[i, a] * inverse[a, b] * R[j, b]
                new[i, j] = R[i, j] + d * (e * f - s)
                new[j, i] = new[i, j]
        made = semidefinite_rank(new) >= semidefinite_rank(R)
    if d == 0.0 or not made:
        for i in range(m):
            for j in range(m):
                new[i, j] = R[i, j]
    return made
