"""Vibration on top of a motion: what an engine does to the structure, the same in every run.

Each stretch is a sum of sines with a flat spectrum of acceleration from ``from_hz`` to ``to_hz``,
one at a random place in each of 16 equal parts of the band, with phases of their own along north,
east and down at the start:

    d(t) = e(t) sum_k A_k sin(2 pi f_k (t - t0) + phi_k),     A_k = sqrt(2 / 16) a / (2 pi f_k)^2

with the r.m.s. acceleration a per axis, and e a smooth rise from 0 to 1 and fall, 0.25 s each.
Displacement, velocity and acceleration are exact derivatives of each other, so that carrier phase
and inertial increments agree.  The three axes are alike, hence it does not matter that they are not
the body's; the attitude does not vibrate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from signals.constants import STANDARD_GRAVITY
from ultratight.ins.trajectory import Motion, RigidMotion, Side

LINES = 16
RISE_S = 0.25


@dataclass(frozen=True)
class Vibration:
    """Flat random vibration from t0_s to t1_s [s]: r.m.s. per axis [g], band [Hz]."""

    t0_s: float
    t1_s: float
    rms_g: float
    from_hz: float
    to_hz: float

    def __post_init__(self) -> None:
        if not all(math.isfinite(x) for x in vars(self).values()):
            raise ValueError(f"{self}: every value must be finite")
        if not self.t1_s - self.t0_s >= 2.0 * RISE_S:
            raise ValueError(f"{self}: expected t1_s >= t0_s + {2.0 * RISE_S:g} s")
        if not 0.0 < self.from_hz < self.to_hz:
            raise ValueError(f"{self}: expected 0 < from_hz < to_hz")
        if self.rms_g < 0.0:
            raise ValueError(f"{self}: expected rms_g >= 0")


class Vibrating(RigidMotion):
    """A motion that is shaken; ``stretches`` may overlap, each has phases of its own."""

    def __init__(self, base: RigidMotion, stretches: Sequence[Vibration]) -> None:
        self.base, self.stretches = base, tuple(stretches)
        self.C_n_e, self.first_jump_s = base.C_n_e, base.first_jump_s
        self.breakpoints_s = base.breakpoints_s

    def at(self, t: ArrayLike, side: Side = "right") -> Motion:
        """Motion at times t (...) [s]; at a jump the limit from the given side."""
        t = np.asarray(t, float)
        moved = np.zeros((3, t.size, 3))
        for k, stretch in enumerate(self.stretches):
            _add(stretch, k, np.ravel(t), moved)
        d, rate, second = (x.reshape(*t.shape, 3) @ self.C_n_e.T for x in moved)
        m = self.base.at(t, side)
        return m._replace(r_eb_e=m.r_eb_e + d, v_eb_e=m.v_eb_e + rate, a_eb_e=m.a_eb_e + second)


def _add(v: Vibration, number: int, t: np.ndarray, moved: np.ndarray) -> None:
    """Add displacement, velocity and acceleration (3, n, 3) of a stretch at times t (n,)."""
    inside = np.flatnonzero((t > v.t0_s) & (t < v.t1_s))
    if not inside.size:
        return
    t = t[inside]
    rng = np.random.default_rng(number)
    band = (v.to_hz - v.from_hz) / LINES
    w = 2.0 * np.pi * (v.from_hz + band * (np.arange(LINES) + rng.random(LINES)))
    phase = 2.0 * np.pi * rng.random((LINES, 3))
    size = math.sqrt(2.0 / LINES) * v.rms_g * STANDARD_GRAVITY / w**2
    angle = (t - v.t0_s)[:, None] * w
    s, c = np.sin(angle), np.cos(angle)
    in_phase, across = size[:, None] * np.cos(phase), size[:, None] * np.sin(phase)
    x = s @ in_phase + c @ across
    x1 = (c * w) @ in_phase - (s * w) @ across
    x2 = -((s * w**2) @ in_phase + (c * w**2) @ across)
    e, e1, e2 = (y[:, None] for y in _envelope(t, v))
    moved[0, inside] += e * x
    moved[1, inside] += e * x1 + e1 * x
    moved[2, inside] += e * x2 + 2.0 * e1 * x1 + e2 * x


def _envelope(t: np.ndarray, v: Vibration) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rise and fall (n,) by 10 u^3 - 15 u^4 + 6 u^5, and two derivatives."""
    from_end = np.minimum(t - v.t0_s, v.t1_s - t)
    u = np.clip(from_end / RISE_S, 0.0, 1.0)
    sign = np.where(t - v.t0_s <= v.t1_s - t, 1.0, -1.0)
    e1 = sign / RISE_S * 30.0 * u**2 * (1.0 - u) ** 2
    e2 = 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / RISE_S**2
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2), e1, e2
