"""Samples of a window of truth in the format of a file."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator

import numpy as np

from signals.front_end import SyntheticIf
from signals.noise import CELL
from signals.propagation import SignalState
from signals.sample_formats import FileFormat
from ultratight.config import InvalidInput

_DEFAULT_RMS = {"i1": 24.0, "i2": 2048.0, "f4": 1.0}
_THRESHOLD = 0.9957
"""Of 2-bit samples -3 -1 1 3 in units of the noise's sigma: least loss, 0.549 dB (Max 1960)"""
_BLOCK = 512 * CELL


def noise_rms(form: FileFormat, rms: float | None = None) -> float:
    """R.m.s. of the noise in each value of a file, I, Q or real; None: the format's own.

    Raises
    ------
    InvalidInput : an r.m.s. that the format cannot hold.
    """
    if form.packed:
        if rms is not None:
            raise InvalidInput(f"--rms: {rms:g} given, but {form.name} has one scale only")
        beyond = math.erfc(_THRESHOLD / math.sqrt(2.0))
        return math.sqrt(1.0 + 8.0 * beyond)
    kind = form.dtype.str[1:]
    if rms is None:
        return _DEFAULT_RMS[kind]
    low, high = 1e-6, 1e6
    if form.dtype.kind == "i":  # a third of full scale: 0.3 % of the values are clipped
        low, high = 0.5, np.iinfo(form.dtype).max / 3.0
    if not low <= rms <= high:
        raise InvalidInput(f"--rms: {rms:g} given, expected {low:g} to {high:.0f} in {form.name}")
    return rms


def tap_sigma(form: FileFormat, rms: float) -> float:
    """`IfSource.sigma` of samples whose values have this r.m.s."""
    return rms / math.sqrt(2.0) if form.real else rms


def blocks(
    state: SignalState,
    chips: np.ndarray,
    sample_rate_hz: float,
    seed: int,
    if_hz: float,
    form: FileFormat,
    rms: float,
    end_sample: int,
) -> Iterator[np.ndarray]:
    """Samples of the truth before ``end_sample``, (n, 2) or (n,), in blocks of whole cells."""
    as_it_is = form.name in ("ci8", "cf32") and rms == noise_rms(form)
    if form.real:
        # a real sample has all of the noise in half of the band: Re z alone would have N0 doubled
        state = state._replace(cn0_dbhz=state.cn0_dbhz + 10.0 * math.log10(2.0))
    source = SyntheticIf(
        state,
        chips,
        sample_rate_hz,
        seed,
        if_hz=if_hz,
        sample_format="int8" if as_it_is and form.name == "ci8" else "float32",
        workers=os.cpu_count() or 1,
    )
    a, end = source.first_sample, min(source.end_sample, end_sample)
    while a < end:
        b = min((a // CELL) * CELL + _BLOCK, end)
        z = source.samples(a, b)
        z = np.ascontiguousarray(z[:, 0]) if form.real else z
        yield z if as_it_is else _quantised(z, form, rms)
        a = b


def _quantised(x: np.ndarray, form: FileFormat, rms: float) -> np.ndarray:
    """Values of unit noise in the format's own; integers are rounded and clipped."""
    if form.packed:
        return (np.where(np.abs(x) < _THRESHOLD, 1, 3) * np.where(x < 0.0, -1, 1)).astype(np.int8)
    x = x * np.float32(rms)
    if form.dtype.kind == "f":
        return x
    full = np.iinfo(form.dtype).max
    return np.clip(np.rint(x), -full, full).astype(form.dtype)
