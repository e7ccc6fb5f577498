"""SINS/CNS on a ballistic missile after Fan, Zhao, Li, Tang & He: flight, sensors, bank, filters.

Printed: 1000 s, 100 000 samples, gyro drift of 1 deg/h, 0.5 deg/h and 50e-6 g_0 as noise of gyros
and accelerometers, half of that for 500 s and twice as much then, a misalignment of (10, 6, 10) in
pitch, heading and roll, ten models.  Not printed, or not legible, and chosen here: the vehicle, the
star tracker's noise and rate, the unit of the misalignment, how a noise in deg/h becomes Q, the
range of the bank, P_0.

Corrected: in (4) the sum is over models, each after its update; (5) lacks the models' own P; (14)
has thrust and drag exchanged, (15) theta_k in its denominator, (16) and (17) the force wrong, (18)
sin psi for cos psi, (19) signs; the blocks of Q in (23) are of three, not two.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from signals.noise import generator
from ultratight.filters.gaussian import Gaussian
from ultratight.filters.multiple_model import hammersley
from ultratight.ins.ballistic_missile import SURFACE_GRAVITY, Flight, Missile, fly, turned
from ultratight.ins.imu import deg_per_h
from ultratight.ins.star_tracker import (
    N_ERRORS,
    angles_of,
    difference,
    run_free,
    turn_between,
    turned_by,
    wrapped,
)
from ultratight.tracking.star_fixes import BY_FLOOR, StarRun, Weighing, run_star_fixes

RATE_HZ, DURATION_S, SWITCH_S = 100, 1000, 500
ARCSEC = np.radians(1.0 / 3600.0)
UNITS = {"arcmin": np.radians(1.0 / 60.0), "deg": np.radians(1.0)}
"""Of the misalignment, whose mark in Table 1 may be either"""
MISALIGNED = np.array([10.0, 6.0, 10.0])
"""Roll, heading, pitch"""
MISSILE = Missile(30_000.0, 185.0, 2755.0, 0.25, 140.0)
SWAY = (np.radians([2.0, 1.0]), np.array([150.0, 200.0]))
"""Amplitudes [rad] and periods [s] of roll and heading, so that no angle stays as it was"""
GYRO_BIAS = deg_per_h(1.0) * np.array([1.0, -1.0, 1.0])
WGT0, WGA0 = deg_per_h(0.5), 50e-6 * SURFACE_GRAVITY
"""[rad/s], [m/s2]; printed as 2.4241e-06 and 4.8902e-04"""
SCALES = (0.5, 2.0)
"""Of both noises in the truth, before and after the switch"""
ACCEL_TAU_S = 300.0
PER_SAMPLE = {"literal": 1.0, "psd": 0.1, "rate": 0.01}
"""Noise of an increment of 10 ms [s], in units of the gyros': Q as printed (no time in it), as a
density, as a rate that is new each sample"""


@dataclass(frozen=True)
class Setting:
    """What the paper leaves open."""

    unit: str = "arcmin"
    mode: str = "literal"  # of `PER_SAMPLE`
    star_hz: int = 10
    star_arcsec: float = 10.0

    @property
    def per_fix(self) -> int:
        """Increments between two fixes."""
        return RATE_HZ // self.star_hz

    @property
    def gyro_noise(self) -> float:
        """Of an increment, scale 1 [rad]."""
        return WGT0 * PER_SAMPLE[self.mode]

    @property
    def t_s(self) -> np.ndarray:
        """Instants of the start and of all fixes."""
        return np.arange(DURATION_S * self.star_hz + 1) / self.star_hz


@dataclass(frozen=True, eq=False)
class Aided:
    """A filter, by its models' scales of both noises (nh, 2); none: as the truth has it."""

    rule: str
    scales: np.ndarray | None
    weighing: Weighing = BY_FLOOR
    passes: int = 1
    star_arcsec: float | None = None  # what it believes of the tracker; none: the truth


class World(NamedTuple):
    """One draw: true attitude, the INS's and what the star tracker shows, at the fixes."""

    setting: Setting
    C_true: np.ndarray  # (n + 1, 3, 3)
    C_ins: np.ndarray  # (n + 1, 3, 3)
    z: np.ndarray  # (n, 3) [rad]


class Flown(NamedTuple):
    """A filter's course at the start and at all fixes; angles are roll, heading, pitch."""

    angle: np.ndarray  # (n + 1, 3) estimate - truth [rad]
    turn: np.ndarray  # (n + 1, 3) the same as a rotation vector in axes i
    run: StarRun
    scale: np.ndarray  # (n,) weighted mean of the models' scale of the gyros, (6)


def bank(n: int = 10, low: float = 0.25, high: float = 2.5) -> np.ndarray:
    """(n, 2) scales of gyro and accelerometer noise, a Hammersley set."""
    return low + (high - low) * hammersley(n)


@cache
def flight() -> Flight:
    """The missile's, at 100 Hz."""
    return fly(MISSILE, DURATION_S, 1.0 / RATE_HZ)


@cache
def attitude() -> tuple[np.ndarray, np.ndarray]:
    """True C_b_i at 100 Hz and the increments between."""
    flown = flight()
    sway = SWAY[0] * np.sin(2.0 * np.pi * flown.t_s[:, None] / SWAY[1])
    return turned(np.column_stack([sway, flown.pitch]))


def draw(seed: int, setting: Setting = Setting()) -> World:
    """A world; worlds of one seed share the unit noises."""
    C, alpha = attitude()
    s = np.where(np.arange(len(alpha)) < SWITCH_S * RATE_HZ, *SCALES)[:, None]
    measured = (
        alpha
        + GYRO_BIAS / RATE_HZ
        + s * setting.gyro_noise * generator(seed, "gyros").standard_normal(alpha.shape)
    )
    first = angles_of(C[:1])[0] + UNITS[setting.unit] * MISALIGNED
    C_ins = run_free(turned(np.stack([first, first]))[0][0], measured, setting.per_fix)
    true = C[:: setting.per_fix]
    noise = generator(seed, "star").standard_normal((len(alpha), 3))[setting.per_fix - 1 ::
                                                                    setting.per_fix]  # fmt: skip
    seen = turned_by(setting.star_arcsec * ARCSEC * noise, true[1:])
    return World(setting, true, C_ins, difference(C_ins[1:], seen))


def estimate(world: World, aided: Aided) -> Flown:
    """One filter's flight."""
    setting, n = world.setting, len(world.z)
    tau = 1.0 / setting.star_hz
    if aided.scales is None:
        s = np.where(np.arange(n) * tau < SWITCH_S, *SCALES)[:, None, None] * np.ones(2)
    else:
        s = np.asarray(aided.scales, float)[None]
    Q = np.zeros((*s.shape[:2], N_ERRORS))
    Q[..., :3] = (s[..., :1] * setting.gyro_noise) ** 2 * setting.per_fix
    Q[..., 6:] = (s[..., 1:] * WGA0) ** 2 * -np.expm1(-2.0 * tau / ACCEL_TAU_S)
    sigma = [10.0 * UNITS[setting.unit]] * 3 + [deg_per_h(1.5)] * 3 + [1e-4 * SURFACE_GRAVITY] * 3
    start = Gaussian(np.zeros(N_ERRORS), np.diag(np.square(sigma)))
    believed = setting.star_arcsec if aided.star_arcsec is None else aided.star_arcsec
    run = run_star_fixes(
        start, world.C_ins, world.z, tau, Q, (believed * ARCSEC) ** 2 * np.eye(3), aided.rule,
        accel_tau_s=ACCEL_TAU_S, weighing=aided.weighing, passes=aided.passes,
    )  # fmt: skip
    phi = np.concatenate([np.zeros((1, 3)), run.mean[:, :3]])
    C = turned_by(phi, world.C_ins)
    angle = wrapped(angles_of(C) - angles_of(world.C_true))
    used = s[:, :, 0] if len(s) > 1 else s[0, :, 0]
    return Flown(angle, turn_between(C, world.C_true), run, (run.weight * used).sum(axis=1))
