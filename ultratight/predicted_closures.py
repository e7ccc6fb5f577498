"""The closures of a scenario as closed forms: errors of their channels at any C/N0."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from signals.constants import C_MPS
from ultratight.data_sheets import imu_errors, oscillator, process_noise
from ultratight.predicted_loops import (
    LOOP_RESPONSE_S,
    LOSS,
    LOWEST_DBHZ,
    Closure,
    Errors,
    Facts,
    channel_loops,
)
from ultratight.predicted_motion import Motion, aided, residual_accel, unaided
from ultratight.tracking import loop_theory as theory
from ultratight.tracking import noisy_phase as noisy
from ultratight.tracking.channel_state import BIT_S, HALF_BIT_S, WAVELENGTH_M
from ultratight.tracking.lock import LOST_BELOW, SMOOTHING_S
from ultratight.tracking.pre_filter import AMPLITUDE2_FLOOR, ARCTANGENT_ABOVE, POWER_S
from ultratight.tracking.steady_filters import (
    BIAS,
    DRIFT,
    PHASE,
    Steady,
    V,
    averaged_code,
    federated_filter,
    peak_response,
    phase_filter,
    sigma,
    tight_filter,
    vector_filter,
)
from ultratight.tracking.vector import LOST_BELOW_DBHZ
from ultratight.tracking.vector_solution import VectorSettings, faded
from ultratight.world import World

RESPONSE_S = 4.0
"""So long the largest error after a step is looked for"""


def closure_of(world: World, m: Motion) -> Closure:
    """The scenario's."""
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
        return channel_loops(of, unaided(m))
    if kind == "scalar-ins":
        tilt = 1e-3 * max(s.receiver.knows.tilt_sigma_mrad, s.receiver.knows.heading_sigma_mrad)
        return channel_loops(of, aided(m, errors, s.receiver.aiding_latency_s, tilt))
    if kind in ("vdll", "vdfll"):
        return _vector(of)
    return _ultra_tight(of) if kind == "ultra-tight" else _federated(of)


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
    a = of.m.accel_e[np.linalg.norm(of.m.accel_e, axis=-1).argmax()]
    if k > 8:
        kick[8:11] = event.step
        # an acceleration that lasts does not fade
        kept = np.array([T**2 / 2.0, T, 1.0]) - faded(np.array([T]), settings.acceleration_tau_s).T
        for i, x, lasts in zip((0, 3, 8), (T**3 / 6, T**2 / 2, T), kept[0], strict=True):
            push[i : i + 3] = event.slope * x + a * lasts
    else:
        push[0:3], push[3:6] = a * T**2 / 2.0, a * T
    own = None if settings.carrier else channel_loops(of, unaided(of.m))

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

    def errors(cn0: np.ndarray) -> Errors:
        level = np.maximum(cn0, LOWEST_DBHZ)
        a2 = 2.0 * half * 10.0 ** (0.1 * level)
        turn2 = 2.0 / a2 + 2.0 / a2**2
        rate2 = turn2 * (wavelength / (2.0 * math.pi * half)) ** 2
        rate2 = rate2 + 2.0 * of.noise.clock_sf / (3.0 * half)
        phase2 = 0.5 / a2 * (wavelength / (2.0 * math.pi)) ** 2
        found = tight_filter(of.noise, event.felt, u, T, phase2 if coherent else None, rate2)
        hz = sigma(found.after, rates) / wavelength
        before = sigma(found.prior, limited) / wavelength
        moved = _answer(found, limited, kick, push, T) / wavelength
        phase = sigma(found.after, limited) / wavelength if coherent else None
        return Errors(phase, hz, _averaged_code(of, u, level), 3.0 * before, moved)

    limit = np.full(n, theory.PILOT_LIMIT_CYCLES) if coherent else theory.FLL_LIMIT / half
    return Closure(
        errors, limit, "deg" if coherent else "Hz", 360.0 if coherent else 1.0,
        np.array([_monitor(coherent, h, s.receiver.epoch_s, of.duration_s) for h in half]),
    )  # fmt: skip


def _averaged_code(of: Facts, u: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Chips (n,) that the codes of all data bits of the run leave of the first uncertainty."""
    c, k = of.world.channels, of.world.scenario.receiver.knows
    first = np.array([k.position_sigma_m] * 3 + [k.clock_sigma_m])
    chips2 = np.array([
        theory.code_variance("dot-product", f, h, x) / 2.0
        for f, h, x in zip(of.flanks, c.half_s, level.tolist(), strict=True)
    ])  # fmt: skip
    chip_m = C_MPS / c.chip_rate_hz
    bits = of.duration_s / float(2.0 * c.half_s.min())
    return averaged_code(first, u, chips2 * chip_m**2, bits) / chip_m


def _federated(of: Facts) -> Closure:
    """Pre-filters follow the phases, the central filter is given rates."""
    c = of.world.channels
    known = c.pilot | (of.world.scenario.receiver.measurement == "coherent")
    found = _pre_filtered(of, known)
    kinds = list(zip(c.half_s.tolist(), known.tolist(), strict=True))
    floors = {kind: _prompts_monitor(of, found, *kind, kinds.index(kind)) for kind in set(kinds)}
    limit = np.where(known, theory.PILOT_LIMIT_CYCLES, theory.COSTAS_LIMIT_CYCLES)
    return Closure(found, limit, "deg", 360.0, np.array([floors[kind] for kind in kinds]))


def _half_amplitude2(half_s: np.ndarray, cn0: np.ndarray) -> np.ndarray:
    """A^2 (n,) of half bits, as pre-filters have it."""
    return np.maximum(2.0 * half_s * 10.0 ** (0.1 * cn0), AMPLITUDE2_FLOOR)


def _pre_filtered(of: Facts, known: np.ndarray) -> Callable[[np.ndarray], Errors]:
    """All pre-filters are as restless as that of the channel of which the INS knows least."""
    s, c = of.world.scenario, of.world.channels
    T, half = s.receiver.federated.update_s, c.half_s
    imu = imu_errors(s, 1)
    event = _event(of.m, residual_accel(of.m, imu))
    u, radian_m = event.u, c.wavelength_m / (2.0 * math.pi)
    rates, accels = np.zeros((2, of.n, PHASE + 1))
    rates[:, V : V + 3], rates[:, DRIFT], accels[:, BIAS : BIAS + 3] = -u, 1.0, -u
    step, kick = np.abs(u @ event.step), np.abs(imu.lag_s * u @ event.force) + abs(event.clock)

    def errors(cn0: np.ndarray) -> Errors:
        level = np.maximum(cn0, LOWEST_DBHZ)
        a2 = _half_amplitude2(half, level)
        share = np.where(known, 1.0, [math.erf(math.sqrt(x)) for x in a2])
        variance = np.where(a2 >= ARCTANGENT_ABOVE, 1.0 + 1.0 / a2, 1.0 / share**2) / a2
        variance *= radian_m**2
        central = federated_filter(of.noise, event.felt, u, T, half, variance)
        own = of.noise.velocity + T * float(sigma(central.after, accels).max()) ** 2
        unrest = of.noise.clock_sg + own
        kinds = list(zip(half.tolist(), variance.tolist(), strict=True))
        followed = {(h, r): _followed(of.noise.clock_sf, unrest, h, r) for h, r in set(kinds)}
        rows = np.array([followed[kind] for kind in kinds]) / c.wavelength_m[:, None]
        after, ahead, to_accel, to_rate = rows.T
        hz = sigma(central.after, rates) / c.wavelength_m
        moved = np.maximum(to_accel * step, to_rate * kick)
        return Errors(after, hz, _averaged_code(of, u, level), 3.0 * ahead, moved)

    return errors


def _followed(clock_sf: float, unrest: float, half_s: float, variance: float) -> tuple[float, ...]:
    """A phase in a pre-filter [m]: two sigmas, and largest errors for two kinds of motion.

    Sigma after half a bit, and in the middle of the bit ahead, where its sign is decided; 1 m/s2
    that goes on, which the central filter learns later, and a step of 1 m/s.
    """
    of = phase_filter(clock_sf, unrest, half_s, variance)
    row, ahead = np.array([[1.0, 0.0]]), np.array([[1.0, 1.5 * half_s]])
    n, none = round(LOOP_RESPONSE_S / half_s), np.zeros(2)
    push, kick = np.array([half_s**2 / 2.0, half_s]), np.array([0.0, 1.0])
    return (
        float(sigma(of.after, row)[0]), float(sigma(of.after, ahead)[0]),
        float(peak_response(of, row, none, push, n, n)[0]),
        float(peak_response(of, row, kick, none, 0, n)[0]),
    )  # fmt: skip


def _prompts_monitor(
    of: Facts, errors: Callable[[np.ndarray], Errors], half_s: float, known: bool, i: int
) -> float:
    """C/N0 at which noise makes the federated form declare channel i lost [dB-Hz].

    Noise in the prompts, in the phase that turns them, and in the power that scales them.
    """
    T = of.world.scenario.receiver.federated.update_s
    bits, gain, each = T / (2.0 * half_s), T / SMOOTHING_S, 2.0 * half_s / POWER_S
    # what the indicator leaves of a value's variance, and of one that lasts for POWER_S
    short, long = gain / (2.0 - gain), POWER_S / (POWER_S + SMOOTHING_S)

    def value(cn0: float) -> noisy.Indicator:
        a2 = float(_half_amplitude2(np.array(half_s), np.array(cn0)))
        spread = (2.0 * math.pi * errors(np.full(of.n, cn0)).three_sigma[i] / 3.0) ** 2
        power = each / (2.0 - each) * (2.0 / a2 + 2.0 / a2**2) * long / short
        if known:
            mean, variance = math.exp(-0.5 * spread), 0.5 / a2 / bits + 0.25 * power
        else:
            mean, variance = math.exp(-2.0 * spread), (2.0 / a2 + 1.0 / a2**2) / bits + power
        return noisy.Indicator(mean, math.sqrt(variance))

    looks = of.duration_s / SMOOTHING_S
    floor = noisy.indicator_threshold_dbhz(value, LOST_BELOW, gain, looks, LOSS)
    return max(floor, LOST_BELOW_DBHZ)


def _monitor(coherent: bool, half_s: float, epoch_s: float, duration_s: float) -> float:
    """C/N0 at which noise alone makes the lock monitor declare a channel lost [dB-Hz]."""

    def value(cn0: float) -> noisy.Indicator:
        a2 = 2.0 * half_s * theory.ratio_hz(cn0)
        return noisy.Indicator(1.0, math.sqrt(0.5 / a2 if coherent else 2.0 / a2 + 2.0 / a2**2))

    return noisy.indicator_threshold_dbhz(
        value, LOST_BELOW, epoch_s / SMOOTHING_S, duration_s / SMOOTHING_S, LOSS
    )
