"""Fading factor: is P too small for the innovations seen?  Inflate it by lambda >= 1.

Xu, Zeng & Huang, Geomatics and Information Science of Wuhan University 42(12), 2017, section 3:

    V0 = (rho V0 + nu nu') / (1 + rho)                                  remembered innovations
    P(lambda) = P1 + Q + (lambda - 1) B,   P1 = Phi P Phi',   M = H B H'

with B = P1 as printed (all states).  The paper says "minimise g = sum (P_xz - K V0)^2" but
prints no formula for lambda.  Three readings:

    (i)   gain frozen at lambda = 1 and P_xz(lambda) = lambda P_xz0 (its (31)):
          lambda = <P_xz0, K0 V0> / <P_xz0, P_xz0>: closed form, 1 when V0 = S0.  In use here.
    (ii)  gain follows lambda.  V0 has an effective rank of about 3 (its memory is
          (1 + q) / (1 - q) = 2.9 epochs, q = rho / (1 + rho)); where the noise of one epoch
          exceeds M, as in tracking at 50 Hz, I - S^-1 V0 is almost a projector, g grows with
          |P_xz(lambda)| and lambda = 1 always.  Kept as a negative result.
    (iii) fit S(lambda) to V0: lambda = 1 + <M, V0 - S0> / <M, M>.

Since E[max(1, lambda)] > 1 in steady flight too, states that are not observed grow as
lambda^(1/T) per second and the printed form diverges at 50 Hz.  Two regularised forms, both with
a gate on the sum of V0_qq - S_qq over rows with information: inflate only what the satellites
observe at once (B = E P1 E, FIQKF-R), or inflate all but clamp every variance at its first value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from signals.compiled import FAST_SUM, borrowing, kernel
from signals.eight import padded
from ultratight.filters.gaussian import Gaussian, Measurement, Prediction, Update, predict, update
from ultratight.filters.padded_rows import dot, rows_times, widen
from ultratight.filters.rules import Rule

OBSERVED = ("r", "v", "cb", "cd", "phase")
"""The block of FIQKF-R: attitude and biases are left alone"""


@dataclass(frozen=True)
class FadingOptions:
    """Which form of the fading factor; the default is FIQKF-R."""

    blocks: tuple[str, ...] | None = OBSERVED  # names of the layout that are inflated; None: all
    gate: float = 3.0  # sigmas of the gate; 0: no gate
    clamp: bool = False  # keep inflated variances at or below their first value
    start_s: float = 1.0  # no inflation before [s since reset]
    rho: float = 0.95  # forgetting constant of V0
    fit: bool = False  # lambda by reading (iii) in place of (i)
    information_row: int = 1  # row of a block (Q of I, Q, S) that counts as informative always

    def __post_init__(self) -> None:
        if not 0.0 < self.rho <= (20.0 if self.fit else 1.0):
            most = 20 if self.fit else 1
            raise ValueError(f"rho: {self.rho}, expected 0 < rho <= {most}")
        if self.gate < 0.0 or self.start_s < 0.0:
            raise ValueError(f"gate, start_s: {self.gate}, {self.start_s}, expected >= 0")


AS_PRINTED = FadingOptions(blocks=None, gate=0.0, start_s=0.0)
BLOCK = FadingOptions()
CLAMPED = FadingOptions(blocks=None, clamp=True)
FITTED = FadingOptions(fit=True, rho=9.5)
"""A memory of 20 epochs: (1 + q) / (1 - q) with q = rho / (1 + rho)"""


class Fading:
    """The memory of one run: V0 over all channels, time since reset, first variances.

    ``step`` is predict and update with lambda; ``reset`` drops V0 and the clock of ``start_s``.
    The first variances (the clamp) survive it, since the hand-over to another measurement model
    is no new start; states that it appends bring their own.
    """

    def __init__(self, options: FadingOptions = BLOCK) -> None:
        self.options = options
        self.first_variance = np.zeros(0)
        self.reset()

    def reset(self) -> None:
        """Forget the innovations."""
        self.V0 = np.zeros((0, 0))
        self.seen = np.zeros(0, dtype=np.bool_)
        self.elapsed_s = 0.0
        self.inflated = np.zeros(0)

    def step(
        self,
        state: Gaussian,
        prediction: Prediction,
        measurement: Measurement,
        rule: Rule,
        iterations: int = 1,
    ) -> tuple[Gaussian, Update]:
        """The prior in use, P(lambda), and the update made from it."""
        options, k = self.options, measurement.z.shape[1]
        self.prepare(state.cov, prediction.layout, prediction.n_channel * k)
        prior = predict(state, prediction.phi, prediction.q)
        plain = update(prior, measurement, rule, iterations)
        self.elapsed_s += prediction.T
        if plain.innovation.size == 0:
            return prior, plain
        m = plain.innovation.size
        V = np.empty((m, m))
        is_open = watch_innovations(
            self.V0, self.seen, measurement.channel, plain.innovation, options.rho, V,
            prior.cov, prediction.q, self.inflated, plain.H, plain.noise,
            min(options.information_row, k - 1), options.gate,
        )  # fmt: skip
        if not is_open or self.elapsed_s <= options.start_s:
            return prior, plain
        return self.faded(prior, plain, V, prediction.q, measurement, rule, iterations)

    def faded(
        self,
        prior: Gaussian,
        plain: Update,
        V: np.ndarray,
        q: np.ndarray,
        measurement: Measurement,
        rule: Rule,
        iterations: int = 1,
    ) -> tuple[Gaussian, Update]:
        """P(lambda) and its update where the gate is open; the plain ones where lambda is 1.

        V (m, m): what is remembered of the innovations of ``plain``; q: the Q in ``prior``.
        """
        options = self.options
        if options.fit:
            HE = np.asarray(plain.H) * self.inflated
            lam = reading_iii(HE @ (prior.cov - q) @ HE.T, plain.S, V)
        else:
            lam = _fading_factor(self.inflated, plain.S, plain.gain, V)
        if not lam > 1.0:
            return prior, plain
        ceiling = self.first_variance if options.clamp else np.zeros(0)
        cov = _inflate(prior.cov, q, self.inflated, lam, ceiling)
        prior = Gaussian(prior.mean, cov)
        faded = update(prior, measurement, rule, iterations)
        faded.lam = lam
        return prior, faded

    def prepare(self, cov: np.ndarray, layout: Any, n_row: int) -> None:
        """Size the memory at the first step after a reset; ValueError where it does not fit.

        n_row: numbers that all channels together can measure.
        """
        n, known = cov.shape[0], self.first_variance.size
        if known < n:
            self.first_variance = np.append(self.first_variance, np.diag(cov)[known:])
        if self.inflated.size == 0:
            self.inflated = block_mask(layout, self.options.blocks, n)
            self.V0, self.seen = np.zeros((n_row, n_row)), np.zeros(n_row, dtype=np.bool_)
        if self.inflated.size != n or self.seen.size != n_row:
            raise ValueError(
                f"fading memory: {self.inflated.size} states, {self.seen.size} rows; got {n}, "
                f"{n_row}: call reset() when the state or the measurement changes"
            )


def block_mask(layout: Any, blocks: tuple[str, ...] | None, n: int) -> np.ndarray:
    """1.0 for the states of the named blocks of a layout, 0.0 elsewhere; all 1.0 for None."""
    if blocks is None:
        return np.ones(n)
    mask = np.zeros(n)
    for name in blocks:
        mask[getattr(layout, name)] = 1.0
    return mask


def reading_i(P_xz: np.ndarray, S: np.ndarray, V0: np.ndarray) -> float:
    """lambda = <P_xz, K V0> / <P_xz, P_xz>, K = P_xz S^-1; not limited to >= 1."""
    return float(np.sum(P_xz * (np.linalg.solve(S, P_xz.T).T @ V0)) / np.sum(P_xz**2))


def reading_ii(P1: np.ndarray, Q: np.ndarray, H: np.ndarray, noise: np.ndarray,
               V0: np.ndarray, largest: float = 1e3) -> float:  # fmt: skip
    """The lambda in [1, largest] of least |P_xz(lambda) (I - S(lambda)^-1 V0)|, by 1-D search.

    ``noise`` (m, m) is Omega + R, held fixed.  Grid of 200 in log lambda, refined once.
    """

    def g(lam: float) -> float:
        P_xz = (lam * P1 + Q) @ H.T
        S = H @ P_xz + noise
        return float(np.sum((P_xz - np.linalg.solve(S, P_xz.T).T @ V0) ** 2))

    grid = np.geomspace(1.0, largest, 200)
    best = int(np.argmin([g(lam) for lam in grid]))
    fine = np.linspace(grid[max(best - 1, 0)], grid[min(best + 1, 199)], 400)
    return float(fine[np.argmin([g(lam) for lam in fine])])


def reading_iii(M: np.ndarray, S: np.ndarray, V0: np.ndarray) -> float:
    """lambda = 1 + <M, V0 - S> / <M, M>: the least-squares fit of S(lambda) to V0."""
    return 1.0 + float(np.sum(M * (V0 - S)) / np.sum(M**2))


# ---------------------------------------------------------------------------------- kernels


@borrowing
def _remember(
    V0: np.ndarray, seen: np.ndarray, rows: np.ndarray, nu: np.ndarray, rho: float, V: np.ndarray
) -> None:
    """Refresh the rows present in V0 (in place) and write their part to V (m, m).

    A pair with a row never seen starts at nu nu' in place of the recursion.
    """
    m = rows.size
    keep, share = rho / (1.0 + rho), 1.0 / (1.0 + rho)
    usual = m == seen.size
    for a in range(m):
        usual = usual and rows[a] == a and seen[a]
    if usual:
        for a in range(m):
            for b in range(m):
                V[a, b] = keep * V0[a, b] + share * (nu[a] * nu[b])
                V0[a, b] = V[a, b]
        return
    for a in range(m):
        for b in range(m):
            fresh = nu[a] * nu[b]
            if seen[rows[a]] and seen[rows[b]]:
                V[a, b] = keep * V0[rows[a], rows[b]] + share * fresh
            else:
                V[a, b] = fresh
    for a in range(m):  # a channel present twice in an epoch leaves its later block
        for b in range(m):
            V0[rows[a], rows[b]] = V[a, b]
    for a in range(m):
        seen[rows[a]] = True


@kernel
def watch_innovations(
    V0: np.ndarray,
    seen: np.ndarray,
    channel: np.ndarray,
    nu: np.ndarray,
    rho: float,
    V: np.ndarray,
    cov: np.ndarray,
    q: np.ndarray,
    inflated: np.ndarray,
    H: np.ndarray,
    noise: np.ndarray,
    row: int,
    sigmas: float,
) -> bool:
    """Remember nu, fill V (m, m) with what is remembered of its rows; True: the gate is open."""
    m = H.shape[0]
    k = m // channel.size
    rows = np.empty(m, np.int64)
    for i in range(m):
        rows[i] = channel[i // k] * k + i % k
    _remember(V0, seen, rows, nu, rho, V)
    if sigmas == 0.0:
        return True
    return _gate_is_open(cov, q, inflated, H, noise, V, k, row, sigmas, 1.0 / (1.0 + rho))


@kernel(fastmath=FAST_SUM)
def _gate_is_open(
    cov: np.ndarray,
    q: np.ndarray,
    inflated: np.ndarray,
    H: np.ndarray,
    noise: np.ndarray,
    V: np.ndarray,
    k: int,
    row: int,
    sigmas: float,
    a: float,
) -> bool:
    """sum (V_qq - S_qq) > sigmas sqrt(2 sum S_qq^2 a / (2 - a)) over rows with information.

    The information of a row h of H is h E (P - Q) E h': what inflation would change of its S.
    """
    m, n = H.shape
    size = noise.shape[1]
    room = np.empty((2 * m + n, padded(n)))
    h, hP, P = room[:m], room[m : 2 * m], room[2 * m :]
    widen(H, h)
    widen(cov, P)
    rows_times(h, P, hP)
    state, some = np.empty(n, np.int64), 0  # of the inflated states alone
    for c in range(n):
        state[some] = c
        some += inflated[c] != 0.0
    room = np.zeros((2 * m + some, padded(some)))
    g, gM, M = room[:m], room[m : 2 * m], room[2 * m :]
    for c in range(some):
        for i in range(m):
            g[i, c] = H[i, state[c]]
        for e in range(some):
            M[c, e] = cov[state[c], state[e]] - q[state[c], state[e]]
    rows_times(g, M, gM)
    excess, spread = 0.0, 0.0
    for first in range(0, m, k):
        reference = dot(gM, first + row, g, first + row)
        for i in range(first, first + k):
            if i == first + row or dot(gM, i, g, i) > 1e-3 * reference:
                S = noise[i // size, i % size, i % size] + dot(hP, i, h, i)
                excess += V[i, i] - S
                spread += S * S
    return excess > sigmas * np.sqrt(2.0 * spread * a / (2.0 - a))


@kernel(fastmath=FAST_SUM)
def _fading_factor(inflated: np.ndarray, S: np.ndarray, gain: np.ndarray, V: np.ndarray) -> float:
    """Reading (i) over the inflated states, at least 1."""
    n, m = gain.shape
    above, below = 0.0, 0.0
    P_xz, KV = np.empty(m), np.empty(m)
    for c in range(n):
        if inflated[c] == 0.0:
            continue
        P_xz[:] = 0.0
        KV[:] = 0.0
        for r in range(m):
            g = gain[c, r]
            for i in range(m):
                P_xz[i] += g * S[r, i]
                KV[i] += g * V[r, i]
        for i in range(m):
            above += P_xz[i] * KV[i]
            below += P_xz[i] * P_xz[i]
    if not above > below:
        return 1.0
    return above / below


@kernel
def _inflate(
    cov: np.ndarray, q: np.ndarray, inflated: np.ndarray, lam: float, ceiling: np.ndarray
) -> np.ndarray:
    """P + (lambda - 1) E (P - Q) E; with a ceiling (n,) rows and columns are scaled down to it.

    A variance above the ceiling before inflation keeps its value.
    """
    n = cov.shape[0]
    P = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            P[i, j] = cov[i, j] + (lam - 1.0) * inflated[i] * inflated[j] * (cov[i, j] - q[i, j])
    if ceiling.size > 0:
        scale = np.ones(n)
        for i in range(n):
            top = max(ceiling[i], cov[i, i])
            if P[i, i] > top:
                scale[i] = np.sqrt(top / P[i, i])
        for i in range(n):
            for j in range(n):
                P[i, j] *= scale[i] * scale[j]
    return P
