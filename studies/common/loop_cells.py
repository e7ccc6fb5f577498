"""What the study `loop_theory` flies: loops, their theory, and the figures of one flight."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from common.loop_bench import NODE_S, WAVELENGTH_M, Flight, falling, fly, pulse
from signals.codes import GPS_L1CA
from ultratight.tracking import loop_theory as theory
from ultratight.tracking import noisy_phase as noisy
from ultratight.tracking.channel_state import (
    BIT_S,
    FREQUENCY_LOST_BELOW,
    HALF_BIT_S,
    LOCK_GAIN,
    PHASE_LOST_BELOW,
)
from ultratight.tracking.loop_filters import frequency_loop, phase_loop
from ultratight.tracking.scalar import ScalarSettings

LEVELS = (20.0, 25.0, 30.0, 35.0, 40.0, 45.0, 50.0)
STRESSED = 6
"""Channels that measure it"""
CLEAR_DB, LEAST_SLOPE = 6.0, 0.98
"""Linear theory is held to its word so far above the threshold, and where noise has taken at most
2 % of the discriminator's slope"""
LOSS, LOSS_S = 0.1, 10.0
"""The threshold: that share of the channels is lost in that time"""
DURATION_S, MEASURED_FROM_S, LOSS_UNTIL_S, JERK_S = 14.0, 5.5, 13.5, (5.0, 11.0)
STRESS_DBHZ, STRESS_CYCLES = 65.0, 0.5 * theory.COSTAS_LIMIT_CYCLES
STRESS_HZ, MIDDLE_S = 5.0, 8.0
"""Of an FLL: the Doppler's rate passes through zero in the middle of what is measured, so that a
frequency held for a while is late by nothing in the mean"""
LATE_S = 0.0005
"""A command acts half an epoch late on average: the loops are designed for it"""


class Loop(NamedTuple):
    """What is flown: settings, code spacing, and what the carrier loop is in theory."""

    settings: ScalarSettings
    spacing_chips: float = 0.25

    @property
    def fll(self) -> bool:
        """No phase loop at all."""
        return self.settings.carrier_loop == "fll"

    @property
    def costas(self) -> bool:
        """Blind to data bits."""
        return self.settings.carrier_discriminator != "atan2"

    @property
    def order(self) -> int:
        """Of the derivative, of the phase or of an FLL the frequency, that leaves an error."""
        s = self.settings
        if not self.fll:
            return s.pll_order
        return s.pll_order - 1 if s.fll_order is None else s.fll_order

    @property
    def w(self) -> float:
        """Natural frequency of the carrier loop [rad/s]."""
        s = self.settings
        if self.fll:
            return frequency_loop(self.order, s.fll_bandwidth_hz, BIT_S, LATE_S)[0]
        return phase_loop(s.pll_order, s.bandwidth_hz, s.integration_s, LATE_S)[0]

    @property
    def noise_bandwidth_hz(self) -> float:
        """Bn of the carrier loop."""
        return self.settings.fll_bandwidth_hz if self.fll else self.settings.bandwidth_hz

    def carrier_sigma(self, cn0: float) -> float:
        """Thermal jitter in theory [cycles, or Hz of an FLL]."""
        s = self.settings
        if self.fll:
            return theory.fll_jitter_hz(s.fll_bandwidth_hz, 0.01, cn0, own=True)
        return theory.pll_jitter_cycles(s.bandwidth_hz, s.integration_s, cn0, self.costas)

    def code_sigma(self, cn0: float, prn: int) -> float:
        """Thermal jitter in theory [chips]."""
        s, of = self.settings, theory.flank_of_code(GPS_L1CA, prn, self.spacing_chips)
        return theory.dll_jitter_chips(
            s.code_discriminator, of, s.dll_bandwidth_hz, s.integration_s, cn0
        )

    def threshold(self, stress: float = 0.0) -> float:
        """By the rule of 3 sigma [dB-Hz]; stress in cycles."""
        s = self.settings
        if self.fll:
            return theory.fll_threshold_dbhz(s.fll_bandwidth_hz, 0.01)
        return theory.pll_threshold_dbhz(s.bandwidth_hz, s.integration_s, self.costas, stress)

    def slope(self, cn0: float) -> float:
        """Of the carrier's discriminator in noise."""
        length_s = 0.01 if self.fll else self.settings.integration_s
        a2 = 2.0 * length_s * theory.ratio_hz(cn0)
        kind = "atan" if self.costas and not self.fll else "atan2"
        return float(noisy.mean_phase_error(kind, np.array(1e-3), a2)) / 1e-3

    def indicator_threshold(self) -> float:
        """Below, noise alone makes the closure's lock indicator declare a loss [dB-Hz]."""
        looks = LOSS_S * LOCK_GAIN / BIT_S
        if self.fll:
            return noisy.indicator_threshold_dbhz(
                lambda cn0: noisy.frequency_indicator(cn0, HALF_BIT_S), FREQUENCY_LOST_BELOW,
                LOCK_GAIN, looks, LOSS,
            )  # fmt: skip
        return noisy.indicator_threshold_dbhz(
            lambda cn0: noisy.phase_indicator(cn0, BIT_S, self.carrier_sigma(cn0)),
            PHASE_LOST_BELOW, LOCK_GAIN, looks, LOSS,
        )  # fmt: skip


S = ScalarSettings
LOOPS = {
    "PLL3 18 Hz 5 ms": Loop(S(0.005, 18.0, dll_bandwidth_hz=4.0)),
    "PLL3 15 Hz 1 ms": Loop(S(0.001, 15.0, dll_bandwidth_hz=4.0), 0.5),
    "PLL2 10 Hz 10 ms": Loop(
        S(0.01, 10.0, dll_bandwidth_hz=4.0, pll_order=2, code_discriminator="envelope"), 0.1
    ),
    "PLL3 5 Hz 20 ms": Loop(S(0.02, 5.0, dll_bandwidth_hz=2.0, code_discriminator="power"), 0.1),
    "pilot 10 Hz 20 ms": Loop(
        S(0.02, 10.0, dll_bandwidth_hz=2.0, carrier_discriminator="atan2",
          code_discriminator="coherent")
    ),
    "FLL 2 Hz 10 ms": Loop(S(0.02, fll_bandwidth_hz=2.0, dll_bandwidth_hz=2.0, carrier_loop="fll")),
}  # fmt: skip
"""Order, noise bandwidth, integration time (of an FLL: of each of its two prompts)"""


class Flown(NamedTuple):
    """A flight in figures; the first axis of each is that of the channels (run)."""

    carrier: np.ndarray  # (run, level) mean square of the carrier's error over theory's variance
    code: np.ndarray  # (run, level) of the code's
    around: np.ndarray  # (level_around,) C/N0 around the threshold [dB-Hz]
    lost: np.ndarray  # (run, level_around) share lost within ten seconds
    around_stress: np.ndarray  # (level_stress,)
    lost_stress: np.ndarray  # (run, level_stress)
    stress: np.ndarray  # (run,) error under a constant derivative over j / w^n


def fly_loop(loop: Loop, runs: int, seed: int) -> Flown:
    """All groups of channels of one loop in one flight."""
    middle = round(max(loop.threshold(), loop.indicator_threshold()))
    around = np.arange(middle - 3.0, middle + 6.0)
    half = STRESS_CYCLES
    stressed = (
        np.arange(0.0)
        if loop.fll
        else np.arange(-4.0, 6.0) + round(max(loop.threshold(half), loop.indicator_threshold()))
    )
    n_stress = max(runs // 2, 1)
    groups = [np.array(LEVELS), around, stressed]
    cn0 = np.concatenate([
        np.repeat(groups[0], runs), np.repeat(groups[1], runs), np.repeat(groups[2], n_stress),
        np.full(STRESSED, STRESS_DBHZ),
    ])  # fmt: skip
    acceleration = np.zeros((cn0.size, round(DURATION_S / NODE_S) + 1))
    acceleration[runs * (len(LEVELS) + around.size) :] = _motion(loop)
    f = fly(
        loop.settings, falling(cn0, DURATION_S), DURATION_S, spacing_chips=loop.spacing_chips,
        acceleration=acceleration, seed=seed,
    )  # fmt: skip
    lost = (f.first_lost_s < LOSS_UNTIL_S).astype(float)
    ends = np.cumsum([runs * len(LEVELS), runs * around.size, n_stress * stressed.size])
    return Flown(
        *jitter(loop, f, runs),
        around, lost[ends[0] : ends[1]].reshape(around.size, runs).T,
        stressed, lost[ends[1] : ends[2]].reshape(stressed.size, n_stress).T,
        _stress(loop, f, ends[2]),
    )  # fmt: skip


def jitter(loop: Loop, f: Flight, runs: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean squares over theory's variances (run, level), NaN where lock was lost."""
    n = runs * len(LEVELS)
    settled, held = f.t_s > MEASURED_FROM_S, f.held(MEASURED_FROM_S)[:n]
    turn = 0.5 if loop.costas else 1.0
    error = f.hz[settled, :n] if loop.fll else f.carrier_cycles[settled, :n]
    if not loop.fll:
        error = error - turn * np.round(error / turn)
    levels = np.repeat(LEVELS, runs)
    prn = 1 + np.arange(n) % 32
    carrier = np.array([loop.carrier_sigma(x) for x in levels])
    code = np.array([loop.code_sigma(x, int(p)) for x, p in zip(levels, prn, strict=True)])
    # satellites accelerate: a mean error is no jitter; it takes 1 / (2 Bn T) of the variance along
    s = loop.settings
    looks = 2.0 * (s.fll_bandwidth_hz if loop.fll else s.bandwidth_hz) * settled.sum() * 0.005
    own = error.var(axis=0) / (1.0 - 1.0 / looks) / carrier**2
    others = (f.chips[settled, :n] ** 2).mean(axis=0) / code**2
    squares = [np.where(held, x, np.nan).reshape(len(LEVELS), runs).T for x in (own, others)]
    return squares[0], squares[1]


def _motion(loop: Loop) -> np.ndarray:
    """Acceleration (n_node,) of a range that shrinks, so that the error is positive."""
    order = loop.order
    size = -(STRESS_HZ if loop.fll else STRESS_CYCLES) * loop.w**order * WAVELENGTH_M
    if loop.fll:
        ramp = pulse(size, JERK_S[0], DURATION_S, DURATION_S)
        return np.where(ramp != 0.0, ramp - size * (MIDDLE_S - JERK_S[0]), 0.0)
    if order == 3:
        return pulse(size, *JERK_S, DURATION_S)
    return pulse(size / NODE_S, JERK_S[0], NODE_S, DURATION_S)  # a step, as good as one at 5 ms


def _stress(loop: Loop, f: Flight, first: int) -> np.ndarray:
    """Mean error under the constant derivative, when it has settled, over theory."""
    until = MIDDLE_S + 1.0 if loop.fll else JERK_S[1]
    late = (f.t_s > until - (2.0 if loop.fll else 1.0)) & (f.t_s < until)
    if loop.fll:
        return np.asarray(f.hz[late, first:].mean(axis=0) / STRESS_HZ)
    error = f.carrier_cycles[late, first:]
    turn = 0.5 if loop.costas else 1.0
    before = f.carrier_cycles[(f.t_s > JERK_S[0] - 0.5) & (f.t_s < JERK_S[0]), first:].mean(axis=0)
    return np.asarray((error - turn * np.round(before / turn)).mean(axis=0) / STRESS_CYCLES)
