"""Which channel of a vector receiver contradicts the others, and for how long.

A motion that is not in the model is in the innovations of all satellites near its direction, and of
a few of ten these are many sigma.  It is no fault: what the others' innovations say of a common
error (three components and the clock, by least squares) explains the channel's own.
"""

from __future__ import annotations

import numpy as np

SMOOTHING_S = 0.2
"""Low pass of the normalised innovations"""
OUT_ABOVE = 6.0
"""Sigmas of the low pass at which a channel is left out"""
AGREES_BELOW = 3.0
CALM_BELOW = 2.5
"""The median of the others: above it the solution is what is wrong, or the model of the motion"""
FALL_BACK_AFTER_S = 0.5
RETURN_AFTER_S = 1.0
FEWEST = 5
"""Without one of four there is no solution to be contradicted"""
FALL_BACK, RETURN = "fall-back", "return"


class Faults:
    """Low passes of the normalised innovations (code, rate) of each channel.

    Parameters
    ----------
    n_channel : int
    update_s : float
        From update to update.
    """

    def __init__(self, n_channel: int, update_s: float) -> None:
        self.gain = min(1.0, update_s / SMOOTHING_S)
        self.scale = np.sqrt((2.0 - self.gain) / self.gain)
        self.mean = np.zeros((n_channel, 2))
        self.line, self.sigma = np.zeros((n_channel, 4)), np.ones((n_channel, 2))
        self.out = np.zeros(n_channel, dtype=np.bool_)
        self.since_s = np.zeros(n_channel)
        self.told = np.zeros(n_channel, dtype=np.bool_)

    def watch(
        self,
        t_s: float,
        channel: np.ndarray,
        z: np.ndarray,
        sigma: np.ndarray,
        line: np.ndarray,
        counts: np.ndarray,
        heard: np.ndarray,
    ) -> list[tuple[int, str, str]]:
        """Take in innovations z (nb, 2) of channels (nb,); say who should fall back.

        sigma (nb, 2) is what the filter expects of them, line (nb, 4) how each moves with a common
        error of position (or velocity) and clock (or drift).  counts (n_channel,): those that could
        take part in the solution; heard: those with a signal.  Returns (channel, `FALL_BACK` or
        `RETURN`, reason); ``out`` is who to leave out.
        """
        self.line[channel], self.sigma[channel] = line, sigma
        step = np.clip(z / sigma, -10.0, 10.0) - self.mean[channel]
        self.mean[channel] += self.gain * step
        self.mean[~heard] = 0.0
        sigmas = self.scale * np.abs(self.mean)
        worst = sigmas.max(axis=1)
        found: list[tuple[int, str, str]] = []
        taking_part = np.flatnonzero(counts & ~self.out)
        if taking_part.size >= FEWEST:
            i = int(taking_part[worst[taking_part].argmax()])
            others = taking_part[taking_part != i]
            if (
                worst[i] > OUT_ABOVE
                and np.median(worst[others]) < CALM_BELOW
                and self._alone(i, int(sigmas[i].argmax()), others) > OUT_ABOVE
            ):
                self.out[i] = True
                self.since_s[i] = t_s
        for i in np.flatnonzero(self.out).tolist():
            if not heard[i]:
                if not self.told[i]:
                    self.clear(i)
            elif not self.told[i]:
                if worst[i] < AGREES_BELOW:
                    self.clear(i)
                elif t_s - self.since_s[i] > FALL_BACK_AFTER_S - 1e-9:
                    self.told[i] = True
                    self.since_s[i] = t_s
                    of = "range" if sigmas[i, 0] > sigmas[i, 1] else "rate"
                    found.append((i, FALL_BACK, f"its {of} is {worst[i]:.0f} sigma off"))
            elif worst[i] > AGREES_BELOW:
                self.since_s[i] = t_s
            elif t_s - self.since_s[i] > RETURN_AFTER_S - 1e-9:
                found.append((i, RETURN, f"agrees with it for {RETURN_AFTER_S:g} s"))
        return found

    def _alone(self, i: int, k: int, others: np.ndarray) -> float:
        """Sigmas of what the others' common error leaves of channel i's range (k = 0) or rate."""
        rows = self.line[others] / self.sigma[others, k, None]
        own = self.line[i] / self.sigma[i, k]
        pinv = np.linalg.pinv(rows)
        left = self.mean[i, k] - own @ (pinv @ self.mean[others, k])
        return float(self.scale * abs(left) / np.sqrt(1.0 + np.sum((own @ pinv) ** 2)))

    def clear(self, i: int) -> None:
        """Channel i is believed again."""
        self.out[i] = self.told[i] = False
        self.mean[i] = 0.0
