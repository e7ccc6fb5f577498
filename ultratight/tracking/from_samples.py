"""Scalar tracking of a recording, from an acquisition on: nothing else is known.

Bit edges come from the prompts of the first second at the Doppler that was acquired
(`bit_synchronisation`); then the loops of the scalar closure run from the first sample on
(`channel_loops`: FLL-assisted PLL, then PLL, carrier-aided DLL).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from signals.codes import GPS_L1CA
from signals.correlator import SampleCorrelator
from signals.nco import Nco
from signals.recording import IfSource
from ultratight.tracking.acquisition import Acquisition
from ultratight.tracking.bit_synchronisation import bit_edge
from ultratight.tracking.channel_loops import (
    ASSISTED,
    BIT_CODES,
    CODE_S,
    EVENTS,
    LOCKED,
    advance,
    close_loops,
    new_loops,
)
from ultratight.tracking.fine_acquisition import Fine, period_taps
from ultratight.tracking.scalar import CODE_CHIPS, EPOCH_S, ScalarSettings, design

SETTINGS = ScalarSettings(integration_s=0.005)
SPACING_CHIPS = 0.5
SURE = 0.99
"""Least probability of a bit edge with which a satellite is tracked"""
_EDGES_FROM_S = 1.0


class Tracks(NamedTuple):
    """All channels from the first sample on; a row per code period, by channel, then by time."""

    prn: np.ndarray  # (n,)
    edge_probability: np.ndarray  # (n,)
    channel: np.ndarray  # (n_row,) index into the channels
    period: np.ndarray  # (n_row,) number of the code period; a multiple of 20 begins a data bit
    t_s: np.ndarray  # (n_row,) of its end, from sample 0 on
    iq: np.ndarray  # (n_row, 3) early, prompt, late; unit noise in each component
    doppler_hz: np.ndarray  # (n_row,) of the replica
    code_phase_chips: np.ndarray  # (n_row,) of the replica at its end; 20 460 chips to a bit
    carrier_cycles: np.ndarray  # (n_row,) of the replica at its end, above the IF
    locked: np.ndarray  # (n,) bool: phase lock, at the end
    phase_lock: np.ndarray  # (n,) indicator there, cos of twice the phase error
    cn0_dbhz: np.ndarray  # (n,) there, low pass of 1 s
    events: list[tuple[float, int, str, str]]  # (t_s, channel, kind, reason)

    def bits(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Sums of the prompts of whole data bits of channel i, and the bits' numbers."""
        rows = self.channel == i
        bit, prompt = self.period[rows] // BIT_CODES, self.iq[rows, 1]
        numbers, where, count = np.unique(bit, return_inverse=True, return_counts=True)
        sums = np.bincount(where, prompt.real) + 1j * np.bincount(where, prompt.imag)
        whole = count == BIT_CODES
        return sums[whole], numbers[whole]


def track(
    source: IfSource,
    acquired: Sequence[Acquisition],
    end_sample: int,
    settings: ScalarSettings = SETTINGS,
) -> Tracks:
    """Track satellites of GPS L1 C/A up to ``end_sample``, those whose bit edges are sure.

    Raises
    ------
    ValueError
        Less than two data bits, settings that mean nothing.
    """
    prn, first = [a.prn for a in acquired], acquired[0].sample_index if acquired else 0
    at = Fine(*(np.array([getattr(a, name) for a in acquired]) for name in Fine._fields))
    ahead, probability = _bit_edges(source, prn, at, first, end_sample)
    sure = np.flatnonzero(probability >= SURE)
    at = Fine(*(values[sure] for values in at))
    tracked = np.array(prn, np.int64)[sure]
    loops, gains = new_loops(at.cn0_dbhz), design(settings, tracked, SPACING_CHIPS)
    t0_s = first / source.sample_rate_hz
    loops.code_chips[:] = at.code_phase_chips + ahead[sure] * CODE_CHIPS
    for hz in (loops.loop_hz, loops.carrier_memory[:, 1], loops.last_good_hz):
        hz[:] = at.doppler_hz
    loops.phase[:] = ASSISTED  # a fine Doppler is a frequency found
    loops.since_s[:] = t0_s
    chips = np.array([GPS_L1CA.chips(int(p)) for p in tracked], np.int8).reshape(-1, CODE_CHIPS)
    correlator = SampleCorrelator(source, chips, np.array([-1.0, 0.0, 1.0]) * SPACING_CHIPS)
    dump, valid = np.full(len(sure), CODE_CHIPS, np.int64), np.ones(len(sure), np.bool_)
    times = t0_s + EPOCH_S * np.arange(_n_epoch(source, first, end_sample) + 1)
    rows: list[tuple[np.ndarray, ...]] = []
    events = []
    for k in range(len(times) - 1 if len(sure) else 0):
        out = np.empty((5, 1, len(sure)))
        advance(times[k], times[k + 1], loops, out)
        command = Nco(times[k : k + 2], out[0], out[1], out[2], out[3], out[4], dump, valid)
        taps = correlator(command)
        told = taps.channel, taps.number, taps.t_end_s, taps.iq
        at_end = taps.code_end_chips, taps.carrier_end_cycles
        rows.append((*told, out[3, 0, taps.channel], *at_end))
        for t_s, i, code, value in close_loops(*told, taps.noise_var, loops, gains):
            kind, reason = EVENTS[int(code)]
            events.append((float(t_s), int(i), kind, reason.format(value)))
    channel, period, t_end_s, iq, doppler_hz, code_phase, carrier = _by_channel(rows)
    return Tracks(
        tracked, probability[sure], channel, period, t_end_s, iq, doppler_hz, code_phase, carrier,
        loops.phase == LOCKED, loops.phase_lock, loops.cn0_dbhz, events,
    )  # fmt: skip


def _n_epoch(source: IfSource, first: int, end: int) -> int:
    return int((end - first) / source.sample_rate_hz / EPOCH_S + 1e-9)


def _bit_edges(
    source: IfSource, prn: Sequence[int], at: Fine, first: int, end: int
) -> tuple[np.ndarray, np.ndarray]:
    """Code periods of the bit under way that have ended at the first sample; their probability."""
    end = min(end, first + round(_EDGES_FROM_S * source.sample_rate_hz))
    ahead, probability = np.zeros(len(prn), np.int64), np.zeros(len(prn))
    if not len(prn):
        return ahead, probability
    taps = period_taps(source, GPS_L1CA, prn, at, np.zeros(1), (first, end))
    for i in range(len(prn)):
        rows = taps.channel == i
        edge = bit_edge(taps.iq[rows, 0], CODE_S, BIT_CODES)
        # the period that begins the bit must be a multiple of 20
        ahead[i] = -(int(taps.number[rows][0]) + edge.first) % BIT_CODES
        probability[i] = edge.probability
    return ahead, probability


def _by_channel(rows: list[tuple[np.ndarray, ...]]) -> list[np.ndarray]:
    """The columns of all epochs, sorted by channel."""
    if not rows:
        empty = np.empty(0)
        whole = np.empty(0, np.int64)
        return [whole, whole, empty, np.empty((0, 3), complex), empty, empty, empty]
    columns = [np.concatenate(column) for column in zip(*rows, strict=True)]
    order = np.argsort(columns[0], kind="stable")
    return [column[order] for column in columns]
