"""Code phase, Doppler and C/N0 of satellites that a search has found, from taps of one period.

All come from integrations over single code periods, whose bounds are also those of data bits and
secondary chips, so that no sign is needed:

* Doppler from the squared prompts, which have no signs left: the peak of their spectrum is twice
  the residual (Kaplan & Hegarty, 3rd ed., 8.5.4; unambiguous within +-1 / (4 T) of the search's).
* Code phase from late minus early r.m.s. amplitudes over their slope, repeated about the result
  until it stands: whatever is symmetric about the peak, as a front-end filter's rounding of it
  nearly is, moves nothing.
* C/N0 from the prompt's mean power over that of taps far from the peak.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from signals.correlator import SampleCorrelator
from signals.nco import Nco, Taps
from signals.recording import IfSource
from signals.replica import replicas
from signals.signal_row import Signal

_TURNS = 3
"""Of the code phase: from 1/4 of a chip each leaves less than a third of the error"""
_FLOOR_TAPS = 16
_PULL_IN_CHIPS = 0.4
_PADDING = 4
"""The spectrum of squared prompts is read at this multiple of their number"""


class Fine(NamedTuple):
    """What is known of satellites at the first sample; rows are satellites."""

    code_phase_chips: np.ndarray  # (n,)
    doppler_hz: np.ndarray  # (n,)
    cn0_dbhz: np.ndarray  # (n,)


def refine(
    source: IfSource,
    signal: Signal,
    prns: Sequence[int],
    start: Fine,
    first_sample: int,
    end_sample: int,
) -> Fine:
    """Better estimates from the whole code periods in ``first_sample`` <= n < ``end_sample``.

    ``start`` must be within half a chip and 1 / (4 T); it is given back for a satellite without a
    whole period there, and its C/N0 where the prompt is no stronger than the floor.
    """
    spacing = 0.5 if signal.per_chip == 1 else 0.25
    near = np.array([-spacing, 0.0, spacing])
    far = np.round((np.arange(_FLOOR_TAPS) + 1.5) * signal.length_chips / (_FLOOR_TAPS + 2))
    span = first_sample, end_sample
    prompts = _by_satellite(period_taps(source, signal, prns, start, near[1:2], span), len(prns))
    if not all(len(z) for z in prompts):
        return start
    period_s = signal.length_chips / signal.chip_rate_hz
    doppler = start.doppler_hz + [residual_hz(z[:, 0], period_s) for z in prompts]
    now = start._replace(doppler_hz=doppler)
    slope = signal.modulation.early_late_slope(spacing)
    for turn in range(_TURNS):
        last = turn == _TURNS - 1
        offsets = np.concatenate([near, far]) if last else near
        taps = period_taps(source, signal, prns, now, offsets, span)
        each = _by_satellite(taps, len(prns))
        power = np.array([np.mean(np.abs(z) ** 2, axis=0) for z in each])
        # unit noise in each of I and Q
        early, prompt, late = np.sqrt(np.maximum(power[:, :3] - 2.0, 1e-3)).T
        delay = np.clip((late - early) / (2.0 * slope * prompt), -spacing, spacing)
        now = now._replace(code_phase_chips=now.code_phase_chips - delay)
    ratio = power[:, 1] / np.median(power[:, 3:], axis=1) - 1.0
    cn0 = 10.0 * np.log10(np.maximum(ratio, 1e-9) / period_s)
    return now._replace(
        code_phase_chips=now.code_phase_chips % signal.length_chips,
        cn0_dbhz=np.where(ratio > 0.0, cn0, start.cn0_dbhz),
    )


def code_sense(
    source: IfSource,
    signal: Signal,
    prns: Sequence[int],
    at: Fine,
    first_sample: int,
    end_sample: int,
) -> tuple[float, float]:
    """How fast codes run with their carriers, and its standard deviation: 1, or -1 if inverted.

    Code phases some time after ``first_sample`` (their origin, estimated up to there) against those
    that the Dopplers predict: 2 f_D / f_carrier of the chip rate lies between the two.  Without
    enough samples or Doppler the standard deviation is large, or infinite.
    """
    period_s = signal.length_chips / signal.chip_rate_hz
    seconds = (end_sample - first_sample) / source.sample_rate_hz
    gain = signal.chip_rate_hz / signal.carrier_hz * at.doppler_hz
    fastest = float(np.abs(gain).max(initial=0.0))
    # so long that the codes are not lost, and half of the samples are left
    later = min(0.5 * seconds, _PULL_IN_CHIPS / (2.0 * fastest)) if fastest else 0.0
    n = first_sample + round(later * source.sample_rate_hz)
    if later < 10.0 * period_s:
        return 1.0, np.inf
    moved = signal.chip_rate_hz * later + gain * later
    start = at._replace(code_phase_chips=(at.code_phase_chips + moved) % signal.length_chips)
    now = refine(source, signal, prns, start, n, end_sample)
    half = signal.length_chips / 2.0
    away = (now.code_phase_chips - start.code_phase_chips + half) % signal.length_chips - half
    # of a difference of two early-late estimates (Kaplan & Hegarty, 3rd ed., 8.5.1), in chips^2
    power = 10.0 ** (at.cn0_dbhz / 10.0)
    variance = (1.0 + 2.0 / (power * period_s)) / (power * min(later, seconds - later))
    lever = gain * later
    weight = float(np.sum(lever**2 / variance))
    return 1.0 + float(np.sum(lever * away / variance)) / weight, weight**-0.5


def period_taps(
    source: IfSource,
    signal: Signal,
    prns: Sequence[int],
    at: Fine,
    offset_chips: np.ndarray,
    span: tuple[int, int],
) -> Taps:
    """Taps of the single code periods within samples ``span``, replicas at constant Doppler."""
    n = len(prns)
    rows = [signal.modulation.modulate(signal.chips(prn)) for prn in prns]
    nco = Nco(
        np.array(span) / source.sample_rate_hz,
        at.code_phase_chips[None],
        signal.chip_rate_hz * (1.0 + at.doppler_hz[None] / signal.carrier_hz),
        np.zeros((1, n)),
        at.doppler_hz[None],
        np.zeros((1, n)),
        np.full(n, signal.length_chips, np.int64),
        np.ones(n, bool),
    )
    return SampleCorrelator(source, replicas(rows, signal.per_chip), offset_chips)(nco)


def _by_satellite(taps: Taps, n: int) -> list[np.ndarray]:
    """Taps (n_dump, n_tap) of each of n satellites."""
    return [taps.iq[taps.channel == i] for i in range(n)]


def residual_hz(prompts: np.ndarray, period_s: float) -> float:
    """Frequency left in the prompts (n,) of one code period each, within +-1 / (4 T)."""
    n = _PADDING * len(prompts)
    size = np.abs(np.fft.fft(prompts**2, n))
    k = int(size.argmax())
    before, peak, after = size[k - 1], size[k], size[(k + 1) % n]
    bend = 2.0 * peak - before - after
    k_fine = k + (0.5 * (after - before) / bend if bend > 0.0 else 0.0)
    turns = (k_fine / n + 0.5) % 1.0 - 0.5
    return float(turns / (2.0 * period_s))
