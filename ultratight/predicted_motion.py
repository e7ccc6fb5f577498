"""What loops will feel: motion along the lines of sight, oscillator and IMU errors, in closed form.

From the scenario's trajectory, sky and data sheets, at both sides of each step; nothing is flown.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.arcs import arcs
from signals.constants import C_MPS, STANDARD_GRAVITY
from signals.propagation import predict_channels
from ultratight.ins.imu import ImuErrors
from ultratight.ins.trajectory import Side
from ultratight.tracking.loop_theory import peak_factor
from ultratight.world import World

POINTS, FEWEST, LONGEST_S = 1500, 3, 0.25
"""Instants in all, at least in a stretch, and the time between two where they suffice"""
SKY_TIMES = 21


class Motion(NamedTuple):
    """The flight at instants (m,), two of them at each step; n channels."""

    t_s: np.ndarray  # (m,)
    stretch: np.ndarray  # (m,) int: what lies between two steps is smooth
    u: np.ndarray  # (m, n, 3) to the satellites, ECEF
    rate: np.ndarray  # (m, n) of the range [m/s]
    accel_e: np.ndarray  # (m, 3) of the body, ECEF [m/s2]
    sky: np.ndarray  # (m, n) acceleration of the range that satellites and geometry make [m/s2]
    force_b: np.ndarray  # (m, 3) specific force [m/s2]
    C_b_e: np.ndarray  # (m, 3, 3)
    clock: np.ndarray  # (m,) drift that the g-sensitive oscillator gets [m/s]


class Sight(NamedTuple):
    """What a channel's loop feels: (m, n) acceleration and steps of rate, along the range."""

    accel: np.ndarray  # [m/s2]
    rate: np.ndarray  # [m/s]


def motion(world: World) -> Motion:
    """Of a world, from 0 s to the end of its scenario; the IMU's motion for the antenna's."""
    s, path = world.scenario, world.trajectory
    inside = path.breakpoints_s[(path.breakpoints_s > 0.0) & (path.breakpoints_s < s.duration_s)]
    edges = np.unique(np.concatenate([[0.0], inside, [s.duration_s]]))
    times, stretch, parts = [], [], []
    for k, (a, b) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        most = max(FEWEST, int(POINTS * (b - a) / s.duration_s))
        t = np.linspace(a, b, int(np.clip(math.ceil((b - a) / LONGEST_S) + 1, FEWEST, most)))
        times.append(t)
        stretch.append(np.full(t.size, k))
        sides: tuple[tuple[np.ndarray, Side], ...] = ((t[:-1], "right"), (t[-1:], "left"))
        for part, side in sides:
            at, force = path.at(part, side), path.specific_force(part, side)
            parts.append((at.r_eb_e, at.v_eb_e, at.a_eb_e, at.C_b_e, force))
    r, v, a_e, C, force = (np.concatenate(x) for x in zip(*parts, strict=True))
    t_s = np.concatenate(times)
    u, rate, still = _sky(world, t_s, r, v)
    across2 = np.sum(v**2, axis=-1)[:, None] - np.einsum("mni,mi->mn", u, v) ** 2
    gamma = C_MPS * 1e-9 * s.clock.g_sensitivity_ppb_per_g / STANDARD_GRAVITY
    sky = still + across2 / 2.2e7
    return Motion(t_s, np.concatenate(stretch), u, rate, a_e, sky, force, C, gamma * force[:, 0])


def _sky(
    world: World, t_s: np.ndarray, r: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lines of sight, range rates, and accelerations of the range for a receiver at rest."""
    s, n = world.scenario, len(world.prn)
    tow = s.start_tow_s
    sky = arcs(world.elements, tow, tow + s.duration_s)
    coarse = np.linspace(0.0, s.duration_s, SKY_TIMES)
    u, rate = np.empty((SKY_TIMES, n, 3)), np.empty((SKY_TIMES, n))
    for k, t in enumerate(coarse):
        i = min(int(np.searchsorted(t_s, t)), t_s.size - 1)
        predict_channels(sky, tow + t, r[i], np.zeros(3), 0.0, 0.0, np.empty(n), rate[k], u[k])
    still = np.empty_like(rate)
    still[:] = np.gradient(rate, coarse, axis=0)
    at = np.stack([np.interp(t_s, coarse, x) for x in u.reshape(SKY_TIMES, -1).T], axis=-1)
    lines = at.reshape(t_s.size, n, 3)
    lines /= np.linalg.norm(lines, axis=-1, keepdims=True)
    both = [np.stack([np.interp(t_s, coarse, x) for x in y.T], axis=-1) for y in (rate, still)]
    return lines, both[0] - np.einsum("mni,mi->mn", lines, v), both[1]


# -- felt by loops -------------------------------------------------------------------------------


def unaided(m: Motion) -> Sight:
    """All of it: the vehicle, the satellites, the oscillator."""
    accel = m.sky - np.einsum("mni,mi->mn", m.u, m.accel_e)
    return Sight(accel, np.broadcast_to(m.clock[:, None], accel.shape))


def residual_accel(m: Motion, imu: ImuErrors) -> np.ndarray:
    """Error of the measured acceleration (m, 3), ECEF, that goes with the motion [m/s2].

    Scale factors (those that are drawn count with their sigma, all of one sign), misalignment
    (across the force), and what is beyond saturation.
    """
    scale = np.array(imu.accel_scale_factor) + imu.accel_scale_factor_sigma
    wrong = scale * m.force_b + imu.accel_misalignment * np.roll(m.force_b, 1, axis=-1)
    if imu.saturation_mps2 is not None:
        limit = imu.saturation_mps2
        wrong = wrong - (m.force_b - np.clip(m.force_b, -limit, limit))
    return np.asarray(np.einsum("mij,mj->mi", m.C_b_e, wrong))


def constant_accel(m: Motion, imu: ImuErrors, tilt_rad: float) -> float:
    """Size of the error that is there all the time, or grows slowly [m/s2]: biases and tilt.

    A free-running INS tilts by its gyros' bias until the end.
    """
    gyro = math.hypot(imu.gyro_bias_turn_on, imu.gyro_bias_in_run)
    tilt = math.hypot(tilt_rad, gyro * float(m.t_s[-1]))
    bias = math.hypot(imu.accel_bias_turn_on, imu.accel_bias_in_run)
    force = float(np.linalg.norm(m.force_b, axis=-1).max())
    return math.hypot(bias, tilt * force)


def aided(m: Motion, imu: ImuErrors, latency_s: float, tilt_rad: float) -> Sight:
    """What a free-running INS leaves: see `residual_accel`, `constant_accel`.

    A lag tau leaves a rate of tau times each step of the force; an aid that is late by L one of L
    times the step, until it has arrived.  The oscillator is not aided at all.
    """
    left = np.einsum("mni,mi->mn", m.u, residual_accel(m, imu))
    late = imu.lag_s + latency_s
    true = np.einsum("mni,mi->mn", m.u, m.accel_e)
    constant = constant_accel(m, imu, tilt_rad)
    rate = m.clock[:, None] + late * true
    worst = np.take_along_axis(left, np.abs(left).argmax(axis=0)[None], axis=0)
    return Sight(left + constant * np.where(worst < 0.0, -1.0, 1.0), rate)


def stress(order: int, w: float, m: Motion, felt: Sight, frequency: bool = False) -> np.ndarray:
    """Largest error (n,) of a loop of that order [m, or m/s of a frequency loop].

    At each step what `loop_theory.peak_factor` says; between steps the smaller of the answers to a
    constant slope and to a step of the whole change.  Events are taken one by one: what has not
    died out when the next one comes is left out.
    """
    accel, rate = (1, 0) if frequency else (2, 1)

    def factor(k: int) -> float:
        return 1.0 if k == 0 else peak_factor(order, k) / w**k

    borders = np.flatnonzero(np.diff(m.stretch) > 0)
    most = np.zeros(felt.accel.shape[1])
    if accel == order:  # it does not follow an acceleration without an error
        most = np.abs(felt.accel).max(axis=0) / w**order
    if borders.size:
        steps = [np.abs(x[borders + 1] - x[borders]) for x in felt]
        most = np.maximum(most, (factor(accel) * steps[0] + factor(rate) * steps[1]).max(axis=0))
    for k in range(int(m.stretch[-1]) + 1):
        own = m.stretch == k
        smooth = np.zeros_like(most)
        for x, derivative in ((felt.accel[own], accel), (felt.rate[own], rate)):
            slope = np.abs(np.diff(x, axis=0) / np.diff(m.t_s[own])[:, None]).max(axis=0)
            answer = factor(derivative) * np.ptp(x, axis=0)
            if derivative < order:
                answer = np.minimum(answer, factor(derivative + 1) * slope)
            smooth = smooth + answer
        most = np.maximum(most, smooth)
    return most


def largest_step(m: Motion, x: np.ndarray) -> np.ndarray:
    """Of x (m, n) at the borders of stretches (n,)."""
    borders = np.flatnonzero(np.diff(m.stretch) > 0)
    if not borders.size:
        return np.zeros(x.shape[1])
    return np.asarray(np.abs(x[borders + 1] - x[borders]).max(axis=0))


def largest_slope(m: Motion, x: np.ndarray) -> np.ndarray:
    """Of x (m, n) inside stretches (n,)."""
    within = np.diff(m.stretch) == 0
    slope = np.diff(x, axis=0)[within] / np.diff(m.t_s)[within, None]
    return np.asarray(np.abs(slope).max(axis=0))
