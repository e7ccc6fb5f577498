"""Channel loops as closed forms, and what all closed forms of closures look at and give."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from signals.clock import Oscillator
from ultratight.ins.error_state import ProcessNoise
from ultratight.predicted_motion import Motion, Sight, largest_slope, largest_step, stress
from ultratight.tracking import loop_theory as theory
from ultratight.tracking import noisy_phase as noisy
from ultratight.tracking.channel_state import (
    BIT_S,
    CN0_LOST_BELOW_DBHZ,
    FREQUENCY_LOST_BELOW,
    HALF_BIT_S,
    LOCK_GAIN,
    PHASE_LOST_BELOW,
    WAVELENGTH_M,
)
from ultratight.tracking.kalman_loop import densities
from ultratight.tracking.loop_filters import frequency_loop, phase_loop
from ultratight.tracking.scalar import EPOCH_S
from ultratight.tracking.steady_filters import kalman_loop_filter, peak_response, sigma
from ultratight.world import World

LOSS = 0.1
"""The threshold: that share of the channels is lost in a run"""
LATE_S = 0.5 * EPOCH_S
LOOP_RESPONSE_S = 1.0
"""So long the largest error after a step is looked for"""
LOWEST_DBHZ = -20.0


class Errors(NamedTuple):
    """What a closure makes of its channels, (n,) each, at a C/N0 for each of them."""

    phase_cycles: np.ndarray | None
    doppler_hz: np.ndarray
    code_chips: np.ndarray
    three_sigma: np.ndarray  # of the quantity that is limited
    stress: np.ndarray  # in the same unit


class Closure(NamedTuple):
    """How channels are lost: by what is limited, or by an indicator that says so."""

    errors: Callable[[np.ndarray], Errors]
    limit: np.ndarray  # (n,) cycles or Hz
    unit: str  # of stresses as they are shown: deg or Hz
    display: float  # deg per cycle, or 1
    indicator_dbhz: np.ndarray  # (n,) below, the indicator declares a loss


class Facts(NamedTuple):
    """What all closures look at."""

    world: World
    m: Motion
    flanks: list[theory.Flank]
    clock: Oscillator
    noise: ProcessNoise

    @property
    def n(self) -> int:
        """Channels."""
        return len(self.flanks)

    @property
    def duration_s(self) -> float:
        """Of the run."""
        return self.world.scenario.duration_s


def _looped(of: Callable[[float], float], cn0: np.ndarray) -> np.ndarray:
    return np.array([of(max(x, LOWEST_DBHZ)) for x in cn0.tolist()])


# -- loops of channels ---------------------------------------------------------------------------


def channel_loops(of: Facts, felt: Sight) -> Closure:
    """Scalar, with INS aiding or without."""
    r = of.world.scenario.receiver
    if r.carrier_loop == "fll":
        return _frequency_loops(of, felt)
    costas = r.carrier_discriminator != "atan2"
    if r.loop == "kalman":
        errors = _kalman_loops(of, felt, costas)
    else:
        w, _ = phase_loop(r.pll_order, r.bandwidth_hz, r.integration_s, LATE_S)
        other = theory.oscillator_jitter_cycles(of.clock, r.pll_order, w, r.integration_s)
        moved = stress(r.pll_order, w, of.m, felt) / WAVELENGTH_M
        # Hz of Doppler for a cycle of thermal jitter
        slope = theory.doppler_jitter_hz(r.pll_order, w, r.integration_s, r.bandwidth_hz, 1.0)

        def errors(cn0: np.ndarray) -> Errors:
            thermal = _looped(
                lambda x: theory.pll_jitter_cycles(r.bandwidth_hz, r.integration_s, x, costas), cn0
            )
            phase = np.hypot(thermal, other)
            return Errors(phase, slope * thermal, _code_loops(of, cn0), 3.0 * phase, moved)

    limit = theory.COSTAS_LIMIT_CYCLES if costas else theory.PILOT_LIMIT_CYCLES

    def jitter(x: float) -> float:
        found = errors(np.full(of.n, x)).phase_cycles
        return 0.0 if found is None else float(found[0])

    floor = _scalar_indicator(of, lambda x: noisy.phase_indicator(x, BIT_S, jitter(x)),
                              PHASE_LOST_BELOW)  # fmt: skip
    return Closure(errors, np.full(of.n, limit), "deg", 360.0, floor)


def _code_loops(of: Facts, cn0: np.ndarray) -> np.ndarray:
    r = of.world.scenario.receiver
    return np.array([
        theory.dll_jitter_chips(
            r.code_discriminator, flank, r.dll_bandwidth_hz, r.integration_s, max(x, LOWEST_DBHZ)
        )
        for flank, x in zip(of.flanks, cn0.tolist(), strict=True)
    ])  # fmt: skip


def _scalar_indicator(
    of: Facts, value: Callable[[float], noisy.Indicator], lost_below: float
) -> np.ndarray:
    looks = of.duration_s * LOCK_GAIN / BIT_S
    floor = noisy.indicator_threshold_dbhz(value, lost_below, LOCK_GAIN, looks, LOSS)
    return np.full(of.n, max(floor, CN0_LOST_BELOW_DBHZ))


def _frequency_loops(of: Facts, felt: Sight) -> Closure:
    r = of.world.scenario.receiver
    order = r.pll_order - 1 if r.fll_order is None else r.fll_order
    w, _ = frequency_loop(order, r.fll_bandwidth_hz, BIT_S, LATE_S)
    moved = stress(order, w, of.m, felt, frequency=True) / WAVELENGTH_M

    def errors(cn0: np.ndarray) -> Errors:
        hz = _looped(
            lambda x: theory.fll_jitter_hz(r.fll_bandwidth_hz, HALF_BIT_S, x, own=True), cn0
        )
        return Errors(None, hz, _code_loops(of, cn0), 3.0 * hz, moved)

    floor = _scalar_indicator(of, lambda x: noisy.frequency_indicator(x, HALF_BIT_S),
                              FREQUENCY_LOST_BELOW)  # fmt: skip
    limit = theory.FLL_LIMIT / HALF_BIT_S
    return Closure(errors, np.full(of.n, limit), "Hz", 1.0, floor)


def _kalman_loops(of: Facts, felt: Sight, costas: bool) -> Callable[[np.ndarray], Errors]:
    r = of.world.scenario.receiver
    T = r.integration_s
    q = densities(
        r.jerk_mps3_sqrt_hz, r.divergence_m_sqrt_s, of.noise.clock_sf, of.noise.clock_sg,
        WAVELENGTH_M,
    )  # fmt: skip
    unit, none = np.eye(4), np.zeros(4)
    ramp = np.array([0.0, T**3 / 6.0, T**2 / 2.0, T])
    step, jerk = largest_step(of.m, felt.accel), largest_slope(of.m, felt.accel)

    @cache
    def filter_at(x: float) -> tuple[np.ndarray, float, float]:
        """Sigmas after an update, and phase errors for a unit step and a unit slope."""
        a2 = 2.0 * T * theory.ratio_hz(x)
        variance = (1.0 + (1.0 / a2 if costas else 0.0)) / (a2 * (2.0 * math.pi) ** 2)
        code = theory.code_variance("dot-product", of.flanks[0], T, x)
        found = kalman_loop_filter(q, T, code, variance)
        n = round(LOOP_RESPONSE_S / T)
        answers = (
            peak_response(found, unit[1:2], unit[3], none, 0, n)[0],
            peak_response(found, unit[1:2], none, ramp, n, n)[0],
        )
        return sigma(found.after, unit), float(answers[0]), float(answers[1])

    def errors(cn0: np.ndarray) -> Errors:
        # the codes' own side lobes make no difference here
        found = [filter_at(x) for x in np.maximum(cn0, LOWEST_DBHZ).tolist()]
        code, phase, hz, _ = np.array([each for each, _, _ in found]).T
        to_step, to_slope = np.array([(a, b) for _, a, b in found]).T
        moved = np.maximum(to_step * step, to_slope * jerk) / WAVELENGTH_M
        return Errors(phase, hz, code, 3.0 * phase, moved)

    return errors
