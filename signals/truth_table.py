"""What a correlator in closed form needs of the truth: checked, and laid out piece by piece."""

from __future__ import annotations

import math

import numpy as np

from signals.compiled import borrowing
from signals.constants import CA_CHIP_RATE_HZ
from signals.error_integral import TRUTH_COLUMNS, fill_truth
from signals.propagation import SignalState

FAR = 2e15
"""Phases beyond would not fit the integers of sums"""
SELF_SEPARATION_DB_PER_HZ = 10.0 * math.log10(2.0 / (3.0 * CA_CHIP_RATE_HZ))
"""Spectral separation of BPSK(1) from itself, 2 / (3 Rc): -61.86 dB/Hz (Kaplan & Hegarty, ch. 9)"""


def check_symbols(state: SignalState, symbol_chips: np.ndarray) -> None:
    """Refuse absurd phases, and symbols that do not cover the code phase of every valid piece."""
    if not state.valid.any():
        return
    sound, first, last = _span_of_symbols(
        state.t_s, np.ascontiguousarray(state.code_phase_chips),
        np.ascontiguousarray(state.carrier_phase_cycles), np.ascontiguousarray(state.valid),
        symbol_chips,
    )  # fmt: skip
    for name in () if sound else ("code_phase_chips", "carrier_phase_cycles"):
        values = getattr(state, name)[state.valid]
        if not np.all(np.abs(values) <= FAR):
            far = values[~(np.abs(values) <= FAR)][0]
            raise ValueError(f"state.{name} contains {far}: expected at most {FAR:g} in size")
    last_given = state.first_symbol + state.symbols.shape[1] - 1
    if first < state.first_symbol or last > last_given:
        raise ValueError(
            f"symbols {state.first_symbol} to {last_given} do not cover the truth: expected "
            f"{first} to {last}"
        )


def truth_table(state: SignalState, multiple_access: bool, kept: np.ndarray) -> np.ndarray:
    """The truth as rows of `error_integral`: (n_piece, n_channel, TRUTH_COLUMNS)."""
    cn0_hz = np.where(state.valid, 10.0 ** (np.asarray(state.cn0_dbhz) / 10.0), 0.0)
    spread = np.ones_like(cn0_hz)
    if multiple_access:
        others = cn0_hz.sum(axis=0) - cn0_hz
        spread = np.sqrt(1.0 + others * 10.0 ** (SELF_SEPARATION_DB_PER_HZ / 10.0))
    n_channel, n_piece = state.valid.shape
    table = np.empty((n_piece, n_channel, TRUTH_COLUMNS))
    fill_truth(
        np.ascontiguousarray(state.t_s), np.ascontiguousarray(state.code_phase_chips),
        np.ascontiguousarray(state.carrier_phase_cycles), np.sqrt(cn0_hz * kept[:, None]), spread,
        table,
    )  # fmt: skip
    return table


# ---- kernels ---------------------------------------------------------------------------------


@borrowing
def _span_of_symbols(
    t_s: np.ndarray, code: np.ndarray, carrier: np.ndarray, valid: np.ndarray,
    symbol_chips: np.ndarray,
) -> tuple[bool, int, int]:  # fmt: skip
    """Are all numbers of the valid pieces within `FAR`?  First and last symbol under them."""
    low, high, sound = math.inf, -math.inf, True
    for i in range(code.shape[0]):
        length = float(symbol_chips[i])
        for p in range(code.shape[1]):
            if valid[i, p]:
                h, c = t_s[p + 1] - t_s[p], code[i, p]
                for k in range(4):
                    sound = sound and abs(c[k]) <= FAR and abs(carrier[i, p, k]) <= FAR
                low = min(low, c[0] / length)
                high = max(high, (c[0] + h * (c[1] + h * (c[2] + h * c[3]))) / length)
    if not sound:
        return False, 0, 0
    return True, math.floor(low), math.floor(high)
