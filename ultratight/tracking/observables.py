"""Pseudorange, carrier phase and Doppler of all channels at common receive times.

With week_bit from the message (`telemetry`), code phase x [chips] of the replica at receiver time
t and the receiver's clock reading start + t,

    time of transmission  0.02 week_bit + x / 1.023 MHz      pseudorange  c (start + t - that)

(Kaplan & Hegarty, 3rd ed., 8.8).  Before a position is known ``start`` is a guess: the nearest
satellite is 67 ms away.  A channel is observed while it is in phase lock and its handover word has
come since it was.  Carrier phases have no half cycle left open, as the words' polarity is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from signals.constants import C_MPS, CA_CHIP_RATE_HZ, WEEK_S
from signals.lnav_words import BIT_S
from ultratight.tracking.bit_synchronisation import bit_edge
from ultratight.tracking.channel_loops import BIT_CODES, CODE_S
from ultratight.tracking.from_samples import Tracks
from ultratight.tracking.scalar import CODE_CHIPS
from ultratight.tracking.telemetry import Telemetry, read

BIT_CHIPS = BIT_CODES * CODE_CHIPS
NEAREST_S = 0.067
"""Travel of the signal from the zenith"""
HEAD_BITS = 60
CN0_OVER_S = 1.0
DOPPLER_OVER_S = 0.1
"""Change of the carrier phase, half of it before the epoch, half after"""
_WEEK_BITS = round(WEEK_S / BIT_S)
_EDGE_PROMPTS = 10_000


class Observations(NamedTuple):
    """Epochs (n,), channels (m,); NaN where there is no observation."""

    prn: np.ndarray  # (m,)
    t_s: np.ndarray  # (n,) from sample 0 on
    tow_ms: np.ndarray  # (n,) int64: what the receiver's clock reads, ms of week, on past its end
    sent_s: np.ndarray  # (n, m) time of transmission by the satellite's clock [s of week]
    pseudorange_m: np.ndarray  # (n, m)
    carrier_cycles: np.ndarray  # (n, m) grows with positive Doppler; RINEX has the other sign
    doppler_hz: np.ndarray  # (n, m)
    cn0_dbhz: np.ndarray  # (n, m) of the second before
    restarted: np.ndarray  # (n, m) bool: carrier phase does not go on from the epoch before

    @property
    def tow_s(self) -> np.ndarray:
        """(n,) what the receiver's clock reads."""
        return self.tow_ms * 1e-3


def sure_edges(tracks: Tracks) -> Tracks:
    """Tracks whose bits begin where the prompts in phase lock say, all of up to 10 s.

    Acquisition's second of prompts leaves a small probability of another place, which would be
    300 km in range.
    """
    period, code_phase = tracks.period.copy(), tracks.code_phase_chips.copy()
    probability = tracks.edge_probability.copy()
    for i in range(len(tracks.prn)):
        rows = np.flatnonzero(tracks.channel == i)
        spans = locked_spans(tracks, i)
        if not spans:
            continue
        begin, end = spans[0]
        mine = rows[(tracks.t_s[rows] > begin) & (tracks.t_s[rows] < end)][:_EDGE_PROMPTS]
        if len(mine) < 2 * BIT_CODES:
            continue
        edge = bit_edge(tracks.iq[mine, 1], CODE_S, BIT_CODES)
        shift = (int(period[mine[0]]) + edge.first) % BIT_CODES
        if edge.probability < probability[i]:
            continue
        shift -= BIT_CODES if shift > BIT_CODES // 2 else 0
        period[rows] -= shift
        code_phase[rows] -= shift * CODE_CHIPS
        probability[i] = edge.probability
    return tracks._replace(period=period, code_phase_chips=code_phase, edge_probability=probability)


def locked_spans(tracks: Tracks, i: int) -> list[tuple[float, float]]:
    """From when to when channel i was in phase lock."""
    spans: list[tuple[float, float]] = []
    since = math.nan
    for t_s, channel, kind, _ in tracks.events:
        if channel != i:
            continue
        if kind == "phase lock":
            since = t_s
        elif kind == "loss of lock" and not math.isnan(since):
            spans.append((since, t_s))
            since = math.nan
    return spans if math.isnan(since) else [*spans, (since, math.inf)]


def telemetry(tracks: Tracks) -> list[Telemetry]:
    """What the bits of each channel hold."""
    return [read(*tracks.bits(i)) for i in range(len(tracks.prn))]


def missing_s(tracks: Tracks, told: Sequence[Telemetry]) -> dict[int, list[float]]:
    """PRN: when words became wrong though strong, as where samples are missing [s]."""
    found = {}
    for i, one in enumerate(told):
        rows = tracks.channel == i
        bits = tracks.code_phase_chips[rows] / BIT_CHIPS
        until = np.array(sorted({m.until for c in one.clocks for m in c.marks}))
        if len(until := until[until <= bits.max(initial=0.0)]):
            found[int(tracks.prn[i])] = np.interp(until, bits, tracks.t_s[rows]).tolist()
    return found


def start_guess_ms(tracks: Tracks, told: Sequence[Telemetry]) -> int | None:
    """What the receiver's clock may have read at sample 0 [ms of week]; None: no time is known."""
    starts = []
    for i, one in enumerate(told):
        if one.clocks:
            rows = np.flatnonzero(tracks.channel == i)
            chips, t_s = tracks.code_phase_chips[rows[-1]], tracks.t_s[rows[-1]]
            bits = _near(one.clocks[-1].week_bit, told)
            starts.append(bits * BIT_S + chips / CA_CHIP_RATE_HZ + NEAREST_S - t_s)
    return round(max(starts) * 1e3) if starts else None


def observe(
    tracks: Tracks, told: Sequence[Telemetry], start_ms: int, interval_ms: int
) -> Observations:
    """Observations whenever the receiver's clock, start_ms at sample 0, reads a multiple.

    Raises
    ------
    ValueError
        An interval below 1 ms.
    """
    if interval_ms < 1:
        raise ValueError(f"interval_ms is {interval_ms}: expected at least 1")
    m = len(tracks.prn)
    last = float(tracks.t_s.max(initial=0.0)) - 0.5 * DOPPLER_OVER_S
    first_ms = -(-start_ms // interval_ms) * interval_ms
    tow_ms = np.arange(first_ms, start_ms + max(0, math.floor(last * 1e3)) + 1, interval_ms)
    t_s = (tow_ms - start_ms) * 1e-3
    columns = [_channel(tracks, i, told, t_s, start_ms) for i in range(m)]
    table = [np.stack(c, axis=1) for c in zip(*columns, strict=True)]
    if not m:
        table = [np.empty((len(t_s), 0))] * 5 + [np.empty((len(t_s), 0), bool)]
    seen = np.isfinite(table[1]).any(axis=1)
    begin = int(seen.argmax()) if seen.any() else len(t_s)
    return Observations(tracks.prn, t_s[begin:], tow_ms[begin:], *(x[begin:] for x in table))


def _channel(
    tracks: Tracks, i: int, told: Sequence[Telemetry], t_s: np.ndarray, start_ms: int
) -> tuple[np.ndarray, ...]:
    """sent, pseudorange, carrier, Doppler, C/N0, restarted of a channel at t_s (n,)."""
    rows = tracks.channel == i
    t, chips, cycles = tracks.t_s[rows], tracks.code_phase_chips[rows], tracks.carrier_cycles[rows]
    bit, half, span = _known(tracks, i, told, t_s, np.interp(t_s, t, chips) / BIT_CHIPS)
    known = span >= 0
    x = np.interp(t_s, t, chips)
    # differences of whole milliseconds: times of week would leave 2 cm of rounding
    whole_s = (start_ms - round(BIT_S * 1e3) * bit) * 1e-3
    rho = C_MPS * (whole_s + (t_s - x / CA_CHIP_RATE_HZ))
    side = 0.5 * DOPPLER_OVER_S
    doppler = (np.interp(t_s + side, t, cycles) - np.interp(t_s - side, t, cycles)) / (2.0 * side)
    out = [
        bit * BIT_S + x / CA_CHIP_RATE_HZ, rho, np.interp(t_s, t, cycles) + 0.5 * half, doppler,
        _cn0_dbhz(tracks, rows, t_s),
    ]  # fmt: skip
    before = np.concatenate([[-1], span[:-1]])
    return (*(np.where(known, v, np.nan) for v in out), known & (span != before))


def _known(
    tracks: Tracks, i: int, told: Sequence[Telemetry], t_s: np.ndarray, bit_now: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """week_bit, whether the phase is half a cycle off, and number of the lock, -1: unknown."""
    week_bit, half = np.zeros(len(t_s), np.int64), np.zeros(len(t_s), bool)
    span = np.full(len(t_s), -1)
    rows = tracks.channel == i
    t, bits = tracks.t_s[rows], tracks.code_phase_chips[rows] / BIT_CHIPS
    for number, (begin, end) in enumerate(locked_spans(tracks, i)):
        low = np.interp(begin, t, bits)
        for clock in told[i].clocks:
            marks = [m for m in clock.marks if low <= m.bit and m.bit <= np.interp(end, t, bits)]
            for mark in marks:
                now = (t_s < end) & (bit_now >= max(mark.bit + HEAD_BITS, clock.known_bit))
                now &= bit_now < mark.until
                week_bit[now], half[now] = _near(clock.week_bit, told), mark.inverted
                span[now] = number
    return week_bit, half, span


def _near(week_bit: int, told: Sequence[Telemetry]) -> int:
    """A bit of the week in the same week as that of the first channel with a time."""
    anchor = next(t.clocks[0].week_bit for t in told if t.clocks)
    return week_bit - _WEEK_BITS * round((week_bit - anchor) / _WEEK_BITS)


def _cn0_dbhz(tracks: Tracks, rows: np.ndarray, t_s: np.ndarray) -> np.ndarray:
    """Narrow-wide power ratio over the whole bits of the second before (`channel_loops`)."""
    bit, prompt, t = tracks.period[rows] // BIT_CODES, tracks.iq[rows, 1], tracks.t_s[rows]
    _, first, where, count = np.unique(
        bit, return_index=True, return_inverse=True, return_counts=True
    )
    narrow = np.bincount(where, prompt.real) ** 2 + np.bincount(where, prompt.imag) ** 2
    wide = np.bincount(where, np.abs(prompt) ** 2)
    whole = count == BIT_CODES
    ends = t[first[whole] + BIT_CODES - 1]
    sums = np.zeros((2, len(ends) + 1))
    np.cumsum([narrow[whole], wide[whole]], axis=1, out=sums[:, 1:])
    to = np.searchsorted(ends, t_s, side="right")
    since = np.maximum(to - round(CN0_OVER_S / BIT_S), 0)
    n = np.maximum(to - since, 1)
    narrow, wide = (sums[:, to] - sums[:, since]) / n
    a2 = np.maximum((narrow - wide) / (BIT_CODES * (BIT_CODES - 1)), 1e-3)
    twice_noise = np.maximum(wide / BIT_CODES - a2, 1e-3)
    cn0: np.ndarray = 10.0 * np.log10(a2 / (twice_noise * CODE_S))
    return cn0
