"""What everybody may know of the signal of each channel, as arrays for the closures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from signals.code_start import Nominal
from signals.signal_row import Signal

HALF_S = 0.01
"""A pilot is integrated in halves of about this length [s]; a data symbol in its own halves"""
BEIDOU_LAG_S = 14.0
"""GPS time - BeiDou time (BDS-SIS-ICD-B1I 3.3: it began with UTC in 2006)"""


class Channels(NamedTuple):
    """Public facts of the channels: (n_channel,) each, but for ``correlation`` and ``overlay``."""

    carrier_hz: np.ndarray
    chip_rate_hz: np.ndarray
    symbol_chips: np.ndarray  # int64
    dump_chips: np.ndarray  # int64: half of a data symbol, or of as long a part of a pilot
    pilot: np.ndarray  # bool: no data, all symbols known
    per_chip: np.ndarray  # int64: R is straight between multiples of 1 / per_chip chips
    correlation: np.ndarray  # (n_channel, most per_chip + 1) the code's own R there, up to 1 chip
    overlay: np.ndarray  # (n_channel, longest) int8 of +-1: symbols of a pilot, periodic
    overlay_length: np.ndarray  # int64: period of the overlay, 1 for none
    overlay_start: np.ndarray  # int64: the chip of the overlay that symbol 0 has

    @property
    def nominal(self) -> Nominal:
        """For `signals.code_start`."""
        return Nominal(self.carrier_hz, self.chip_rate_hz, self.symbol_chips)

    @property
    def wavelength_m(self) -> np.ndarray:
        """Of the carrier."""
        return self.nominal.wavelength_m

    @property
    def half_s(self) -> np.ndarray:
        """Nominal length of an integration [s]."""
        return self.dump_chips / self.chip_rate_hz

    def pilot_symbols(self, i: int, number: np.ndarray) -> np.ndarray:
        """Symbols (n,) of +-1 of pilot i by their numbers (n,)."""
        return self.overlay[i, (self.overlay_start[i] + number) % self.overlay_length[i]]


def channels(signals: Sequence[Signal], prn: Sequence[int], start_tow_s: float) -> Channels:
    """Facts of the signals of channels (n_channel,) with their PRN, at GPS time of week [s]."""
    most = max(s.per_chip for s in signals)
    correlation = np.empty((len(signals), most + 1))
    overlays = []
    for i, (s, p) in enumerate(zip(signals, prn, strict=True)):
        own = s.autocorrelation(int(p))[: s.per_chip + 1]
        correlation[i] = np.append(own, np.full(most + 1 - own.size, own[-1]))
        known = s.secondary_chips(int(p))
        # a secondary code that the replica holds is no overlay
        overlays.append(known if known.size * s.length_chips > s.symbol_chips else known[:1] ** 2)
    length = np.array([x.size for x in overlays], dtype=np.int64)
    lag_s = np.array([BEIDOU_LAG_S if s.system == "C" else 0.0 for s in signals])
    symbol_hz = np.array([s.chip_rate_hz / s.symbol_chips for s in signals])
    return Channels(
        np.array([s.carrier_hz for s in signals]),
        np.array([s.chip_rate_hz for s in signals]),
        np.array([s.symbol_chips for s in signals], dtype=np.int64),
        np.array([_dump_chips(s) for s in signals], dtype=np.int64),
        np.array([s.pilot for s in signals]),
        np.array([s.per_chip for s in signals], dtype=np.int64),
        correlation,
        np.stack([np.resize(x, length.max()) for x in overlays]),
        length,
        np.floor((start_tow_s - lag_s) * symbol_hz).astype(np.int64) % length,
    )


def _dump_chips(s: Signal) -> int:
    """Half of a data symbol; of a pilot, the whole code periods in `HALF_S`, or all of that."""
    if not s.pilot:
        return s.symbol_chips // 2
    chips = round(HALF_S * s.chip_rate_hz)
    return chips // s.length_chips * s.length_chips or chips
