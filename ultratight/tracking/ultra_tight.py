"""The ultra-tight closure: INS and one filter command every NCO; there are no channel loops."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.compiled import borrowing
from signals.nco import Nco, Taps
from ultratight.filters.gaussian import Filter, Gaussian, Measurement, Prediction, Update
from ultratight.filters.rules import Rule
from ultratight.ins.error_state import (
    N_WITH_SCALE,
    SCALE_FACTOR,
    Layout,
    ProcessNoise,
)
from ultratight.ins.imu import Increments
from ultratight.tracking.at_once import GATE_OPEN, TO_FILTER, AtOnce
from ultratight.tracking.code_model import code_rows
from ultratight.tracking.epoch import (
    ABSURD,
    FINE,
    NOT_FINITE,
    settle,
    transition_of,
)
from ultratight.tracking.half_bit_phases import kept_apart
from ultratight.tracking.half_bits import Bits, HalfBits
from ultratight.tracking.knows import Knows
from ultratight.tracking.lock import LockMonitor
from ultratight.tracking.measurements import NO_BITS, Amplitudes, bit_missing, measure
from ultratight.tracking.rows import Fields, Rows
from ultratight.tracking.steering import N_NAVIGATION, feed_back, start, steer_epoch

WHY = {
    NOT_FINITE: "the filter's estimate is not finite",
    ABSURD: "estimated velocity or clock drift beyond any receiver's",
}
STATES = "covariance of the error states after the update; the channels' phases are left out"
UNITS = "products of m, m/s, rad, m/s2, rad/s, m, m/s, 1"


class Settings(NamedTuple):
    """What the closure may be told; see `ultratight.scenario.Receiver` for the meanings."""

    measurement: str = "coherent"
    half_bits: bool = False
    hand_over_s: float = 2.0
    fall_back: bool = True
    return_s: float = 2.0
    epoch_s: float = 0.02
    states: int = 17


class UltraTight:
    """A receiver whose filter is the loop: `steer` gives the command, `step` takes the taps.

    Parameters
    ----------
    knows : Knows
        Everything that the receiver is told at the start; there is no other source of truth.
    settings : Settings
    filter_ : Filter
        Any object with ``step(state, prediction, measurement) -> Update`` and ``reset()``.
    spacing_chips : float
        Early and late replicas stand this far from the prompt.
    piece_s : float
        IMU interval: the command has one piece for each.
    """

    def __init__(
        self,
        knows: Knows,
        settings: Settings,
        filter_: Filter,
        spacing_chips: float,
        piece_s: float,
    ) -> None:
        self.knows, self.settings, self.filter = knows, settings, filter_
        self.spacing_chips = spacing_chips
        n = self.n_channel = knows.prn.size
        self.layout = self._layout()
        self.noise: ProcessNoise = knows.process_noise
        self._densities = np.array(self.noise)
        self.cov = knows.initial_covariance(self.layout.n_scale)
        self.steering, self.sky = start(knows, piece_s, settings.epoch_s)
        self.u_before = self.steering.u.copy()
        self.no_phase = np.zeros(n)
        facts = knows.channels
        self.half_s, self.wavelength_m = facts.half_s, facts.wavelength_m
        self.clock_lag_s = float(facts.half_s.min())
        self.half_bits = HalfBits(facts, 3)
        self.codes = code_rows(facts)
        self.amplitudes = Amplitudes(
            2.0 * 10.0 ** (knows.cn0_dbhz / 10.0) * self.half_s, np.zeros(n, dtype=np.complex128)
        )
        self.lock = LockMonitor(n, settings.epoch_s)
        self.coherent = False
        self.diverged = False
        self.returns_at_s = settings.hand_over_s
        self.epoch = 0
        self.t_s = 0.0
        self.events: list[tuple[float, int, str, str]] = []
        self.told = (math.nan, math.nan, math.nan)
        """NIS of the epoch, how many numbers were measured, fading factor"""
        self.rule: Rule | None = getattr(filter_, "at_once", None)
        self.at_once: AtOnce | None = None
        self.dump_chips = facts.dump_chips
        self.valid = np.ones(n, dtype=np.bool_)

    def _layout(self, n_phase: int = 0) -> Layout:
        return Layout.build(self.settings.states == N_WITH_SCALE, n_phase, n_phase > 0)

    def steer(self, t_end_s: float, imu: Increments) -> Nco:
        """Command one piece per increment of the epoch; each uses only earlier increments."""
        out = np.empty((5, imu.t_s.size - 1, self.n_channel))
        self.sky.reach(t_end_s)
        steer_epoch(self.steering.buffer, self.sky.arcs, imu.t_s, imu.alpha_ib_b, imu.nu_ib_b, out)
        self.t_s = t_end_s
        return Nco(imu.t_s, out[0], out[1], out[2], out[3], out[4], self.dump_chips, self.valid)

    def step(self, taps: Taps) -> None:
        """Weigh what came against what was expected; feed the correction back."""
        if self.rule is not None and not (self.coherent and self.settings.half_bits):
            self._step_at_once(taps, self.rule)
            return
        measurement = self._measurement(self.half_bits.pair(taps, self.steering))
        self._step_by_filter(measurement, *self._transition())

    def _transition(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Phi and Q of the epoch; force (2, 3): its mean and its change."""
        force = np.empty((2, 3))
        n = self.layout.n
        phi, q, work = np.empty((n, n)), np.empty((n, n)), np.empty((n + 1, n))
        transition_of(
            self.steering.buffer, self.settings.epoch_s, self.u_before, self.layout.n_scale,
            self.layout.n_phase, self.clock_lag_s, self._densities, self.epoch == 0, work, phi, q,
            force,
        )  # fmt: skip
        return phi, q, force

    def _step_at_once(self, taps: Taps, rule: Rule) -> None:
        """The same in one compiled call, and what that leaves to Python."""
        if self.at_once is None:
            self.at_once = self._bind(rule)
        one, T = self.at_once, self.settings.epoch_s
        outcome, row, nis, in_phase, square = one(
            taps, self.cov, self.sky.arcs, self.no_phase, self.t_s, T, self.epoch == 0
        )
        if outcome == FINE:
            self.told = nis, 3.0 * one.n_bit, 1.0
            channel, z = one.seen
            self.events += self.lock.heard(self.t_s, channel, z, row, in_phase)
            self._choose_model(square)
            self.epoch += 1
            return
        if outcome in WHY:
            self._give_up(WHY[outcome])
            return
        room = one.room()
        if outcome == GATE_OPEN:
            self._accept(one.faded(room, nis), one.measurement(room))
        elif outcome == TO_FILTER:
            self._step_by_filter(one.measurement(room), room.phi, room.q, room.force)
        else:
            raise bit_missing(room.number[row], room.channel[row])

    def _bind(self, rule: Rule) -> AtOnce:
        """`AtOnce` for the layout in use."""
        k, layout, facts = self.knows, self.layout, self.knows.channels
        fading, waiting, lock = getattr(self.filter, "fading", None), self.half_bits, self.lock
        if fading is not None:
            fading.prepare(self.cov, layout, 3 * self.n_channel)
        return AtOnce(
            rule, fading, layout,
            (np.array([facts.dump_chips, facts.symbol_chips, facts.overlay_length,
                       facts.overlay_start]), facts.overlay, facts.pilot, self.codes,
             NO_BITS if k.data_bits is None else k.data_bits, self._densities),
            (waiting.number, waiting.t_s, waiting.iq, self.steering.buffer, *self.amplitudes,
             self.u_before),
            (self.steering.buffer, lock.indicator, lock.locked),
            np.array([layout.n_scale, layout.n_phase, layout.phase.start, self.spacing_chips,
                      self.noise.clock_sf, self.clock_lag_s, self.settings.epoch_s, k.first_bit,
                      lock.gain]),
        )  # fmt: skip

    def _step_by_filter(
        self, measurement: Measurement, phi: np.ndarray, q: np.ndarray, force: np.ndarray
    ) -> None:
        """The filter's own step, whatever it is."""
        prediction = Prediction(
            phi, q, self.t_s, self.epoch, self.settings.epoch_s, force[0], force[1],
            self.steering.C_b_e.copy(), self.layout, self.n_channel,
        )  # fmt: skip
        try:
            u = self.filter.step(
                Gaussian(np.zeros(self.layout.n), self.cov), prediction, measurement
            )
        except np.linalg.LinAlgError as error:
            self._give_up(f"covariance: {error}")
            return
        if not isinstance(u, Update):
            raise TypeError(
                f"{type(self.filter).__name__}.step gave {type(u).__name__}, expected an "
                "ultratight.filters.gaussian.Update"
            )
        self._accept(u, measurement)

    def _accept(self, u: Update, measurement: Measurement) -> None:
        """Feed an update back, and see what it means for lock."""
        mean, cov = np.ascontiguousarray(u.mean), np.ascontiguousarray(u.cov)
        outcome = self._settle(mean, cov)
        if outcome != NOT_FINITE:
            self.told = float(u.nis), float(u.innovation.size), float(u.lam)
            self.cov = cov
            self.events += [(self.t_s, -1, *note) for note in getattr(self.filter, "notes", ())]
        if outcome != FINE:
            self._give_up(WHY[outcome])
            return
        self._watch(u, measurement)
        self.epoch += 1

    def _settle(self, mean: np.ndarray, cov: np.ndarray) -> int:
        """Feed the estimate back to INS, clock and NCOs; says what came of it, see `settle`."""
        return int(
            settle(
                self.steering.buffer, self.sky.arcs, mean, cov, self.layout.phase.start,
                self.no_phase, self.t_s,
            )
        )  # fmt: skip

    def _watch(self, u: Update, measurement: Measurement) -> None:
        """See what an epoch means for lock and for the measurement model."""
        self.events += self.lock.watch(self.t_s, measurement.channel, measurement.z)
        square = math.nan
        if self.coherent:
            square = self.lock.quadrature_square(u, measurement.z.shape[1])
        self._choose_model(square)

    def _give_up(self, reason: str) -> None:
        """The filter has diverged: there is nothing left to steer with."""
        self.diverged = True
        self.lock.lose_all(self.t_s)
        self.events.append((self.t_s, -1, "diverged", reason))

    def _measurement(self, bits: Bits) -> Measurement:
        k, layout = self.knows, self.layout
        found = measure(
            bits, self.steering, self.t_s, layout.n, layout.phase.start, self.codes,
            k.channels.pilot, self.spacing_chips, self.noise.clock_sf, self.amplitudes,
            k.data_bits, k.first_bit, self.clock_lag_s, self.settings.epoch_s,
        )  # fmt: skip
        if not (self.coherent and self.settings.half_bits):
            return found
        return kept_apart(found, bits, k.channels.pilot, k.data_bits, k.first_bit)

    def _feed_back(self, x: np.ndarray, phase_m: np.ndarray) -> None:
        n = self.layout.phase.start
        feed_back(self.steering.buffer, self.sky.arcs, x[:n], phase_m, self.t_s)

    def _choose_model(self, square: float) -> None:
        """Start in D, hand over to C; on loss fall back to D for a while, if allowed.

        square: mean normalised square of the quadrature innovations in C, NaN without any.
        """
        if self.settings.measurement != "coherent":
            return
        if not self.coherent:
            if self.t_s >= self.returns_at_s - 1e-9:
                self._hand_over()
            return
        self.lock.watch_quadrature(square)
        reason = self.lock.loss()
        if reason and self.settings.fall_back:
            self._fall_back(reason)

    def _hand_over(self) -> None:
        n = self.layout.n
        self.layout = self._layout(self.n_channel)
        radian_m = self.wavelength_m / (2.0 * np.pi)
        cov = np.zeros((self.layout.n, self.layout.n))
        cov[:n, :n] = self.cov
        cov[self.layout.phase, self.layout.phase] = np.diag(radian_m**2)
        self.cov = cov
        self._feed_back(np.zeros(n), -np.angle(self.amplitudes.prompt) * radian_m)
        self.coherent, self.at_once = True, None
        self.filter.reset()
        self.lock.restart()
        self.events.append((self.t_s, -1, "hand-over", "differential to coherent"))

    def _fall_back(self, reason: str) -> None:
        """Back to model D.  The filter was sure of what was wrong: the doubt of the start returns.

        Without that the differential model inherits a covariance that keeps it from pulling in.
        """
        self.layout = self._layout()
        n = self.layout.n
        self.cov = self.cov[:n, :n] + self.knows.initial_covariance(self.layout.n_scale)
        self.coherent, self.at_once = False, None
        self.returns_at_s = self.t_s + self.settings.return_s
        self.filter.reset()
        self.lock.restart()
        self.events.append((self.t_s, -1, "fall-back", reason))

    @property
    def epoch_s(self) -> float:
        """Length of an epoch [s]."""
        return self.settings.epoch_s

    @property
    def first_lost_s(self) -> np.ndarray:
        """(n_channel,) first loss of lock [s], NaN where there was none."""
        return self.lock.first_lost_s

    @property
    def cn0_dbhz(self) -> np.ndarray:
        """Running estimate of C/N0 per channel, from the amplitude [dB-Hz]."""
        return 10.0 * np.log10(self.amplitudes.amplitude2 / (2.0 * self.half_s))

    def fields(self) -> Fields:
        """What is kept of each epoch; the channels' phases are left out of ``covariance``."""
        n, n_state = self.n_channel, self.layout.phase.start
        channel = ((n,), ("channel",))
        scale: Fields = {
            "accel_scale_factor": ((3,), ("axis",), "1", "estimated accelerometer scale factor"),
        }
        return {
            "r_eb_e": ((3,), ("xyz",), "m", "estimated IMU position, ECEF"),
            "v_eb_e": ((3,), ("xyz",), "m/s", "estimated IMU velocity, ECEF"),
            "C_b_e": ((3, 3), ("row", "column"), "1", "estimated attitude, body to ECEF"),
            "accel_bias": ((3,), ("axis",), "m/s2", "estimated accelerometer bias, body axes"),
            "gyro_bias": ((3,), ("axis",), "rad/s", "estimated gyro bias, body axes"),
            "clock_m": ((), (), "m", "estimated receiver clock bias"),
            "clock_rate": ((), (), "m/s", "estimated receiver clock drift"),
            **(scale if self.layout.n_scale else {}),
            "covariance": ((n_state, n_state), ("state", "state_2"), UNITS, STATES),
            "nis": ((), (), "1", "normalised innovation squared (NIS) of the epoch"),
            "n_measurement": ((), (), "1", "how many numbers were measured in the epoch"),
            "fading_factor": ((), (), "1", "fading factor in use, 1 for none"),
            "coherent": ((), (), "1", "1 in the coherent model, 0 in the differential one"),
            "lock_indicator": (*channel, "1", "running mean of the in-phase measurement"),
            "cn0": (*channel, "dB-Hz", "estimated C/N0"),
        }

    def write(self, rows: Rows, k: int) -> None:
        """Write row k of each field."""
        _write(
            rows.block[k], self.steering.buffer, self.cov, self.lock.indicator,
            self.amplitudes.amplitude2, self.half_s, *self.told, float(self.coherent),
            self.layout.n_scale,
        )  # fmt: skip


# ---- kernels ---------------------------------------------------------------------------------


@borrowing
def _write(
    row: np.ndarray,
    buffer: np.ndarray,
    cov: np.ndarray,
    indicator: np.ndarray,
    amplitude2: np.ndarray,
    half_s: np.ndarray,
    nis: float,
    n_measurement: float,
    lam: float,
    coherent: float,
    n_scale: int,
) -> None:
    """The fields of an epoch, in their order."""
    at, n_state = N_NAVIGATION + n_scale, SCALE_FACTOR + n_scale
    for k in range(at):
        row[k] = buffer[k]
    for i in range(n_state):
        for j in range(n_state):
            row[at + j] = cov[i, j]
        at += n_state
    row[at], row[at + 1], row[at + 2], row[at + 3] = nis, n_measurement, lam, coherent
    at += 4
    n = indicator.size
    for i in range(n):
        row[at + i] = indicator[i]
        row[at + n + i] = 10.0 * math.log10(amplitude2[i] / (2.0 * half_s[i]))
