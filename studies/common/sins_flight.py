"""SINS/GNSS in closed loop, with GNSS anomalies in six windows: flight, sensors, filters.

Of Guo, Liu, Shi & Sun (ACEKF) the text survives, with the gyros, GNSS noise, start and duration;
its equations, tables and figures are lost.  Chosen here: the manoeuvres, the accelerometers, the
anomalies' sizes (T1, and the stronger BASE) and the first covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from signals.noise import generator
from ultratight.filters.catalog import RecipeFilter, make_filter
from ultratight.filters.gaussian import Gaussian, Measurement, Prediction
from ultratight.filters.ud import condition_ud, cov_ud, factor_ud, predict_ud
from ultratight.ins.imu import deg_per_h, deg_per_sqrt_h, ug
from ultratight.ins.local_level import (
    N_ERRORS,
    Navigation,
    Path,
    advance,
    correct,
    follow,
    radii,
    rotation_from_attitude,
)

RATE_HZ, DURATION_S, PER_STEP = 200, 1000, 20
START = np.array([np.radians(34.27), np.radians(108.95), 380.0])
TURNS = ((300, 1), (470, -1), (640, 1), (860, -1))
"""Start [s] and side (1: left) of turns by 90 deg in a minute, banked by 15 deg"""
GYRO_BIAS, ARW = deg_per_h(0.1), deg_per_sqrt_h(0.002)
ACCEL_BIAS, VRW = ug(100.0), ug(10.0)
SIGMA = np.array([0.5] * 3 + [10.0] * 3)
"""GNSS: velocity [m/s] and position [m]"""
FIRST_SIGMA = np.array([np.radians(0.02)] * 2 + [np.radians(0.05)] + [0.1] * 3 + [5.0] * 3
                       + [GYRO_BIAS] * 3 + [ACCEL_BIAS] * 3)  # fmt: skip
"""Of the 15 errors, positions in metres"""
WINDOWS = ((100, 150), (220, 280), (340, 400), (480, 540), (600, 700), (820, 880))
"""Anomalies after the first to the second time [s]; the first and the fourth are class A"""
LARGE = (0, 3)
SIZES = {
    "T1": ((30.0, 600.0), (2.0, 40.0), (1.5, 30.0), (40.0, 800.0), (3.0, 60.0), (1.5, 30.0)),
    "BASE": ((50.0, 1000.0), (5.0, 100.0), (2.0, 50.0), (50.0, 1000.0), (8.0, 150.0), (3.0, 60.0)),
    "none": ((0.0, 0.0),) * 6,
}
"""R.m.s. of the anomalies of velocity [m/s] and position [m] in each window"""
KINDS = ("white", "ar", "bias")
"""Independent each second; Gauss-Markov of 20 s; a constant of random sign"""
TAU_S = 20.0
EPOCHS = np.arange(1, DURATION_S + 1)


class World(NamedTuple):
    """One draw of everything random."""

    alpha: np.ndarray  # (200 000, 3) measured increments
    nu: np.ndarray
    first: np.ndarray  # (15,) errors at the start, positions in metres
    gnss: np.ndarray  # (1000, 6) GNSS - truth [m/s], [m]; NaN: no fix
    true_variance: np.ndarray  # (1000, 6) of it


class Flown(NamedTuple):
    """One filter's course, a row per second."""

    error: np.ndarray  # (1000, 6) east, north, up [m/s], latitude, longitude, height [m]
    sigma: np.ndarray  # (1000, 15)
    kind: np.ndarray  # (1000,) class, see `filters.classified`
    eta: np.ndarray  # (1000,)
    weight: np.ndarray  # (1000, 6) lambda


@dataclass(frozen=True)
class Aided:
    """A row of the catalogue with changes; ``true_R``: it is told the variance of every epoch."""

    row: str
    changes: Mapping[str, Any]
    true_R: bool = False

    def make(self) -> RecipeFilter:
        """For one run."""
        made = make_filter(self.row, **self.changes)
        assert isinstance(made, RecipeFilter)
        return made


@cache
def path() -> Path:
    """Take-off, climb, four turns and level cruise; every rate is constant piece by piece."""
    t = np.arange(RATE_HZ * DURATION_S + 1) / RATE_HZ
    speed = np.interp(t, [20, 80, 90, 190], [0.0, 60.0, 65.0, 105.0])
    pitch = np.interp(t, [80, 90, 190, 200], [0.0, 10.0, 10.0, 0.0])
    roll, yaw = np.zeros(t.size), np.zeros(t.size)
    for at, side in TURNS:
        roll -= side * np.interp(t, [at, at + 4, at + 64, at + 68], [0.0, 15.0, 15.0, 0.0])
        yaw += side * np.interp(t, [at + 4, at + 64], [0.0, 90.0])
    return follow(1.0 / RATE_HZ, np.radians(np.stack([pitch, roll, yaw], axis=1)), speed, START)


def anomalies(sizes: str, kind: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors (1000, 6) added to GNSS, and their variance."""
    if kind not in KINDS or sizes not in SIZES:
        raise ValueError(f"{sizes}, {kind}: expected one of {list(SIZES)} and one of {KINDS}")
    rng = generator(seed, "anomalies")
    added, variance = np.zeros((DURATION_S, 6)), np.zeros((DURATION_S, 6))
    keep = np.exp(-1.0 / TAU_S)
    for (begin, end), size in zip(WINDOWS, SIZES[sizes], strict=True):
        white, n = rng.standard_normal((end - begin, 6)), end - begin
        rms = np.repeat(size, 3)
        if kind == "ar":
            for k in range(1, n):
                white[k] = keep * white[k - 1] + np.sqrt(1.0 - keep**2) * white[k]
        elif kind == "bias":
            white = np.repeat(np.sign(white[:1]), n, axis=0)
        added[begin:end], variance[begin:end] = rms * white, rms**2
    return added, variance


def draw(seed: int, sizes: str = "T1", kind: str = "ar") -> World:
    """A world; worlds of one seed differ in the anomalies only."""
    true, shape = path(), (RATE_HZ * DURATION_S, 3)
    signs = np.sign(generator(seed, "biases").standard_normal((2, 3)))
    added, variance = anomalies(sizes, kind, seed)
    root = np.sqrt(true.dt_s)
    return World(
        true.alpha + signs[0] * GYRO_BIAS * true.dt_s
        + ARW * root * generator(seed, "gyros").standard_normal(shape),
        true.nu + signs[1] * ACCEL_BIAS * true.dt_s
        + VRW * root * generator(seed, "accelerometers").standard_normal(shape),
        FIRST_SIGMA * generator(seed, "start").standard_normal(N_ERRORS),
        SIGMA * generator(seed, "gnss").standard_normal((DURATION_S, 6)) + added,
        SIGMA**2 + variance,
    )  # fmt: skip


def in_metres(p: np.ndarray) -> np.ndarray:
    """Metres per unit of latitude, longitude and height."""
    RM, RN = radii(p[0], p[2])
    return np.array([RM, RN * np.cos(p[0]), 1.0])


def first_state(error: np.ndarray) -> Navigation:
    """The INS at take-off, with those of 15 errors that are not the sensors'."""
    true = path()
    state = Navigation(
        rotation_from_attitude(*true.attitude[0]), true.v[0].copy(), true.p[0].copy(), np.zeros(3),
        np.zeros(3),
    )  # fmt: skip
    wrong = np.concatenate([error[:6], error[6:9] / in_metres(true.p[0]), np.zeros(6)])
    correct(state, -wrong)  # C (I - phi) C_true, v + dv, p + dp
    return state


class _Direct:
    """z is the error itself."""

    def h(self, y: np.ndarray) -> np.ndarray:
        """(1, p, 6)."""
        return y

    def h_jacobian(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(1, 6), (1, 6, 6)."""
        return y, _ONE


_ONE = np.eye(6)[None]
_MODEL, _GNSS = _Direct(), np.zeros(1, np.int64)


def fly(world: World, aided: Aided) -> Flown:
    """1000 s of navigation and a fix each second, corrected in closed loop."""
    true, made = path(), aided.make()
    state = first_state(world.first)
    scale = np.ones(N_ERRORS)
    scale[6:9] = 1.0 / in_metres(true.p[0])
    cov = np.diag((FIRST_SIGMA * scale) ** 2)
    zero, R = np.zeros(N_ERRORS), np.diag(SIGMA**2)[None]
    out = Flown(*(np.zeros((DURATION_S, n)) for n in (6, N_ERRORS)), np.zeros(DURATION_S, int),
                np.zeros(DURATION_S), np.zeros((DURATION_S, 6)))  # fmt: skip
    A = np.zeros((1, 6, N_ERRORS))
    A[0, :3, 3:6] = np.eye(3)
    none = Measurement(np.zeros((0, 6)), A[:0], R[:0], _MODEL.h, _MODEL.h_jacobian, _GNSS[:0])
    for k in range(DURATION_S):
        part = slice(k * RATE_HZ, (k + 1) * RATE_HZ)
        Phi, Q = advance(
            state, world.alpha[part], world.nu[part], true.dt_s, (ARW**2, VRW**2), PER_STEP
        )
        at = (k + 1) * RATE_HZ
        metres = in_metres(state.p)
        v, p = state.v - true.v[at], (state.p - true.p[at]) * metres
        measurement = none
        if world.gnss[k, 0] == world.gnss[k, 0]:
            A[0, 3, 6], A[0, 4, 7], A[0, 5, 8] = metres
            z = np.concatenate([v, p]) - world.gnss[k]
            R_k = np.diag(world.true_variance[k])[None] if aided.true_R else R
            measurement = Measurement(z[None], A, R_k, _MODEL.h, _MODEL.h_jacobian, _GNSS)
        found = made.step(Gaussian(zero, cov), _prediction(Phi, Q), measurement)
        correct(state, found.mean)
        cov = found.cov
        out.error[k, :3] = state.v - true.v[at]
        out.error[k, 3:] = (state.p - true.p[at]) * metres
        out.sigma[k] = np.sqrt(np.diag(cov))
        if made.weights is not None and measurement is not none:
            out.kind[k], out.eta[k] = made.weights.kind[0], made.weights.eta[0]
            out.weight[k] = made.weights.weight[0]
    return out


def _prediction(Phi: np.ndarray, Q: np.ndarray) -> Prediction:
    """What a filter reads of an epoch; nothing else is there to read."""
    nothing = np.zeros(3)
    return Prediction(Phi, Q, 0.0, 0, 1.0, nothing, nothing, np.eye(3), None, 0)


def precision(scale: float) -> dict[str, float]:
    """Largest relative error of a standard deviation on the flight, R scaled, by form.

    The covariance alone, 10 Hz, a fix each second; against Joseph's form in double precision.
    """
    true, state = path(), first_state(np.zeros(N_ERRORS))
    metres = in_metres(true.p[0])
    first = np.diag((FIRST_SIGMA / np.concatenate([np.ones(6), metres, np.ones(6)])) ** 2)
    R, H = scale * np.diag(SIGMA**2), np.zeros((6, N_ERRORS))
    H[:3, 3:6] = np.eye(3)
    forms = {
        "Joseph, double": (_joseph, np.float64),
        "short, double": (_short, np.float64),
        "Joseph, single": (_joseph, np.float32),
        "short, single": (_short, np.float32),
    }
    P = {name: first.astype(kind) for name, (_, kind) in forms.items()}
    U = {name: factor_ud(first).astype(kind)
         for name, kind in (("UD, double", np.float64), ("UD, single", np.float32))}  # fmt: skip
    worst = dict.fromkeys([*forms, *U], 0.0)
    for k in range(0, len(true.alpha), PER_STEP):
        part = slice(k, k + PER_STEP)
        Phi, Q = advance(
            state, true.alpha[part], true.nu[part], true.dt_s, (ARW**2, VRW**2), PER_STEP
        )
        P = {name: f @ C @ f.T + Q.astype(C.dtype)
             for name, C in P.items() for f in [Phi.astype(C.dtype)]}  # fmt: skip
        U = {name: predict_ud(F, Phi, Q) for name, F in U.items()}
        if (k + PER_STEP) % RATE_HZ:
            continue
        H[[3, 4, 5], [6, 7, 8]] = in_metres(state.p)
        P = {name: forms[name][0](C, H.astype(C.dtype), R.astype(C.dtype)) for name, C in P.items()}
        for F in U.values():
            condition_ud(np.zeros(N_ERRORS, F.dtype), F, np.zeros(6, F.dtype), H.astype(F.dtype),
                         np.diag(R).astype(F.dtype)[:, None, None])  # fmt: skip
        variances = {name: np.diag(C).astype(float) for name, C in P.items()}
        variances |= {name: np.diag(cov_ud(F.astype(float))) for name, F in U.items()}
        sigma = np.sqrt(variances["Joseph, double"])
        for name, variance in variances.items():
            off = np.abs(np.sqrt(np.maximum(variance, 0.0)) / sigma - 1.0).max()
            worst[name] = max(worst[name], float(off))
    return worst


def _joseph(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    left = np.eye(len(P), dtype=P.dtype) - K @ H
    return left @ P @ left.T + K @ R @ K.T


def _short(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    P = P - K @ H @ P
    return (P + P.T) / P.dtype.type(2.0)
