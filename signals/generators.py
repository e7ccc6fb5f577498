"""Generators of ranging and secondary codes: prn -> chips as logical 0 and 1.

Registers and formulas stand here, the numbers of each satellite in ``icd_gps``, ``icd_galileo``
and ``icd_beidou``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from signals import icd_beidou, icd_galileo, icd_gps
from signals.sequences import modular_register, shift_register, weil

L2C_PRNS = (*range(1, 64), *range(159, 211))
"""Satellites of `icd_gps.L2CM_INITIAL` and `icd_gps.L2CL_INITIAL`"""


def gps_ca(prn: int) -> np.ndarray:
    """G1 = 1 + X^3 + X^10; G2 = 1 + X^2 + X^3 + X^6 + X^8 + X^9 + X^10 (IS-GPS-200 3.3.2.3)."""
    g2 = shift_register((2, 3, 6, 8, 9, 10), "1" * 10, 1023)
    return shift_register((3, 10), "1" * 10, 1023) ^ np.roll(g2, icd_gps.CA_G2_DELAY[prn - 1])


def gps_l5(advance: tuple[int, ...], prn: int) -> np.ndarray:
    """XA, cut short at 8190, plus XB from ``advance`` on; both restart each ms (IS-GPS-705 3.3.2).

    XA = 1 + x^9 + x^10 + x^12 + x^13, XB = 1 + x + x^3 + x^4 + x^6 + x^7 + x^8 + x^12 + x^13.
    """
    xa = shift_register((9, 10, 12, 13), "1" * 13, 8190)
    xb = shift_register((1, 3, 4, 6, 7, 8, 12, 13), "1" * 13, 8191)
    return np.resize(xa, 10_230) ^ np.resize(np.roll(xb, -advance[prn - 1]), 10_230)


def gps_l2c(initial: tuple[int, ...], length: int, prn: int) -> np.ndarray:
    """The 27-stage register of both codes, short-cycled (IS-GPS-200 3.3.2.4, figure 3-14)."""
    return modular_register(0o445112474, initial[L2C_PRNS.index(prn)], length)[0]


def gps_l1c(indices: tuple[tuple[int, int], ...], prn: int) -> np.ndarray:
    """Weil code of 10223 with seven chips put in before the p-th (IS-GPS-800 3.2.2.1.1)."""
    w, p = indices[prn - 1]
    return np.insert(weil(10_223, w), p - 1, np.array([0, 1, 1, 0, 1, 0, 0], np.uint8))


def gps_l1c_overlay(prn: int) -> np.ndarray:
    """1800 outputs of the 11-stage register S1 (IS-GPS-800 3.2.2.1.2)."""
    polynomial, initial = icd_gps.L1CO[prn - 1]
    # coefficient m_i is bit i; the output begins with the initial state, its first bit first
    taps = tuple(i for i in range(1, 12) if polynomial >> i & 1)
    return shift_register(taps, f"{initial:011b}"[::-1], 1800)


def shared_code(text: str) -> Callable[[int], np.ndarray]:
    """A secondary code that all satellites share."""
    bits = np.array([int(bit) for bit in text], dtype=np.uint8)
    return lambda prn: bits


def galileo_e5a(taps: tuple[int, ...], start: tuple[int, ...], prn: int) -> np.ndarray:
    """Two 14-stage registers, the first from all ones (Galileo OS SIS ICD 3.4.1)."""
    first = shift_register((1, 6, 8, 14), "1" * 14, 10_230)
    # stage 1 is the last bit of the start value
    return first ^ shift_register(taps, f"{start[prn - 1]:014b}"[::-1], 10_230)


def galileo_cs100(prn: int) -> np.ndarray:
    bits = f"{int(icd_galileo.E5AQ_CS100[prn - 1], 16):0100b}"
    return np.array([int(bit) for bit in bits], dtype=np.uint8)


def beidou_b1i(prn: int) -> np.ndarray:
    """Sum of G1 and stages of G2, short of a chip (BDS-SIS-ICD-B1I 4.3)."""
    g1 = shift_register((1, 7, 8, 9, 10, 11), "01010101010", 2046)
    # a stage k is the output 11 - k chips ahead
    g2 = shift_register((1, 2, 3, 4, 5, 8, 9, 11), "01010101010", 2046 + 10)
    stages = [g2[11 - tap : 11 - tap + 2046] for tap in icd_beidou.B1I_TAPS[prn - 1]]
    return np.bitwise_xor.reduce([g1, *stages])


def beidou_weil(
    prime: int, length: int, indices: tuple[tuple[int, int], ...], prn: int
) -> np.ndarray:
    """Weil code from its p-th chip on, truncated (BDS-SIS-ICD-B1C 5.2)."""
    w, p = indices[prn - 1]
    return np.roll(weil(prime, w), 1 - p)[:length]
