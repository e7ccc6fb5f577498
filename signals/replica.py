"""A replica inside a cell of samples: its tables, and phases exact to 1e-7 cycles or chips.

Generator and correlator both re-base their phases in float64 at the start of each cell and run
on integers inside it: every sample's phase is one multiplication away, in any vector lane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from signals.compiled import kernel
from signals.elementary import TURN

LONGEST_CELL = 2048
"""Most samples that may be looked up from one start, at no more than one chip per sample"""

_WINDOW = 64  # entries that a vector may load beyond the last one it uses


class Replicas(NamedTuple):
    """Spreading waveforms of all channels, constant over a sub-chip; made by `replicas`.

    Entry k mod length of channel i stands at ``table[first[i] + k]`` for every
    0 <= k < length + per_chip (LONGEST_CELL + 1): a cell that starts inside the period never
    wraps.
    """

    table: np.ndarray  # (n_total,) float32
    first: np.ndarray  # (n_channel,) int64: its first entry
    length: np.ndarray  # (n_channel,) int64: period in sub-chips
    per_chip: np.ndarray  # (n_channel,) int64: sub-chips per chip; BPSK 1, BOC(1,1) 2, BOC(6,1) 12


def replicas(rows: Sequence[np.ndarray], per_chip: Sequence[int] | int = 1) -> Replicas:
    """Tables of one period per channel; ``rows[i]`` is (length_i,), any real numbers.

    ``per_chip`` is the number of entries per chip, of all channels or of each.

    Raises
    ------
    ValueError : a row that is not one finite period of whole chips.
    """
    each = [per_chip] * len(rows) if isinstance(per_chip, int) else [int(n) for n in per_chip]
    if len(each) != len(rows):
        raise ValueError(f"per_chip has {len(each)} numbers: expected one for each of {len(rows)}")
    parts = []
    for i, (row, n) in enumerate(zip(rows, each, strict=True)):
        if n < 1:
            raise ValueError(f"per_chip is {n}: expected >= 1")
        if np.ndim(row) != 1 or not np.size(row) or np.size(row) % n or not np.isfinite(row).all():
            raise ValueError(
                f"row {i} is {np.shape(row)}: expected a finite (length,), a multiple of {n}"
            )
        period = np.asarray(row, np.float32)
        parts.append(np.resize(period, period.size + n * (LONGEST_CELL + 1) + _WINDOW))
    sizes = np.array([part.size for part in parts], np.int64)
    return Replicas(
        np.concatenate([*parts, np.empty(0, np.float32)]),
        np.cumsum(sizes) - sizes,
        np.array([np.size(row) for row in rows], np.int64),
        np.array(each, np.int64),
    )


def index_delays(waveforms: Replicas, offset_chips: np.ndarray) -> np.ndarray:
    """Delays (n_channel, n_tap) modulo the period, int64 [2^-32 sub-chips]; `behind`."""
    sub_chips = np.outer(waveforms.per_chip, offset_chips)
    return np.rint((sub_chips % waveforms.length[:, None]) * TURN).astype(np.int64)


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def index_step(chips_per_sample: float, per_chip: int) -> Any:
    """Step per sample of a table index, int64 [2^-32 sub-chips]."""
    return np.int64(np.rint(chips_per_sample * per_chip * TURN))


@kernel
def index_phase(chips: float, per_chip: int, length: int) -> Any:
    """Code phase modulo the ``length`` sub-chips of the period, int64 [2^-32 sub-chips]."""
    index = chips * per_chip
    index -= math.floor(index / length) * length
    # the quotient may round up to a whole number that the phase has not reached
    return np.int64(max(index, 0.0) * TURN)


@kernel
def behind(phase: Any, delay: Any, turn: Any) -> Any:
    """A phase less a delay, both within the period ``turn``, modulo the period."""
    late = phase - delay
    return late if late >= 0 else late + turn
