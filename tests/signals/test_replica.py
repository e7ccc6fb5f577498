"""Replica tables: what stands where, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from signals.replica import LONGEST_CELL, replicas

pytestmark = pytest.mark.nojit


def test_a_cell_never_wraps() -> None:
    """Every look-up of a cell that starts in the period finds the waveform modulo its length."""
    rng = np.random.default_rng(1)
    rows = [rng.normal(size=n) for n in (1023, 24, 4092 * 2)]
    per_chip = [1, 12, 2]
    r = replicas(rows, per_chip)
    assert r.table.dtype == np.float32
    for i, row in enumerate(rows):
        k = np.arange(row.size + per_chip[i] * (LONGEST_CELL + 1))
        np.testing.assert_array_equal(r.table[r.first[i] + k], row[k % row.size].astype(np.float32))
    assert r.length.tolist() == [1023, 24, 8184]
    assert r.per_chip.tolist() == per_chip


def test_int8_rows_of_one_kind() -> None:
    r = replicas(np.array([[1, -1, 1], [-1, -1, 1]], np.int8))
    assert r.per_chip.tolist() == [1, 1]
    np.testing.assert_array_equal(r.table[r.first[1] + np.arange(4)], [-1, -1, 1, -1])
    assert replicas([]).first.size == 0


@pytest.mark.parametrize(
    ("rows", "per_chip", "message"),
    [
        ([np.ones(6)], 4, "row 0 is .*a multiple of 4"),
        ([np.ones(6), np.ones((2, 3))], 1, "row 1 is"),
        ([np.ones(0)], 1, "row 0 is"),
        ([np.array([1.0, np.nan])], 1, "row 0 is .*finite"),
        ([np.ones(6)], 0, "per_chip is 0"),
        ([np.ones(6)], [1, 2], "per_chip has 2 numbers: expected one for each of 1"),
    ],
)
def test_bad_rows_are_refused(rows: list, per_chip: int | list[int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replicas(rows, per_chip)
