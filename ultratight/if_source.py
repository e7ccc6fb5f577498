"""Samples of a window of truth in the format of a file."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np

from signals.front_end import IfFormat, SyntheticIf
from signals.propagation import SignalState
from signals.sample_formats import FileFormat
from ultratight.config import InvalidInput
from ultratight.world import World

_KINDS: dict[str, IfFormat] = {"i1": "int8", "i2": "int16", "f4": "float32"}
_PACKED: dict[int, IfFormat] = {1: "bits1", 2: "bits2", 4: "bits4"}
_BLOCK = 1 << 19


def if_source(w: World, state: SignalState, form: FileFormat, rms: float | None) -> SyntheticIf:
    """The samples of a piece of the world's truth, of a scenario's front end, as a file has them.

    ``rms`` is that of the noise in each value, I, Q or real; None: the format's own.  Raises
    `InvalidInput` for one that the format cannot hold.
    """
    f = w.scenario.front_end
    try:
        return SyntheticIf(
            state,
            w.waveforms,
            f.sample_rate_hz,
            w.seed,
            if_hz=f.if_hz,
            symbol_chips=w.channels.symbol_chips,
            sample_format=(
                _PACKED[form.packing.bits] if form.packing else _KINDS[form.value_dtype.str[1:]]
            ),
            real=form.real,
            sigma=rms,
            workers=os.cpu_count() or 1,
        )
    except ValueError as error:
        raise InvalidInput(f"{form.name}: {error}") from None


def blocks(source: SyntheticIf, end_sample: int) -> Iterator[np.ndarray]:
    """Its samples before ``end_sample`` in order, (n, 2) or (n,)."""
    for a in range(source.first_sample, min(source.end_sample, end_sample), _BLOCK):
        yield source.samples(a, min(a + _BLOCK, source.end_sample, end_sample))
