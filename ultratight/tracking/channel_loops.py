"""The kernels that run the loops of the channels of the scalar closure."""

from __future__ import annotations

import math

import numpy as np

from signals.compiled import kernel
from signals.constants import CA_CHIP_RATE_HZ, GPS_L1_HZ
from ultratight.tracking import kalman_loop
from ultratight.tracking.channel_lock import amplitude2, watch
from ultratight.tracking.channel_state import (
    ASSISTED,
    BIT_CODES,
    BIT_S,
    CHIP_M,
    CN0_LOST,
    CN0_LOST_BELOW_DBHZ,
    CODE_S,
    DIVERGED,
    DIVERGENCE_S,
    EVENTS,
    FLL,
    FREQUENCY_FOUND,
    FREQUENCY_FOUND_ABOVE,
    FREQUENCY_LOST,
    FREQUENCY_LOST_BELOW,
    HALF_BIT_S,
    LOCKED,
    NEVER,
    PATIENCE_S,
    PHASE_FOUND,
    PHASE_FOUND_ABOVE,
    PHASE_GOOD_ABOVE,
    PHASE_LOST,
    PHASE_LOST_BELOW,
    PLL,
    PULL_IN,
    SETTLING_S,
    WAVELENGTH_M,
    Design,
    Loops,
    new_loops,
)
from ultratight.tracking.discriminators import ATAN2, delay_error, frequency_error, phase_error
from ultratight.tracking.kalman_loop import (
    DOPPLER,
    RATE,
    add_period,
    close_filter,
    ran,
    start_estimate,
)
from ultratight.tracking.loop_filters import filter_step

__all__ = [
    "ASSISTED",
    "BIT_CODES",
    "BIT_S",
    "CODE_S",
    "EVENTS",
    "HALF_BIT_S",
    "LOCKED",
    "PULL_IN",
    "WAVELENGTH_M",
    "Design",
    "Loops",
    "advance",
    "close_loops",
    "new_loops",
]

# ---- kernels ---------------------------------------------------------------------------------


@kernel
def advance(t0_s: float, t1_s: float, loops: Loops, out: np.ndarray) -> None:
    """Command [t0, t1) into out (5, 1, n_channel), in the order of `Nco`; phases go on."""
    dt = t1_s - t0_s
    for i in range(loops.phase.size):
        if i < loops.kalman.t_s.size:
            if loops.phase[i] != PULL_IN and not math.isnan(loops.kalman.t_s[i]):
                loops.loop_chips_per_s[i], loops.loop_hz[i] = kalman_loop.command(
                    i, t0_s, dt, loops.steer_s[0], loops.kalman
                )
            ran(i, loops.loop_chips_per_s[i], loops.loop_hz[i], t0_s, t1_s, loops.kalman)
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
        length = _integration(i, loops, design)
        scale = 1.0 / math.sqrt(noise_var[k])
        if design.bits.shape[1]:
            column = index[k] // BIT_CODES - design.first_bit
            known = 0 <= column < design.bits.shape[1]
            scale *= float(design.bits[i, column]) if known else 0.0
        _add(i, index[k], code, length, iq[k], scale, loops)
        if i < loops.kalman.t_s.size:
            add_period(i, t_end_s[k], CODE_S, code % length == 0, loops.kalman)
        bit_ends = loops.n_in_bit[i] == BIT_CODES
        if bit_ends:
            watch(i, loops, design.cn0)
            _close_frequency_loop(i, loops, design)
        if loops.n_in_block[i] == length:
            _close_block(i, length, t_end_s[k], loops, design)
        if bit_ends:
            what, value = _decide(i, t_end_s[k], loops, design)
            if loops.phase[i] == ASSISTED and what == FREQUENCY_FOUND and loops.kalman.t_s.size:
                start_estimate(i, loops.carrier_memory[i, 1], loops.kalman)
            if what >= 0:
                events[n_event, 0] = t_end_s[k]
                events[n_event, 1] = i
                events[n_event, 2] = what
                events[n_event, 3] = value
                n_event += 1
    return events[:n_event]


@kernel
def _integration(i: int, loops: Loops, design: Design) -> int:
    """Code periods in an integration of channel i now."""
    if loops.phase[i] == PULL_IN:
        return 1
    return design.block if loops.phase[i] == LOCKED else design.block_assisted


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
def _close_frequency_loop(i: int, loops: Loops, design: Design) -> None:
    """The FLL alone, or its push on the integrators of the PLL."""
    pull_in = loops.phase[i] == PULL_IN
    if design.carrier == PLL and loops.phase[i] == LOCKED:
        return
    if loops.kalman.t_s.size and not pull_in:
        return
    memory = loops.carrier_memory[i]
    if loops.frequency_lock[i] < FREQUENCY_FOUND_ABOVE:
        lag_s, n_product = CODE_S, BIT_CODES - 1
        products = loops.products[i]
    else:
        lag_s, n_product = HALF_BIT_S, BIT_CODES**2 // 4
        products = loops.halves[i, 1] * loops.halves[i, 0].conjugate()
    # noise alone, when the signal is gone, is far below the amplitude that was: it pushes little
    weight = min(1.0, abs(products) / (n_product * amplitude2(i, loops)))
    size2 = max(abs(products), 1e-30)
    error = weight * frequency_error(design.discriminators[2], products, lag_s, size2)
    if pull_in or design.carrier == FLL:
        gains = design.pull_in if pull_in else design.assist
        loops.loop_hz[i] = filter_step(memory, error, BIT_S, gains)
    else:
        memory[0] += design.assist[2] * error
        memory[1] += design.assist[1] * error


@kernel
def _close_block(i: int, length: int, t_s: float, loops: Loops, design: Design) -> None:
    """Code loop, and carrier phase loop if it is on, at the end of an integration."""
    early, prompt, late = loops.block[i]
    interval_s = length * CODE_S
    a2 = length**2 * amplitude2(i, loops)
    code, phase, _ = design.discriminators
    error = delay_error(code, early, prompt, late, a2, design.slope[i], design.level[i])
    pull_in = loops.phase[i] == PULL_IN
    if loops.kalman.t_s.size and not pull_in:
        _close_kalman(i, length, t_s, error, loops, design)
    else:
        gains = design.dll if loops.phase[i] == LOCKED else design.dll_assisted
        if pull_in:
            gains = design.dll_pull_in
        loops.loop_chips_per_s[i] = filter_step(loops.code_memory[i], error, interval_s, gains)
        if not pull_in and design.carrier != FLL:
            settled = loops.phase[i] == LOCKED and t_s > loops.since_s[i] + design.narrow_after_s
            carrier_gains = design.pll if settled else design.pll_wide
            if loops.phase[i] == ASSISTED:
                carrier_gains = design.pll_assisted
            loops.loop_hz[i] = filter_step(
                loops.carrier_memory[i], phase_error(phase, prompt, a2), interval_s, carrier_gains
            )
    rate_mps = -CHIP_M * loops.loop_chips_per_s[i]  # code phase that runs ahead is a shorter range
    loops.divergence_mps[i] += interval_s / DIVERGENCE_S * (rate_mps - loops.divergence_mps[i])


@kernel
def _close_kalman(
    i: int, length: int, t_s: float, code_error: float, loops: Loops, design: Design
) -> None:
    """The filter in place of the loops' own; variances are those of dot product and Costas loop."""
    if math.isnan(loops.kalman.t_s[i]):
        start_estimate(i, loops.carrier_memory[i, 1], loops.kalman)
    kind = design.discriminators[1]
    a2 = length * amplitude2(i, loops)  # 2 T C/N0
    error = phase_error(kind, loops.block[i, 1], length * a2)
    squaring = 0.0 if kind == ATAN2 else 1.0 / a2
    code_variance = design.early_late[i] / (a2 * design.slope[i] ** 2) * (1.0 + 2.0 / a2)
    variance = (1.0 + squaring) / (a2 * (2.0 * math.pi) ** 2)
    close_filter(
        i, t_s, length, length * CODE_S, (code_error, error), (code_variance, variance),
        1.0 if kind == ATAN2 else 0.5, design.kalman, loops.kalman,
    )  # fmt: skip
    loops.steer_s[0] = length * CODE_S
    loops.carrier_memory[i, 0] = loops.kalman.mean[i, RATE]
    loops.carrier_memory[i, 1] = loops.kalman.mean[i, DOPPLER]


@kernel
def _decide(i: int, t_s: float, loops: Loops, design: Design) -> tuple[int, float]:
    """Next phase of channel i; returns (code of the event or -1, its value)."""
    for_s = t_s - loops.since_s[i]
    phase_lock, frequency_lock = loops.phase_lock[i], loops.frequency_lock[i]
    if loops.phase[i] == LOCKED:
        alone = design.carrier == FLL
        if (frequency_lock if alone else phase_lock) > PHASE_GOOD_ABOVE:
            loops.last_good_hz[i] = loops.carrier_memory[i, 1]
        what, value = -1, 0.0
        if not alone and phase_lock < PHASE_LOST_BELOW:
            what, value = PHASE_LOST, phase_lock
        elif frequency_lock < FREQUENCY_LOST_BELOW:
            what, value = FREQUENCY_LOST, frequency_lock
        elif loops.cn0_dbhz[i] < CN0_LOST_BELOW_DBHZ:
            what, value = CN0_LOST, loops.cn0_dbhz[i]
        elif abs(loops.divergence_mps[i]) > design.divergence_mps and for_s > 2.0 * DIVERGENCE_S:
            what, value = DIVERGED, loops.divergence_mps[i]
        if what >= 0:
            _pull_in_again(i, t_s, loops)
        return what, value
    settling_s = SETTLING_S if loops.phase[i] == PULL_IN else design.settling_s
    if for_s > settling_s:
        if loops.phase[i] == PULL_IN and frequency_lock > FREQUENCY_FOUND_ABOVE:
            loops.phase[i] = LOCKED if design.carrier == FLL else ASSISTED
            loops.since_s[i] = t_s
            loops.phase_lock[i] = 0.0  # the phase is not believed before it has been seen
            return FREQUENCY_FOUND, frequency_lock
        if loops.phase[i] == ASSISTED and phase_lock > PHASE_FOUND_ABOVE:
            loops.phase[i] = LOCKED
            loops.since_s[i] = t_s
            return PHASE_FOUND, phase_lock
    if for_s > settling_s + PATIENCE_S:
        never = math.isnan(loops.first_lost_s[i])
        _pull_in_again(i, t_s, loops)
        if never:
            return NEVER, for_s
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
    loops.divergence_mps[i] = 0.0
    if loops.kalman.t_s.size:
        loops.kalman.t_s[i] = math.nan
