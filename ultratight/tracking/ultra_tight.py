"""The ultra-tight closure: INS and one filter command every NCO; there are no channel loops."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.compiled import borrowing
from signals.nco import Nco, Taps
from ultratight.filters.gaussian import Filter, Gaussian, Measurement, Prediction, Update
from ultratight.ins.error_state import (
    N_WITH_SCALE,
    SCALE_FACTOR,
    Layout,
    ProcessNoise,
    clock_step_into,
    transition_into,
)
from ultratight.ins.imu import Increments
from ultratight.tracking.code_model import code_rows
from ultratight.tracking.half_bit_phases import kept_apart
from ultratight.tracking.half_bits import Bits, HalfBits
from ultratight.tracking.knows import Knows
from ultratight.tracking.lock import LockMonitor
from ultratight.tracking.measurements import Amplitudes, measure
from ultratight.tracking.rows import Fields, Rows
from ultratight.tracking.steering import (
    N_NAVIGATION,
    feed_back,
    lever,
    start,
    steer_epoch,
    views,
)

ABSURD_SPEED_MPS = 2e4
ABSURD_DRIFT_MPS = 4e4
"""Beyond what a scenario may ask for: an estimate there has nothing to do with a receiver"""
FINE, NOT_FINITE, ABSURD = range(3)
"""What may come of an estimate"""
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
        self.update: Update | None = None
        self.bits: Bits | None = None
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
        bits = self.bits = self.half_bits.pair(taps, self.steering)
        measurement = self._measurement(bits)
        prediction = self._prediction()
        n = prediction.phi.shape[0]
        try:
            u = self.filter.step(Gaussian(np.zeros(n), self.cov), prediction, measurement)
        except np.linalg.LinAlgError as error:
            self._give_up(f"covariance: {error}")
            return
        if not isinstance(u, Update):
            raise TypeError(
                f"{type(self.filter).__name__}.step gave {type(u).__name__}, expected an "
                "ultratight.filters.gaussian.Update"
            )
        mean, cov = np.ascontiguousarray(u.mean), np.ascontiguousarray(u.cov)
        outcome = _settle(
            self.steering.buffer, self.sky.arcs, mean, cov, self.layout.phase.start, self.no_phase,
            self.t_s,
        )  # fmt: skip
        if outcome == NOT_FINITE:
            self._give_up("the filter's estimate is not finite")
            return
        self.update, self.cov = u, cov
        self.events += [(self.t_s, -1, *note) for note in getattr(self.filter, "notes", ())]
        if outcome == ABSURD:
            self._give_up("estimated velocity or clock drift beyond any receiver's")
            return
        self.events += self.lock.watch(self.t_s, bits.channel, measurement.z)
        self._choose_model(u, measurement)
        self.epoch += 1

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

    def _prediction(self) -> Prediction:
        s, n, T = self.steering, self.layout.n, self.settings.epoch_s
        phi, q, force = np.empty((n, n)), np.empty((n, n)), np.empty((2, 3))
        work = np.empty((n + 1, n))
        _transition(
            s.buffer, T, self.u_before, self.layout.n_scale, self.layout.n_phase,
            self.clock_lag_s, self._densities, work, phi, q, force,
        )  # fmt: skip
        if self.epoch == 0:
            force[1] = 0.0
        return Prediction(
            phi, q, self.t_s, self.epoch, T, force[0], force[1], s.C_b_e.copy(), self.layout,
            self.n_channel,
        )  # fmt: skip

    def _feed_back(self, x: np.ndarray, phase_m: np.ndarray) -> None:
        n = self.layout.phase.start
        feed_back(self.steering.buffer, self.sky.arcs, x[:n], phase_m, self.t_s)

    def _choose_model(self, u: Update, measurement: Measurement) -> None:
        """Start in D, hand over to C; on loss fall back to D for a while, if allowed."""
        if self.settings.measurement != "coherent":
            return
        if not self.coherent:
            if self.t_s >= self.returns_at_s - 1e-9:
                self._hand_over()
            return
        self.lock.watch_quadrature(u, measurement)
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
        self.coherent = True
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
        self.coherent = False
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
        u = self.update
        nis, size, lam = (u.nis, u.innovation.size, u.lam) if u is not None else (np.nan,) * 3
        _write(
            rows.block[k], self.steering.buffer, self.cov, self.lock.indicator,
            self.amplitudes.amplitude2, self.half_s, float(nis), float(size), float(lam),
            float(self.coherent), self.layout.n_scale,
        )  # fmt: skip


# ---- kernels ---------------------------------------------------------------------------------


@borrowing
def _transition(
    buffer: np.ndarray,
    T: float,
    u_before: np.ndarray,
    n_scale: int,
    n_phase: int,
    clock_lag_s: float,
    density: np.ndarray,
    work: np.ndarray,
    Phi: np.ndarray,
    Q: np.ndarray,
    force: np.ndarray,
) -> None:
    """Phi and Q of the epoch of T seconds that ends now; force (2, 3): its mean and its change.

    u_before (n_channel, 3) comes with the lines of sight of the epoch before, leaves with these.
    """
    s = views(buffer, u_before.shape[0])
    _, _, _, vx, vy, vz = lever(s)
    for i in range(u_before.shape[0]):
        for k in range(3):
            u_before[i, k] = (s.u[i, k] - u_before[i, k]) / T
    transition_into(
        s.r_eb_e, s.C_b_e, s.mean_force[0], T, s.u, u_before, (vx, vy, vz), n_scale, n_phase,
        density, work, Phi, Q,
    )  # fmt: skip
    if n_phase:
        clock_step_into(T, clock_lag_s, n_scale, n_phase, density, Phi, Q)
    for i in range(u_before.shape[0]):
        for k in range(3):
            u_before[i, k] = s.u[i, k]
    for k in range(3):
        force[0, k] = s.mean_force[0, k]
        force[1, k] = s.mean_force[0, k] - s.mean_force[1, k]


@borrowing
def _settle(
    buffer: np.ndarray,
    sky: np.ndarray,
    mean: np.ndarray,
    cov: np.ndarray,
    n: int,
    no_phase: np.ndarray,
    t_s: float,
) -> int:
    """Feed back an estimate of n states and phases, if any, where it is finite; is it absurd?"""
    total = 0.0
    for i in range(mean.size):
        total += 0.0 * mean[i]
        for j in range(mean.size):
            total += 0.0 * cov[i, j]
    if total != 0.0:
        return NOT_FINITE
    feed_back(buffer, sky, mean[:n], mean[n:] if mean.size > n else no_phase, t_s)
    s = views(buffer, no_phase.size)
    v = s.v_eb_e
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return ABSURD if speed > ABSURD_SPEED_MPS or abs(s.clock[1]) > ABSURD_DRIFT_MPS else FINE


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
