"""An extended Kalman filter over the epochs: position, velocity, clock, without inertial sensors.

    x = (r, c b, v, c b')      v' = white noise, the clock's two-state model

(Kaplan & Hegarty, 3rd ed., 13.2; Brown & Hwang, 4th ed., ch. 9).  Pseudoranges that come more often
than the code loop forgets share their noise: their variance is that of as many independent ones,
enlarged by (1 + a) / (1 - a), a = exp(-4 B_L T), the correlation of a first-order loop.
What is left of orbits and atmosphere does not average out at all; the covariance is without it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.clock import OSCILLATORS
from ultratight.filters.gaussian import Gaussian, Measurement, predict, update
from ultratight.filters.rules import RULES
from ultratight.tracking.single_point import (
    Epoch,
    Fix,
    Models,
    code_variances,
    corrections,
    looks,
    predicted,
)

ACCELERATION = 1.0
"""White acceleration [m/s^2 / sqrt(Hz)]: somebody who walks or drives"""
OSCILLATOR = "tcxo"
GATE_SIGMA = 5.0
"""An innovation beyond is not believed"""
_RATE_SIGMA_MPS = 0.05
"""Of a Doppler from the phase of an 18 Hz loop over 0.1 s: 0.01 m/s at 45 dB-Hz, 0.06 at 30"""
_CODE_LOOP_HZ = 1.0
_MOST_REFUSED = 0.5
"""Share of innovations beyond the gate at which the filter rather than they is wrong"""


class Estimate(NamedTuple):
    """State (8,), as of `single_point.Fix`, and its covariance."""

    state: np.ndarray
    cov: np.ndarray
    used: np.ndarray  # (n,) bool
    lost: bool = False  # most innovations are beyond the gate


def begin(fix: Fix) -> Estimate:
    """The filter's start from a fix: velocity and drift have the geometry of the position."""
    cov = np.zeros((8, 8))
    cov[:4, :4] = fix.cov
    per_m2 = _RATE_SIGMA_MPS**2 * fix.dop.geometric**2
    cov[4:, 4:] = np.diag(np.full(4, per_m2))
    return Estimate(fix.state.copy(), cov, fix.used)


def advance(
    before: Estimate, dt_s: float, epoch: Epoch, models: Models, acceleration: float = ACCELERATION
) -> Estimate:
    """Predict over dt_s and take in an epoch."""
    phi = np.eye(8)
    phi[:4, 4:] = dt_s * np.eye(4)
    prior = predict(Gaussian(before.state, before.cov), phi, _process(dt_s, acceleration))
    x = prior.mean
    model = predicted(epoch, x)
    look = looks(epoch, x)
    delay, _ = corrections(epoch, x, look, models)
    z = np.column_stack([epoch.pseudorange_m - delay - model[:, 0], epoch.rate_mps - model[:, 1]])
    H = np.zeros((len(z), 2, 8))
    H[:, 0, :3] = H[:, 1, 4:7] = -model[:, 2:]
    H[:, 0, 3] = H[:, 1, 7] = 1.0
    a = math.exp(-4.0 * _CODE_LOOP_HZ * dt_s)
    R = np.zeros((len(z), 2, 2))
    R[:, 0, 0] = code_variances(epoch.cn0_dbhz) * (1.0 + a) / (1.0 - a)
    R[:, 1, 1] = _RATE_SIGMA_MPS**2
    S = np.einsum("bij,jk,bik->bi", H, prior.cov, H) + np.einsum("bii->bi", R)
    good = (np.abs(z) < GATE_SIGMA * np.sqrt(S)).all(axis=1) & (look[0] >= models.mask)
    up = look[0] >= models.mask
    if not good.any():
        return Estimate(x, prior.cov, good, bool(up.any()))
    taken = Measurement(
        z[good], H[good], R[good], _identity, _identity_and_slope, np.flatnonzero(good)
    )
    found = update(Gaussian(np.zeros(8), prior.cov), taken, RULES["linearised"])
    lost = float(np.mean(~good[up])) > _MOST_REFUSED
    return Estimate(x + found.mean, found.cov, good, lost)


def _process(dt_s: float, acceleration: float) -> np.ndarray:
    """Q (8, 8) of white acceleration and of the oscillator."""
    clock = OSCILLATORS[OSCILLATOR]
    q = np.array([*[acceleration**2] * 3, clock.drift_psd])
    Q = np.zeros((8, 8))
    Q[:4, :4] = np.diag(q * dt_s**3 / 3.0)
    Q[:4, 4:] = Q[4:, :4] = np.diag(q * dt_s**2 / 2.0)
    Q[4:, 4:] = np.diag(q * dt_s)
    Q[3, 3] += clock.bias_psd * dt_s
    return Q


def _identity(y: np.ndarray) -> np.ndarray:
    return y


def _identity_and_slope(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return y, np.broadcast_to(np.eye(2), (len(y), 2, 2))
