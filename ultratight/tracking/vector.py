"""The vector closures: one filter on position, velocity and clock of a receiver without IMU.

Its states are r, v (antenna, ECEF), clock bias and drift, and the acceleration where there are 11:

    8     acceleration is white noise of the density that was told
    11    acceleration is driven by white jerk and fades when nobody measures it (Gauss-Markov)

Every update (a data bit, or a few) takes range and rate of all channels (`vector_measurements`),
each with the variance that its measured C/N0 gives, and commands the NCOs to where the solution
expects each satellite at the next one:

    VDLL     the code of all channels; each keeps its own carrier loop (FLL-assisted PLL, Costas)
    VDFLL    code and carrier frequency of all channels

(Spilker in Parkinson & Spilker, 1996, vol. I, ch. 7; Lashley, Bevly & Hung, PLANS 2010.)  Both
weigh the same measurements; a VDLL's rates come through its carrier loops' NCOs.

Membership is not lock.  A channel whose signal is too weak is left out of the sums, and stays where
the others say that it should be; when the signal is back it counts with the first bit.  When the
solution itself no longer knows within the reach of the taps where that is, as after an outage of
all, the channel searches around it (`vector_search`).  A signal
that is there and contradicts all the others (a satellite's clock, a reflection) is left out too,
and falls back to its own scalar loops until it agrees again or is lost.
"""

from __future__ import annotations

import numpy as np

from signals.code_start import code_phase_origin
from signals.constants import C_MPS, CA_CHIP_RATE_HZ
from signals.nco import Nco, Taps
from ultratight.filters.gaussian import Gaussian, Measurement, Update, predict, update
from ultratight.filters.rules import get_rule
from ultratight.ins.imu import Increments
from ultratight.tracking.channel_loops import (
    EVENTS,
    LOCKED,
    PULL_IN,
    WAVELENGTH_M,
    Loops,
    advance,
    close_loops,
    new_loops,
)
from ultratight.tracking.epoch import ABSURD_DRIFT_MPS, ABSURD_SPEED_MPS
from ultratight.tracking.knows import Knows
from ultratight.tracking.rows import Fields, Rows
from ultratight.tracking.scalar import BIT_S, CODE_CHIPS, EPOCH_S, ScalarSettings, design
from ultratight.tracking.steering import antenna, start
from ultratight.tracking.vector_dwell import FOUND_ABOVE_DBHZ
from ultratight.tracking.vector_faults import RETURN, Faults
from ultratight.tracking.vector_measurements import (
    amplitude2_of,
    cn0_of,
    code_facts,
    new_bits,
    observe,
    take_in,
)
from ultratight.tracking.vector_search import Search, agreeing
from ultratight.tracking.vector_solution import (
    VectorSettings,
    fields_of,
    steer_members,
    transition,
    uncertainty,
)

LOST_BELOW_DBHZ = 13.0
"""Of the running C/N0, whose noise without a signal reaches it at 3 sigma"""


class Vector:
    """A receiver whose channels share one solution: `steer` gives the command, `step` takes taps.

    Parameters
    ----------
    knows : Knows
        Everything that the receiver is told at the start; data bits and IMU are not used.
    settings : VectorSettings
    loops : ScalarSettings
        Of the channels' own loops: a VDLL's carriers, and whoever falls back.
    spacing_chips : float
        Early and late replicas stand this far from the prompt.

    Raises
    ------
    ValueError
        A setting that is out of range, by name.
    """

    epoch_s = EPOCH_S

    def __init__(
        self, knows: Knows, settings: VectorSettings, loops: ScalarSettings, spacing_chips: float
    ) -> None:
        self.every = round(settings.update_s / EPOCH_S)
        if (
            self.every < 1
            or abs(settings.update_s / BIT_S - round(settings.update_s / BIT_S)) > 1e-9
        ):
            raise ValueError(f"update_s is {settings.update_s}: expected a multiple of {BIT_S} s")
        self.knows, self.settings = knows, settings
        n = self.n_channel = knows.prn.size
        steering, self.sky = start(knows, settings.update_s)
        r, v = antenna(steering.buffer, n)
        self.x = np.zeros(settings.states)
        self.x[:8] = *r, *v, knows.clock_m, knows.clock_rate_mps
        own = np.full(settings.states - 8, settings.acceleration_sigma_mps2)
        self.cov = np.diag(np.concatenate([knows.sigma[:6], knows.sigma[15:17], own]) ** 2)
        self.phi, self.q = transition(settings, *knows.process_noise[4:6])
        self.code = code_facts(knows.prn, spacing_chips)
        self.bits = new_bits(knows.cn0_dbhz)
        self.design = design(loops, knows, spacing_chips)
        self.loops: Loops = new_loops(knows.cn0_dbhz)
        self.loops.carrier_cycles[:] = -steering.rho / WAVELENGTH_M
        self.origin = code_phase_origin(knows.start_tow_s)
        self.loops.code_chips[:] = self.origin - CA_CHIP_RATE_HZ * steering.rho / C_MPS
        self.vector_chips_per_s = np.zeros(n)
        self.member, self.heard = np.ones(n, dtype=np.bool_), np.ones(n, dtype=np.bool_)
        self.dropped = np.zeros(n, dtype=np.bool_)
        self.lost_at_s, self.first_lost_s = np.full(n, np.nan), np.full(n, np.nan)
        self.faults = Faults(n, settings.update_s)
        self.search = Search(
            self.bits.amplitude2, spacing_chips, settings.update_s, settings.search_bits,
            settings.search_false_alarm,
        )  # fmt: skip
        self.rule = get_rule("linearised")
        self.events: list[tuple[float, int, str, str]] = []
        self.diverged = False
        self.told = (np.nan, np.nan)
        """NIS of the update, how many numbers were measured"""
        self.t_s, self.n_epoch = 0.0, 0
        self.dump_chips = np.full(n, CODE_CHIPS, dtype=np.int64)
        self.valid = np.ones(n, dtype=np.bool_)
        self._seed(slice(None), -steering.rho_rate / WAVELENGTH_M)
        self._command()

    def steer(self, t_end_s: float, imu: Increments) -> Nco:
        """Command one piece up to t_end_s; there is no IMU to look at."""
        t_s = np.array([self.t_s, t_end_s])
        out = np.empty((5, 1, self.n_channel))
        advance(self.t_s, t_end_s, self.loops, out)
        self.t_s = t_end_s
        return Nco(t_s, out[0], out[1], out[2], out[3], out[4], self.dump_chips, self.valid)

    def step(self, taps: Taps) -> None:
        """Add the dumps up, let them act on the channels' own loops, and update when it is due."""
        take_in(
            taps.channel, taps.number, taps.t_start_s, taps.t_end_s, taps.iq, taps.noise_var,
            (taps.code_start_chips, taps.code_end_chips),
            (taps.carrier_start_cycles, taps.carrier_end_cycles), self.bits,
        )  # fmt: skip
        self.search.take_in(taps)
        self._own_loops(taps)
        self.n_epoch += 1
        if self.n_epoch % self.every == 0:
            self._update()
            self._search()
            self._command()

    def _own_loops(self, taps: Taps) -> None:
        """Carrier loops of a VDLL, and all loops of whoever has fallen back."""
        channel, number, t_end_s, iq, noise_var = (
            taps.channel, taps.number, taps.t_end_s, taps.iq, taps.noise_var,
        )  # fmt: skip
        # noise in a loop would move the replica of who searches
        theirs = ~self.member if self.settings.carrier else ~self.search.looking
        if not theirs.all():
            alone = theirs[channel]
            if not alone.any():
                return
            channel, number, t_end_s = channel[alone], number[alone], t_end_s[alone]
            iq, noise_var = iq[alone], noise_var[alone]
        happened = close_loops(channel, number, t_end_s, iq, noise_var, self.loops, self.design)
        np.copyto(self.loops.loop_chips_per_s, self.vector_chips_per_s, where=self.member)
        for t_s, i, code, value in happened:
            kind, reason = EVENTS[int(code)]
            self._note(int(i), kind, f"own loop: {reason.format(value)}", float(t_s))
            if kind == "loss of lock":
                self.dropped[int(i)] = True
                self._lost(int(i), float(t_s))

    def _update(self) -> None:
        """Predict, weigh what all channels measured, and see what it says of each of them."""
        n, k = self.n_channel, self.x.size
        prior = predict(Gaussian(np.zeros(k), self.cov), self.phi, self.q)
        self.x = self.phi @ self.x
        self.sky.reach(self.t_s + self.settings.update_s)
        z, A, R = np.empty((n, 2)), np.empty((n, 2, k)), np.empty((n, 2, 2))
        channel = np.empty(n, dtype=np.int64)
        nb = observe(
            self.t_s, self.knows.start_tow_s, self.x, self.sky.arcs, self.origin,
            self.knows.process_noise.clock_sf, self.code, self.bits, z, A, R, channel,
        )  # fmt: skip
        z, A, R, channel = z[:nb], A[:nb], R[:nb], channel[:nb]
        self._watch(channel, z)
        self._admit(channel, z, A, R, prior)
        sigma = np.sqrt(np.einsum("cij,jk,cik->ci", A, prior.cov, A) + np.diagonal(R, 0, 1, 2))
        counts = self.member & self.heard & ~self.search.held
        self.search.remember(self.bits.amplitude2, counts)
        line = A[:, 0, [0, 1, 2, 6]]
        told = self.faults.watch(self.t_s, channel, z, sigma, line, counts, self.heard)
        use = (counts & ~self.faults.out)[channel]
        u = update(
            prior,
            Measurement(z[use], A[use], R[use], _identity, _identity_slope, channel[use]),
            self.rule,
        )
        self._settle(u)
        for i, kind, reason in told:
            if kind == RETURN:
                self._return(i, reason)
            elif self.settings.fall_back:
                self._fall_back(i, reason)

    def _settle(self, u: Update) -> None:
        self.x = self.x + u.mean
        self.cov = u.cov
        self.told = u.nis, float(u.innovation.size)
        speed, drift = float(np.sqrt(self.x[3:6] @ self.x[3:6])), abs(float(self.x[7]))
        if not speed <= ABSURD_SPEED_MPS or not drift <= ABSURD_DRIFT_MPS:
            self.diverged = True
            self.first_lost_s = np.where(np.isnan(self.first_lost_s), self.t_s, self.first_lost_s)
            self._note(-1, "diverged", "estimated velocity or clock drift beyond any receiver's")

    def _watch(self, channel: np.ndarray, z: np.ndarray) -> None:
        """Who is heard, by the running C/N0 and with some hysteresis; z as it came."""
        a2 = self.bits.amplitude2
        lost = self.heard & (a2 < amplitude2_of(LOST_BELOW_DBHZ))
        found = ~self.heard & (a2 > amplitude2_of(FOUND_ABOVE_DBHZ))
        found &= ~self.search.deaf & ~self.search.refused
        for i in np.flatnonzero(lost).tolist():
            self.heard[i] = False
            if self.search.held[i]:  # never said to be back
                continue
            self._lost(i, self.t_s)
            self._note(i, "loss of lock", f"C/N0 below {LOST_BELOW_DBHZ:g} dB-Hz: "
                       "steered by the vector solution")  # fmt: skip
            if not self.member[i]:
                self._return(i, "its own loops have lost the signal")
        for i in np.flatnonzero(found).tolist():
            self.heard[i] = True
            if self.search.looking[i]:
                self.search.hold(i, self.t_s)
                if not self.settings.carrier:
                    self._seed(i, self.loops.loop_hz[i])
            elif not self.search.held[i]:
                self._regained(i, z[channel == i])

    def _regained(self, i: int, z: np.ndarray) -> None:
        """Say that channel i counts again, of which z (0 or 1, 2) was measured."""
        after = self.t_s - self.lost_at_s[i]
        off = f", replica {z[0, 0]:+.1f} m, {z[0, 1]:+.2f} m/s off" if len(z) else ""
        self._note(
            i, "lock regained", f"C/N0 {self.cn0_dbhz[i]:.1f} dB-Hz after {after:.2f} s{off}"
        )

    def _search(self) -> None:
        """Let lost channels look around the solution; see `vector_search`."""
        dark = self.member & ~self.heard
        if not (dark | self.search.held).any():
            return
        spread = uncertainty(self.t_s, self.knows.start_tow_s, self.x, self.sky.arcs, self.cov)
        began, anew = self.search.step(self.t_s, dark, spread)
        if not self.settings.carrier:
            for i in began + anew:
                self._seed(i, self.loops.loop_hz[i])
        self.bits.amplitude2[anew] = self.bits.step[anew] = 0.0  # to be heard there by itself
        for i in began:
            chips, hertz = np.sqrt(np.diagonal(spread[i]))
            self._note(i, "search", f"begins: sigma {chips:.2f} chips, {hertz:.0f} Hz, "
                       f"{self.search.dwell[i]} bits in a cell")  # fmt: skip

    def _admit(
        self, channel: np.ndarray, z: np.ndarray, A: np.ndarray, R: np.ndarray, prior: Gaussian
    ) -> None:
        """Those whom the search has found and who are heard join the solution, if they agree."""
        counting = int((self.heard & self.member & ~self.search.held).sum())
        present = self.search.refused & (self.bits.amplitude2 > amplitude2_of(LOST_BELOW_DBHZ))
        ready = self.search.ready(self.t_s, self.heard | present, counting)
        rows = np.flatnonzero(ready[channel])
        if not rows.size:
            return
        keep = agreeing(z[rows], A[rows], R[rows], prior.cov)
        for i, agrees in zip(channel[rows].tolist(), keep.tolist(), strict=True):
            if agrees:
                self.heard[i] = True
                self._regained(i, z[channel == i])
                self._note(i, "re-acquired", self.search.said(i, self.t_s))
                self.search.release(i)
                self.faults.clear(i)
            else:
                self.heard[i] = False
                if self.search.refuse(i):
                    self._note(i, "search", "what it found contradicts the solution")

    def _lost(self, i: int, t_s: float) -> None:
        self.lost_at_s[i] = t_s
        if np.isnan(self.first_lost_s[i]):
            self.first_lost_s[i] = t_s

    def _fall_back(self, i: int, reason: str) -> None:
        """Channel i goes on by its own loops, from where its NCO is."""
        loops = self.loops
        if self.settings.carrier:
            a2 = float(max(self.bits.amplitude2[i], amplitude2_of(FOUND_ABOVE_DBHZ))) / 10.0
            loops.narrow[i], loops.wide[i] = 20.0 * (20.0 * a2 + 2.0), 20.0 * (a2 + 2.0)
            self._seed(i, loops.feed[i, 0] + loops.feed[i, 1] * self.settings.update_s)
        loops.feed[i] = 0.0
        loops.code_memory[i] = 0.0
        loops.loop_chips_per_s[i] = 0.0
        self.member[i] = False
        self._note(i, "fall-back", f"to its own loops: {reason}")

    def _return(self, i: int, reason: str) -> None:
        """Channel i is steered by the vector solution again."""
        self.member[i] = True
        self.faults.clear(i)
        self._note(i, "re-acquired", f"by the vector solution: {reason}")

    def _seed(self, i: int | slice, doppler_hz: np.ndarray | float) -> None:
        """Carrier loops i start to pull in at these frequencies."""
        loops = self.loops
        loops.phase[i] = PULL_IN
        loops.since_s[i] = self.t_s
        loops.frequency_lock[i] = 1.0
        loops.carrier_memory[i, 0] = 0.0
        loops.loop_hz[i] = loops.carrier_memory[i, 1] = loops.last_good_hz[i] = doppler_hz

    def _command(self) -> None:
        """Send the members to where the solution expects them at the next update."""
        # a carrier loop that has nothing to hold on to is led until the signal is back
        adrift = (self.loops.phase == PULL_IN) & (~self.heard | self.dropped)
        self.dropped[:] = False
        steer_members(
            self.t_s, self.knows.start_tow_s, self.settings.update_s, self.x, self.phi @ self.x,
            self.sky.arcs, self.origin, self.member, self.settings.carrier, adrift,
            *self.search.off, self.loops, self.vector_chips_per_s,
        )  # fmt: skip

    def _now(self) -> tuple[np.ndarray, np.ndarray]:
        """State and covariance at the end of the epoch, between updates too."""
        since = self.n_epoch % self.every
        if since == 0:
            return self.x, self.cov
        clock = self.knows.process_noise[4:6]
        phi, q = transition(self.settings._replace(update_s=since * EPOCH_S), *clock)
        return phi @ self.x, predict(Gaussian(self.x, self.cov), phi, q).cov

    def _note(self, i: int, kind: str, reason: str, t_s: float | None = None) -> None:
        self.events.append((self.t_s if t_s is None else t_s, i, kind, reason))

    @property
    def locked(self) -> np.ndarray:
        """(n_channel,) bool: heard; of a VDLL or on its own, in phase lock too."""
        own = ~self.member if self.settings.carrier else np.ones(self.n_channel, dtype=np.bool_)
        return self.heard & (~own | (self.loops.phase == LOCKED))

    @property
    def cn0_dbhz(self) -> np.ndarray:
        """(n_channel,) running estimate of C/N0 [dB-Hz]."""
        return cn0_of(self.bits.amplitude2)

    def fields(self) -> Fields:
        """What is kept of each row of the history."""
        return fields_of(self.n_channel, self.x.size)

    def write(self, rows: Rows, k: int) -> None:
        """Write row k of each field."""
        x, cov = self._now()
        rows["r_eb_e"][k], rows["v_eb_e"][k] = x[:3], x[3:6]
        rows["clock_m"][k], rows["clock_rate"][k] = x[6], x[7]
        if x.size > 8:
            rows["a_eb_e"][k] = x[8:]
        rows["covariance"][k] = cov
        rows["nis"][k], rows["n_measurement"][k] = self.told
        rows["lock_indicator"][k] = self.bits.coherence
        rows["member"][k] = self.member
        rows["contributes"][k] = self.member & self.heard & ~self.faults.out & ~self.search.held
        rows["search_chips"][k], rows["search_hz"][k] = self.search.off
        rows["cn0"][k] = self.cn0_dbhz
        rows["prompt_i"][k] = self.bits.prompt.real
        rows["prompt_q"][k] = self.bits.prompt.imag


def _identity(y: np.ndarray) -> np.ndarray:
    return y


def _identity_slope(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return y, np.broadcast_to(np.eye(2), (len(y), 2, 2)).copy()
