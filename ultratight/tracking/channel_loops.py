"""What the channels of the scalar closure remember, and the kernels that run their loops.

Powers, with P_k the 20 prompts of one code period (1 ms) in a data bit, in units of the noise:

    narrow  |sum P_k|^2 = 400 A^2 + 20 (2 N)        wide  sum |P_k|^2 = 20 (A^2 + 2 N)

so that A^2 = (narrow - wide) / 380 needs no noise floor, and C/N0 = A^2 / (2 N 1 ms): the
narrow-wide power ratio of Van Dierendonck (Parkinson & Spilker, 1996, vol. I, ch. 8), as a ratio
of low passes.  His phase lock indicator (I^2 - Q^2) / (I^2 + Q^2) = cos 2 phi of a bit's prompt is
used too; the frequency lock indicator is Re(H2 conj H1) over the mean power of the halves H1, H2
of the bit, the cosine of the turn in half a bit.  Both are low passes of the bits' own ratios.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.compiled import kernel
from signals.constants import C_MPS, CA_CHIP_RATE_HZ, GPS_L1_HZ
from ultratight.tracking.discriminators import costas_phase, dot_product_delay, frequency
from ultratight.tracking.loop_filters import filter_step
from ultratight.tracking.steering import advance_ins, predict, views

WAVELENGTH_M = C_MPS / GPS_L1_HZ
PULL_IN, ASSISTED, LOCKED = 0, 1, 2
CODE_S = 0.001
BIT_CODES = 20
BIT_S = BIT_CODES * CODE_S
HALF_BIT_S = 0.5 * BIT_S
POWER_GAIN = BIT_S / 1.0
"""C/N0: low pass of 1 s"""
LOCK_GAIN = BIT_S / 0.4
"""Indicators: low pass of 0.4 s, which forgives what a loop survives"""
SETTLING_S = 0.3
"""Pull-in takes at least this long"""
PATIENCE_S = 2.0
"""Pull-in and assisted phase start anew so long after they could have ended"""
FREQUENCY_FOUND_ABOVE = 0.5
"""cos(2 pi f 10 ms): 17 Hz, less at low C/N0"""
PHASE_FOUND_ABOVE = 0.6
PHASE_GOOD_ABOVE = 0.8
PHASE_LOST_BELOW = 0.4
FREQUENCY_LOST_BELOW = 0.2
"""A Costas loop can rest at a multiple of 1/(2 T), where the halves of the bit turn by 90 deg"""
CN0_LOST_BELOW_DBHZ = 15.0
CN0_FLOOR_DBHZ = 10.0

_FREQUENCY_FOUND, _PHASE_FOUND, _PHASE_LOST, _FREQUENCY_LOST, _CN0_LOST, _NEVER = range(6)
EVENTS = (
    ("frequency lock", "frequency lock indicator {:.2f}"),
    ("phase lock", "phase lock indicator {:.2f}"),
    ("loss of lock", "phase lock indicator {:.2f}"),
    ("loss of lock", "frequency lock indicator {:.2f}"),
    ("loss of lock", "C/N0 {:.1f} dB-Hz"),
    ("loss of lock", "no lock within {:.1f} s"),
)
"""(kind, reason) by the code that `close_loops` gives"""


class Design(NamedTuple):
    """Gains of the loops for `filter_step`, and what they need to know of the signal."""

    block: int  # code periods in an integration of the assisted and locked phases
    pll: np.ndarray  # (3,)
    pll_wide: np.ndarray  # (3,) while it is assisted, and until it has settled without
    assist: np.ndarray  # (3,) FLL beside the PLL
    pull_in: np.ndarray  # (3,) FLL alone
    dll: np.ndarray  # (3,)
    dll_pull_in: np.ndarray  # (3,) on single code periods
    slope: np.ndarray  # (n_channel,) of early minus late [1/chip]
    settling_s: float  # the PLL is assisted at least this long
    narrow_after_s: float  # and stays wide for so long after phase lock


class Loops(NamedTuple):
    """All channels' memory; arrays are updated in place."""

    code_chips: np.ndarray  # (n_channel,) NCO code phase at the end of the command
    carrier_cycles: np.ndarray  # (n_channel,) NCO carrier phase there
    loop_hz: np.ndarray  # (n_channel,) carrier loop's share of the frequency
    loop_chips_per_s: np.ndarray  # (n_channel,) code loop's share of the chip rate
    carrier_memory: np.ndarray  # (n_channel, 2) Hz/s, Hz
    code_memory: np.ndarray  # (n_channel, 2) chips/s^2, chips/s
    feed: np.ndarray  # (n_channel, 2) fed forward: Hz, Hz/s
    feed_t_s: np.ndarray  # (1,) at this time
    last_good_hz: np.ndarray  # (n_channel,) loop frequency when the phase was last well locked
    phase: np.ndarray  # (n_channel,) int64: PULL_IN, ASSISTED, LOCKED
    since_s: np.ndarray  # (n_channel,) in this phase since
    first_lost_s: np.ndarray  # (n_channel,) NaN where never lost
    next_index: np.ndarray  # (n_channel,) int64, of the dump to come
    n_in_block: np.ndarray  # (n_channel,) int64
    n_in_bit: np.ndarray  # (n_channel,) int64, negative in a bit that is not whole
    block: np.ndarray  # (n_channel, 3) sums of early, prompt, late over the integration
    halves: np.ndarray  # (n_channel, 2) sums of the prompts over the halves of the bit
    last: np.ndarray  # (n_channel,) complex prompt before this one
    products: np.ndarray  # (n_channel,) sum of P_k conj(P_k-1) over the bit
    wide_now: np.ndarray  # (n_channel,) sum of |P_k|^2 over the bit
    narrow: np.ndarray  # (n_channel,) low pass of the narrow-band power
    wide: np.ndarray  # (n_channel,) and of the wide-band power
    cn0_dbhz: np.ndarray  # (n_channel,)
    phase_lock: np.ndarray  # (n_channel,) indicator
    frequency_lock: np.ndarray  # (n_channel,) indicator
    prompt: np.ndarray  # (n_channel,) complex, last whole bit, unit noise per component


def new_loops(cn0_dbhz: np.ndarray) -> Loops:
    """Loops at rest, told the C/N0 (n_channel,) to expect."""
    n = cn0_dbhz.size
    real, whole, turning = np.zeros, np.int64, np.complex128
    loops = Loops(
        real(n), real(n), real(n), real(n), real((n, 2)), real((n, 2)), real((n, 2)), real(1),
        real(n), real(n, whole), real(n), np.full(n, np.nan),
        np.full(n, -1, whole), real(n, whole), np.full(n, -BIT_CODES, whole),
        real((n, 3), turning), real((n, 2), turning), real(n, turning), real(n, turning),
        real(n), real(n), real(n),
        np.array(cn0_dbhz, dtype=np.float64), real(n), real(n), real(n, turning),
    )  # fmt: skip
    loops.frequency_lock[:] = 1.0  # the first Doppler is good to some Hz, until proved otherwise
    a2 = 2.0 * 10.0 ** (cn0_dbhz / 10.0) * CODE_S
    loops.narrow[:] = BIT_CODES * (BIT_CODES * a2 + 2.0)
    loops.wide[:] = BIT_CODES * (a2 + 2.0)
    return loops


@kernel
def advance(t0_s: float, t1_s: float, loops: Loops, out: np.ndarray) -> None:
    """Command [t0, t1) into out (5, 1, n_channel), in the order of `Nco`; phases go on."""
    dt = t1_s - t0_s
    for i in range(loops.phase.size):
        ramp = loops.feed[i, 1]
        freq = loops.feed[i, 0] + ramp * (t0_s - loops.feed_t_s[0]) + loops.loop_hz[i]
        cycles = dt * (freq + 0.5 * ramp * dt)
        # carrier aiding: the code runs with the carrier, and the DLL only adds
        chip_rate = CA_CHIP_RATE_HZ * (1.0 + cycles / dt / GPS_L1_HZ) + loops.loop_chips_per_s[i]
        out[0, 0, i] = loops.code_chips[i]
        out[1, 0, i] = chip_rate
        out[2, 0, i] = loops.carrier_cycles[i]
        out[3, 0, i] = freq
        out[4, 0, i] = ramp
        loops.code_chips[i] += chip_rate * dt
        loops.carrier_cycles[i] += cycles


@kernel
def feed_forward(
    t_s: np.ndarray,
    alpha: np.ndarray,
    nu: np.ndarray,
    steering: np.ndarray,
    sky: np.ndarray,
    loops: Loops,
) -> None:
    """Take the increments (m, 3) between t_s (m + 1,) into the INS; renew what is fed forward.

    ``steering`` is the buffer of a `Steering`, ``sky`` its arcs.  The Doppler's rate is its change
    over the last interval.
    """
    s = views(steering, sky.shape[2])
    for j in range(t_s.size - 1):
        dt = t_s[j + 1] - t_s[j]
        advance_ins(s, alpha[j], nu[j], dt)
        predict(s, sky, t_s[j + 1])
        for i in range(loops.phase.size):
            doppler = -s.rho_rate[i] / WAVELENGTH_M
            loops.feed[i, 1] = (doppler - loops.feed[i, 0]) / dt
            loops.feed[i, 0] = doppler
    loops.feed_t_s[0] = t_s[t_s.size - 1]


@kernel
def close_loops(
    channel: np.ndarray,
    index: np.ndarray,
    t_end_s: np.ndarray,
    iq: np.ndarray,
    noise_var: np.ndarray,
    loops: Loops,
    design: Design,
) -> np.ndarray:
    """Let dumps of one code period act; returns the events (n, 4): t_s, channel, code, value.

    iq (n_dump, 3): early, prompt, late.
    """
    events = np.empty((channel.size, 4))
    n_event = 0
    for k in range(channel.size):
        i = channel[k]
        code = index[k] % BIT_CODES
        length = design.block if loops.phase[i] != PULL_IN else 1
        _add(i, index[k], code, length, iq[k], 1.0 / math.sqrt(noise_var[k]), loops)
        bit_ends = loops.n_in_bit[i] == BIT_CODES
        if bit_ends:
            _watch(i, loops)
            _close_frequency_loop(i, loops, design)
        if loops.n_in_block[i] == length:
            _close_block(i, length, t_end_s[k], loops, design)
        if bit_ends:
            what, value = _decide(i, t_end_s[k], loops, design)
            if what >= 0:
                events[n_event, 0] = t_end_s[k]
                events[n_event, 1] = i
                events[n_event, 2] = what
                events[n_event, 3] = value
                n_event += 1
    return events[:n_event]


@kernel
def _add(
    i: int, index: int, code: int, length: int, iq: np.ndarray, scale: float, loops: Loops
) -> None:
    """Add a dump, the code-th of its data bit, to the sums of channel i."""
    if index != loops.next_index[i]:  # dumps are missing: neither integration nor bit is whole
        loops.n_in_block[i] = -BIT_CODES
        loops.n_in_bit[i] = -2 * BIT_CODES
    loops.next_index[i] = index + 1
    if code % length == 0:
        loops.n_in_block[i] = 0
        loops.block[i, :] = 0.0
    if code == 0:
        loops.n_in_bit[i] = 0
        loops.halves[i, :] = 0.0
        loops.products[i] = 0.0
        loops.wide_now[i] = 0.0
        loops.last[i] = 0.0
    prompt = iq[1] * scale
    for m in range(3):
        loops.block[i, m] += iq[m] * scale
    loops.halves[i, 2 * code // BIT_CODES] += prompt
    loops.products[i] += prompt * loops.last[i].conjugate()
    loops.wide_now[i] += prompt.real**2 + prompt.imag**2
    loops.last[i] = prompt
    loops.n_in_block[i] += 1
    loops.n_in_bit[i] += 1


@kernel
def _watch(i: int, loops: Loops) -> None:
    """Renew C/N0 and the lock indicators of channel i at the end of a data bit."""
    first, second = loops.halves[i, 0], loops.halves[i, 1]
    prompt = first + second
    loops.prompt[i] = prompt / math.sqrt(BIT_CODES)
    narrow = prompt.real**2 + prompt.imag**2
    # ratios bit by bit: a signal that is gone does not live on in the sums
    doubled = (prompt.real**2 - prompt.imag**2) / max(narrow, 1e-30)
    loops.phase_lock[i] += LOCK_GAIN * (doubled - loops.phase_lock[i])
    turned = second.real * first.real + second.imag * first.imag
    power = 0.5 * (abs(first) ** 2 + abs(second) ** 2)
    loops.frequency_lock[i] += LOCK_GAIN * (turned / max(power, 1e-30) - loops.frequency_lock[i])
    if loops.phase[i] == PULL_IN and loops.frequency_lock[i] < FREQUENCY_FOUND_ABOVE:
        return  # the bit's sum says nothing of the power while the frequency is wrong
    loops.narrow[i] += POWER_GAIN * (narrow - loops.narrow[i])
    loops.wide[i] += POWER_GAIN * (loops.wide_now[i] - loops.wide[i])
    a2 = _amplitude2(i, loops)
    twice_noise = max(loops.wide[i] / BIT_CODES - a2, 1e-30)
    loops.cn0_dbhz[i] = 10.0 * math.log10(a2 / (twice_noise * CODE_S))


@kernel
def _amplitude2(i: int, loops: Loops) -> float:
    """Squared amplitude of the prompt of one code period, not below the floor."""
    pairs = BIT_CODES * (BIT_CODES - 1)
    floor = 2.0 * 10.0 ** (CN0_FLOOR_DBHZ / 10.0) * CODE_S
    return max((loops.narrow[i] - loops.wide[i]) / pairs, floor)


@kernel
def _close_frequency_loop(i: int, loops: Loops, design: Design) -> None:
    """The FLL alone, or its push on the integrators of the PLL."""
    if loops.phase[i] == LOCKED:
        return
    memory = loops.carrier_memory[i]
    if loops.frequency_lock[i] < FREQUENCY_FOUND_ABOVE:
        lag_s, n_product = CODE_S, BIT_CODES - 1
        products = loops.products[i]
    else:
        lag_s, n_product = HALF_BIT_S, BIT_CODES**2 // 4
        products = loops.halves[i, 1] * loops.halves[i, 0].conjugate()
    # noise alone, when the signal is gone, is far below the amplitude that was: it pushes little
    weight = min(1.0, abs(products) / (n_product * _amplitude2(i, loops)))
    error = weight * frequency(products, lag_s)
    if loops.phase[i] == PULL_IN:
        loops.loop_hz[i] = filter_step(memory, error, BIT_S, design.pull_in)
    else:
        memory[0] += design.assist[2] * error
        memory[1] += design.assist[1] * error


@kernel
def _close_block(i: int, length: int, t_s: float, loops: Loops, design: Design) -> None:
    """Code loop, and carrier phase loop if it is on, at the end of an integration."""
    early, prompt, late = loops.block[i]
    interval_s = length * CODE_S
    error = dot_product_delay(
        early, prompt, late, length**2 * _amplitude2(i, loops), design.slope[i]
    )
    pull_in = loops.phase[i] == PULL_IN
    gains = design.dll_pull_in if pull_in else design.dll
    loops.loop_chips_per_s[i] = filter_step(loops.code_memory[i], error, interval_s, gains)
    if not pull_in:
        settled = loops.phase[i] == LOCKED and t_s > loops.since_s[i] + design.narrow_after_s
        carrier_gains = design.pll if settled else design.pll_wide
        loops.loop_hz[i] = filter_step(
            loops.carrier_memory[i], costas_phase(prompt), interval_s, carrier_gains
        )


@kernel
def _decide(i: int, t_s: float, loops: Loops, design: Design) -> tuple[int, float]:
    """Next phase of channel i; returns (code of the event or -1, its value)."""
    for_s = t_s - loops.since_s[i]
    phase_lock, frequency_lock = loops.phase_lock[i], loops.frequency_lock[i]
    if loops.phase[i] == LOCKED:
        if phase_lock > PHASE_GOOD_ABOVE:
            loops.last_good_hz[i] = loops.carrier_memory[i, 1]
        what, value = -1, 0.0
        if phase_lock < PHASE_LOST_BELOW:
            what, value = _PHASE_LOST, phase_lock
        elif frequency_lock < FREQUENCY_LOST_BELOW:
            what, value = _FREQUENCY_LOST, frequency_lock
        elif loops.cn0_dbhz[i] < CN0_LOST_BELOW_DBHZ:
            what, value = _CN0_LOST, loops.cn0_dbhz[i]
        if what >= 0:
            _pull_in_again(i, t_s, loops)
        return what, value
    settling_s = SETTLING_S if loops.phase[i] == PULL_IN else design.settling_s
    if for_s > settling_s:
        if loops.phase[i] == PULL_IN and frequency_lock > FREQUENCY_FOUND_ABOVE:
            loops.phase[i] = ASSISTED
            loops.since_s[i] = t_s
            loops.phase_lock[i] = 0.0  # the phase is not believed before it has been seen
            return _FREQUENCY_FOUND, frequency_lock
        if loops.phase[i] == ASSISTED and phase_lock > PHASE_FOUND_ABOVE:
            loops.phase[i] = LOCKED
            loops.since_s[i] = t_s
            return _PHASE_FOUND, phase_lock
    if for_s > settling_s + PATIENCE_S:
        never = math.isnan(loops.first_lost_s[i])
        _pull_in_again(i, t_s, loops)
        if never:
            return _NEVER, for_s
    return -1, 0.0


@kernel
def _pull_in_again(i: int, t_s: float, loops: Loops) -> None:
    """Back to the FLL, from the last frequency that can be believed."""
    if math.isnan(loops.first_lost_s[i]):
        loops.first_lost_s[i] = t_s
    loops.phase[i] = PULL_IN
    loops.since_s[i] = t_s
    loops.carrier_memory[i, 0] = 0.0
    loops.carrier_memory[i, 1] = loops.last_good_hz[i]
    loops.loop_hz[i] = loops.last_good_hz[i]
    loops.frequency_lock[i] = 0.0
