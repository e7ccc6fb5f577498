"""Rows: what a closure keeps of its epochs."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

Fields = Mapping[str, tuple[tuple[int, ...], tuple[str, ...], str, str]]
"""Name -> (shape, dimensions, units, long name)"""


class Rows(dict[str, np.ndarray]):
    """Arrays (n, *shape) by name, NaN at first: ``rows["v_eb_e"][k]`` is a value of row k.

    They are views of one ``block`` (n, n_number), with the fields side by side in their order, so
    that a compiled step can write a whole row.
    """

    def __init__(self, n: int, fields: Fields) -> None:
        super().__init__()
        sizes = [math.prod(shape) for shape, _, _, _ in fields.values()]
        self.block = np.full((n, sum(sizes)), np.nan)
        first = 0
        for (name, (shape, _, _, _)), size in zip(fields.items(), sizes, strict=True):
            self[name] = self.block[:, first : first + size].reshape(n, *shape)
            first += size
