"""What every ranging signal is made of: the row of `signals.codes`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from signals.modulation import Modulation


@dataclass(frozen=True)
class Signal:
    """One ranging signal: what one component of a satellite's transmission looks like.

    Attributes
    ----------
    label
        Short name, the second half of a channel's: "L1CA" in G05:L1CA.
    system
        First letter of a channel's name: G, E or C.
    name
        System and signal, e.g. "GPS L1 C/A".
    carrier_hz, chip_rate_hz
        Nominal frequencies.
    length_chips
        Period of the primary code.
    symbol_s
        How long the sign that multiplies the replica stays: a data symbol; of a pilot, a chip of
        an overlay that is longer than a replica can be, or else the period of its whole code.
    modulation
        Waveform of the chips.
    prns
        PRN numbers that have a code.
    generate
        prn -> (length_chips,) of logical 0 and 1.
    secondary
        prn -> chips of the secondary code, logical 0 and 1, one per period of the primary; None
        where there is none.
    pilot
        No data: all symbols are known.
    """

    label: str
    system: str
    name: str
    carrier_hz: float
    chip_rate_hz: float
    length_chips: int
    symbol_s: float
    modulation: Modulation
    prns: Sequence[int]
    generate: Callable[[int], np.ndarray]
    secondary: Callable[[int], np.ndarray] | None = None
    pilot: bool = False

    @property
    def per_chip(self) -> int:
        """Values of the replica per chip."""
        return self.modulation.per_chip

    @property
    def sub_chip_rate_hz(self) -> float:
        """Rate of the replica's values."""
        return self.chip_rate_hz * self.per_chip

    @property
    def symbol_chips(self) -> int:
        """Chips in a symbol."""
        return round(self.symbol_s * self.chip_rate_hz)

    def channel(self, prn: int) -> str:
        """Name of a channel, such as G05:L1CA."""
        return f"{self.system}{prn:02d}:{self.label}"

    def chips(self, prn: int) -> np.ndarray:
        """One period of the primary code as +-1, logical 0 is +1: (length_chips,) int8, read-only.

        Raises
        ------
        ValueError
            The PRN has no code.
        """
        self._check(prn)
        return _chips(self, int(prn))

    def secondary_chips(self, prn: int) -> np.ndarray:
        """Secondary code as +-1, one chip per period of the primary: (n,) int8, (1,) for none."""
        self._check(prn)
        if self.secondary is None:
            return np.ones(1, dtype=np.int8)
        return _signs(self.secondary(int(prn)))

    def tiered_chips(self, prn: int) -> np.ndarray:
        """Primary code times the secondary as far as it fits in a symbol: (n length_chips,) int8.

        L1C and B1C pilots: the primary alone, their secondary chips are the symbols.
        """
        secondary, primary = self.secondary_chips(prn), self.chips(prn)
        if len(secondary) * self.length_chips > self.symbol_chips:
            return primary
        return np.multiply.outer(secondary, primary).ravel()

    def subchips(self, prn: int) -> np.ndarray:
        """The modulated `tiered_chips`: (n length_chips per_chip,) float32 of mean power 1."""
        return self.modulation.modulate(self.tiered_chips(prn))

    def autocorrelation(self, prn: int) -> np.ndarray:
        """Periodic autocorrelation of `subchips`, lags in steps of 1 / per_chip, read-only.

        1 at 0; straight between these lags.  Without the quadrature component of a QMBOC.

        Raises
        ------
        ValueError
            The PRN has no code.
        """
        self._check(prn)
        return _autocorrelation(self, int(prn))

    def _check(self, prn: int) -> None:
        if prn not in self.prns:
            raise ValueError(f"prn {prn}: {self.name} has codes for PRN {_spans(self.prns)}")


def _spans(numbers: Sequence[int]) -> str:
    """1-63, 159-210."""
    breaks = [i for i in range(1, len(numbers)) if numbers[i] != numbers[i - 1] + 1]
    first, last = [0, *breaks], [*breaks, len(numbers)]
    return ", ".join(f"{numbers[i]}-{numbers[j - 1]}" for i, j in zip(first, last, strict=True))


def _signs(bits: np.ndarray) -> np.ndarray:
    return 1 - 2 * bits.astype(np.int8)


@cache
def _chips(signal: Signal, prn: int) -> np.ndarray:
    chips = _signs(signal.generate(prn))
    chips.flags.writeable = False
    return chips


@cache
def _autocorrelation(signal: Signal, prn: int) -> np.ndarray:
    values = signal.subchips(prn).astype(np.float64)
    sums = np.fft.irfft(np.abs(np.fft.rfft(values)) ** 2, values.size)
    if np.array_equal(values, np.rint(values)):
        sums = np.rint(sums)  # of whole numbers
    sums /= sums[0]
    sums.flags.writeable = False
    return sums
