"""Equivalent loops, scalar and vector: the same prompts, discriminator and process noise.

A frequency loop alone, without code, data bits, estimated power or lock indicator.  Per data bit
every channel has two prompts of 10 ms at the replica's frequency error, with unit noise per
component, and from them

    f = Im(P2 conj P1) / (A^2 2 pi T_h)                                       [Hz]

as the VDFLL has at low C/N0 (`ultratight.tracking.vector_measurements`).  A Kalman filter in its
steady state at that C/N0 weighs them and steers: a *vector* one has the VDFLL's states without
position (velocity, clock drift, and acceleration where it has eleven) and all channels, a *scalar*
one is the same filter of a single channel, whose line of sight has the process noise of one of the
VDFLL's axes (acceleration, or its jerk, white) and of its clock.  Nothing else differs; what the
vector one gains is that channels share a state.  The truth is uniform motion with the clock's own
noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.linalg import solve_discrete_are

import ultratight
from common.closure_cells import DURATION_S, FIVE, WORLD
from ultratight.data_sheets import imu_errors, process_noise
from ultratight.predicted_motion import motion
from ultratight.tracking.channel_state import BIT_S, HALF_BIT_S, WAVELENGTH_M
from ultratight.tracking.vector_solution import VectorSettings, transition
from ultratight.world import World

OFF_HZ, OFF_BITS = 25.0, 10
"""Lost as in `metrics.off_carrier_s`"""
TRIALS, SEED = 200, 77
LEVELS = tuple(float(x) for x in range(9, 24))
PLACE, DRIFT = (0, 1, 2, 6), 7
"""States of the VDFLL that are no rates, and its clock drift"""
RESPONSE = 2000
"""Bits after which nothing is left of a loop's impulse response"""


class Loop(NamedTuple):
    """x' = F x + w with covariance Q; rates H x [m/s]; ``clock``: the state that really wanders."""

    F: np.ndarray
    Q: np.ndarray
    H: np.ndarray
    clock: int
    clock_walk: float


def loop(u: np.ndarray | None, states: int) -> Loop:
    """Of all lines of sight u (n, 3), or with None of a channel alone; 8 or 11 states."""
    scenario = ultratight.load("uniform", WORLD)
    clock = process_noise(scenario, imu_errors(scenario, 1))
    F, Q = transition(VectorSettings(states=states, update_s=BIT_S), clock.clock_sf, clock.clock_sg)
    walk = float(np.sqrt(Q[DRIFT, DRIFT]))
    if u is not None:
        kept = [i for i in range(states) if i not in PLACE]
        H = np.zeros((len(u), len(kept)))
        H[:, 0:3], H[:, kept.index(DRIFT)] = -u, 1.0
        return Loop(F[np.ix_(kept, kept)], Q[np.ix_(kept, kept)], H, kept.index(DRIFT), walk)
    kept = [3, 8] if states > 8 else [3]  # one axis stands for the line of sight
    Q = Q[np.ix_(kept, kept)]
    Q[0, 0] += walk**2
    return Loop(F[np.ix_(kept, kept)], Q, np.eye(1, len(kept)), 0, walk)


def gain(of: Loop, cn0_dbhz: float) -> np.ndarray:
    """Of the Kalman filter in its steady state (n_state, n_channel)."""
    a2 = 2.0 * HALF_BIT_S * 10.0 ** (0.1 * cn0_dbhz)
    R = (2.0 / a2 + 2.0 / a2**2) * (WAVELENGTH_M / (2.0 * np.pi * HALF_BIT_S)) ** 2
    R = R * np.eye(len(of.H))
    P = solve_discrete_are(of.F.T, of.H.T, of.Q, R)  # before an update
    K = np.linalg.solve(of.H @ P @ of.H.T + R, of.H @ P).T
    return np.asarray(K)


def bandwidth_hz(of: Loop, cn0_dbhz: float) -> float:
    """Noise bandwidth of a channel's frequency, one-sided, as that of a loop filter."""
    K = gain(of, cn0_dbhz)
    A, x = of.F - of.F @ K @ of.H, (of.F @ K)[:, 0]
    h = []
    for _ in range(RESPONSE):
        h.append(float(of.H[0] @ x))
        x = A @ x
    return float(np.sum(np.square(h)) / (2.0 * BIT_S * np.sum(h) ** 2))


def fly(of: Loop, cn0_dbhz: float, trials: int, rng: np.random.Generator) -> np.ndarray:
    """Share of the channels that are lost within `DURATION_S`, per trial (trials,)."""
    K = gain(of, cn0_dbhz)
    A2 = 2.0 * HALF_BIT_S * 10.0 ** (0.1 * cn0_dbhz)
    x = np.zeros((trials, len(of.F)))  # true - estimate
    bits, lost = np.zeros((trials, len(of.H)), int), np.zeros((trials, len(of.H)), bool)
    for _ in range(round(DURATION_S / BIT_S)):
        hz = x @ of.H.T / WAVELENGTH_M
        bits = np.where(np.abs(hz) > OFF_HZ, bits + 1, 0)
        lost |= bits >= OFF_BITS
        noise = rng.standard_normal((4, *hz.shape))
        prompt = np.sqrt(A2) * np.sinc(hz * HALF_BIT_S)
        turn = np.exp(2j * np.pi * hz * HALF_BIT_S)
        first, second = prompt + noise[0] + 1j * noise[1], prompt * turn + noise[2] + 1j * noise[3]
        seen = (second * first.conj()).imag / (A2 * 2.0 * np.pi * HALF_BIT_S)
        x = (x - seen * WAVELENGTH_M @ K.T) @ of.F.T
        x[:, of.clock] += of.clock_walk * rng.standard_normal(trials)
    return np.asarray(lost.mean(axis=1))


def lines_of_sight(prns: tuple[int, ...] | None = None) -> np.ndarray:
    """Unit vectors from the antenna to the satellites (n, 3), ECEF, at the start."""
    scenario = ultratight.load("uniform", WORLD | {"prns": None if prns is None else list(prns)})
    return np.asarray(motion(World(scenario, 1)).u[0])


def equivalents(quick: bool) -> dict[str, xr.DataArray]:
    """Share lost (cn0_dbhz, run) of a channel alone, and of all channels together."""
    skies = {11: lines_of_sight(), 5: lines_of_sight(FIVE)}
    made = {}
    for states in (8, 11):
        made[f"scalar {states}"] = _over_levels(loop(None, states), quick)
        for n, u in skies.items():
            made[f"vector {states}, {n} satellites"] = _over_levels(loop(u, states), quick)
    return made


def _over_levels(of: Loop, quick: bool) -> xr.DataArray:
    trials = TRIALS // (4 if quick else 1)
    rng = np.random.default_rng(SEED)
    return xr.DataArray(
        [fly(of, x, trials, rng) for x in LEVELS], {"cn0_dbhz": list(LEVELS)}, ("cn0_dbhz", "run")
    )
