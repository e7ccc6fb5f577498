"""Filters that close loops, in their steady state: covariance by Riccati's equation, and response.

The vector closures' filter, the Kalman loop of a channel and a reduced error state of the
ultra-tight closure, each as x' = Phi x + white Q, z = H x + white R.  What a filter does with
motion that its model does not hold follows from the same gain.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ultratight.ins.error_state import ProcessNoise
from ultratight.tracking.kalman_loop import CHIPS_PER_CYCLE, transition_into
from ultratight.tracking.vector_solution import VectorSettings, transition

FLOOR = 1e-12
"""Added to Q: a state that nothing drives would have no steady state"""
ROUNDS = 40


class Steady(NamedTuple):
    """A filter whose gain no longer changes."""

    phi: np.ndarray  # (n, n)
    gain: np.ndarray  # (n, m)
    rows: np.ndarray  # H (m, n)
    prior: np.ndarray  # (n, n) covariance before an update
    after: np.ndarray  # (n, n) and after it


def steady(phi: np.ndarray, q: np.ndarray, rows: np.ndarray, r: np.ndarray) -> Steady:
    """Covariances and gain of x' = Phi x + Q, z = H x + R; r (m,) variances.

    Riccati's equation by doubling (Chu, Fan, Lin & Wang, Int. J. Control 77(8), 2004): after k
    rounds ``prior`` is that of 2^k updates from certainty.

    Raises
    ------
    ArithmeticError
        The covariance still grows after 2^40 updates: a state that nothing measures.
    """
    unit = np.eye(len(q))
    A, G, prior = phi.T, rows.T @ (rows / r[:, None]), q + FLOOR * unit
    for _ in range(ROUNDS):
        solved = np.linalg.solve(unit + G @ prior, np.hstack([A, G]))
        new_A, new_G = np.hsplit(solved, 2)
        more = A.T @ prior @ new_A
        A, G = A @ new_A, G + A @ new_G @ A.T
        prior = prior + 0.5 * (more + more.T)
        if np.abs(more).max() <= 1e-12 * np.abs(prior).max():
            break
    else:
        raise ArithmeticError("a state that no measurement sees: no steady state")
    s = rows @ prior @ rows.T + np.diag(r)
    gain = np.linalg.solve(s, rows @ prior).T
    return Steady(phi, gain, rows, prior, prior - gain @ rows @ prior)


def sigma(covariance: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Standard deviation of each row of outputs (k, n)."""
    variance = np.einsum("ki,ij,kj->k", rows, covariance, rows)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def peak_response(
    of: Steady, outputs: np.ndarray, kick: np.ndarray, push: np.ndarray, n_push: int, n: int
) -> np.ndarray:
    """Largest size of outputs (k, n_state) of the error before updates, over n updates.

    The error begins as ``kick`` (n_state,) and gets ``push`` (n_state,) in each of the first
    n_push periods: motion that is not in the model.
    """
    keep = np.eye(len(of.phi)) - of.gain @ of.rows
    error, most = kick.astype(float), np.zeros(len(outputs))
    for k in range(n):
        error = of.phi @ error
        if k < n_push:
            error = error + push
        most = np.maximum(most, np.abs(outputs @ error))
        error = keep @ error
    return most


def vector_filter(
    settings: VectorSettings, noise: ProcessNoise, u: np.ndarray, code_var: np.ndarray,
    rate_var: np.ndarray,
) -> Steady:  # fmt: skip
    """Of the closures vdll and vdfll: range and rate of every channel each update.

    u (n, 3) to the satellites; variances (n,) of an update's range [m2] and rate [m2/s2].
    """
    phi, q = transition(settings, noise.clock_sf, noise.clock_sg)
    n = len(u)
    rows = np.zeros((2 * n, settings.states))
    rows[:n, 0:3], rows[:n, 6] = -u, 1.0
    rows[n:, 3:6], rows[n:, 7] = -u, 1.0
    return steady(phi, q, rows, np.concatenate([code_var, rate_var]))


def kalman_loop_filter(
    densities: np.ndarray, integration_s: float, code_var: float, phase_var: float
) -> Steady:
    """Of a channel's code [chips], phase [cycles], Doppler [Hz] and its rate [Hz/s].

    The measurement is a mean over the integration, see `kalman_loop`.
    """
    phi, q, T = np.empty((4, 4)), np.empty((4, 4)), integration_s
    transition_into(T, densities, phi, q)
    k = CHIPS_PER_CYCLE
    rows = np.array([[1.0, 0.0, -0.5 * k * T, k * T * T / 6.0], [0.0, 1.0, -0.5 * T, T * T / 6.0]])
    return steady(phi, q, rows, np.array([code_var, phase_var]))


V, BIAS, DRIFT, PHASE = 0, 3, 6, 7
"""Rows of the reduced error state: velocity, acceleration, clock drift, one phase per channel"""


def tight_filter(
    noise: ProcessNoise, force: float, u: np.ndarray, epoch_s: float, phase_var: np.ndarray | None,
    rate_var: np.ndarray,
) -> Steady:  # fmt: skip
    """Of the ultra-tight closure: v, an acceleration in ECEF, clock drift, and phases if coherent.

    Accelerometer biases and what tilts make of the specific force (``force`` [m/s2]) are one
    random walk.  phase_var (n,) [m2] of the coherent measurement, None for the differential one,
    of which rate_var (n,) [m2/s2] is the noise.
    """
    phi, q = _tight_model(noise, force, u, epoch_s, phase_var is not None)
    if phase_var is not None:
        return steady(phi, q, np.eye(len(phi))[PHASE:], phase_var)
    return steady(phi, q, _rates(u, len(phi)), rate_var)


def _tight_model(
    noise: ProcessNoise, force: float, u: np.ndarray, T: float, coherent: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Phi and Q of that error state over T seconds."""
    n = PHASE + (len(u) if coherent else 0)
    F, G = np.zeros((n, n)), np.zeros((n, n))
    F[V : V + 3, BIAS : BIAS + 3] = np.eye(3)
    G[V : V + 3, V : V + 3] = noise.velocity * np.eye(3)
    walk = noise.accel_bias + force**2 * noise.attitude
    G[BIAS : BIAS + 3, BIAS : BIAS + 3] = walk * np.eye(3)
    G[DRIFT, DRIFT] = noise.clock_sg
    if coherent:
        F[PHASE:, V : V + 3], F[PHASE:, DRIFT] = -u, 1.0
        G[PHASE:, PHASE:] = noise.clock_sf
    phi = np.eye(len(F)) + T * F + 0.5 * T * T * F @ F
    return phi, 0.5 * T * (phi @ G @ phi.T + G)


def _rates(u: np.ndarray, n_state: int) -> np.ndarray:
    """Rows (n, n_state) of the range rates."""
    rows = np.zeros((len(u), n_state))
    rows[:, V : V + 3], rows[:, DRIFT] = -u, 1.0
    return rows


def federated_filter(
    noise: ProcessNoise, force: float, u: np.ndarray, update_s: float, half_s: np.ndarray,
    phase_var: np.ndarray,
) -> Steady:  # fmt: skip
    """Of the federated form: `tight_filter`'s differential states, and the clock's step behind.

    Each channel hands over the slope of a line through the phases of its halves (half_s, phase_var
    (n,), [s], [m2]): sigma^2 = R / sum (t - mean)^2, of the rate in the middle of the interval.
    What the clock's white noise makes of it is common (`pre_filter_hand_over`).
    """
    T = update_s
    model = _tight_model(noise, force, u, T, False)
    phi, q = (np.pad(x, (0, 1)) for x in model)
    n = np.maximum(np.floor(T / half_s + 1e-9), 2.0)
    rows = np.hstack([_rates(u, PHASE), np.ones((len(u), 1))])
    rows[:, BIAS : BIAS + 3] = 0.5 * T * u
    # of the step, by ten integrations of the epoch as the filter has it
    ago = (np.arange(10) + 0.5) * T / 10
    w = (ago.mean() - ago) / np.sum((ago - ago.mean()) ** 2)
    a, b = np.meshgrid(ago, ago)
    m = np.minimum(a, b)
    walk = m * (a * b - 0.5 * m * (a + b) + m * m / 3.0)
    q[-1, -1] = w @ (noise.clock_sf * m + noise.clock_sg * walk) @ w
    q[-1, DRIFT] = q[DRIFT, -1] = w @ (noise.clock_sg * ago**2 / 2.0)
    return steady(phi, q, rows, phase_var * 12.0 / (half_s**2 * n * (n**2 - 1.0)))


def phase_filter(clock_sf: float, unrest: float, half_s: float, phase_var: float) -> Steady:
    """Of a channel's phase and Doppler [m, m/s] in a pre-filter, each half bit (`pre_filter`)."""
    h = half_s
    phi = np.array([[1.0, h], [0.0, 1.0]])
    q = unrest * np.array([[h**3 / 3.0, h * h / 2.0], [h * h / 2.0, h]])
    q[0, 0] += clock_sf * h
    return steady(phi, q, np.array([[1.0, 0.0]]), np.array([phase_var]))


def averaged_code(
    first: np.ndarray, u: np.ndarray, code_var: np.ndarray, epochs: float
) -> np.ndarray:
    """Range errors (n,) [m] left by the mean of so many epochs of code: carriers do the smoothing.

    ``first`` (4,): sigmas of position and clock at the start; code_var (n,) of an epoch [m2].
    """
    rows = np.hstack([-u, np.ones((len(u), 1))])
    known = np.diag(1.0 / first**2) + epochs * rows.T @ (rows / code_var[:, None])
    return sigma(np.linalg.inv(known), rows)
