"""Half-bit dumps become data bits: paired, and freed of what is known of the NCO."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from signals.compiled import kernel
from signals.nco import Taps
from ultratight.tracking.steering import Steering, mean_known

EARLY, PROMPT, LATE = 0, 1, 2
"""Order of the taps"""
AMPLITUDE_GAIN = 0.02
"""Share of each bit in the running A^2: a time constant of 1 s"""
AMPLITUDE2_FLOOR = 0.5


class Bits(NamedTuple):
    """Data bits that are complete, one row each; and each channel's first half that waits."""

    channel: np.ndarray  # (n_bit,) int64
    number: np.ndarray  # (n_bit,) int64, of the data bit
    t_mid_s: np.ndarray  # (n_bit,)
    half_s: np.ndarray  # (n_bit,) length of a half [s]
    iq: np.ndarray  # (n_bit, 2, n_tap) complex, known rotation taken out
    range_offset_m: np.ndarray  # (n_bit,) known reference - NCO of the code, mean over the bit


class HalfBits:
    """Pairs the half-bit dumps of each channel; a half that waits is kept with its times."""

    def __init__(self, n_channel: int, n_tap: int) -> None:
        self.number = np.full(n_channel, -(10**9), dtype=np.int64)
        self.t_s = np.zeros((n_channel, 2))
        self.iq = np.zeros((n_channel, n_tap), dtype=np.complex128)

    def track(self, bits: Bits, amplitude2: np.ndarray) -> None:
        """Let A^2 (n_channel,) follow the power of the prompts, bit by bit."""
        _track_amplitude(bits.channel, bits.iq, amplitude2)

    def pair(self, taps: Taps, steering: Steering) -> Bits:
        """Data bits that ended among these dumps, derotated by what is known of the NCO."""
        n_dump = taps.channel.size
        n_tap = self.iq.shape[1]
        out = Bits(
            np.empty(n_dump, dtype=np.int64),
            np.empty(n_dump, dtype=np.int64),
            np.empty(n_dump),
            np.empty(n_dump),
            np.empty((n_dump, 2, n_tap), dtype=np.complex128),
            np.empty(n_dump),
        )
        n_bit = _pair_halves(
            taps.channel, taps.number, taps.t_start_s, taps.t_end_s, taps.iq, taps.noise_var,
            self.number, self.t_s, self.iq,
            steering.known_t_s, steering.known_carrier, steering.known_range, out,
        )  # fmt: skip
        return Bits(*(a[:n_bit] for a in out))


@kernel
def _pair_halves(
    channel: np.ndarray,
    number: np.ndarray,
    t_start: np.ndarray,
    t_end: np.ndarray,
    iq: np.ndarray,
    noise_var: np.ndarray,
    wait_number: np.ndarray,
    wait_t: np.ndarray,
    wait_iq: np.ndarray,
    known_t: np.ndarray,
    known_carrier: np.ndarray,
    known_range: np.ndarray,
    out: Bits,
) -> int:
    """Fill the rows of `Bits` in out; returns their number."""
    n_bit = 0
    for k in range(channel.size):
        i = channel[k]
        scale = 1.0 / np.sqrt(noise_var[k])
        if number[k] % 2 == 0:
            wait_number[i] = number[k]
            wait_t[i, 0], wait_t[i, 1] = t_start[k], t_end[k]
            wait_iq[i] = iq[k] * scale
        elif wait_number[i] == number[k] - 1:
            t0, t1, t2 = wait_t[i, 0], wait_t[i, 1], t_end[k]
            turn1 = mean_known(known_t, known_carrier[:, i], t0, t1)
            turn2 = mean_known(known_t, known_carrier[:, i], t_start[k], t2)
            out.channel[n_bit] = i
            out.number[n_bit] = number[k] // 2
            out.t_mid_s[n_bit] = 0.5 * (t0 + t2)
            out.half_s[n_bit] = 0.5 * (t2 - t0)
            out.iq[n_bit, 0] = wait_iq[i] * np.exp(-2j * np.pi * turn1)
            out.iq[n_bit, 1] = iq[k] * scale * np.exp(-2j * np.pi * turn2)
            out.range_offset_m[n_bit] = mean_known(known_t, known_range[:, i], t0, t2)
            n_bit += 1
    return n_bit


@kernel
def _track_amplitude(channel: np.ndarray, iq: np.ndarray, amplitude2: np.ndarray) -> None:
    for b in range(channel.size):
        i = channel[b]
        power = 0.5 * (abs(iq[b, 0, PROMPT]) ** 2 + abs(iq[b, 1, PROMPT]) ** 2) - 2.0
        follow = amplitude2[i] + AMPLITUDE_GAIN * (power - amplitude2[i])
        amplitude2[i] = max(follow, AMPLITUDE2_FLOOR)
