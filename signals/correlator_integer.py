"""The integer engine: int8 samples in 16-bit words, where half a percent of noise is no matter.

Sample j of a stride meets a carrier of int8 pairs, of the tabulated frequency nearest to its own.
With sample x + j y the product is a word and exact, whatever the int8, as

    0 <= (x + 128) c + (y + 128) s < 255 max(c + s) <= 255 * 128 < 2^15                         (1)

bounds it from above (from below likewise); 128 (c + s) is then taken off again.  The sum of words
times code over a stride is an int32 and exact too.  A float32 phasor turns what a stride has left
of the carrier.  Approximated are

* the carrier's amplitude, `AMPLITUDE` and rounded: 0.5 % of every sample, at random.  The mean
  gain of a table is divided out, hence no bias;
* its frequency, within 2^-18 cycles per sample inside a stride: 0.1 %;
* where a chip ends, to 2^-16 entries of the table, without bias: 0.3 % of BPSK, 0.4 % of BOC;
* waveforms that are not whole numbers, to 1 / 8192 of their peak.
"""

from __future__ import annotations

import logging
import math
from typing import Any, NamedTuple

import numpy as np

from signals import cpu
from signals import lanes_integer as vectors
from signals.compiled import borrowing
from signals.elementary import cos_sin, wrap
from signals.lanes_correlator import PHASE_BITS
from signals.lanes_integer import MOST, SPAN, STRIDE, VECTOR
from signals.plan import (
    BASE,
    BEND,
    CELL,
    CHIPS,
    CHIPS_PER_SAMPLE,
    END,
    FIRST,
    SAMPLES,
    SLOT,
    START,
    STEP,
    Work,
)  # fmt: skip
from signals.replica import (
    Replicas,
    behind,
    index_delays,
    index_phase,
    index_step,
    replicas,
)

AMPLITUDE = 89.5
"""Of the tabulated carriers: c + s stays at 128 or below, see (1)"""

_STEP_BITS = 31  # a table for every 2^31 of the 2^48 units of a cycle per sample
_TABLES = 4  # of a channel: a frequency that wavers between two of them finds both
_SPREAD = 4  # table entries from the first to the last tap of a cluster
_PEAK = 4096.0  # of a waveform that is not of whole numbers
_TOLERANCE = 1e-5  # float32 sums of exact strides
_log = logging.getLogger(__name__)


class _Code(NamedTuple):
    """Waveforms as words, and where the taps look them up."""

    table: np.ndarray  # (n_total,) int16
    first: np.ndarray  # (n_channel,) int64: a channel's first entry
    length: np.ndarray  # (n_channel,) int64: period in entries
    per_chip: np.ndarray  # (n_channel,) int64: entries per chip
    unit: np.ndarray  # (n_channel,) value of a word
    head: np.ndarray  # (n_channel, n_cluster) int64: delay of the latest tap [2^-32 entries]
    ahead: np.ndarray  # (n_channel, n_tap) int64: what a tap of `tap` is earlier than that
    cluster: np.ndarray  # (n_tap,) int64: the cluster of `tap`
    tap: np.ndarray  # (n_tap,) int64: taps in order of cluster and fraction
    most: np.ndarray  # (n_channel,) int64: step [2^-32 entries] that a window spans


class _Carriers(NamedTuple):
    """Strides of carrier; row `_TABLES` channel + k holds one of frequency number k modulo that."""

    number: np.ndarray  # (n_row,) int64: frequency [2^_STEP_BITS 2^-48 cycles per sample]
    gain: np.ndarray  # (n_row,) mean gain
    table: np.ndarray  # (n_row, 2, 2 STRIDE) int8: c, s ... for I and -s, c ... for Q
    bias: np.ndarray  # (n_row, 2, STRIDE) int16: what the 128 in (1) make of them


class _Scratch(NamedTuple):
    """Of one thread."""

    samples: np.ndarray  # (2 SPAN + pad,) uint8: of a cell, I and Q + 128
    starts: np.ndarray  # (2 n_cluster,) int64: first entry, its fraction [2^-32]
    sums: np.ndarray  # (2 n_tap,) I and Q of `_Code.tap`
    words: np.ndarray  # (2, SPAN) int32: wiped, for the plain twin
    done: np.ndarray  # (n_channel,) int64: parts


def _aligned(shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """Zeros at a 64-byte boundary: no vector lies across two cache lines."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    memory = np.zeros(size + 64, np.uint8)
    start = -memory.ctypes.data % 64
    return memory[start : start + size].view(dtype).reshape(shape)


def clusters(ahead: np.ndarray) -> list[list[list[int]]]:
    """Taps that are looked up in one window, in groups of one fraction of an entry, latest first.

    ``ahead`` (n_channel, n_tap) is how much each tap is earlier than the latest [2^-32 entries].
    """
    made: list[list[list[int]]] = []
    for tap in np.argsort(ahead.max(axis=0, initial=0), kind="stable").tolist():
        if made and sum(map(len, made[-1])) < MOST:
            from_head = ahead[:, tap] - ahead[:, made[-1][0][0]]
            if np.all((from_head >= 0) & (from_head <= _SPREAD << 32)):
                for group in made[-1]:
                    if not np.any((ahead[:, tap] - ahead[:, group[0]]) & 0xFFFFFFFF):
                        group.append(tap)
                        break
                else:
                    made[-1].append([tap])
                continue
        made.append([[tap]])
    return made


def _words(waveforms: Replicas) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Table of int16, first entry and value of a unit of each channel."""
    rows, units = [], []
    for first, length, per_chip in zip(*waveforms[1:], strict=True):
        row = waveforms.table[first : first + length].astype(np.float64)
        peak = np.abs(row).max()
        whole = peak <= _PEAK and not np.any(row % 1.0)
        units.append(1.0 if whole else peak / _PEAK)
        word = np.rint(row / units[-1]).astype(np.int16)
        rows.append(np.resize(word, length + per_chip * (SPAN + 1) + 2 * VECTOR))
    sizes = np.array([row.size for row in rows], np.int64)
    table = _aligned((int(sizes.sum()),), np.int16)
    table[:] = np.concatenate([*rows, table[:0]])
    return table, np.cumsum(sizes) - sizes, np.array(units)


class Integer:
    """Fills sums from int8 samples; an instance belongs to one thread; see `exact.Exact`."""

    span = SPAN

    def __init__(self, waveforms: Replicas, offset_chips: np.ndarray) -> None:
        n, n_tap = waveforms.length.size, offset_chips.size
        delays = index_delays(waveforms, offset_chips)
        turns = waveforms.length[:, None] << 32
        latest = delays[:, np.argmax(offset_chips)][:, None] if n_tap else delays
        made = clusters((latest - delays) % turns)
        tap = np.array([t for c in made for g in c for t in g], np.int64)
        cluster = np.array([k for k, c in enumerate(made) for g in c for _ in g], np.int64)
        head = np.ascontiguousarray(delays[:, [c[0][0] for c in made]])
        ahead = np.ascontiguousarray((head[:, cluster] - delays[:, tap]) % turns)
        table, first, unit = _words(waveforms)
        most = (((VECTOR - 1) << 32) - ahead.max(axis=1, initial=0)) // (VECTOR - 1) - (1 << 16)
        code = _Code(
            table, first, waveforms.length, waveforms.per_chip, unit, head, ahead, cluster, tap,
            most,
        )  # fmt: skip
        carriers = _Carriers(
            np.full(n * _TABLES, -(1 << 62)),
            np.ones(n * _TABLES),
            _aligned((n * _TABLES, 2, 2 * STRIDE), np.int8),
            _aligned((n * _TABLES, 2, STRIDE), np.int16),
        )
        scratch = _Scratch(
            _aligned((2 * SPAN + 2 * VECTOR,), np.uint8),
            np.zeros(2 * len(made), np.int64),
            np.zeros(2 * n_tap),
            np.zeros((2, SPAN), np.int32),
            np.zeros(n, np.int64),
        )
        # its type tells the vectors how many taps each group has
        shape = tuple(tuple((0,) * len(group) for group in c) for c in made)
        self.own = code, carriers, scratch, shape

    def __call__(
        self, c0: int, c1: int, narrow: np.ndarray, wide: np.ndarray, n_cell: int, work: Work,
        sums: np.ndarray,
    ) -> None:  # fmt: skip
        """Add the parts of channels c0 ... c1 - 1 to ``sums`` (n_channel, n_slot, n_tap, 2).

        Raises
        ------
        ValueError : samples that are not int8.
        """
        if wide.size:
            raise ValueError('samples are not int8: expected int8 for method "integer"')
        _accumulate(c0, c1, narrow, n_cell, work, sums, *self.own)


# ---- kernels ---------------------------------------------------------------------------------


@borrowing
def tabulate(step: float, row: int, table: np.ndarray, bias: np.ndarray) -> float:
    """A stride of carrier of ``step`` cycles per sample, its phase 0 in the middle; its gain."""
    gain = 0.0
    for k in range(STRIDE):
        turn = 2.0 * math.pi * (k - 0.5 * (STRIDE - 1)) * step
        c, s = round(AMPLITUDE * math.cos(turn)), round(AMPLITUDE * math.sin(turn))
        table[row, 0, 2 * k], table[row, 0, 2 * k + 1] = c, s
        table[row, 1, 2 * k], table[row, 1, 2 * k + 1] = -s, c
        bias[row, 0, k], bias[row, 1, k] = 128 * (c + s), 128 * (c - s)
        gain += c * math.cos(turn) + s * math.sin(turn)
    return gain / STRIDE


@borrowing
def sum_plain(
    samples: Any, first: int, n: int, line: Any, scale: Any, row: int, table: Any, bias: Any,
    code: Any, step: Any, starts: Any, ahead: Any, channel: int, cluster: Any, shape: Any,
    sums: Any, words: Any,
) -> None:  # fmt: skip
    """Sums of n samples of a cell from ``first`` on, I and Q of each tap, into ``sums``.

    ``line`` is the carrier of the cell, (BASE, STEP, BEND, SAMPLES) of `plan.Work`; ``row`` is
    its row of the tables; ``scale`` multiplies all; ``step`` [2^-32 entries] is the code's.
    """
    for j in range(n):
        k = 2 * (j % STRIDE)
        x, y = int(samples[2 * (first + j)]) - 128, int(samples[2 * (first + j) + 1]) - 128
        c, s = int(table[row, 0, k]), int(table[row, 0, k + 1])
        words[0, j], words[1, j] = x * c + y * s, y * c - x * s
    for k in range(cluster.size):
        sums[2 * k], sums[2 * k + 1] = 0.0, 0.0
        origin, phase = starts[2 * cluster[k]], starts[2 * cluster[k] + 1]
        for m in range(0, n, STRIDE):
            i, q = 0, 0
            for j in range(m, min(m + STRIDE, n)):
                now = phase + (j // VECTOR) * (VECTOR * step)
                lane = (ahead[channel, k] + (j % VECTOR) * step) >> 16
                more = ((now >> 16) & 0xFFFF) >= (lane & 0xFFFF) ^ 0xFFFF
                word = int(code[origin + (now >> 32) + (lane >> 16) + int(more)])
                i += word * words[0, j]
                q += word * words[1, j]
            c, s = _turn(first + m, line)
            sums[2 * k] += scale * (c * i + s * q)
            sums[2 * k + 1] += scale * (c * q - s * i)


@borrowing
def _turn(start: int, line: Any) -> tuple[Any, Any]:
    """Carrier in the middle of the stride from sample ``start`` of the cell."""
    base, step, bend, n = line
    j = np.float32(start) + np.float32(0.5 * (STRIDE - 1))
    bow = np.int64(np.int32(bend * j * (np.float32(n) - j)))
    phase = base + step * start + ((step * (STRIDE - 1)) >> 1)
    return cos_sin(wrap((phase >> (PHASE_BITS - 32)) + bow))


@borrowing
def sum_vectors(
    samples: Any, first: int, n: int, line: Any, scale: Any, row: int, table: Any, bias: Any,
    code: Any, step: Any, starts: Any, ahead: Any, channel: int, cluster: Any, shape: Any,
    sums: Any, words: Any,
) -> None:  # fmt: skip
    """`sum_plain` in vectors: the intrinsic as a function."""
    vectors.sum_32(samples, first, n, line, scale, row, table, bias, code, step, starts, ahead,
                   channel, cluster, shape, sums, words)  # fmt: skip


def _agree() -> bool:
    """True if the vectors give what their twin gives on numbers of any size."""
    rng = np.random.default_rng(1)
    waveforms = replicas([rng.choice([-1.0, 1.0], 1023), rng.standard_normal(1022)], [1, 2])
    code, carriers, scratch, shape = Integer(waveforms, np.array([-0.5, 0.0, 0.3, 0.5, 9.0])).own
    scratch.samples[:] = rng.integers(0, 256, scratch.samples.size)
    scratch.starts[::2] = rng.integers(0, 500, scratch.starts.size // 2)
    scratch.starts[1::2] = rng.integers(0, 1 << 32, scratch.starts.size // 2)
    scale = np.float32(1.0 / tabulate(0.123, 1, carriers.table, carriers.bias))
    line = 1 << 45, round(0.123 * 2**PHASE_BITS), np.float32(9.0), 1000
    arrays = carriers.table, carriers.bias, code.table
    error = 0.0
    for channel, step in ((0, 1_100_000_000), (1, 2_200_000_000)):
        found = np.zeros((2, 10))
        for run, sums in zip((sum_plain, sum_vectors), found, strict=True):
            run(scratch.samples, 5, 600, line, scale, 1, *arrays, step, scratch.starts, code.ahead,
                channel, code.cluster, shape, sums, scratch.words)  # fmt: skip
        error = max(error, np.abs(found[1] - found[0]).max() / np.abs(found[0]).max())
    if not error < _TOLERANCE:
        _log.warning("vectors are not taken for integers: off by %g of %g", error, _TOLERANCE)
    return bool(error < _TOLERANCE)


IN_VECTORS = cpu.path() == "avx512" and vectors.able() and _agree()
"""Whether this machine has the vectors"""

_sum = vectors.sum_32 if IN_VECTORS else sum_plain


@borrowing
def _load(narrow: np.ndarray, first: int, n: int, samples: np.ndarray) -> None:
    source, target = narrow[2 * first : 2 * (first + n)], samples[: 2 * n]
    for j in range(source.shape[0]):
        target[j] = np.uint8(source[j]) ^ np.uint8(0x80)


@borrowing
def _accumulate(
    c0: int, c1: int, narrow: Any, n_cell: int, work: Work, sums: Any, code: Any, carriers: Any,
    scratch: Any, shape: Any,
) -> None:  # fmt: skip
    """Parts of channels c0 ... c1 - 1, cell by cell."""
    cells, count, whole, real = work
    chips, first, length, per_chip, unit, head, ahead, cluster, tap, most = code
    number, gain, table, bias = carriers
    samples, starts, found, wiped, done = scratch
    done[c0:c1] = 0
    for cell in range(n_cell):
        n = cells[cell, SAMPLES]
        _load(narrow, cells[cell, FIRST], n, samples)
        for channel in range(c0, c1):
            part, turn = done[channel], length[channel] << 32
            while part < count[channel] and whole[channel, part, CELL] == cell:
                a, b = whole[channel, part, START], whole[channel, part, END]
                phase = index_phase(real[channel, part, CHIPS], per_chip[channel], length[channel])
                for k in range(head.shape[1]):
                    late = behind(phase, head[channel, k], turn)
                    starts[2 * k] = first[channel] + (late >> 32)
                    starts[2 * k + 1] = late & 0xFFFFFFFF
                step = index_step(real[channel, part, CHIPS_PER_SAMPLE], per_chip[channel])
                bend = np.float32(real[channel, part, BEND])
                line = whole[channel, part, BASE], whole[channel, part, STEP], bend, n
                nearest = (line[1] + (1 << (_STEP_BITS - 1))) >> _STEP_BITS
                row = channel * _TABLES + (nearest & (_TABLES - 1))
                if number[row] != nearest:
                    number[row] = nearest
                    per_sample = nearest * 2.0 ** (_STEP_BITS - PHASE_BITS)
                    gain[row] = tabulate(per_sample, row, table, bias)
                scale = np.float32(unit[channel] / gain[row])
                if step <= most[channel]:
                    _sum(samples, a, b - a, line, scale, row, table, bias, chips, step, starts,
                         ahead, channel, cluster, shape, found, wiped)  # fmt: skip
                else:
                    sum_plain(samples, a, b - a, line, scale, row, table, bias, chips, step,
                              starts, ahead, channel, cluster, shape, found, wiped)  # fmt: skip
                slot = whole[channel, part, SLOT]
                for k in range(tap.size):
                    sums[channel, slot, tap[k], 0] += found[2 * k]
                    sums[channel, slot, tap[k], 1] += found[2 * k + 1]
                part += 1
            done[channel] = part
