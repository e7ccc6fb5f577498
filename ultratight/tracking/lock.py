"""Lock: one indicator per channel, events with reasons, and the decision to fall back.

The indicator is the running mean of the in-phase measurement, which is cos(phase error) in the
coherent and cos(phase turned in half a bit) in the differential model, times the sinc and code
losses: 1 when locked, 0 when the phase is anywhere.
"""

from __future__ import annotations

import math

import numpy as np

from signals.compiled import borrowing
from ultratight.filters.gaussian import Update

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
        if channel.size == 0:
            return self.heard(t_s, channel, z, 0, self.mean_now)
        return self.heard(
            t_s, channel, z, *follow(channel, z, 0, self.gain, self.indicator, self.locked)
        )

    def heard(
        self, t_s: float, channel: np.ndarray, z: np.ndarray, row: int, mean: float
    ) -> list[tuple[float, int, str, str]]:
        """`watch` of an epoch that `follow` has gone through as far as ``row``."""
        self.mean_now = mean
        events = []
        while row < channel.size:
            i = int(channel[row])
            if not self.locked[i] and np.isnan(self.first_lost_s[i]):
                self.first_lost_s[i] = t_s
            kind = "lock regained" if self.locked[i] else "loss of lock"
            events.append((t_s, i, kind, f"lock indicator {self.indicator[i]:.2f}"))
            row, _ = follow(channel, z, row + 1, self.gain, self.indicator, self.locked)
        self.low = self.low + 1 if self.mean_now < LOST_BELOW else 0
        return events

    def lose_all(self, t_s: float) -> None:
        """The whole receiver is lost."""
        self.locked[:] = False
        self.first_lost_s = np.where(np.isnan(self.first_lost_s), t_s, self.first_lost_s)

    @staticmethod
    def quadrature_square(update: Update, k: int) -> float:
        """Mean normalised square of the quadrature innovations, second of k each; NaN: none."""
        nu = np.ascontiguousarray(update.innovation)
        return float(normalised_square(nu, 1, k, np.ascontiguousarray(update.variance(1, k))))

    def watch_quadrature(self, square: float) -> None:
        """Remember the `quadrature_square` of the epoch (coherent model)."""
        if square == square:
            # one epoch alone is a surprise, not a loss
            self.quadrature.append(min(square, 2.0 * NIS_LIMIT))
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
def follow(
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


@borrowing
def normalised_square(nu: np.ndarray, first: int, step: int, variance: np.ndarray) -> float:
    """Mean of nu^2 / variance over the entries of nu from ``first`` on in steps; NaN of none."""
    if variance.size == 0:
        return math.nan
    s = 0.0
    for i in range(variance.size):
        x = nu[first + i * step]
        s += x * x / variance[i]
    return s / variance.size
