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
_WINDOW_S, _FEWEST_WINDOWS, _WINDOWS = 0.05, 5, 40
_PADDING = 4
"""The spectrum of squared prompts is read at this multiple of their number"""


class Fine(NamedTuple):
    """What is known of satellites at the first sample; rows are satellites."""

    code_phase_chips: np.ndarray  # (n,)
    doppler_hz: np.ndarray  # (n,)
    cn0_dbhz: np.ndarray  # (n,)


class CodeSense(NamedTuple):
    """What codes say of carriers."""

    sense: float
    """Of their Dopplers: 1 as they should be, -1 where Q is negated"""
    sense_sigma: float
    offset_hz: float
    """By how much all carriers stand higher than the codes say, with Dopplers of the right sense"""
    offset_sigma_hz: float


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
) -> CodeSense:
    """How fast codes run, beside their carriers.

    Code phases in one short window after the other, from ``first_sample`` (their origin) on,
    against those that the Dopplers predict.  Where carriers stand at f = s d + b and codes run as
    for d, they leave that by g (f (s - 1) - s b) chips a second, g the chip rate over the carrier:
    s and b by weighted least squares, then b alone with s = 1.  Without enough samples, satellites
    or Doppler sigmas are large, or infinite.
    """
    unknown = CodeSense(1.0, np.inf, 0.0, np.inf)
    per_hz = signal.chip_rate_hz / signal.carrier_hz
    rate = signal.chip_rate_hz + per_hz * at.doppler_hz
    fastest = per_hz * float(np.abs(at.doppler_hz).max(initial=0.0))
    whole = (end_sample - first_sample) / source.sample_rate_hz
    seconds = min(_WINDOW_S, whole / _FEWEST_WINDOWS, _PULL_IN_CHIPS / (2.0 * fastest + 1e-9))
    n = max(int(seconds * source.sample_rate_hz), 1)
    windows = min((end_sample - first_sample) // n, _WINDOWS)
    if windows < _FEWEST_WINDOWS or seconds < 10.0 * signal.length_chips / signal.chip_rate_hz:
        return unknown
    half, away = signal.length_chips / 2.0, np.zeros((windows, len(prns)))
    guess = np.zeros(len(prns))
    for k in range(windows):
        code = at.code_phase_chips + rate * (k * n / source.sample_rate_hz) + guess
        start = at._replace(code_phase_chips=code % signal.length_chips)
        first = first_sample + k * n
        now = refine(source, signal, prns, start, first, first + n)
        more = now.code_phase_chips - start.code_phase_chips
        away[k] = guess + (more + half) % signal.length_chips - half
        guess = away[k] + (away[k] - away[k - 1] if k else 0.0)
    times = np.arange(windows) * n / source.sample_rate_hz
    times -= times.mean()
    drift = times @ away / (times @ times)
    # of an early-late estimate (Kaplan & Hegarty, 3rd ed., 8.5.1), in chips^2
    power, period_s = 10.0 ** (at.cn0_dbhz / 10.0), signal.length_chips / signal.chip_rate_hz
    variance = (1.0 + 2.0 / (power * period_s)) / (power * n / source.sample_rate_hz)
    weight = per_hz**2 * (times @ times) / variance
    return _line_through(at.doppler_hz, drift / per_hz, weight)


def _line_through(doppler_hz: np.ndarray, drift_hz: np.ndarray, weight: np.ndarray) -> CodeSense:
    """s and b of `code_sense` from the codes' drift as Doppler (n,)."""
    total = float(weight.sum())
    offset = -float(weight @ drift_hz) / total
    apart = doppler_hz - float(weight @ doppler_hz) / total
    spread = float(weight @ apart**2)
    if not spread > 0.0:
        return CodeSense(1.0, np.inf, offset, total**-0.5)
    slope = float(weight @ (apart * drift_hz)) / spread
    return CodeSense(1.0 + slope, spread**-0.5, offset, total**-0.5)


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
