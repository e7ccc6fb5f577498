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

JTQ-R goes further (docs/jtq.md): a sensor errs along the change of force that it saw, hence the
blocks are opened along it, and less on a ramp; after the score test has fired the bias stays
restless for a second; what half a second of vibration shows as usual triggers nothing; the
half-bit prompts are kept apart, and where a step or its feedback turns them they are modelled by
their exact mean (`turned_prompts`), with a search of instant and size of a step of the drift.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from signals.constants import STANDARD_GRAVITY
from ultratight.filters.door import check_step
from ultratight.filters.gaussian import Gaussian, Measurement, Prediction, Update, predict, update
from ultratight.filters.multiple_model import (
    Bank,
    bank_of,
    fed_back,
    merged,
    mixed,
    normalised,
    report,
    weighed,
    with_noise,
)
from ultratight.filters.opened_blocks import raised, seen_from_a_step, told, widen
from ultratight.filters.relinearisation import STEP_RAD, WIDE, is_wide, radians_per
from ultratight.filters.rules import Rule
from ultratight.filters.score import ScoreTest
from ultratight.filters.turned_prompts import (
    STEPPED,
    are_half_bits,
    freed_of_kink,
    searched,
    stepped,
)

NONE, ACCELERATION, CLOCK, BOTH = range(4)
STEP = 0.05
"""A change of force is a step above this w, part of a ramp below"""
RAISED = (2.0, 0.5, 3.0)
"""Least sigma of bias, velocity and drift after the score test has fired"""
RESTART_BELOW, DECIDED_ABOVE = 1e-6, 0.9999
"""Weights at which a hypothesis starts anew, and at which the others are given up"""
LONGEST_SET = 50
"""Epochs after which hypotheses are merged"""
QUIET_SET, AFTER_STEP = 3, 25
"""Epochs without a score test after hypotheses were made, with the higher gate after a step"""
LOUD = 2.0
"""Mean in-phase number of model D beyond which power has returned unknown to the amplitudes"""
PASSES_AT_STEP, SEARCHED_MPS, TAIL = 6, 0.5, 4.0
"""Linearisations at a step; how well a search finds it; beyond how many variances it is a tail"""
USUAL = 25
"""Epochs that say which changes of force are usual"""


@dataclass(frozen=True)
class JumpOptions:
    """Sizes of the surprises, and which of the parts are at work; the default is JTQ."""

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
    ramp: float = 1.0  # share of V on a ramp
    unrest: float = 0.0  # of the bias after the score test has fired [m/s2/sqrt(s)]
    unrest_s: float = 1.0  # how long
    unusual: float = 0.0  # no trigger below so many medians of the second difference of the force
    wide: bool = True  # more points where phase or rate may be off by a good part of a radian
    half_bits: bool = False  # asks for the half-bit prompts kept apart
    cold: bool = False  # the first force that is seen counts as a change from rest
    exact: bool = False  # these by their exact mean where a step or a feedback turns them
    trigger: bool = True
    hypotheses: bool = True  # False: all blocks opened in one Gaussian
    gate: float = 40.0  # of the score test; inf: none
    gate_after_step: float = 80.0
    start_s: float = 1.0  # no score test before

    def __post_init__(self) -> None:
        sizes = (
            self.dead_zone_mps2, self.accel_mps2, self.velocity_mps, self.clock_mps, self.spill,
            self.load, self.phase_share, self.transverse, self.ramp, self.unrest,
            self.unrest_s, self.unusual, self.start_s,
        )  # fmt: skip
        if not (all(size >= 0.0 for size in sizes) and self.reference_mps2 > 0.0):
            raise ValueError(f"{self}: expected sizes >= 0 and reference_mps2 > 0")
        if not (self.gate > 0.0 and self.gate_after_step > 0.0):
            raise ValueError(f"gates: {self.gate}, {self.gate_after_step}, expected above 0")
        p = self.prior
        if not (len(p) == 4 and all(x > 0.0 for x in p) and abs(sum(p) - 1.0) <= 1e-9):
            raise ValueError(f"prior: {self.prior}, expected four positive numbers of sum 1")
        if not 0.0 < self.stay < 1.0:
            raise ValueError(f"stay: {self.stay}, expected 0 < stay < 1")

    def make(self, rule: Rule, iterations: int) -> JumpTriggered:
        """The filter with these options."""
        return JumpTriggered(self, rule, iterations)


JTQ = JumpOptions()
JTQ_E = replace(JTQ, half_bits=True)
J1 = replace(JTQ, hypotheses=False)
IO = replace(JTQ, trigger=False, hypotheses=False)
JTQ_R = replace(
    JTQ_E, transverse=0.1, prior=(0.3, 0.3, 0.2, 0.2), ramp=0.3, unrest=8.0, load=0.005,
    unusual=4.0, exact=True, cold=True,
)  # fmt: skip


class JumpTriggered:
    """JTQ and its relatives at work.

    ``notes`` says what the last step has done: (kind, reason), for the receiver's events.
    """

    def __init__(self, options: JumpOptions, rule: Rule, iterations: int) -> None:
        self.options, self.rule, self.iterations = options, rule, iterations
        self.score = ScoreTest()
        self.prior = np.array(options.prior)
        self.transition = options.stay * np.eye(4) + (1.0 - options.stay) * self.prior
        s = options.spill
        self.share = ((s, s), (1.0, s), (s, 1.0), (1.0, 1.0))
        self.notes: list[tuple[str, str]] = []
        self.fed_bias = np.zeros(3)
        self.last_change = (0.0, 0.0, 0.0)
        self.second = [0.0] * USUAL
        self.slot = 0
        self.reset()

    @property
    def half_bits(self) -> bool:
        """Does it ask for the half-bit prompts kept apart?"""
        return self.options.half_bits

    def reset(self) -> None:
        """Start again from one Gaussian: the state or the measurement model has changed."""
        self.bank: Bank | None = None  # None: one hypothesis, the receiver's own
        self.age = 0  # epochs since the hypotheses were made
        self.since_step = self.since_fire = 10**9
        self.elapsed_s = 0.0
        self.step_weight: np.ndarray | None = None
        self.fed: np.ndarray | None = None
        self.stepping = False
        self.late_s = self.drift = 0.0  # of the last step: after the start of its epoch, size
        self.score.reset()

    def step(self, state: Gaussian, prediction: Prediction, measurement: Measurement) -> Update:
        """Open, predict, update and weigh; reopen where the score test fires."""
        check_step(state, prediction, measurement, definite=False)
        o = self.options
        self.notes = []
        again = self.since_step == 0
        self.age += 1
        self.since_step += 1
        self.since_fire += 1
        self.elapsed_s += prediction.T
        before = self.bank if self.bank is not None else _bank_of_one(state)
        bank = self._open(before, prediction)
        self.stepping = False
        if o.exact and are_half_bits(measurement):
            measurement = self._exactly(bank, prediction, measurement, again)
        if self.since_step == 0 and not self.stepping:
            measurement = seen_from_a_step(measurement, prediction)
        loaded = prediction._replace(q=self._q(prediction))
        bank, updates = self._update(bank, loaded, measurement)
        if measurement.z.size and o.gate < math.inf:
            j = int(bank.log_weight.argmax()) if len(updates) > 1 else 0
            windowed, single = self.score.watch(loaded, updates[j])
            if measurement.A.shape[1] == 2 and measurement.z[:, 0].mean() > LOUD:
                self.score.reset()  # what is off is the scale of every number, not the motion
            elif self._fires(windowed, single):
                self.notes.append(("reopened", f"score test {max(windowed, single):.0f}"))
                self.score.reset()
                self.since_fire = 0
                one = raised(merged(before), prediction, RAISED, o.phase_share)
                bank, updates = self._update(_bank_of_one(one), loaded, measurement)
        result = updates[0] if len(updates) == 1 else report(bank, updates)
        self.bank = fed_back(bank, result.mean) if len(updates) > 1 else None
        self.fed, self.fed_bias = result.mean, result.mean[prediction.layout.accel_bias]
        return result

    def _exactly(
        self, bank: Bank, prediction: Prediction, measurement: Measurement, again: bool
    ) -> Measurement:
        """The measurement freed of a large feedback, and with a step in it where there is one.

        again: there was one in the epoch before; it may be the same, seen in two halves.
        """
        if self.fed is not None:
            stepped_s = self.late_s - prediction.T if again else -math.inf
            measurement = freed_of_kink(measurement, prediction, self.fed, stepped_s)
        self.stepping = self.since_step == 0
        if not self.stepping:
            return measurement
        j = min(CLOCK, len(bank.mean) - 1)
        prior = predict(Gaussian(bank.mean[j], bank.cov[j]), prediction.phi, prediction.q)
        self.late_s, self.drift = searched(prior, measurement, prediction, since_before=again)
        return stepped(measurement, prediction, self.late_s)

    def _open(self, bank: Bank, prediction: Prediction) -> Bank:
        """The bank with the blocks opened that the change of force casts doubt on."""
        o, several = self.options, bank.log_weight.size > 1
        if o.cold and prediction.epoch == 0:
            bank = self._from_rest(bank, prediction)
        # the receiver's force is free of the bias, whose estimate has just moved
        change = prediction.df_b + self.fed_bias
        df = math.hypot(*change.tolist()) if o.trigger else 0.0
        w = max(df - o.dead_zone_mps2, 0.0) / o.reference_mps2
        if o.unusual and df < self._usual(change):
            w = 0.0
        if w == 0.0:
            if not several:
                return bank
            decided = bank.log_weight.max() > math.log(DECIDED_ABOVE)
            return _bank_of_one(merged(bank)) if decided or self.age > LONGEST_SET else bank
        if w > STEP:
            self.notes.append(("opened", f"specific force changed by {df:.1f} m/s2"))
            self.score.reset()
            self.since_step = 0
        if not o.hypotheses:
            return self._widened(bank, prediction, w, change / df, ((1.0, 1.0),))
        if w > STEP or not several:
            self.age = 0
            bank = bank_of(merged(bank), self.prior)
        else:
            bank = mixed(bank, self.transition)
        return self._widened(bank, prediction, w, change / df, self.share)

    def _from_rest(self, bank: Bank, prediction: Prediction) -> Bank:
        """A flight that begins under load: calibrated at rest, the sensor errs by all of e(f)."""
        o = self.options
        w = self._load(prediction) / o.reference_mps2
        if not (o.trigger and w > 0.0):
            return bank
        along = prediction.f_b / math.hypot(*prediction.f_b.tolist())
        cov = bank.cov.copy()
        for j in range(len(cov)):
            widen(cov[j], prediction, (o.accel_mps2**2 * w, 0.0, 0.0, 0.0), along, o.transverse)
        return bank._replace(cov=cov)

    def _load(self, prediction: Prediction) -> float:
        """What the specific force is away from that at rest [m/s2]."""
        force = math.hypot(*prediction.f_b.tolist())
        return max(abs(force - STANDARD_GRAVITY) - 1.0, 0.0)

    def _usual(self, change: np.ndarray) -> float:
        """Changes of force below are vibration, by the median of what half a second has shown.

        The second difference is blind to a ramp, and a jump is two of 25 values.
        """
        now = tuple(change.tolist())
        gate = self.options.unusual * sorted(self.second)[USUAL // 2]
        self.second[self.slot] = math.dist(now, self.last_change)
        self.last_change, self.slot = now, (self.slot + 1) % USUAL
        return gate

    def _widened(
        self,
        bank: Bank,
        prediction: Prediction,
        w: float,
        along: np.ndarray,
        share: tuple[tuple[float, float], ...],
    ) -> Bank:
        """Hypothesis j gets its shares of V: of bias and velocity, of the clock."""
        o, cov = self.options, bank.cov.copy()
        part = o.ramp if w <= STEP else 1.0
        v_a, v_v = part * o.accel_mps2**2 * w, part * (o.velocity_mps * w) ** 2
        v_c = part * o.clock_mps**2 * w
        common = o.phase_share * prediction.T**2
        for j, (a, c) in enumerate(share):
            sizes = (a * v_a, a * v_v, c * v_c, c * v_c * common)
            widen(cov[j], prediction, sizes, along, o.transverse)
        return bank._replace(cov=cov)

    def _q(self, prediction: Prediction) -> np.ndarray:
        """Q with the unrest of the accelerometer bias, under load and after the score test."""
        load = self._load(prediction) / self.options.reference_mps2
        density = (self.options.load * load) ** 2
        if self.since_fire * prediction.T < self.options.unrest_s:
            density += self.options.unrest**2
        return with_noise(prediction, prediction.layout.accel_bias, density)

    def _update(
        self, bank: Bank, prediction: Prediction, measurement: Measurement
    ) -> tuple[Bank, list[Update]]:
        """Predict, update and weigh every hypothesis; one that is out starts from the mixture."""
        if self.step_weight is None and measurement.z.size and not self.stepping:
            self.step_weight = radians_per(measurement, prediction) / STEP_RAD
        updates = []
        for j, (mean, cov) in enumerate(zip(bank.mean, bank.cov, strict=True)):
            prior = predict(Gaussian(mean, cov), prediction.phi, prediction.q)
            if self.stepping:
                clock = len(bank.mean) == 1 or j in (CLOCK, BOTH)
                updates.append(self._condition_step(prior, prediction, measurement, clock))
            else:
                updates.append(self._condition(prior, prediction, measurement))
        if len(updates) == 1:
            return _bank_of_one(Gaussian(updates[0].mean, updates[0].cov)), updates
        bank = weighed(bank, updates, 0.0)
        out = bank.log_weight < math.log(RESTART_BELOW)
        if out.any():
            whole = merged(bank)
            bank.log_weight[out] = -np.inf
            bank = bank._replace(log_weight=normalised(bank.log_weight, 0.0))
            bank.mean[out], bank.cov[out] = whole
        return bank, updates

    def _condition(
        self, prior: Gaussian, prediction: Prediction, measurement: Measurement
    ) -> Update:
        """The relinearised update of one hypothesis."""
        weight, rule = self.step_weight, self.rule
        if self.options.wide and weight is not None and is_wide(prior, prediction, weight):
            rule = WIDE
        return update(prior, measurement, rule, self.iterations, step_weight=weight)

    def _condition_step(
        self, prior: Gaussian, prediction: Prediction, seen: Measurement, clock: bool
    ) -> Update:
        """The same where velocity and drift may have stepped at the instant that was searched.

        If the clock is in doubt, the search says where to linearise first; a step beyond what was
        thought possible is then as likely as it is large.
        """
        start = prior
        if clock:
            cd, d = prediction.layout.cd.start, self.drift
            column = prediction.phi[:, cd]
            excess = max(d * d - TAIL * prior.cov[cd, cd], 0.0)
            prior = Gaussian(prior.mean, prior.cov + excess * np.outer(column, column))
            start = Gaussian(prior.mean + column * d, told(prior.cov, cd, SEARCHED_MPS))
        weight = self.step_weight
        weight = None if weight is None else np.append(weight, weight[-1])
        return update(prior, seen, STEPPED, PASSES_AT_STEP, start=start, step_weight=weight)

    def _fires(self, windowed: float, single: float) -> bool:
        o = self.options
        if self.elapsed_s <= o.start_s or (self.bank is not None and self.age < QUIET_SET):
            return False
        if self.since_step <= AFTER_STEP:
            return single > o.gate_after_step
        return max(windowed, single) > o.gate


def _bank_of_one(gaussian: Gaussian) -> Bank:
    return Bank(np.zeros(1), gaussian.mean[None], gaussian.cov[None])
