"""Half-bit dumps become data bits: paired, and freed of what is known of the NCO.

A pilot has no bits: its pairs are those of two integrations, the first with an even number, freed
of the overlay, which is public.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.compiled import borrowing
from signals.nco import Taps
from ultratight.tracking.channels import Channels
from ultratight.tracking.steering import Steering, mean_known, views

EARLY, PROMPT, LATE = 0, 1, 2
"""Order of the taps"""
T_MID, HALF, RANGE = 0, 1, 2
"""Columns of `Bits.span`"""


class Bits(NamedTuple):
    """Data bits that are complete, one row each."""

    channel: np.ndarray  # (n_bit,) int64
    number: np.ndarray  # (n_bit,) int64, of the data bit
    span: np.ndarray  # (n_bit, 3) middle [s], length of a half [s], known reference - NCO [m]
    iq: np.ndarray  # (n_bit, 2, n_tap) complex, known rotation taken out


class HalfBits:
    """Pairs the half-bit dumps of each channel; a half that waits is kept with its times."""

    def __init__(self, channels: Channels, n_tap: int) -> None:
        self.channels = channels
        n_channel = len(channels.pilot)
        self.number = np.full(n_channel, -(10**9), dtype=np.int64)
        self.t_s = np.zeros((n_channel, 2))
        self.iq = np.zeros((n_channel, n_tap), dtype=np.complex128)

    def pair(self, taps: Taps, steering: Steering) -> Bits:
        """Data bits that ended among these dumps, derotated by what is known of the NCO."""
        n_dump, n_tap = taps.iq.shape
        channel, number = np.empty(n_dump, dtype=np.int64), np.empty(n_dump, dtype=np.int64)
        span, iq = np.empty((n_dump, 3)), np.empty((n_dump, 2, n_tap), dtype=np.complex128)
        facts = self.channels
        n = pair_into(
            facts.dump_chips, facts.symbol_chips, facts.overlay, facts.overlay_length,
            facts.overlay_start, taps.channel, taps.number, taps.t_start_s, taps.t_end_s, taps.iq,
            taps.noise_var, self.number, self.t_s, self.iq, steering.buffer,
            channel, number, span, iq,
        )  # fmt: skip
        return Bits(channel[:n], number[:n], span[:n], iq[:n])


# ---- kernels ---------------------------------------------------------------------------------


@borrowing
def pair_into(
    dump_chips: np.ndarray,
    symbol_chips: np.ndarray,
    overlay: np.ndarray,
    overlay_length: np.ndarray,
    overlay_start: np.ndarray,
    channel: np.ndarray,
    number: np.ndarray,
    t_start: np.ndarray,
    t_end: np.ndarray,
    iq: np.ndarray,
    noise_var: np.ndarray,
    wait_number: np.ndarray,
    wait_t: np.ndarray,
    wait_iq: np.ndarray,
    buffer: np.ndarray,
    bit_channel: np.ndarray,
    bit_number: np.ndarray,
    span: np.ndarray,
    bit_iq: np.ndarray,
) -> int:
    """Fill the rows of `Bits`; returns their number."""
    s = views(buffer, wait_number.size)
    n_bit = 0
    for k in range(channel.size):
        i = channel[k]
        scale = 1.0 / math.sqrt(noise_var[k])
        if overlay_length[i] > 1:
            symbol = overlay_start[i] + number[k] * dump_chips[i] // symbol_chips[i]
            scale *= overlay[i, symbol % overlay_length[i]]
        if number[k] % 2 == 0:
            wait_number[i] = number[k]
            wait_t[i, 0], wait_t[i, 1] = t_start[k], t_end[k]
            for j in range(iq.shape[1]):
                wait_iq[i, j] = iq[k, j] * scale
        elif wait_number[i] == number[k] - 1:
            t0, t1, t2 = wait_t[i, 0], wait_t[i, 1], t_end[k]
            turn1 = mean_known(s.known_t_s, s.known_carrier[:, i], t0, t1)
            turn2 = mean_known(s.known_t_s, s.known_carrier[:, i], t_start[k], t2)
            back1 = complex(math.cos(2.0 * math.pi * turn1), -math.sin(2.0 * math.pi * turn1))
            back2 = complex(math.cos(2.0 * math.pi * turn2), -math.sin(2.0 * math.pi * turn2))
            bit_channel[n_bit] = i
            bit_number[n_bit] = number[k] // 2
            span[n_bit, T_MID] = 0.5 * (t0 + t2)
            span[n_bit, HALF] = 0.5 * (t2 - t0)
            span[n_bit, RANGE] = mean_known(s.known_t_s, s.known_range[:, i], t0, t2)
            for j in range(iq.shape[1]):
                bit_iq[n_bit, 0, j] = wait_iq[i, j] * back1
                bit_iq[n_bit, 1, j] = iq[k, j] * scale * back2
            n_bit += 1
    return n_bit
