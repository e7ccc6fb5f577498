"""Vector kernels and their plain twins on the same numbers; run once per process by `signals.cpu`.

It must not know the path in force, which hangs on its outcome.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from signals import lanes_correlator as kernels
from signals.compiled import kernel

_N, _SAMPLES = 602, 608
"""Two whole strides and a part; whole groups of vectors, single ones and a part"""

_TOLERANCE = 2e-6
_SLOPES = 0.2557, 0.977
"""Table entries per sample: a window shared by vectors, and one for each"""


def check(path: str) -> list[tuple[str, float, float]]:
    """Rows (kernel, largest error, tolerance) of a path; errors are relative to the largest."""
    exercise = {"avx512": exercise_16, "avx2": exercise_8}.get(path)
    if exercise is None:
        return []
    rng = np.random.default_rng(1)
    narrow = rng.integers(-128, 128, 2 * _SAMPLES).astype(np.int8)
    wide = rng.standard_normal(2 * _SAMPLES).astype(np.float32)
    table = rng.standard_normal(2 * _SAMPLES).astype(np.float32)
    planes, sums = np.zeros((2, 6, 800), np.float32), np.zeros((2, len(_SLOPES), 12))
    turns = np.zeros((2, kernels.TURNS), np.float32)
    line = np.array([0.3 * 2**48, -0.0123 * 2**48]).astype(np.int64)
    code = (np.array([0.99999, 30.4, 31.9, *_SLOPES]) * 2**32).astype(np.int64)
    for k, run in enumerate((exercise, exercise_plain)):
        run(narrow, wide, table, line, code, planes[k], sums[k], turns[k])
    found: dict[str, tuple[np.ndarray, float]] = {
        "planar int8": (planes[:, :2, :_SAMPLES], 0.0),
        "planar float32": (planes[:, 2:4, :_SAMPLES], 0.0),
        "wipe": (planes[:, 4:, :_N], _TOLERANCE),
        "turns": (turns[:, : 4 * kernels.STRIDES], _TOLERANCE),
        "add": (sums, 5.0 * _TOLERANCE),
    }
    return [
        (name, float(np.abs(x[0] - x[1]).max() / np.abs(x[1]).max()), tolerance)
        for name, (x, tolerance) in found.items()
    ]


# ---- kernels ---------------------------------------------------------------------------------

_BEND = np.float32(30.0)  # [2^-32 cycles]: 5e-5 cycles in the middle


@kernel
def exercise_16(
    narrow: Any, wide: Any, table: Any, line: Any, code: Any, planes: Any, sums: Any, turns: Any
) -> None:  # fmt: skip
    """Every kernel of 16 lanes once: planes (6, n) int8 I, Q, float32 I, Q, wiped; sums (2, 12)."""
    kernels.planar_16(narrow, 0, _SAMPLES, planes[0], planes[1])
    kernels.planar_16(wide, 0, _SAMPLES, planes[2], planes[3])
    x, y = planes[4], planes[5]
    kernels.wipe_16(planes[2], planes[3], _N, line[0], line[1], _BEND, x, y, turns)
    for k in range(sums.shape[0]):
        step = code[3 + k]
        one = kernels.add_16(x, y, 1, _N, table, 0, (code[0],), step, turns)
        two = kernels.add_16(x, y, 1, _N, table, 0, (code[0], code[1]), step, turns)
        three = kernels.add_16(x, y, 1, _N, table, 0, (code[0], code[1], code[2]), step, turns)
        _write(one, two, three, sums[k])


@kernel
def exercise_8(
    narrow: Any, wide: Any, table: Any, line: Any, code: Any, planes: Any, sums: Any, turns: Any
) -> None:  # fmt: skip
    """Every kernel of 8 lanes once."""
    kernels.planar_8(narrow, 0, _SAMPLES, planes[0], planes[1])
    kernels.planar_8(wide, 0, _SAMPLES, planes[2], planes[3])
    x, y = planes[4], planes[5]
    kernels.wipe_8(planes[2], planes[3], _N, line[0], line[1], _BEND, x, y, turns)
    for k in range(sums.shape[0]):
        step = code[3 + k]
        one = kernels.add_8(x, y, 1, _N, table, 0, (code[0],), step, turns)
        two = kernels.add_8(x, y, 1, _N, table, 0, (code[0], code[1]), step, turns)
        three = kernels.add_8(x, y, 1, _N, table, 0, (code[0], code[1], code[2]), step, turns)
        _write(one, two, three, sums[k])


@kernel
def exercise_plain(
    narrow: Any, wide: Any, table: Any, line: Any, code: Any, planes: Any, sums: Any, turns: Any
) -> None:  # fmt: skip
    """Every twin once."""
    kernels.planar_plain(narrow, _SAMPLES, planes[0], planes[1])
    kernels.planar_plain(wide, _SAMPLES, planes[2], planes[3])
    x, y = planes[4], planes[5]
    kernels.wipe_plain(planes[2], planes[3], _N, line[0], line[1], _BEND, x, y, turns)
    for k in range(sums.shape[0]):
        step = code[3 + k]
        a = kernels.add_plain(x, y, 1, _N, table, code[0], step, turns)
        b = kernels.add_plain(x, y, 1, _N, table, code[1], step, turns)
        c = kernels.add_plain(x, y, 1, _N, table, code[2], step, turns)
        _write(a, (a[0], a[1], b[0], b[1]), (a[0], a[1], b[0], b[1], c[0], c[1]), sums[k])


@kernel
def _write(one: Any, two: Any, three: Any, row: np.ndarray) -> None:
    for k in range(2):
        row[k] = one[k]
    for k in range(4):
        row[2 + k] = two[k]
    for k in range(6):
        row[6 + k] = three[k]
