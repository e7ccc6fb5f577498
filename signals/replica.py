"""A replica inside a cell of samples: fixed-point phases that are exact to 1e-7 cycles or chips.

Generator and correlator both re-base their phases in float64 at the start of each cell and run
on integers inside it: every sample's phase is one multiplication away, in any vector lane.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from signals.compiled import kernel
from signals.elementary import TURN, wrap


def replica_table(chips: np.ndarray) -> np.ndarray:
    """Two code periods and a chip (n_channel, 2 length + 1) float32: no wrap inside a cell."""
    return np.ascontiguousarray(np.hstack([chips, chips, chips[:, :1]]), np.float32)


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def carrier_steps(start: float, middle: float, end: float, n: int) -> tuple[Any, Any, Any]:
    """Fixed-point phase and step [2^-32 cycles] (int32) over n samples, and the bend (float32).

    From the phases [cycles] at samples 0, n / 2 and n; see `carrier_phase`.
    """
    base = np.int64((start - math.floor(start)) * TURN)
    step = np.int64(np.rint((end - start) / n * TURN))
    bend = 4.0 * TURN * (middle - 0.5 * (start + end)) / (float(n) * float(n))
    return wrap(base), wrap(step), np.float32(bend)


@kernel(inline="always")
def carrier_phase(j: Any, base: Any, step: Any, bend: Any, n: Any) -> Any:
    """Phase of sample j of n as int32 [2^-32 cycles]: chord + bend j (n - j)."""
    x = np.float32(np.int32(j))
    chord = np.int64(base) + np.int64(np.int32(j)) * np.int64(step)
    return wrap(chord + np.int64(np.int32(bend * x * (n - x))))


@kernel
def code_steps(start: float, per_sample: float, length: int) -> tuple[Any, Any]:
    """Fixed-point code phase modulo ``length`` and its step per sample [chips 2^32]."""
    base = np.uint64((start - math.floor(start / length) * length) * TURN)
    return base, np.uint64(np.rint(per_sample * TURN))
