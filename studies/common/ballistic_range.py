"""Ballistic range data after Duan, Gong, Xu & Zhao, as far as they are printed.

A vehicle is measured in two coordinates every 50 ms for 100 s and followed by a filter of constant
acceleration.  Printed: x0 = y0 = 0, vx0 = 1000 m/s, vy0 = 0, the same acceleration in x and y,
Q = 10 I, bursts of five outliers of -200 m every 10 s, 50 runs.  Not printed, or lost: the
acceleration, the noise and its steps, P_0 and R_0.  Those chosen here make Q = 10 I the best power
of ten for noises of 15 and 60 m; a gentler motion would reverse some of the claims.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from signals.noise import generator
from ultratight.filters.adaptive import SageHusa
from ultratight.filters.gaussian import Gaussian
from ultratight.filters.linear import FIXED, LinearRun, run_linear
from ultratight.filters.robust import Ishakf

DT, N_EPOCH = 0.05, 2000
K = np.arange(1, N_EPOCH + 1)
T = DT * K
"""Time of each measurement [s]"""
STEPS_S = (20.0, 40.0, 60.0, 80.0)
NOMINAL, LOW = (20.0, 60.0, 15.0, 60.0, 20.0), (5.0, 20.0, 2.0, 20.0, 5.0)
"""Noise between the steps [m]"""
BURSTS_S = np.arange(5.0, 100.0, 10.0)
SETTLED = T > 5.0


def sinusoidal() -> np.ndarray:
    """Positions (2000, 2) [m] by an acceleration of 30 sin(t / 2) m/s2 in x and in y."""
    swing = 60.0 * T - 120.0 * np.sin(0.5 * T)
    return np.column_stack([1000.0 * T + swing, swing])


def stepped(levels: Iterable[float], at_s: Iterable[float] = STEPS_S) -> np.ndarray:
    """Noise (2000,) [m] that changes its level at these times."""
    edges = np.round(np.array(list(at_s)) / DT)
    return np.array(list(levels))[np.searchsorted(edges, K, side="right")]


def outliers(starts_s: Iterable[float] = BURSTS_S, length: int = 5) -> np.ndarray:
    """Offsets (2000,) [m] of both coordinates: -200 m on ``length`` measurements from each time."""
    out = np.zeros(N_EPOCH)
    for start in starts_s:
        first = round(start / DT) - 1
        out[first : first + length] = -200.0
    return out


@dataclass(frozen=True, eq=False)
class Cell:
    """A filter and what it meets.  ``noise``: None for a fixed R; ``known``: R as it really is."""

    noise: SageHusa | Ishakf | None
    sigma: np.ndarray = field(default_factory=lambda: stepped(NOMINAL))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(N_EPOCH))
    R0_m: float = 50.0
    q: float = 10.0
    axes: int = 2
    known: bool = False


def matrices(axes: int) -> tuple[np.ndarray, np.ndarray]:
    """Phi (1, 3 axes, 3 axes) and H (axes, 3 axes); position, velocity, acceleration per axis."""
    one = np.array([[1.0, DT, 0.5 * DT**2], [0.0, 1.0, DT], [0.0, 0.0, 1.0]])
    return np.kron(np.eye(axes), one)[None], np.kron(np.eye(axes), [1.0, 0.0, 0.0])


def fly(cell: Cell, seed: int) -> tuple[np.ndarray, LinearRun]:
    """Position errors (2000, axes) [m], truth - estimate, and the run."""
    Phi, H = matrices(cell.axes)
    n, truth = 3 * cell.axes, sinusoidal()[:, : cell.axes]
    unit = generator(seed, "range").standard_normal((N_EPOCH, 2))[:, : cell.axes]
    z = truth + cell.sigma[:, None] * unit + cell.offset[:, None]
    start = Gaussian(np.array([0.0, 1000.0, 0.0] + [0.0] * (n - 3)), 100.0 * np.eye(n))
    Q, noise = cell.q * np.eye(n), cell.noise or FIXED
    if not cell.known:
        run = run_linear(start, Phi, Q, H, cell.R0_m**2 * np.eye(cell.axes), z, noise)
        return truth - run.mean @ H.T, run
    errors = []
    edges = np.flatnonzero(np.diff(cell.sigma)) + 1
    for rows in np.split(np.arange(N_EPOCH), edges):
        R = cell.sigma[rows[0]] ** 2 * np.eye(cell.axes)
        run = run_linear(start, Phi, Q, H, R, z[rows])
        start = run.last
        errors.append(truth[rows] - run.mean @ H.T)
    return np.concatenate(errors), run


@dataclass(frozen=True)
class Flown:
    """All runs of a cell."""

    error: np.ndarray  # (run, 2000, axes) [m]
    sigma: np.ndarray  # (run, 2000) root of the mean variance in R^, NaN below 0 [m]
    indefinite: np.ndarray  # (run,) epochs whose R^ is not positive definite
    held: np.ndarray  # (run,) epochs at which R^ did not change


def fly_all(cell: Cell, seeds: Iterable[int]) -> Flown:
    """A cell over the flights of these seeds."""
    errors, runs = zip(*(fly(cell, seed) for seed in seeds), strict=True)
    error = np.array(errors, dtype=np.float32)
    if cell.known:
        sigma = np.tile(cell.sigma.astype(np.float32), (len(errors), 1))
        return Flown(error, sigma, *[np.zeros(len(errors))] * 2)
    R = np.array([run.R_epoch for run in runs])
    least = np.linalg.eigvalsh(np.nan_to_num(R, nan=-1.0))[..., 0]
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.trace(R, axis1=2, axis2=3) / cell.axes).astype(np.float32)
    held = np.all(np.diff(R, axis=1) == 0.0, axis=(2, 3)).sum(axis=1)
    return Flown(error, sigma, (least <= 0.0).sum(axis=1), held)


# -- figures of merit -----------------------------------------------------------------------------


def between(first_s: float, last_s: float) -> np.ndarray:
    """Mask (2000,) of first_s < t <= last_s."""
    return (first_s < T) & (last_s >= T)


def rms(error: np.ndarray, when: np.ndarray = SETTLED) -> np.ndarray:
    """Per run (run,), over coordinates and the chosen epochs [m]."""
    chosen = error[:, when].astype(float)
    return np.sqrt(np.mean(np.where(np.isfinite(chosen), chosen, np.inf) ** 2.0, axis=(1, 2)))


def segment_sigmas(sigma: np.ndarray) -> np.ndarray:
    """Mean sigma^ (5,) between the steps, without the first 5 s after each."""
    ends = (0.0, *STEPS_S, T[-1])
    windows = zip(ends[:-1], ends[1:], strict=True)
    return np.array([sigma[:, between(a + 5.0, b)].mean(dtype=float) for a, b in windows])


def jitter(sigma: np.ndarray) -> float:
    """Standard deviation of sigma^ over the runs by its mean, of the settled epochs."""
    when = np.zeros(N_EPOCH, dtype=bool)
    ends = (0.0, *STEPS_S, T[-1])
    for a, b in zip(ends[:-1], ends[1:], strict=True):
        when |= between(a + 5.0, b)
    return float(np.mean(sigma.std(axis=0)[when] / sigma.mean(axis=0)[when]))


def response(sigma: np.ndarray, levels: tuple[float, ...] = NOMINAL) -> np.ndarray:
    """Time (..., 4) [s] until sigma^ (..., 2000) has made 80 % of each step; inf: never."""
    out = np.full((*sigma.shape[:-1], len(STEPS_S)), np.inf)
    ends = (*STEPS_S, T[-1])
    for j, step in enumerate(STEPS_S):
        share = (sigma - levels[j]) / (levels[j + 1] - levels[j])
        when = between(step - DT / 2, ends[j + 1] - DT)
        done = share[..., when] >= 0.8
        first = np.argmax(done, axis=-1)
        out[..., j] = np.where(done.any(axis=-1), DT * (first + 1), np.inf)
    return out


def peaks(error: np.ndarray, starts_s: Iterable[float] = BURSTS_S, s: float = 2.0) -> np.ndarray:
    """Largest |error| (run, burst) [m] of either coordinate within s seconds of each start."""
    size = np.abs(error).max(axis=2)
    return np.stack([size[:, between(t - DT / 2, t + s)].max(axis=1) for t in starts_s], axis=1)
