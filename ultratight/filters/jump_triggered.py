"""JTQ: a quadrature filter that doubts IMU and clock when the *measured* specific force jumps.

The error of an inertial sensor or an oscillator is an unknown function of the specific force f.
Taken as a Wiener process in f its variance grows with |df|, not with time: nothing is added while
f is constant, and at a step of f three blocks are opened, the accelerometer bias, the velocity
and the clock drift,

    w = max(|df| - dead zone, 0) / f_c,     V_a = sigma_a^2 w,  V_v = (sigma_v w)^2,
    V_c = sigma_c^2 w  (and xi T^2 V_c, fully correlated, on clock bias and carrier phases).

Which block moved is not known: four hypotheses (none, acceleration, clock, both) run in parallel
until the likelihoods have decided (`multiple_model`).  The update is relinearised, since an opened
clock turns the phase by radians.  A score test on velocity and drift (`score`) reopens everything
when something happens that the accelerometer did not show.  No scale factor, latency, saturation
or g-sensitivity enters, only how large a surprise per 10 g may be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from signals.compiled import kernel
from signals.constants import STANDARD_GRAVITY
from ultratight.filters.gaussian import Gaussian, Measurement, Prediction, Update, predict, update
from ultratight.filters.multiple_model import (
    Bank,
    bank_of,
    fed_back,
    has_phases,
    merged,
    mixed,
    normalised,
    report,
    weighed,
    with_noise,
)
from ultratight.filters.quadrature import gauss_hermite
from ultratight.filters.rules import Rule
from ultratight.filters.score import ScoreTest

NONE, ACCELERATION, CLOCK, BOTH = range(4)
RESTART_BELOW = 1e-6
DECIDED_ABOVE = 0.9999


def _wide(d: int) -> tuple[np.ndarray, np.ndarray]:
    return gauss_hermite((3,) + (7,) * (d - 1), d)


WIDE = Rule(
    "gh3-range-7", "projected", _wide, "Gauss-Hermite tensor, 3 points in range, 7 elsewhere"
)
"""Where phase or rate may be off by a good part of a radian; the narrow rule has 3 points"""


@dataclass(frozen=True)
class JumpOptions:
    """Sizes of the surprises, and which of the three parts are at work."""

    reference_mps2: float = 100.0  # f_c
    dead_zone_mps2: float = 0.05
    accel_mps2: float = 2.0  # sigma_a, 1 sigma per f_c
    velocity_mps: float = 1.0  # sigma_v
    clock_mps: float = 3.0  # sigma_c
    spill: float = 0.02  # rho: share of V that a hypothesis gives to the other blocks
    load: float = 0.015  # kappa [m/s2/sqrt(s)]: unrest of the bias at 100 m/s2 of load
    phase_share: float = 0.1  # xi
    prior: tuple[float, float, float, float] = (0.4, 0.2, 0.2, 0.2)
    stay: float = 0.98  # on a ramp; the rest goes by ``prior``
    transverse: float = 1.0  # size across the change of force, in units of that along it
    delay: float = 0.0  # of the velocity's step after the start of the epoch, in epochs
    jitter: float = 0.0  # its variance, in epochs squared
    ramp: float = 1.0  # share of V on a ramp
    unsteady: float = 0.0  # no trigger below so many medians of the second difference of force
    aftershock: float = 0.0  # size of velocity opened in the epoch after, in that of the epoch
    unrest: float = 0.0  # of the bias after the score test has fired [m/s2/sqrt(s)]
    unrest_s: float = 1.0  # how long
    trigger: bool = True
    hypotheses: bool = True  # False: all blocks opened in one Gaussian
    gate: float = 40.0  # of the score test; inf: none
    gate_after_step: float = 80.0
    start_s: float = 1.0  # no score test before

    def __post_init__(self) -> None:
        sizes = (
            self.dead_zone_mps2, self.accel_mps2, self.velocity_mps, self.clock_mps, self.spill,
            self.load, self.phase_share, self.start_s,
        )  # fmt: skip
        if min(sizes) < 0.0 or not self.reference_mps2 > 0.0:
            raise ValueError(f"{self}: expected sizes >= 0 and reference_mps2 > 0")
        if min(self.prior) <= 0.0 or abs(sum(self.prior) - 1.0) > 1e-9:
            raise ValueError(f"prior: {self.prior}, expected four positive numbers of sum 1")
        if not 0.0 < self.stay < 1.0:
            raise ValueError(f"stay: {self.stay}, expected 0 < stay < 1")

    def make(self, rule: Rule, iterations: int) -> JumpTriggered:
        """The filter with these options."""
        return JumpTriggered(self, rule, iterations)


JTQ = JumpOptions()
J1 = replace(JTQ, hypotheses=False)
IO = replace(JTQ, trigger=False, hypotheses=False)

STEP = 0.05  # of w: a step above, a ramp below
RAISED = (2.0, 0.5, 3.0)
"""Least sigma of bias, velocity and drift after the score test has fired"""
LONGEST_SET = 50  # epochs
QUIET_SET, AFTER_STEP = 3, 25  # epochs
STEP_RAD = 0.15
MEMORY = 25  # epochs


class JumpTriggered:
    """JTQ and its relatives at work."""

    def __init__(self, options: JumpOptions, rule: Rule, iterations: int) -> None:
        self.options, self.rule, self.iterations = options, rule, iterations
        self.score = ScoreTest()
        self.prior = np.array(options.prior)
        self.transition = options.stay * np.eye(4) + (1.0 - options.stay) * self.prior
        self.reset()

    def reset(self) -> None:
        """Start again from one Gaussian: the state or the measurement model has changed."""
        self.bank: Bank | None = None  # None: one hypothesis, the receiver's own
        self.age = 0  # epochs since the hypotheses were spawned
        self.since_step = 10**9
        self.since_fire = 10**9
        self.shock = None
        self.change = (0.0, 0.0, 0.0)
        self.second = [0.0] * MEMORY
        self.slot = 0
        self.elapsed_s = 0.0
        self.fed_bias = np.zeros(3)
        self.step_weight: np.ndarray | None = None
        self.score.reset()

    def step(self, state: Gaussian, prediction: Prediction, measurement: Measurement) -> Update:
        """Open, predict, update and weigh; reopen where the score test fires."""
        o = self.options
        self.notes: list[tuple[str, str]] = []
        self.elapsed_s += prediction.T
        before = self.bank if self.bank is not None else _bank_of_one(state)
        bank = self._open(before, prediction)
        if self.since_step == 0:
            measurement = seen_from_a_step(measurement, prediction, self.options.delay)
        loaded = prediction._replace(q=self._q(prediction))
        bank, updates = self._update(bank, loaded, measurement)
        if measurement.z.size and np.isfinite(o.gate):
            heaviest = updates[int(np.argmax(bank.log_weight))]
            windowed, single = self.score.watch(loaded, heaviest)
            if self._fires(windowed, single):
                self.notes.append(("reopened", f"score test {max(windowed, single):.0f}"))
                self.score.reset()
                self.since_fire = 0
                bank = _bank_of_one(self._raised(merged(before), prediction))
                bank, updates = self._update(bank, loaded, measurement)
        result = updates[0] if len(updates) == 1 else report(bank, updates)
        self.bank = fed_back(bank, result.mean) if len(updates) > 1 else None
        self.fed_bias = result.mean[prediction.layout.accel_bias]
        return result

    def _open(self, bank: Bank, prediction: Prediction) -> Bank:
        """The bank with the blocks opened that the change of force casts doubt on."""
        o = self.options
        self.age += 1
        self.since_step += 1
        self.since_fire += 1
        # the receiver's force is free of the bias, whose estimate has just moved
        change = prediction.df_b + self.fed_bias
        df = math.hypot(*change.tolist()) if o.trigger else 0.0
        along = change / df if df > 0.0 else change
        w = max(df - o.dead_zone_mps2, 0.0) / o.reference_mps2
        if o.unsteady and df < self._gate(change):
            w = 0.0
        several = bank.log_weight.size > 1
        if o.aftershock and self.shock is not None:
            size, way = self.shock
            bank = self._widened(
                bank, prediction, o.aftershock * size, way, self._share(several), only_v=True
            )
            self.shock = (size * o.aftershock, way) if size > 0.01 else None
        if w > STEP:
            self.shock = (w, along)
        if w == 0.0:
            if several and (
                self.age > LONGEST_SET or bank.log_weight.max() > math.log(DECIDED_ABOVE)
            ):
                return _bank_of_one(merged(bank))
            return bank
        if w > STEP:
            self.notes.append(("opened", f"specific force changed by {df:.1f} m/s2"))
            self.score.reset()
            self.since_step = 0
        if not o.hypotheses:
            return self._widened(bank, prediction, w, along, np.ones((1, 2)))
        if w > STEP or not several:
            self.age = 0
            bank = bank_of(merged(bank), self.prior)
        else:
            bank = mixed(bank, self.transition)
        return self._widened(bank, prediction, w, along, self._share(True))

    def _gate(self, change: np.ndarray) -> float:
        """Changes of force below are vibration: the median of what half a second has shown."""
        change_x, change_y, change_z = change.tolist()
        x, y, z = self.change
        self.change = change_x, change_y, change_z
        gate = self.options.unsteady * sorted(self.second)[len(self.second) // 2]
        self.second[self.slot] = math.hypot(change_x - x, change_y - y, change_z - z)
        self.slot = (self.slot + 1) % len(self.second)
        return gate

    def _share(self, several: bool) -> np.ndarray:
        s = self.options.spill
        return np.array([[s, s], [1.0, s], [s, 1.0], [1.0, 1.0]]) if several else np.ones((1, 2))

    def _widened(
        self,
        bank: Bank,
        prediction: Prediction,
        w: float,
        along: np.ndarray,
        share: np.ndarray,
        only_v: bool = False,
    ) -> Bank:
        o = self.options
        v_a, v_v, v_c = o.accel_mps2**2 * w, (o.velocity_mps * w) ** 2, o.clock_mps**2 * w
        if w <= STEP:
            v_a, v_v, v_c = o.ramp * v_a, o.ramp * v_v, o.ramp * v_c
        if only_v:
            v_a = v_c = 0.0
        cov = bank.cov.copy()
        phase = o.phase_share * prediction.T**2
        for j in range(share.shape[0]):
            a, c = share[j]
            _add(
                cov[j],
                *_rows(prediction.layout),
                a * v_a,
                a * v_v,
                c * v_c,
                c * v_c * phase,
                along,
                prediction.C_b_e,
                o.transverse,
            )
            if w > STEP and not only_v and (o.delay or o.jitter):
                self._delayed(cov[j], prediction, a * v_v, along)
        return bank._replace(cov=cov)

    def _delayed(self, cov, prediction, v_v, along) -> None:
        o, layout = self.options, prediction.layout
        d = prediction.C_b_e @ along
        V = v_v * ((1.0 - o.transverse**2) * np.outer(d, d) + o.transverse**2 * np.eye(3))
        turned = prediction.phi[layout.phase, layout.v]
        cross = -o.delay * turned @ V
        cov[layout.phase, layout.v] += cross
        cov[layout.v, layout.phase] += cross.T
        cov[layout.phase, layout.phase] += (o.delay**2 + o.jitter) * turned @ V @ turned.T

    def _raised(self, one: Gaussian, prediction: Prediction) -> Gaussian:
        """Variances of the three blocks raised to at least those of `RAISED`."""
        cov, layout = one.cov.copy(), prediction.layout
        now = np.diag(cov).copy()
        for block, sigma in zip((layout.accel_bias, layout.v, layout.cd), RAISED, strict=True):
            rows = np.arange(block.start, block.stop)
            cov[rows, rows] = np.maximum(now[rows], sigma**2)
        gained = cov[layout.cd, layout.cd][0, 0] - now[layout.cd][0]
        phase = self.options.phase_share * prediction.T**2
        _add(cov, *_rows(layout), 0.0, 0.0, 0.0, phase * gained, np.zeros(3), prediction.C_b_e, 1.0)
        return Gaussian(one.mean, cov)

    def _q(self, prediction: Prediction) -> np.ndarray:
        """Q with the unrest of the accelerometer bias under load."""
        force = math.hypot(*prediction.f_b.tolist())
        load = max(abs(force - STANDARD_GRAVITY) - 1.0, 0.0) / self.options.reference_mps2
        density = (self.options.load * load) ** 2
        if self.since_fire * prediction.T < self.options.unrest_s:
            density += self.options.unrest**2
        return with_noise(prediction, prediction.layout.accel_bias, density)

    def _update(
        self, bank: Bank, prediction: Prediction, measurement: Measurement
    ) -> tuple[Bank, list[Update]]:
        """Predict, update and weigh every hypothesis; one that is out starts from the mixture."""
        if self.step_weight is None and measurement.z.size:
            self.step_weight = radians_per(measurement, prediction) / STEP_RAD
        updates = []
        for mean, cov in zip(bank.mean, bank.cov, strict=True):
            prior = predict(Gaussian(mean, cov), prediction.phi, prediction.q)
            rule = WIDE if self._is_wide(prior, prediction) else self.rule
            updates.append(
                update(prior, measurement, rule, self.iterations, step_weight=self.step_weight)
            )
        if len(updates) == 1:
            return _bank_of_one(Gaussian(updates[0].mean, updates[0].cov)), updates
        bank = weighed(bank, updates, 0.0)
        out = bank.log_weight < np.log(RESTART_BELOW)
        if out.any():
            whole = merged(bank)
            bank.log_weight[out] = -np.inf
            bank = bank._replace(log_weight=normalised(bank.log_weight, 0.0))
            bank.mean[out], bank.cov[out] = whole
        return bank, updates

    def _is_wide(self, prior: Gaussian, prediction: Prediction) -> bool:
        """May a phase turn, or start, beyond what three points see?"""
        if self.step_weight is None:
            return False
        layout, scale = prediction.layout, self.step_weight
        if prior.cov[layout.cd.start, layout.cd.start] * scale[-1] ** 2 > 1.0:
            return True
        if not has_phases(layout):
            return False
        return bool(prior.cov.diagonal()[layout.phase].max() * (0.5 * scale[1]) ** 2 > 1.0)

    def _fires(self, windowed: float, single: float) -> bool:
        o = self.options
        if self.elapsed_s <= o.start_s or (self.bank is not None and self.age < QUIET_SET):
            return False
        if self.since_step <= AFTER_STEP:
            return single > o.gate_after_step
        return max(windowed, single) > o.gate


def seen_from_a_step(
    measurement: Measurement, prediction: Prediction, delay: float = 0.0
) -> Measurement:
    """A as it is for a velocity and a drift that have stepped at the start of this epoch.

    An integration of length L = 2 h whose last part o of it lies after the step has the mean phase
    dv o^2 / 2 L.  Seen from the end of the epoch, T after the step, that is the phase there minus
    dv (T - o^2 / 2 L), where an error as old as the integration has dv times the time to its
    middle.  The phase turned between its halves, divided by h, is the rate it shows.
    """
    if measurement.span is None:
        return measurement
    layout, T = prediction.layout, prediction.T
    middle, h = measurement.span[:, 0] - prediction.t_s, measurement.span[:, 1]
    A = measurement.A.copy()
    for columns, after in ((layout.v, (1.0 - delay) * T), (layout.cd, T)):
        o = middle + h + after
        partly = o < 2.0 * h
        o = np.maximum(o, 0.0)
        early = np.maximum(o - h, 0.0)
        rate = np.where(partly, (o**2 - 2.0 * early**2) / (2.0 * h**2), 1.0)
        A[:, -1, columns] *= rate[:, None]
        if A.shape[1] > 2:
            back = np.where(partly, (after - o**2 / (4.0 * h)) / -middle, 1.0)
            A[:, 1, columns] *= back[:, None]
    return measurement._replace(A=A)


def radians_per(measurement: Measurement, prediction: Prediction) -> np.ndarray:
    """Phase in radians per unit of each projected number y (d,): slope of Q = sin where y = 0.

    In the coherent model the rate counts by what it turns in half an epoch.
    """
    nb, d, _ = measurement.A.shape
    _, J = measurement.h_jacobian(np.zeros((nb, d)))
    slope = np.abs(J[:, 1, :]).max(axis=0)
    slope[0] = 0.0
    if d > 2:
        slope[-1] = 0.5 * prediction.T * slope[1]
    return np.asarray(slope)


def _bank_of_one(gaussian: Gaussian) -> Bank:
    return Bank(np.zeros(1), gaussian.mean[None], gaussian.cov[None])


def _rows(layout: Any) -> tuple[int, int, int, int, int, int]:
    """First rows of bias, velocity, clock bias, drift; first and last of the phases."""
    return (
        layout.accel_bias.start, layout.v.start, layout.cb.start, layout.cd.start,
        layout.phase.start, layout.phase.stop,
    )  # fmt: skip


# ---------------------------------------------------------------------------------- kernels


@kernel
def _add(
    cov: np.ndarray,
    bias: int,
    v: int,
    cb: int,
    cd: int,
    first: int,
    last: int,
    v_a: float,
    v_v: float,
    v_c: float,
    v_p: float,
    along: np.ndarray,
    C: np.ndarray,
    transverse: float,
) -> None:
    """Add the variances in place; v_p on clock bias and phases alike, fully correlated."""
    t2 = transverse**2
    for i in range(3):
        cov[bias + i, bias + i] += t2 * v_a
        cov[v + i, v + i] += t2 * v_v
        for j in range(3):
            cov[bias + i, bias + j] += (1.0 - t2) * v_a * (along[i] * along[j])
            a, b = 0.0, 0.0
            for k in range(3):
                a += C[i, k] * along[k]
                b += C[j, k] * along[k]
            cov[v + i, v + j] += (1.0 - t2) * v_v * (a * b)
    cov[cd, cd] += v_c
    cov[cb, cb] += v_p
    for i in range(first, last):
        cov[cb, i] += v_p
        cov[i, cb] += v_p
        for j in range(first, last):
            cov[i, j] += v_p
