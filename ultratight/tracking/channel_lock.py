"""C/N0 and lock indicators of the channels of the scalar closure, renewed with every data bit.

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

import numpy as np

from signals.compiled import kernel
from ultratight.tracking.channel_state import (
    BIT_CODES,
    BIT_S,
    CN0_FLOOR_DBHZ,
    CODE_S,
    FREQUENCY_FOUND_ABOVE,
    LOCK_GAIN,
    M2M4,
    NWPR,
    POWER_GAIN,
    PULL_IN,
    Loops,
)

# ---- kernels ---------------------------------------------------------------------------------


@kernel
def watch(i: int, loops: Loops, estimator: int) -> None:
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
    a2 = amplitude2(i, loops)
    twice_noise = max(loops.wide[i] / BIT_CODES - a2, 1e-30)
    loops.cn0_dbhz[i] = 10.0 * math.log10(a2 / (twice_noise * CODE_S))
    power = narrow / BIT_CODES
    moments = loops.moments[i]
    moments[0] += POWER_GAIN * (power - moments[0])
    moments[1] += POWER_GAIN * (power**2 - moments[1])
    moments[2] += POWER_GAIN * (abs(loops.prompt[i].real) - moments[2])
    if estimator != NWPR:
        loops.cn0_dbhz[i] = _cn0_of_moments(moments, estimator)


@kernel
def _cn0_of_moments(moments: np.ndarray, estimator: int) -> float:
    """C/N0 [dB-Hz] by M2M4 or SNV of the bits' prompts, not below the floor."""
    signal = moments[2] ** 2
    if estimator == M2M4:
        signal = math.sqrt(max(2.0 * moments[0] ** 2 - moments[1], 0.0))
    noise = max(moments[0] - signal, 1e-30)
    return max(10.0 * math.log10(max(signal, 1e-30) / (noise * BIT_S)), CN0_FLOOR_DBHZ)


@kernel
def amplitude2(i: int, loops: Loops) -> float:
    """Squared amplitude of the prompt of one code period, not below the floor."""
    pairs = BIT_CODES * (BIT_CODES - 1)
    floor = 2.0 * 10.0 ** (CN0_FLOOR_DBHZ / 10.0) * CODE_S
    return max((loops.narrow[i] - loops.wide[i]) / pairs, floor)
