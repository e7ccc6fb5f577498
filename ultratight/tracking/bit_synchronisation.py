"""Where data bits begin: maximum likelihood over all places where they may.

With the prompts P_k of single code periods, unit noise in each component, amplitude A and the
phase known up to its sign, the bits' signs averaged out,

    log L(edge) = sum over bits of log cosh(A sum over the bit's periods of Re P_k)

(Kaplan & Hegarty, 3rd ed., 8.8; Proakis, Digital Communications, 5.3).  Parts of bits at both ends
count as what they are.  Only changes of sign tell: without any all edges are alike.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ultratight.tracking.fine_acquisition import residual_hz


class BitEdge(NamedTuple):
    """The most probable place."""

    first: int
    """Index of the first prompt that begins a bit, below the number of periods in a bit"""
    probability: float
    """Of this place, all having been alike before"""


def bit_edge(prompts: np.ndarray, period_s: float, per_bit: int) -> BitEdge:
    """Edge of the bits in consecutive prompts (n,), complex, with a constant Doppler left in them.

    The probability is what it says from 27 dB-Hz on with 200 prompts of 1 ms; below, the Doppler
    taken from squared prompts may be wrong, and it says too much (25 dB-Hz: 0.79, and 0.53 are
    right).  The Doppler may be up to 1 / (4 ``period_s``); its change must not turn the phase by
    more than some 0.1 cycles.

    Raises
    ------
    ValueError
        Fewer prompts than there are in two bits.
    """
    n = len(prompts)
    if n < 2 * per_bit:
        raise ValueError(f"prompts: {n} given, expected at least {2 * per_bit}, two bits")
    z = prompts * np.exp(-2j * np.pi * residual_hz(prompts, period_s) * period_s * np.arange(n))
    y = (z * np.exp(-0.5j * np.angle(np.sum(z**2)))).real
    amplitude = np.sqrt(max(float(np.mean(np.abs(prompts) ** 2)) - 2.0, 0.0))
    sums = np.concatenate([[0.0], np.cumsum(y)])
    log_l = np.empty(per_bit)
    for first in range(per_bit):
        edges = np.unique(np.concatenate([[0], np.arange(first, n, per_bit), [n]]))
        x = np.abs(amplitude * np.diff(sums[edges]))
        log_l[first] = np.sum(x + np.log1p(np.exp(-2.0 * x)))
    best = int(log_l.argmax())
    return BitEdge(best, float(1.0 / np.sum(np.exp(log_l - log_l[best]))))
