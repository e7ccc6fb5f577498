"""Ranging codes: every signal is a row of facts with the clause of its interface document."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from signals.constants import CA_CHIP_RATE_HZ, GPS_L1_HZ


@dataclass(frozen=True)
class Signal:
    """One ranging signal.

    Attributes
    ----------
    name
        System and signal, e.g. "GPS L1 C/A".
    carrier_hz, chip_rate_hz
        Nominal frequencies.
    length_chips
        Period of the code.
    symbol_s
        Length of a data symbol.
    modulation
        Of the chips, e.g. "BPSK(1)".
    prns
        Range of PRN numbers that have a code.
    generate
        prn -> (length_chips,) of logical 0 and 1.
    """

    name: str
    carrier_hz: float
    chip_rate_hz: float
    length_chips: int
    symbol_s: float
    modulation: str
    prns: range
    generate: Callable[[int], np.ndarray]

    def chips(self, prn: int) -> np.ndarray:
        """One period of the code as +-1, logical 0 is +1: (length_chips,) int8, read-only.

        Raises
        ------
        ValueError
            The PRN has no code.
        """
        if prn not in self.prns:
            first, last = self.prns[0], self.prns[-1]
            raise ValueError(f"prn {prn}: {self.name} has codes for PRN {first}-{last}")
        return _chips(self, int(prn))

    def autocorrelation(self, prn: int) -> np.ndarray:
        """Periodic autocorrelation at delays of whole chips, 1 at 0: (length_chips,), read-only.

        Raises
        ------
        ValueError
            The PRN has no code.
        """
        self.chips(prn)
        return _autocorrelation(self, int(prn))


@cache
def _chips(signal: Signal, prn: int) -> np.ndarray:
    chips = (1 - 2 * signal.generate(prn)).astype(np.int8)
    chips.flags.writeable = False
    return chips


@cache
def _autocorrelation(signal: Signal, prn: int) -> np.ndarray:
    spectrum = np.fft.rfft(signal.chips(prn).astype(np.float64))
    sums = np.fft.irfft(np.abs(spectrum) ** 2, signal.length_chips)
    values = np.rint(sums) / signal.length_chips  # the sums are whole numbers
    values.flags.writeable = False
    return values


# Delay of G2 in chips, PRN 1-210: IS-GPS-200 tables 3-Ia, 3-Ib and 6-I
# fmt: off
_G2_DELAY = (
    5, 6, 7, 8, 17, 18, 139, 140, 141, 251, 252, 254, 255, 256, 257, 258, 469, 470, 471, 472,
    473, 474, 509, 512, 513, 514, 515, 516, 859, 860, 861, 862, 863, 950, 947, 948, 950, 67,
    103, 91, 19, 679, 225, 625, 946, 638, 161, 1001, 554, 280, 710, 709, 775, 864, 558, 220,
    397, 55, 898, 759, 367, 299, 1018, 729, 695, 780, 801, 788, 732, 34, 320, 327, 389, 407,
    525, 405, 221, 761, 260, 326, 955, 653, 699, 422, 188, 438, 959, 539, 879, 677, 586, 153,
    792, 814, 446, 264, 1015, 278, 536, 819, 156, 957, 159, 712, 885, 461, 248, 713, 126, 807,
    279, 122, 197, 693, 632, 771, 467, 647, 203, 145, 175, 52, 21, 237, 235, 886, 657, 634, 762,
    355, 1012, 176, 603, 130, 359, 595, 68, 386, 797, 456, 499, 883, 307, 127, 211, 121, 118,
    163, 628, 853, 484, 289, 811, 202, 1021, 463, 568, 904, 670, 230, 911, 684, 309, 644, 932,
    12, 314, 891, 212, 185, 675, 503, 150, 395, 345, 846, 798, 992, 357, 995, 877, 112, 144,
    476, 193, 109, 445, 291, 87, 399, 292, 901, 339, 208, 711, 189, 263, 537, 663, 942, 173,
    900, 30, 500, 935, 556, 373, 85, 652, 310,
)
# fmt: on


def _register(taps: tuple[int, ...]) -> np.ndarray:
    """Output of a 10-stage register that starts at all ones: (1023,) of 0 and 1."""
    stages = [1] * 10
    out = np.empty(1023, dtype=np.int64)
    for k in range(1023):
        out[k] = stages[9]
        stages = [sum(stages[tap - 1] for tap in taps) % 2, *stages[:9]]
    return out


def _gps_ca(prn: int) -> np.ndarray:
    """G1 = 1 + X^3 + X^10; G2 = 1 + X^2 + X^3 + X^6 + X^8 + X^9 + X^10 (IS-GPS-200 3.3.2.3)."""
    return _register((3, 10)) ^ np.roll(_register((2, 3, 6, 8, 9, 10)), _G2_DELAY[prn - 1])


GPS_L1CA = Signal(
    name="GPS L1 C/A",
    carrier_hz=GPS_L1_HZ,  # IS-GPS-200 3.3.1.1
    chip_rate_hz=CA_CHIP_RATE_HZ,  # 3.2.1.3
    length_chips=1023,
    symbol_s=0.02,  # 50 bit/s, 3.3.2.2
    modulation="BPSK(1)",
    prns=range(1, 211),
    generate=_gps_ca,
)
