"""Samples and taps as they are defined, in float64: slow, and what kernels are held to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from signals.nco import Nco, Taps
from signals.propagation import SignalState
from signals.recording import IfSource


def taps_by_definition(
    source: IfSource,
    rows: Sequence[np.ndarray],
    offset_chips: np.ndarray,
    nco: Nco,
    taps: Taps,
    per_chip: int = 1,
) -> np.ndarray:
    """``iq`` (n_dump, n_tap) of the integrations that ``taps`` names, with exact index and phase.

    ``rows`` are the codes of the channels, one period in sub-chips, ``per_chip`` to the chip.
    Bounds are those of ``taps``; they must lie inside the pieces of ``nco``.  Equation:
    sum of sample x conjugate carrier x delayed code / (sigma sqrt(number of samples)), see
    `signals.nco.Taps`.
    """
    fs = source.sample_rate_hz
    first = np.rint(taps.t_start_s * fs).astype(np.int64)
    end = np.rint(taps.t_end_s * fs).astype(np.int64)
    iq = np.empty_like(taps.iq)
    for row, i in enumerate(taps.channel):
        n = np.arange(first[row], end[row])
        t = n / fs
        pairs = source.samples(int(first[row]), int(end[row])).astype(np.float64)
        piece = np.clip(np.searchsorted(nco.t_s, t + 1e-12, "right") - 1, 0, nco.t_s.size - 2)
        dt = t - nco.t_s[piece]
        bend = 0.5 * nco.carrier_rate_hz_per_s[piece, i] * dt**2
        turns = nco.carrier_phase_cycles[piece, i] + nco.carrier_freq_hz[piece, i] * dt + bend
        turns = turns - np.floor(turns) + np.mod(source.if_hz * t, 1.0)
        wiped = (pairs[:, 0] + 1j * pairs[:, 1]) * np.exp(-2j * np.pi * turns)
        code = nco.code_phase_chips[piece, i] + nco.chip_rate_hz[piece, i] * dt
        for k, offset in enumerate(offset_chips):
            index = np.floor((code - offset) * per_chip).astype(np.int64) % rows[i].size
            iq[row, k] = wiped @ rows[i][index] / (source.sigma * np.sqrt(n.size))
    return iq


def samples_by_definition(
    state: SignalState,
    rows: Sequence[np.ndarray],
    n: np.ndarray,
    sample_rate_hz: float,
    if_hz: float = 0.0,
    symbol_chips: int = 20_460,
) -> np.ndarray:
    """Satellites alone (n.size,) complex at samples ``n``, for noise of unit variance in I and Q.

    Equation (1) of `signals.front_end`; ``rows`` are the codes of the channels, one period each.
    """
    t = n / sample_rate_hz
    piece = np.clip(np.searchsorted(state.t_s, t + 1e-12, "right") - 1, 0, state.t_s.size - 2)
    powers = (t - state.t_s[piece])[:, None] ** np.arange(4)
    total = np.zeros(n.size, np.complex128)
    for i, row in enumerate(rows):
        code = (state.code_phase_chips[i, piece] * powers).sum(axis=1)
        turns = (state.carrier_phase_cycles[i, piece] * powers).sum(axis=1)
        turns = turns - np.floor(turns) + np.mod(if_hz * t, 1.0)
        size = np.sqrt(2.0 * 10.0 ** (0.1 * state.cn0_dbhz[i, piece]) / sample_rate_hz)
        symbol = np.floor(code / symbol_chips).astype(np.int64) - state.first_symbol
        chip = np.floor(code).astype(np.int64) % row.size
        total += size * state.symbols[i, symbol] * row[chip] * np.exp(2j * np.pi * turns)
    return total


def relative_error(got: np.ndarray, wanted: np.ndarray) -> float:
    """|got - wanted| / |wanted| over all numbers."""
    return float(np.linalg.norm(got - wanted) / np.linalg.norm(wanted))
