"""A code loop on its own, its carrier known: jitter, stress and threshold of DLLs.

In the receiver the carrier aids the code, which then never moves and never is what loses lock.
Here nothing aids it.  A replica runs at the rate that the filter commanded for an integration, the
next command is made of the taps of that one; channels are independent and step together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from common.loop_samples import discriminate
from signals.codes import GPS_L1CA
from signals.correlations import correlations
from signals.replica import replicas
from signals.taps_from_errors import taps_from_errors
from ultratight.tracking import loop_theory as theory
from ultratight.tracking.discriminators import signal_peak
from ultratight.tracking.loop_filters import filter_step, phase_loop

PRN = 7
LEVELS = (20.0, 25.0, 30.0, 35.0, 40.0, 45.0, 50.0)
DURATION_S, SETTLED = 10.0, 2.0
"""Jitter is measured after `SETTLED` / Bn, and no sooner than after half of the time"""
LOST_CHIPS = 1.0
"""Farther off than that no discriminator of a BPSK code points back"""
BELOW_DB, ABOVE_DB = 14.0, 4.0
"""How far around the rule's threshold loss is measured"""
STRESS_DBHZ, STRESS_CHIPS = 65.0, 0.01
"""A dot product falls with the prompt: 1 % too small an output"""


class CodeLoop(NamedTuple):
    """A DLL of GPS C/A."""

    order: int
    bandwidth_hz: float
    integration_s: float
    discriminator: str
    spacing_chips: float

    @property
    def flank(self) -> theory.Flank:
        """Of the code's own correlation."""
        return theory.flank_of_code(GPS_L1CA, PRN, self.spacing_chips)

    @property
    def w(self) -> float:
        """Natural frequency [rad/s]."""
        return phase_loop(self.order, self.bandwidth_hz, self.integration_s)[0]

    def sigma(self, cn0_dbhz: float) -> float:
        """Thermal jitter in theory [chips]."""
        return theory.dll_jitter_chips(
            self.discriminator, self.flank, self.bandwidth_hz, self.integration_s, cn0_dbhz
        )

    def threshold(self) -> float:
        """3 sigma = D / 2 [dB-Hz]."""
        return theory.dll_threshold_dbhz(
            self.discriminator, self.flank, self.bandwidth_hz, self.integration_s,
            self.spacing_chips,
        )  # fmt: skip


CODE_LOOPS = {
    "DLL1 1 Hz 20 ms, power, D = 0.5": CodeLoop(1, 1.0, 0.02, "power", 0.25),
    "DLL2 2 Hz 10 ms, dot product, D = 0.5": CodeLoop(2, 2.0, 0.01, "dot-product", 0.25),
    "DLL1 5 Hz 5 ms, envelope, D = 1": CodeLoop(1, 5.0, 0.005, "envelope", 0.5),
    "DLL2 4 Hz 20 ms, coherent, D = 0.2": CodeLoop(2, 4.0, 0.02, "coherent", 0.1),
}
"""Order, noise bandwidth, integration time, early to late"""


class CodeFlown(NamedTuple):
    """A flight in figures; the first axis is that of the channels."""

    code: np.ndarray  # (channel, level) mean square error over theory's variance, NaN where lost
    around: np.ndarray  # (level_around,) [dB-Hz]
    lost: np.ndarray  # (channel, level_around) lost within `DURATION_S`
    stress: np.ndarray  # (channel,) error under a constant derivative over size / w^order


def fly_code_loop(loop: CodeLoop, n_channel: int, seed: int) -> CodeFlown:
    """Groups of channels: quiet at `LEVELS`, quiet around the threshold, and under stress."""
    middle = round(loop.threshold())
    around = np.arange(middle - BELOW_DB, middle + ABOVE_DB + 1.0)
    cn0 = np.repeat([*LEVELS, *around, STRESS_DBHZ], n_channel)
    size = np.zeros(cn0.size)
    size[-n_channel:] = STRESS_CHIPS * loop.w**loop.order
    error = run(loop, cn0, size, seed)  # (update, channel)
    lost = np.abs(error).max(axis=0) > LOST_CHIPS
    updates = np.arange(len(error)) * loop.integration_s
    late = updates > max(SETTLED / loop.bandwidth_hz, 0.5 * DURATION_S)
    square = (error[late] ** 2).mean(axis=0) / np.array([loop.sigma(x) for x in cn0]) ** 2
    n = n_channel * len(LEVELS)
    code = np.where(lost, np.nan, square)[:n].reshape(len(LEVELS), n_channel)
    shares = lost[n:-n_channel].astype(float).reshape(around.size, n_channel)
    stress = error[late, -n_channel:].mean(axis=0) / STRESS_CHIPS
    return CodeFlown(code.T, around, shares.T, stress)


def run(loop: CodeLoop, cn0_dbhz: np.ndarray, size: np.ndarray, seed: int) -> np.ndarray:
    """Delay errors (n_update, n_channel), mean of each integration, true - replica [chips].

    ``size`` (n_channel,): constant derivative of the delay, of the loop's order [chips/s^order].
    """
    t, n = loop.integration_s, cn0_dbhz.size
    offset = np.array([-1.0, 0.0, 1.0]) * loop.spacing_chips
    code = correlations(replicas(GPS_L1CA.chips(PRN)[None]), offset)
    slope, level = signal_peak(GPS_L1CA, PRN, loop.spacing_chips)
    _, gains = phase_loop(loop.order, loop.bandwidth_hz, t)
    a2 = [2.0 * t * theory.ratio_hz(x) for x in cn0_dbhz]
    channel = np.arange(n)
    replica, rate, memory = np.zeros(n), np.zeros(n), np.zeros((n, 2))
    error = np.empty((round(DURATION_S / t), n))
    for k, row in enumerate(error):
        middle = (k + 0.5) * t
        # mean of v t, or of a t^2 / 2, over the integration
        true = size * (middle if loop.order == 1 else 0.5 * (middle**2 + t**2 / 12.0))
        row[:] = true - (replica + 0.5 * t * rate)
        replica += t * rate
        taps = taps_from_errors(row, 0.0, 0.0, cn0_dbhz, t, code, offset, seed=seed,
                                stream="code-loops", channel=channel, number=k)  # fmt: skip
        for i in range(n):
            found = discriminate(loop.discriminator, taps[i], a2[i], slope, level)
            rate[i] = filter_step(memory[i], float(found), t, gains)
    return error
