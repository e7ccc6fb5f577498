"""Modulations as sub-chip waveforms: replica values, correlation function and spectrum.

A chip is ``per_chip`` equal steps.  Everything follows from their values: with chips that are
independent signs at the rate f_c, p the steps of a chip and m their number,

    R(d) = correlation of the chip's waveform with itself, straight between multiples of 1 / m
    S(f) = sinc^2(f / (m f_c)) |sum_k p_k exp(-j 2 pi f k / (m f_c))|^2 / (m^2 f_c)

For BPSK and sine-phased BOC, S is the closed form of Betz, NAVIGATION 48(4), 2001.  A modulation
with chips of two waveforms (TMBOC) has the mean of both.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Modulation:
    """A waveform for each chip.

    Attributes
    ----------
    name
        Such as "BPSK(1)".
    waveforms
        Steps of a chip, a row for each kind of chip, all of one length; mean power 1.
    positions
        Chips that have the second waveform, counted within ``cycle`` chips.
    left_out
        Share of the signal's power in a component that these waveforms do not hold.
    """

    name: str
    waveforms: tuple[tuple[float, ...], ...]
    positions: tuple[int, ...] = ()
    cycle: int = 1
    left_out: float = 0.0

    @property
    def per_chip(self) -> int:
        """Steps in a chip."""
        return len(self.waveforms[0])

    @cached_property
    def shares(self) -> np.ndarray:
        """Share of the chips that has each waveform (n_waveform,)."""
        second = len(self.positions) / self.cycle
        return np.array([1.0 - second, second])[: len(self.waveforms)]

    def modulate(self, chips: np.ndarray) -> np.ndarray:
        """Values (length * per_chip,) float32 of chips (length,) of +-1."""
        steps = np.asarray(self.waveforms, dtype=np.float32)
        kind = np.zeros(len(chips), dtype=np.int64)
        for position in self.positions:
            kind[position :: self.cycle] = 1
        return (chips[:, None].astype(np.float32) * steps[kind]).ravel()

    def correlation(self, delay_chips: np.ndarray) -> np.ndarray:
        """R(d) of independent chips, at delays of any shape [chips]; 1 at 0, 0 from 1 on."""
        m = self.per_chip
        steps = np.asarray(self.waveforms, dtype=np.float64)
        lags = self.shares @ np.array([np.correlate(p, p, "full") / m for p in steps])
        return np.interp(delay_chips, np.arange(-m, m + 1) / m, np.pad(lags, 1))

    def early_late_slope(self, spacing_chips: float) -> float:
        """Growth of late minus early with the delay of the signal, half of it, per chip.

        The mean over +-1/48 chip for taps ``spacing_chips`` on each side of the prompt.  BPSK: 1.
        BOC(1,1): 3 below half a chip, then -1: the code would be driven to a side peak.  BOC(6,1)
        parts make it rise and fall every 1/12 chip.
        """
        h = min(1.0 / 48.0, spacing_chips)
        early, late = self.correlation(np.array([spacing_chips - h, spacing_chips + h]))
        return float((early - late) / (2.0 * h))

    def psd(self, f_hz: np.ndarray, chip_rate_hz: float) -> np.ndarray:
        """S(f) [1/Hz] of unit power, at offsets from the carrier of any shape [Hz]."""
        f = np.asarray(f_hz, dtype=np.float64)
        step_hz = self.per_chip * chip_rate_hz
        turns = np.exp(-2j * np.pi * f[..., None] * np.arange(self.per_chip) / step_hz)
        power = np.abs(turns @ np.asarray(self.waveforms, dtype=np.float64).T) ** 2 @ self.shares
        return np.sinc(f / step_hz) ** 2 * power / (self.per_chip * step_hz)

    def power_kept(self, chip_rate_hz: float, bandwidth_hz: float) -> float:
        """Share of the power inside +- bandwidth / 2: the loss in SNR against a full replica."""
        f, weight = _nodes(chip_rate_hz, bandwidth_hz, self.per_chip)
        return float(weight @ self.psd(f, chip_rate_hz))

    def gabor_bandwidth_hz(self, chip_rate_hz: float, bandwidth_hz: float) -> float:
        """RMS bandwidth inside +- bandwidth / 2: sqrt(int f^2 S / int S)."""
        f, weight = _nodes(chip_rate_hz, bandwidth_hz, self.per_chip)
        s = weight * self.psd(f, chip_rate_hz)
        return float(np.sqrt(s @ f**2 / s.sum()))

    def band_limited_correlation(
        self, delay_chips: np.ndarray, chip_rate_hz: float, bandwidth_hz: float
    ) -> np.ndarray:
        """Correlation of the full replica with a signal through an ideal filter, any shape.

        int S(f) cos(2 pi f d / f_c) df over +- bandwidth / 2.  Its value at 0 is `power_kept`;
        the filtered noise has the same shape, so that taps with unit noise have the mean
        R_B(d) / sqrt(R_B(0)) and the covariance R_B(d_i - d_k) / R_B(0).
        """
        d = np.asarray(delay_chips, dtype=np.float64)
        far = float(np.abs(d).max(initial=1.0))
        f, weight = _nodes(chip_rate_hz, bandwidth_hz, self.per_chip + far)
        s = weight * self.psd(f, chip_rate_hz)
        # in parts: the cosines of all delays at once would fill the memory
        parts = [
            np.cos(2.0 * np.pi / chip_rate_hz * part[:, None] * f) @ s
            for part in np.array_split(d.ravel(), max(1, d.size // 256))
        ]
        return np.concatenate(parts).reshape(d.shape)


def _nodes(
    chip_rate_hz: float, bandwidth_hz: float, swings: float
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights over +- bandwidth / 2.

    ``swings``: how often the integrand may oscillate per chip rate; 16 nodes take two periods of
    the oscillation to 1e-12.
    """
    if not (np.isfinite(bandwidth_hz) and bandwidth_hz > 0.0):
        raise ValueError(f"bandwidth_hz is {bandwidth_hz}: expected more than 0 Hz")
    x, w = np.polynomial.legendre.leggauss(16)
    n = int(np.ceil(bandwidth_hz / chip_rate_hz * (swings + 1.0) / 2.0))
    half = 0.5 * bandwidth_hz / n
    middle = (2.0 * np.arange(n) + 1.0 - n) * half
    return (middle[:, None] + half * x).ravel(), np.tile(half * w, n)


def _square_wave(periods: int, steps: int) -> np.ndarray:
    """Sine-phased square wave with ``periods`` in a chip of ``steps`` steps."""
    return np.tile(np.repeat([1.0, -1.0], steps // (2 * periods)), periods)


def bpsk(n: int) -> Modulation:
    """BPSK at n x 1.023 Mcps."""
    return Modulation(f"BPSK({n})", ((1.0,),))


_BOC11 = _square_wave(1, 12)
_BOC61 = _square_wave(6, 12)

BOC11 = Modulation("BOC(1,1)", ((1.0, -1.0),))
BOC61 = Modulation("BOC(6,1)", (tuple(_BOC61),))

TMBOC = Modulation("TMBOC(6,1,4/33)", (tuple(_BOC11), tuple(_BOC61)), (0, 4, 6, 29), 33)
"""L1C pilot: chips 0, 4, 6 and 29 of each 33 are BOC(6,1) (IS-GPS-800 3.3)"""

CBOC_PLUS = Modulation(
    "CBOC(6,1,1/11,+)", (tuple(np.sqrt(10 / 11) * _BOC11 + np.sqrt(1 / 11) * _BOC61),)
)
"""E1-B: sub-carriers in phase (Galileo OS SIS ICD 2.3.3)"""
CBOC_MINUS = Modulation(
    "CBOC(6,1,1/11,-)", (tuple(np.sqrt(10 / 11) * _BOC11 - np.sqrt(1 / 11) * _BOC61),)
)
"""E1-C: sub-carriers in opposite phase (Galileo OS SIS ICD 2.3.3)"""

QMBOC = Modulation("QMBOC(6,1,4/33)", ((1.0, -1.0),), left_out=4 / 33)
"""B1C pilot: sqrt(29/33) BOC(1,1) + j sqrt(4/33) BOC(6,1) (BDS-SIS-ICD-B1C 4.2).

Its BOC(1,1) alone: 10 log10(29/33) = -0.56 dB against the pilot's power.  The quadrature
component is neither sent nor received; in truth it adds to the Q of a delayed tap.
"""

_ROOT2 = float(np.sqrt(2.0))
FIRST_HALF = Modulation("BPSK(1/2), first half", ((_ROOT2, 0.0),))
"""L2 CM: chips alternate with those of L2 CL, and each is on the air for half of its time"""
SECOND_HALF = Modulation("BPSK(1/2), second half", ((0.0, _ROOT2),))
"""L2 CL (IS-GPS-200 3.2.2, 3.3.2.4)"""
