"""Shift registers and Weil sequences, from which ranging codes are made: arrays of logical 0 and 1.

Results of the cached functions are shared and read-only.
"""

from __future__ import annotations

from functools import cache

import numpy as np


@cache
def shift_register(taps: tuple[int, ...], start: str, length: int) -> np.ndarray:
    """Output (length,) of the last stage of a register that shifts towards it.

    Parameters
    ----------
    taps
        Stages, counted from 1, whose sum enters stage 1; the last one is the output.
    start
        Contents of stages 1, 2, ... at the start, one digit each.
    """
    # output n + m is the sum of outputs n + m - k over the taps k: a window of m outputs, the
    # oldest in bit 0, is the register itself
    m = len(start)
    mask = sum(1 << (m - tap) for tap in taps)
    window = int(start, 2)  # stage k is bit m - k
    out = np.empty(length, dtype=np.uint8)
    for n in range(length):
        out[n] = window & 1
        window = window >> 1 | ((window & mask).bit_count() & 1) << (m - 1)
    out.flags.writeable = False
    return out


def modular_register(mask: int, start: int, length: int) -> tuple[np.ndarray, int]:
    """Output (length,) of a register that adds ``mask`` when a 1 leaves it, and its last state.

    The last state is the one that gives output ``length`` - 1 (IS-GPS-200 figure 3-14).
    """
    out = np.empty(length, dtype=np.uint8)
    state = last = start
    for n in range(length):
        last = state
        bit = state & 1
        out[n] = bit
        state = state >> 1 ^ (mask if bit else 0)
    return out, last


@cache
def legendre(prime: int) -> np.ndarray:
    """Legendre sequence (prime,): 1 where the index is a square modulo ``prime``, 0 at 0."""
    out = np.zeros(prime, dtype=np.uint8)
    out[np.arange(1, prime, dtype=np.int64) ** 2 % prime] = 1
    out.flags.writeable = False
    return out


def weil(prime: int, w: int) -> np.ndarray:
    """Weil sequence (prime,): W(k) = L(k) xor L(k + w)."""
    return legendre(prime) ^ np.roll(legendre(prime), -w)
