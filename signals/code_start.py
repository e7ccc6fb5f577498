"""Frequencies and symbols of the channels, and where their codes stand at the start of a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from signals.codes import GPS_L1CA
from signals.constants import C_MPS
from signals.signal_row import Signal


class Nominal(NamedTuple):
    """What the propagation of a channel needs to know of its signal: (n_channel,) each."""

    carrier_hz: np.ndarray
    chip_rate_hz: np.ndarray
    symbol_chips: np.ndarray  # int64

    @property
    def wavelength_m(self) -> np.ndarray:
        """Of the carrier [m]."""
        return C_MPS / self.carrier_hz


def nominal(signals: Sequence[Signal]) -> Nominal:
    """Facts of the signals of all channels as arrays."""
    return Nominal(
        np.array([s.carrier_hz for s in signals], dtype=np.float64),
        np.array([s.chip_rate_hz for s in signals], dtype=np.float64),
        np.array([s.symbol_chips for s in signals], dtype=np.int64),
    )


def code_phase_origin(start_tow_s: float, of: Signal | Nominal = GPS_L1CA) -> Any:
    """Code phase [chips] at the run's start, counted from the symbol under way in GPS time.

    A number for a signal, (n_channel,) for the nominal facts of channels.
    """
    # in symbols first: 0.02 s is not a binary number, 50 / s is
    symbols = start_tow_s * (of.chip_rate_hz / of.symbol_chips)
    return (symbols - np.floor(symbols)) * of.symbol_chips


def symbol_span(
    start_tow_s: float,
    t_s: np.ndarray,
    rho_max_m: float = 3.2e7,
    rho_min_m: float = 1.5e7,
    of: Nominal | None = None,
) -> tuple[int, int]:
    """First symbol and number of symbols that any channel can receive during ``t_s``.

    Pseudoranges lie in [rho_min_m, rho_max_m], receiver clock included.  ``of``: the channels'
    signals, L1 C/A where left out.
    """
    of = nominal([GPS_L1CA]) if of is None else of
    origin = code_phase_origin(start_tow_s, of)
    early = origin + of.chip_rate_hz * (float(t_s[0]) - rho_max_m / C_MPS)
    late = origin + of.chip_rate_hz * (float(t_s[-1]) - rho_min_m / C_MPS)
    first = math.floor((early / of.symbol_chips).min())
    return first, math.floor((late / of.symbol_chips).max()) - first + 1
