"""Lock: one indicator per channel, events with reasons, and the decision to fall back.

The indicator is the running mean of the in-phase measurement, which is cos(phase error) in the
coherent and cos(phase turned in half a bit) in the differential model, times the sinc and code
losses: 1 when locked, 0 when the phase is anywhere.
"""

from __future__ import annotations

import numpy as np

from signals.compiled import borrowing
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
        self, t_s: float, channel: np.ndarray, z: np.ndarray
    ) -> list[tuple[float, int, str, str]]:
        """Take in one epoch, z (nb, 3) with I first; return the events that it caused.

        An event: (t_s, channel, kind, reason).
        """
        events, row, n = [], 0, channel.size
        while row < n:
            row, mean = _follow(channel, z, row, self.gain, self.indicator, self.locked)
            self.mean_now = mean
            if row == n:
                break
            i = int(channel[row])
            if not self.locked[i] and np.isnan(self.first_lost_s[i]):
                self.first_lost_s[i] = t_s
            kind = "lock regained" if self.locked[i] else "loss of lock"
            events.append((t_s, i, kind, f"lock indicator {self.indicator[i]:.2f}"))
            row += 1
        self.low = self.low + 1 if self.mean_now < LOST_BELOW else 0
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
            square = nu * nu / update.variance(1, k)
            # one epoch alone is a surprise, not a loss
            self.quadrature.append(min(float(square.sum()) / nu.size, 2.0 * NIS_LIMIT))
            del self.quadrature[: -self.window]

    def loss(self) -> str:
        """Why the receiver as a whole has lost phase lock; empty while it has not."""
        if self.low >= self.window:
            return f"mean in-phase below {LOST_BELOW} for {FALL_BACK_AFTER_S} s"
        if len(self.quadrature) >= self.window and sum(self.quadrature) > NIS_LIMIT * self.window:
            return f"quadrature NIS above {NIS_LIMIT} over {FALL_BACK_AFTER_S} s"
        return ""


# ---- kernels ---------------------------------------------------------------------------------


@borrowing
def _follow(
    channel: np.ndarray,
    z: np.ndarray,
    first: int,
    gain: float,
    indicator: np.ndarray,
    locked: np.ndarray,
) -> tuple[int, float]:
    """Let the indicators follow z (nb, 3) from row ``first`` to the next change of lock.

    Returns that row (nb: none) and the mean of all in-phase measurements.
    """
    nb = channel.size
    mean = 0.0
    for b in range(nb):
        mean += z[b, 0] / nb
    for b in range(first, nb):
        i = channel[b]
        indicator[i] += gain * (min(max(z[b, 0], -2.0), 2.0) - indicator[i])
        if locked[i] and indicator[i] < LOST_BELOW:
            locked[i] = False
            return b, mean
        if not locked[i] and indicator[i] > FOUND_ABOVE:
            locked[i] = True
            return b, mean
    return nb, mean
