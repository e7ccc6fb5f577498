"""The federated form of the ultra-tight closure: a pre-filter per channel, one central filter.

As in the centralised form (`ultra_tight`) INS and central filter command every NCO, and there are
no channel loops.  What the taps say reaches the central filter by another way:

    taps -> pre-filter of each channel (code, phase, Doppler)     every half data bit
         -> range and rate residual with their covariance         every 20 to 100 ms
         -> central filter (17 states, or 20) -> INS -> NCO

The carrier phase stays with the channel: at each hand-over the NCO takes it in, and so much of
range and rate as the central filter corrects leaves the pre-filter's estimate, since the reference
has moved by that.  Central states are those of the differential model and the clock's step
(`pre_filter_hand_over`).

With known data bits, or on a pilot, phase is followed modulo a wavelength, without modulo half of
one; nothing else changes.  A channel counts while it is in lock: its in-phase prompt is
what the amplitude lets expect.  In an interval where it is not, nothing is handed over, and the
filter begins anew where the INS says that the signal is.
"""

from __future__ import annotations

import numpy as np

from signals.nco import Taps
from ultratight.filters.gaussian import Filter, Measurement, Update
from ultratight.ins.error_state import N_WITH_SCALE, Layout
from ultratight.tracking.epoch import settle
from ultratight.tracking.knows import Knows
from ultratight.tracking.lock import LOST_BELOW, SMOOTHING_S
from ultratight.tracking.measurements import NO_BITS, bit_missing
from ultratight.tracking.pre_filter import (
    CODE,
    DOPPLER,
    PHASE,
    absorb,
    begin,
    channel_facts,
    new_pre_filters,
    take_in,
)
from ultratight.tracking.pre_filter_hand_over import (
    clock_step,
    clock_step_into,
    error_variances,
    hand_over,
)
from ultratight.tracking.rows import Fields, Rows
from ultratight.tracking.ultra_tight import Settings, UltraTight
from ultratight.tracking.vector import LOST_BELOW_DBHZ

UPDATE_S = (0.02, 0.1)
"""Shortest and longest interval between hand-overs"""
SIGMAS = 3.0
"""An in-phase mean so far below 1, and below `LOST_BELOW`, is not that of the signal"""


class Federated(UltraTight):
    """A receiver of pre-filters and a central filter: `steer` gives the command, `step` takes taps.

    Parameters
    ----------
    knows, filter_, spacing_chips, piece_s
        As those of `UltraTight`; the filter must not look into the taps itself.
    settings : Settings
        ``epoch_s`` is the interval between hand-overs.  ``measurement``: "coherent" wipes off
        known data bits, "differential" knows none.

    Raises
    ------
    ValueError
        An interval out of range, a measurement that is neither, or a filter of half bits.
    """

    def __init__(
        self,
        knows: Knows,
        settings: Settings,
        filter_: Filter,
        spacing_chips: float,
        piece_s: float,
    ) -> None:
        if not UPDATE_S[0] - 1e-9 <= settings.epoch_s <= UPDATE_S[1] + 1e-9:
            raise ValueError(
                f"update_s is {settings.epoch_s:g}: expected {UPDATE_S[0]} to {UPDATE_S[1]} s"
            )
        if settings.measurement not in ("coherent", "differential") or settings.half_bits:
            given = "half-bits" if settings.half_bits else settings.measurement
            raise ValueError(f'measurement is {given!r}: expected "coherent" or "differential"')
        super().__init__(knows, settings, filter_, spacing_chips, piece_s)
        first = self.cov
        self.cov = np.zeros((self.layout.n, self.layout.n))
        self.cov[: len(first), : len(first)] = first
        T, halves = settings.epoch_s, 2.0 * np.ceil(settings.epoch_s / (2.0 * self.half_s) + 1.0)
        self.coherent = settings.measurement == "coherent"
        self.data_bits = knows.data_bits if self.coherent else None
        self.clock = clock_step(T, self.noise.clock_sf, self.noise.clock_sg)
        self.pre = new_pre_filters(self.amplitudes.amplitude2, int(halves.max()))
        self.facts = channel_facts(self.codes, knows.channels.pilot, spacing_chips)
        self.heard_above = 2.0 * self.half_s * 10.0 ** (LOST_BELOW_DBHZ / 10.0)
        n = self.n_channel
        self.variances = np.empty((n, 3))
        self.handed = np.full((4, n), np.nan)
        """Residual of range and rate, and their sigmas"""
        self.failed = np.zeros(n, dtype=np.bool_)
        self.doubted = np.zeros(n, dtype=np.bool_)
        self.failed_at_s = np.full(n, -np.inf)
        self.lost_at_s = np.full(n, np.nan)
        self._look_at_errors()
        for i in range(n):
            self._begin(i)

    def _layout(self, n_phase: int = 0) -> Layout:
        return Layout.build(self.settings.states == N_WITH_SCALE, 0, True)

    def _transition(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        phi, q, force = super()._transition()
        clock_step_into(self.settings.epoch_s, self.clock, phi, q)
        return phi, q, force

    def step(self, taps: Taps) -> None:
        """Let the taps act on the pre-filters, and hand over what they have learnt."""
        bits, k = self.half_bits.pair(taps, self.steering), self.knows
        missing = take_in(
            *bits, self.facts, NO_BITS if self.data_bits is None else self.data_bits, k.first_bit,
            self.noise.clock_sf, self.unrest, self.pre,
        )  # fmt: skip
        if missing >= 0:
            raise bit_missing(bits.number[missing], bits.channel[missing])
        np.maximum(self.pre.power, 0.5, out=self.amplitudes.amplitude2)
        self.in_phase, seen = self._judge()
        self._step_by_filter(self._handed_over(), *self._transition())
        if not self.diverged:
            self._follow_lock(seen)

    def _judge(self) -> tuple[np.ndarray, np.ndarray]:
        """In-phase mean of the interval (n_channel,), and where it says something.

        Says who has `failed`, and who is `doubted` since: until the prompt is back for sure, or
        has not failed for as long as the lock indicator needs to tell.
        """
        sums, variance, n = self.pre.in_phase.T
        mean = sums / np.maximum(n, 1.0)
        margin = SIGMAS * np.sqrt(variance) / np.maximum(n, 1.0)
        gone = (self.pre.power < self.heard_above) & (self.pre.n_kept > 0)
        mean[gone] = 0.0
        seen = (n > 0.0) | gone
        self.failed = seen & ((mean < np.minimum(LOST_BELOW, 1.0 - margin)) | gone)
        self.failed_at_s[self.failed] = self.t_s
        sure = seen & (mean > np.maximum(LOST_BELOW, margin))
        waiting = self.t_s - self.failed_at_s < SMOOTHING_S
        self.doubted = (self.doubted | self.failed) & waiting & ~sure
        self.pre.in_phase[:] = 0.0
        return mean, seen

    def _handed_over(self) -> Measurement:
        """Range and rate residuals of the channels in lock, as the central filter takes them."""
        n, n_state = self.n_channel, self.layout.n
        z, A, R = np.empty((n, 2)), np.empty((n, 2, n_state)), np.empty((n, 2, 2))
        channel = np.empty(n, dtype=np.int64)
        nb = hand_over(
            self.t_s, self.steering.buffer, self.layout.n_scale, self.clock,
            self.lock.locked & ~self.doubted, self.pre, z, A, R, channel,
        )  # fmt: skip
        z, A, R, channel = z[:nb], A[:nb], R[:nb], channel[:nb]
        self.handed[:] = np.nan
        self.handed[:2, channel] = z.T
        self.handed[2:, channel] = np.sqrt(np.diagonal(R, axis1=1, axis2=2)).T
        return Measurement(z, A, R, _identity, _identity_slope, channel)

    def _settle(self, mean: np.ndarray, cov: np.ndarray) -> int:
        """The NCOs take the phases in, INS and clock the rest; both leave the pre-filters."""
        pre, n = self.pre, self.layout.phase.start
        ahead = np.where(np.isnan(pre.t_s), 0.0, self.t_s - pre.t_s)
        phase_m = np.where(self.failed, 0.0, pre.mean[:, PHASE] + ahead * pre.mean[:, DOPPLER])
        s = self.steering
        outcome = settle(s.buffer, self.sky.arcs, mean[:n], cov, n, phase_m, self.t_s)
        absorb(self.t_s, s.before, s.rho, s.rho_rate, phase_m, pre)
        return int(outcome)

    def _watch(self, u: Update, measurement: Measurement) -> None:
        """Lock is seen by the pre-filters, see `_follow_lock`."""

    def _follow_lock(self, seen: np.ndarray) -> None:
        """Events, and filters that begin anew."""
        self._look_at_errors()
        before = self.lock.locked.copy()
        channel = np.flatnonzero(seen)
        for t_s, i, kind, why in self.lock.watch(
            self.t_s, channel, self.in_phase[channel, None].copy()
        ):
            why = f"{why}, C/N0 {self.cn0_dbhz[i]:.1f} dB-Hz"
            if kind == "loss of lock":
                self.lost_at_s[i] = t_s
                why += ": left to INS and clock"
            else:
                why += f", after {t_s - self.lost_at_s[i]:.2f} s"
            self.events.append((t_s, i, kind, why))
        for i in np.flatnonzero(self.failed | (before & ~self.lock.locked)).tolist():
            self._begin(i)

    def _look_at_errors(self) -> None:
        """What the central filter's covariance says of range, rate and acceleration."""
        error_variances(self.steering.buffer, self.layout.n_scale, self.cov, self.variances)
        own = self.noise.velocity + self.variances[:, 2] * self.settings.epoch_s
        self.unrest = self.noise.clock_sg + own

    def _begin(self, i: int) -> None:
        begin(
            i, self.variances[i, CODE], self.variances[i, 1], self.facts.wavelength_m[i], self.pre
        )

    def fields(self) -> Fields:
        """What is kept of each epoch, a hand-over."""
        channel = ((self.n_channel,), ("channel",))
        return {
            **super().fields(),
            "contributes": (*channel, "1", "1 where the channel has handed over"),
            "range_residual": (*channel, "m", "handed over: range, measured minus INS"),
            "rate_residual": (*channel, "m/s", "handed over: range rate, measured minus INS"),
            "range_sigma": (*channel, "m", "its standard deviation"),
            "rate_sigma": (*channel, "m/s", "its standard deviation, without the common clock"),
        }

    def write(self, rows: Rows, k: int) -> None:
        """Write row k of each field."""
        super().write(rows, k)
        rows["contributes"][k] = ~np.isnan(self.handed[0])
        names = ("range_residual", "rate_residual", "range_sigma", "rate_sigma")
        for name, value in zip(names, self.handed, strict=True):
            rows[name][k] = value


def _identity(y: np.ndarray) -> np.ndarray:
    return y


def _identity_slope(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return y, np.broadcast_to(np.eye(2), (len(y), 2, 2)).copy()
