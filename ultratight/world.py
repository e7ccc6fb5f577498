"""World: the truth of a scenario and a seed. The receiver sees its IMU, its signals, its `Knows`.

One trajectory drives everything: the antenna's motion becomes delay and phase of each satellite,
and the same motion becomes the increments of the IMU, which is then made imperfect.  Every noise
source has its own named stream, so that switching one off changes no other.
"""

from __future__ import annotations

import logging
from functools import cached_property

import numpy as np

from signals import clock
from signals.arcs import arcs
from signals.channel import Disturbance, Effects, disturbed, effects
from signals.codes import LABELS, signal
from signals.constants import C_MPS
from signals.correlations import Correlations, correlations
from signals.correlator_model import ModelCorrelator
from signals.front_end import Recording, SyntheticIf
from signals.nco import Correlator
from signals.noise import generator
from signals.propagation import (
    SignalState,
    elevation_azimuth,
    predict_channels,
    signal_state,
)
from signals.replica import Replicas, replicas
from ultratight import sky
from ultratight.consistency import NODE_S
from ultratight.data_sheets import imu_errors, oscillator, process_noise
from ultratight.ins.attitude import rotation_from_vector
from ultratight.ins.imu import ImuErrors, Increments, corrupt
from ultratight.motion import motion
from ultratight.scenario import InvalidInput, Scenario, Unsupported
from ultratight.tracking.channels import channels
from ultratight.tracking.knows import Knows

N_NODE_PAST = 4
FEWEST_SATELLITES = 4
USUAL_SATELLITES = 7
"""Fewer above the mask are worth a warning: somewhere else than where the ephemerides are from"""
_log = logging.getLogger(__name__)


class World:
    """The simulated world.

    Parameters
    ----------
    scenario : Scenario
    seed : int
        Seed of every named random stream.
    samples : SyntheticIf or Recording, optional
        IF samples to use in place of the world's own: several receivers can then share them.

    Raises
    ------
    InvalidInput
        The sky of the scenario has fewer than four satellites, or no ephemeris at its time.
    """

    def __init__(
        self, scenario: Scenario, seed: int, samples: SyntheticIf | Recording | None = None
    ) -> None:
        self.scenario, self.seed = scenario, seed
        self._samples = samples
        self.trajectory = motion(scenario)
        # a little past the end, so that a longer run begins with the same bits
        n_node = int(np.ceil(scenario.duration_s / NODE_S - 1e-9)) + 1 + N_NODE_PAST
        self.t_s = np.arange(n_node) * NODE_S
        self.lever_arm_b_m = np.array(scenario.imu.lever_arm_b_m)
        self._start_clock()
        self._choose_satellites()

    def _start_clock(self) -> None:
        c = self.scenario.clock
        self.oscillator = oscillator("clock.model", c.model)
        force = None
        if c.g_sensitivity_ppb_per_g:  # at the middles: the force steps at nodes
            force = self.trajectory.specific_force(self.t_s[:-1] + 0.5 * NODE_S)[:, 0]
        self.clock = clock.simulate(
            self.oscillator,
            self.t_s,
            generator(self.seed, "clock"),
            c.bias_m,
            c.drift_mps,
            c.g_sensitivity_ppb_per_g,
            force,
        )

    def _choose_satellites(self) -> None:
        s = self.scenario
        self.sky = sky.constellation(s)
        prn, rows = self.sky.select(s.start_week, s.start_tow_s)
        r, v = self.antenna(np.zeros(1))
        rho, rate, u = np.empty(prn.size), np.empty(prn.size), np.empty((prn.size, 3))
        now = arcs(rows, s.start_tow_s, s.start_tow_s)
        predict_channels(now, s.start_tow_s, r[0], v[0], 0.0, 0.0, rho, rate, u)
        elevation = np.degrees(elevation_azimuth(r[0], u)[0])
        keep = elevation >= s.mask_deg
        if s.prns is not None:
            keep &= np.isin(prn, s.prns)
        order = np.argsort(-elevation, kind="stable")
        chosen = np.sort([i for i in order if keep[i]][: s.max_satellites])
        risen = int((elevation >= s.mask_deg).sum())
        if len(chosen) < FEWEST_SATELLITES:
            raise InvalidInput(self._too_few(len(chosen), risen))
        if s.constellation == "embedded" and risen < USUAL_SATELLITES:
            _log.warning(
                "constellation: %d satellites of the embedded sky above the mask; it holds those "
                "that were seen from East Asia%s",
                risen, sky.other_sky(s),
            )  # fmt: skip
        self._name_channels(prn[chosen], rows[chosen])

    def _name_channels(self, prn: np.ndarray, rows: np.ndarray) -> None:
        """Every satellite sends every signal; channels stand signal by signal."""
        s = self.scenario
        try:
            kinds = [signal(label, s.galileo_codes) for label in s.signals]
            self.rows = [row for row in kinds for _ in prn]
            self.prn = np.tile(prn, len(kinds))
            self.channels = channels(self.rows, self.prn.tolist(), s.start_tow_s)
        except ValueError as error:
            raise InvalidInput(f"signals: {error}") from None
        self.elements = np.ascontiguousarray(np.tile(rows, (len(kinds), 1)))
        self.disturbances = self._disturbances()

    def _disturbances(self) -> list[Disturbance]:
        """What befalls which channels; `InvalidInput` names a satellite that is not there."""
        found = []
        for i, d in enumerate(self.scenario.channel.disturbance):
            foreign = sorted(set(d.prns or ()) - set(self.prn.tolist()))
            if foreign:
                raise InvalidInput(
                    f"channel.disturbance[{i}].prns: {', '.join(map(str, foreign))} given, "
                    "expected some of the satellites in view: "
                    f"{', '.join(map(str, np.unique(self.prn).tolist()))}"
                )
            affected = np.isin(self.prn, self.prn if d.prns is None else d.prns)
            if d.elevation_deg is not None or d.azimuth_deg is not None:
                t = np.array([d.t0_s])
                affected &= sky.stands_between(
                    self.scenario, self.sky, self.prn, self.true_time(t), self.antenna(t)[0], d
                )
            t1 = np.inf if d.t1_s is None else d.t1_s
            change = d.cn0_change_db, d.pseudorange_m, d.pseudorange_rate_mps
            found.append(Disturbance(d.t0_s, t1, affected, *change))
        return found

    def _too_few(self, kept: int, risen: int) -> str:
        """Name the key that left too few satellites."""
        s = self.scenario
        least = f"expected at least {FEWEST_SATELLITES}"
        if risen < FEWEST_SATELLITES:
            return (
                f"mask_deg: {risen} satellites of {s.constellation} at or above {s.mask_deg:g} deg "
                f"at the start, {least}{sky.other_sky(s)}"
            )
        key = "max_satellites" if s.prns is None else "prns"
        return f"{key}: leaves {kept} of {risen} satellites above the mask, {least}"

    @property
    def names(self) -> list[str]:
        """Channel names, such as G05:L1CA."""
        return [row.channel(p) for row, p in zip(self.rows, self.prn.tolist(), strict=True)]

    def true_time(self, t_s: np.ndarray) -> np.ndarray:
        """GPS time since the nominal start, at receiver times [s]."""
        late = np.minimum(t_s, 0.0) * self.clock.clock_rate_mps[0]
        return t_s - (np.interp(t_s, self.t_s, self.clock.clock_m) + late) / C_MPS

    def antenna(self, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """True antenna position and velocity (n, 3) at receiver times [m, m/s]."""
        return self.trajectory.antenna(self.true_time(t_s), self.lever_arm_b_m)

    @cached_property
    def symbols(self) -> tuple[int, np.ndarray]:
        """Number of the first symbol, and all symbols (n_channel, n_symbol)."""
        return sky.symbols(
            self.scenario, self.seed, self.sky, self.rows, self.prn, self.channels, self.t_s
        )

    @cached_property
    def signal(self) -> SignalState:
        """Delay and phase of each satellite as they reach the antenna."""
        return self.signal_between(0, len(self.t_s) - 1)

    def signal_between(self, first: int, last: int, valid: np.ndarray | None = None) -> SignalState:
        """`signal` from one node to another; ``valid`` (n_channel,): channels that are received."""
        part = slice(first, last + 1)
        r, v = self.antenna(self.t_s[part])
        first_bit, bits = self.symbols
        state = signal_state(
            self.elements,
            self.scenario.start_tow_s,
            self.t_s[part],
            r,
            v,
            self.clock.clock_m[part],
            self.clock.clock_rate_mps[part],
            self._cn0_dbhz(self.t_s[part]),
            bits,
            first_bit,
            valid,
            self.channels.nominal,
        )
        state = sky.with_atmosphere(self.scenario, self.sky, self.prn, self.channels, r, state)
        return disturbed(state, self.disturbances, self.channels.nominal)

    def effects(self, t_s: np.ndarray) -> Effects:
        """What the scenario's disturbances do at receiver times t_s (n,)."""
        return effects(self.disturbances, t_s, self.prn.size)

    def cn0_dbhz(self, t_s: np.ndarray) -> np.ndarray:
        """True C/N0 (n, n_channel) at receiver times t_s (n,)."""
        level = self._cn0_dbhz(t_s)
        if level.ndim == 1:
            level = level[:, None]
        return np.asarray((level + self.effects(t_s).cn0_change_db).T)

    def _cn0_dbhz(self, t_s: np.ndarray) -> np.ndarray:
        s = self.scenario
        names = [name.partition(":")[0] for name in self.names]
        foreign = set(s.channel.cn0_by_prn_dbhz) - set(names)
        if foreign:
            seen = ", ".join(dict.fromkeys(names))
            raise InvalidInput(
                f"channel.cn0_by_prn_dbhz: {', '.join(sorted(foreign))} given, expected some of "
                f"the satellites in view: {seen}"
            )
        level = np.array([s.channel.cn0_by_prn_dbhz.get(name, s.cn0_dbhz) for name in names])
        if not s.channel.cn0_profile_s_db:
            return level
        t, offset = np.array(s.channel.cn0_profile_s_db).T
        return level[:, None] + np.interp(t_s, t, offset)

    @cached_property
    def imu(self) -> tuple[Increments, dict[str, np.ndarray]]:
        """What the IMU reports from one interval before the start on, and its true errors."""
        dt = 1.0 / self.scenario.imu.rate_hz
        n = round(self.scenario.duration_s / dt)
        t = np.arange(-1, n + 1) * dt
        alpha, nu = self.trajectory.increments(self.true_time(t))
        return corrupt(Increments(t, alpha, nu), self.errors, self.seed)

    @cached_property
    def errors(self) -> ImuErrors:
        """The grade with the scenario's changes; a fixed scale factor alternates by seed."""
        return imu_errors(self.scenario, self.seed)

    @cached_property
    def waveforms(self) -> Replicas:
        """One period of the replica of each channel."""
        rows = [r.subchips(p) for r, p in zip(self.rows, self.prn.tolist(), strict=True)]
        return replicas(rows, [row.per_chip for row in self.rows])

    @cached_property
    def samples(self) -> SyntheticIf | Recording:
        """The IF samples: those given, or the world's own, generated where they are asked for.

        They hold the channels of one carrier.  `InvalidInput` where Doppler lifts the sub-chip
        rate of a signal above the sampling rate.
        """
        if self._samples is not None:
            return self._samples
        f = self.scenario.front_end
        try:
            return SyntheticIf(
                self.signal,
                self.waveforms,
                sample_rate_hz=f.sample_rate_hz,
                if_hz=f.if_hz,
                seed=self.seed,
                sample_format=f.sample_format,
                symbol_chips=self.channels.symbol_chips,
            )
        except ValueError as error:
            raise InvalidInput(f"front_end: {error}") from None

    @cached_property
    def correlations(self) -> Correlations:
        """Autocorrelation of the replica of each channel."""
        return correlations(self.waveforms)

    def correlator(self) -> Correlator:
        """A fresh correlator of the scenario's kind."""
        c = self.scenario.correlator
        if c.kind == "model":
            if self._samples is not None:
                raise Unsupported("correlator.kind: the closed form takes no samples")
            kind = np.array([LABELS.index(row.label) for row in self.rows])
            length = np.array([row.length_chips for row in self.rows])
            return ModelCorrelator(
                self.signal,
                self.correlations,
                self.prn + 256 * kind,
                self.offset_chips,
                self.seed,
                symbol_chips=self.channels.symbol_chips,
                # of a code longer than an integration any part stands for all
                period_chips=np.gcd(self.channels.dump_chips, length),
                multiple_access=c.multiple_access,
            )
        from signals.correlator import SampleCorrelator  # takes a while, and the model needs none

        return SampleCorrelator(self.samples, self.waveforms, self.offset_chips)

    @property
    def offset_chips(self) -> np.ndarray:
        """Early, prompt, late."""
        spacing = self.scenario.correlator.spacing_chips
        return np.array([-spacing, 0.0, spacing])

    @cached_property
    def knows(self) -> Knows:
        """What the receiver is told: drawn around the truth with the stated sigmas."""
        s, k = self.scenario, self.scenario.receiver.knows
        rng = generator(self.seed, "receiver.initial-state")
        m = self.trajectory.at(self.true_time(np.zeros(1)))
        tilt, heading = 1e-3 * k.tilt_sigma_mrad, 1e-3 * k.heading_sigma_mrad
        r = m.r_eb_e[0] - k.position_sigma_m * rng.standard_normal(3)
        v = m.v_eb_e[0] - k.velocity_sigma_mps * rng.standard_normal(3)
        psi = self.trajectory.C_n_e @ (rng.standard_normal(3) * [tilt, tilt, heading])
        clock_m = self.clock.clock_m[0] - k.clock_sigma_m * rng.standard_normal()
        rate = self.clock.drift_mps[0] - k.clock_rate_sigma_mps * rng.standard_normal()
        e = self.errors
        sigma = np.repeat(
            [
                k.position_sigma_m,
                k.velocity_sigma_mps,
                max(tilt, heading),
                np.hypot(e.accel_bias_turn_on, e.accel_bias_in_run),
                np.hypot(e.gyro_bias_turn_on, e.gyro_bias_in_run),
            ],
            3,
        )
        increments = self.imu[0]
        cn0 = self.signal.cn0_dbhz[:, 0] + k.cn0_sigma_db * generator(
            self.seed, "receiver.cn0"
        ).standard_normal(self.prn.size)
        return Knows(
            start_week=s.start_week,
            start_tow_s=s.start_tow_s,
            prn=self.prn,
            elements=self.elements,
            channels=self.channels,
            cn0_dbhz=cn0,
            r_eb_e=r,
            v_eb_e=v,
            C_b_e=rotation_from_vector(-psi) @ m.C_b_e[0],
            clock_m=float(clock_m),
            clock_rate_mps=float(rate),
            first_alpha=increments.alpha_ib_b[0],
            first_nu=increments.nu_ib_b[0],
            sigma=np.append(sigma, [k.clock_sigma_m, k.clock_rate_sigma_mps]),
            lever_arm_b_m=self.lever_arm_b_m,
            noise=np.array(process_noise(s, e)),
            data_bits=self.signal.symbols if k.data_bits else None,
            first_bit=self.signal.first_symbol,
            scale_factor_sigma=1e-6 * k.accel_scale_factor_sigma_ppm,
        )
