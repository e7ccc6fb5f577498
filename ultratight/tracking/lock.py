"""Lock: one indicator per channel, events with reasons, and the decision to fall back.

The indicator is the running mean of the in-phase measurement, which is cos(phase error) in the
coherent and cos(phase turned in half a bit) in the differential model, times the sinc and code
losses: 1 when locked, 0 when the phase is anywhere.
"""

from __future__ import annotations

import numpy as np

from ultratight.filters.gaussian import Measurement, Update

SMOOTHING_S = 0.4
LOST_BELOW = 0.5
FOUND_ABOVE = 0.75
FALL_BACK_AFTER_S = 0.2
NIS_LIMIT = 3.0
"""Mean normalised square of the quadrature innovations at which lock counts as lost"""


class LockMonitor:
    """Watches all channels; the states are its only memory."""

    def __init__(self, n_channel: int, epoch_s: float) -> None:
        self.gain = epoch_s / SMOOTHING_S
        self.window = max(1, round(FALL_BACK_AFTER_S / epoch_s))
        self.indicator = np.ones(n_channel)
        self.locked = np.ones(n_channel, dtype=bool)
        self.first_lost_s = np.full(n_channel, np.nan)
        self.restart()

    def restart(self) -> None:
        """Forget the recent past of the receiver as a whole (a new measurement model)."""
        self.low = 0
        self.mean_now = 1.0
        self.quadrature: list[float] = []

    def watch(
        self, t_s: float, channel: np.ndarray, in_phase: np.ndarray
    ) -> list[tuple[float, int, str, str]]:
        """Take in one epoch; return the events (t_s, channel, kind, reason) that it caused."""
        events = []
        if channel.size:
            self.mean_now = float(in_phase.mean())
        self.low = self.low + 1 if self.mean_now < LOST_BELOW else 0
        for i, now in zip(channel, np.clip(in_phase, -2.0, 2.0), strict=True):
            self.indicator[i] += self.gain * (now - self.indicator[i])
            value = self.indicator[i]
            if self.locked[i] and value < LOST_BELOW:
                self.locked[i] = False
                if np.isnan(self.first_lost_s[i]):
                    self.first_lost_s[i] = t_s
                events.append((t_s, int(i), "loss of lock", f"lock indicator {value:.2f}"))
            elif not self.locked[i] and value > FOUND_ABOVE:
                self.locked[i] = True
                events.append((t_s, int(i), "lock regained", f"lock indicator {value:.2f}"))
        return events

    def lose_all(self, t_s: float) -> None:
        """The whole receiver is lost."""
        self.locked[:] = False
        self.first_lost_s = np.where(np.isnan(self.first_lost_s), t_s, self.first_lost_s)

    def watch_quadrature(self, update: Update, measurement: Measurement) -> None:
        """Remember the normalised quadrature innovations of the epoch (coherent model)."""
        k = measurement.z.shape[1]
        nu = update.innovation[1::k]
        if nu.size:
            self.quadrature.append(float(np.mean(nu**2 / np.diag(update.S)[1::k])))
            del self.quadrature[: -self.window]

    def loss(self) -> str:
        """Why the receiver as a whole has lost phase lock; empty while it has not."""
        if self.low >= self.window:
            return f"mean in-phase below {LOST_BELOW} for {FALL_BACK_AFTER_S} s"
        if len(self.quadrature) >= self.window and np.mean(self.quadrature) > NIS_LIMIT:
            return f"quadrature NIS above {NIS_LIMIT} over {FALL_BACK_AFTER_S} s"
        return ""
