"""How long a cell of the vector closures' search is dwelt on; see `vector_search`."""

from __future__ import annotations

import math

import numpy as np

from ultratight.tracking.channel_state import BIT_S, CODE_S
from ultratight.tracking.vector_measurements import POWER_GAIN, amplitude2_of

BIN_HZ, HALF_WIDTH_HZ = 25.0, 300.0
"""Half of 1 / bit, so that at most 0.9 dB are lost between two; 300 Hz lose 1.3 dB in 1 ms"""
N_BIN = 2 * round(HALF_WIDTH_HZ / BIN_HZ) + 1
CELL_HZ = N_BIN * BIN_HZ
FOUND_ABOVE_DBHZ = 16.0
"""A channel is heard: 6 sigma of the running C/N0 without a signal"""
DETECTED, DETECTED_SIGMAS = 0.9, 1.28
"""Probability that a signal passes in its cell, and is heard at the centre in a wait"""


def threshold(bits: int, false_alarm: float) -> float:
    """Of the largest summed power of a cell without a signal, unit noise per component."""
    from scipy.special import gammainccinv  # slow to import

    return 2.0 * float(gammainccinv(bits, false_alarm / (3 * N_BIN)))


def detection(bits: int, amplitude2: float, spacing_chips: float, false_alarm: float) -> float:
    """Probability that a signal of A^2 somewhere in the cell passes after so many bits.

    With the mean losses of power: a triangle to half a tap's distance, half a bin in 20 ms, half a
    cell in 1 ms.
    """
    from scipy.special import chndtr  # slow to import

    h = 0.5 * spacing_chips
    turned = (
        np.linspace(-0.5, 0.5, 101) * hz * s for hz, s in ((BIN_HZ, BIT_S), (CELL_HZ, CODE_S))
    )
    kept = (1.0 - (1.0 - h) ** 3) / (3.0 * h) * math.prod(np.mean(np.sinc(x) ** 2) for x in turned)
    # beyond 500 nothing is missed that a double could tell
    noncentral = min(2.0 * bits * max(amplitude2, 0.0) * kept, 500.0)
    return 1.0 - float(chndtr(threshold(bits, false_alarm), 2 * bits, noncentral))


def dwell(
    amplitude2: float, spacing_chips: float, false_alarm: float, least: int, most: int
) -> int:
    """Fewest bits with `DETECTED`; ``most`` + 1 where they do not suffice."""
    for bits in range(least, most + 1):
        if detection(bits, amplitude2, spacing_chips, false_alarm) >= DETECTED:
            return bits
    return most + 1


def heard_after(amplitude2: float, most: int) -> int:
    """Bits after which the low pass of A^2, from zero, is over the limit with `DETECTED`."""
    limit = float(amplitude2_of(FOUND_ABOVE_DBHZ))
    sigma = math.sqrt(max(2.0 * amplitude2 + 2.0, 0.0) * POWER_GAIN / (2.0 - POWER_GAIN))
    for bits in range(1, most):
        left = (1.0 - POWER_GAIN) ** bits
        noise = DETECTED_SIGMAS * sigma * math.sqrt(1.0 - left**2)
        if amplitude2 * (1.0 - left) - noise >= limit:
            return bits
    return most
