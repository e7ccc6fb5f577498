"""The closures of a scenario as closed forms: errors of their channels at any C/N0."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from signals.clock import Oscillator
from signals.constants import C_MPS
from ultratight.data_sheets import imu_errors, oscillator, process_noise
from ultratight.ins.error_state import ProcessNoise
from ultratight.predicted_motion import (
    Motion,
    Sight,
    aided,
    largest_slope,
    largest_step,
    residual_accel,
    stress,
    unaided,
)
from ultratight.scenario import Unsupported
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
from ultratight.tracking.lock import LOST_BELOW, SMOOTHING_S
from ultratight.tracking.loop_filters import frequency_loop, phase_loop
from ultratight.tracking.scalar import EPOCH_S
from ultratight.tracking.steady_filters import (
    BIAS,
    DRIFT,
    PHASE,
    Steady,
    V,
    averaged_code,
    kalman_loop_filter,
    peak_response,
    sigma,
    tight_filter,
    vector_filter,
)
from ultratight.tracking.vector import LOST_BELOW_DBHZ
from ultratight.tracking.vector_solution import VectorSettings
from ultratight.world import World

LOSS = 0.1
"""The threshold: that share of the channels is lost in a run"""
LATE_S = 0.5 * EPOCH_S
RESPONSE_S, LOOP_RESPONSE_S = 4.0, 1.0
"""So long the largest error after a step is looked for: of a solution, of a channel's filter"""
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


def closure_of(world: World, m: Motion) -> Closure:
    """The scenario's; `Unsupported` where there is no closed form of it."""
    s = world.scenario
    errors = imu_errors(s, 1)
    spacing = s.correlator.spacing_chips
    of = Facts(
        world, m,
        [theory.flank_of_code(row, int(p), spacing)
         for row, p in zip(world.rows, world.prn, strict=True)],
        oscillator("clock.model", s.clock.model), process_noise(s, errors),
    )  # fmt: skip
    kind = s.receiver.closure
    if kind == "scalar":
        return _channel_loops(of, unaided(m))
    if kind == "scalar-ins":
        tilt = 1e-3 * max(s.receiver.knows.tilt_sigma_mrad, s.receiver.knows.heading_sigma_mrad)
        return _channel_loops(of, aided(m, errors, s.receiver.aiding_latency_s, tilt))
    if kind in ("vdll", "vdfll"):
        return _vector(of)
    if kind == "ultra-tight":
        return _ultra_tight(of)
    raise Unsupported(
        f"receiver.closure: {kind!r} given, expected one that has a closed form: scalar, "
        "scalar-ins, vdll, vdfll, ultra-tight"
    )


def _looped(of: Callable[[float], float], cn0: np.ndarray) -> np.ndarray:
    return np.array([of(max(x, LOWEST_DBHZ)) for x in cn0.tolist()])


# -- loops of channels ---------------------------------------------------------------------------


def _channel_loops(of: Facts, felt: Sight) -> Closure:
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


# -- solutions that channels share ---------------------------------------------------------------


class _Event(NamedTuple):
    """The largest step of a vector (m, 3) and of a scalar (m,) at one border, and the geometry."""

    step: np.ndarray  # (3,)
    clock: float
    force: np.ndarray  # (3,) step of the body's own acceleration, ECEF
    slope: np.ndarray  # (3,) largest slope between borders
    u: np.ndarray  # (n, 3)
    felt: float  # specific force before it [m/s2]: that is what the gain was made with


def _event(m: Motion, x: np.ndarray) -> _Event:
    borders = np.flatnonzero(np.diff(m.stretch) > 0)
    within = np.flatnonzero(np.diff(m.stretch) == 0)
    slopes = np.diff(x, axis=0)[within] / np.diff(m.t_s)[within, None]
    slope = slopes[np.linalg.norm(slopes, axis=-1).argmax()]
    if not borders.size:
        force = float(np.linalg.norm(m.force_b[0]))
        return _Event(np.zeros(3), 0.0, np.zeros(3), slope, m.u[0], force)
    steps, own = x[borders + 1] - x[borders], m.accel_e[borders + 1] - m.accel_e[borders]
    k = int((np.linalg.norm(steps, axis=-1) + 1e-3 * np.linalg.norm(own, axis=-1)).argmax())
    at = borders[k]
    force = float(np.linalg.norm(m.force_b[at]))
    return _Event(steps[k], float(m.clock[at + 1] - m.clock[at]), own[k], slope, m.u[at], force)


def _vector(of: Facts) -> Closure:
    """VDLL and VDFLL; the carriers of a VDLL are its channels' own."""
    s = of.world.scenario
    settings = VectorSettings(
        carrier=s.receiver.closure == "vdfll", **s.receiver.vector.model_dump()
    )
    T, k = settings.update_s, settings.states
    bits = T / BIT_S
    event = _event(of.m, of.m.accel_e)
    n, u = of.n, event.u
    ranges, rates = np.zeros((n, k)), np.zeros((n, k))
    ranges[:, 0:3], ranges[:, 6] = -u, 1.0
    rates[:, 3:6], rates[:, 7] = -u, 1.0
    kick, push = np.zeros(k), np.zeros(k)
    kick[7] = event.clock
    if k > 8:
        kick[8:11] = event.step
        push[0:3], push[3:6], push[8:11] = (event.slope * x for x in (T**3 / 6, T**2 / 2, T))
    else:
        a = of.m.accel_e[np.linalg.norm(of.m.accel_e, axis=-1).argmax()]
        push[0:3], push[3:6] = a * T**2 / 2.0, a * T
    own = None if settings.carrier else _channel_loops(of, unaided(of.m))

    def errors(cn0: np.ndarray) -> Errors:
        level = np.maximum(cn0, LOWEST_DBHZ).tolist()
        a2 = 2.0 * HALF_BIT_S * 10.0 ** (0.1 * np.array(level))
        chips2 = np.array([
            theory.code_variance("dot-product", f, HALF_BIT_S, x) / (2.0 * bits)
            for f, x in zip(of.flanks, level, strict=True)
        ])  # fmt: skip
        hz2 = (2.0 / a2 + 2.0 / a2**2) / (bits * (2.0 * math.pi * HALF_BIT_S) ** 2)
        chip_m = C_MPS / of.world.channels.chip_rate_hz
        rate2 = hz2 * WAVELENGTH_M**2 + 2.0 * of.noise.clock_sf / (3.0 * HALF_BIT_S * bits)
        found = vector_filter(settings, of.noise, u, chips2 * chip_m**2, rate2)
        code = sigma(found.after, ranges) / chip_m
        hz = sigma(found.prior, rates) / WAVELENGTH_M
        if own is not None:
            return own.errors(cn0)._replace(code_chips=code)
        return Errors(None, hz, code, 3.0 * hz, _answer(found, rates, kick, push, T) / WAVELENGTH_M)

    if own is not None:
        return own._replace(errors=errors)
    limit = np.full(n, theory.FLL_LIMIT / HALF_BIT_S)
    return Closure(errors, limit, "Hz", 1.0, np.full(n, LOST_BELOW_DBHZ))


def _answer(
    of: Steady, rows: np.ndarray, kick: np.ndarray, push: np.ndarray, T: float
) -> np.ndarray:
    """Largest answer of each row to a kick, and to a push that goes on."""
    n = round(RESPONSE_S / T)
    return np.maximum(
        peak_response(of, rows, kick, 0.0 * push, 0, n),
        peak_response(of, rows, 0.0 * kick, push, n, n),
    )


def _ultra_tight(of: Facts) -> Closure:
    """The INS closes; IMU errors that go with the motion are what its filter does not hold."""
    s, world = of.world.scenario, of.world
    coherent = s.receiver.measurement != "differential"
    half, wavelength = world.channels.half_s, world.channels.wavelength_m
    T = float(2.0 * half.min())
    imu = imu_errors(s, 1)
    event = _event(of.m, residual_accel(of.m, imu))
    n, u = of.n, event.u
    size = PHASE + (n if coherent else 0)
    rates = np.zeros((n, size))
    rates[:, V : V + 3], rates[:, DRIFT] = -u, 1.0
    limited = np.eye(size)[PHASE:] if coherent else rates
    kick, push = np.zeros(size), np.zeros(size)
    kick[V : V + 3], kick[BIAS : BIAS + 3] = imu.lag_s * event.force, event.step
    kick[DRIFT] = event.clock
    push[V : V + 3], push[BIAS : BIAS + 3] = event.slope * T**2 / 2.0, event.slope * T
    k = s.receiver.knows
    first = np.array([k.position_sigma_m] * 3 + [k.clock_sigma_m])

    def errors(cn0: np.ndarray) -> Errors:
        level = np.maximum(cn0, LOWEST_DBHZ)
        a2 = 2.0 * half * 10.0 ** (0.1 * level)
        turn2 = 2.0 / a2 + 2.0 / a2**2
        rate2 = turn2 * (wavelength / (2.0 * math.pi * half)) ** 2
        rate2 = rate2 + 2.0 * of.noise.clock_sf / (3.0 * half)
        phase2 = 0.5 / a2 * (wavelength / (2.0 * math.pi)) ** 2
        found = tight_filter(of.noise, event.felt, u, T, phase2 if coherent else None, rate2)
        chips2 = np.array([
            theory.code_variance("dot-product", f, h, x) / 2.0
            for f, h, x in zip(of.flanks, half, level.tolist(), strict=True)
        ])  # fmt: skip
        chip_m = C_MPS / world.channels.chip_rate_hz
        code = averaged_code(first, u, chips2 * chip_m**2, of.duration_s / T) / chip_m
        hz = sigma(found.after, rates) / wavelength
        before = sigma(found.prior, limited) / wavelength
        moved = _answer(found, limited, kick, push, T) / wavelength
        phase = sigma(found.after, limited) / wavelength if coherent else None
        return Errors(phase, hz, code, 3.0 * before, moved)

    limit = np.full(n, theory.PILOT_LIMIT_CYCLES) if coherent else theory.FLL_LIMIT / half
    return Closure(
        errors, limit, "deg" if coherent else "Hz", 360.0 if coherent else 1.0,
        np.array([_monitor(coherent, h, s.receiver.epoch_s, of.duration_s) for h in half]),
    )  # fmt: skip


def _monitor(coherent: bool, half_s: float, epoch_s: float, duration_s: float) -> float:
    """C/N0 at which noise alone makes the lock monitor declare a channel lost [dB-Hz]."""

    def value(cn0: float) -> noisy.Indicator:
        a2 = 2.0 * half_s * theory.ratio_hz(cn0)
        return noisy.Indicator(1.0, math.sqrt(0.5 / a2 if coherent else 2.0 / a2 + 2.0 / a2**2))

    return noisy.indicator_threshold_dbhz(
        value, LOST_BELOW, epoch_s / SMOOTHING_S, duration_s / SMOOTHING_S, LOSS
    )
