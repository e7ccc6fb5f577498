"""What a correlator sums, and what of it ends where: the command as a list of parts of cells.

A cell is at most ``span`` samples that end at a multiple of it or at the end of a piece of the
command; carrier and code of a channel are re-based in float64 at its start.  A *part* of a cell
belongs to one integration of one channel.  Engines fill the sums of the parts; no sample is
touched here.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from signals.compiled import borrowing, kernel
from signals.front_end import GUARD_SAMPLES
from signals.lanes_correlator import PHASE_BITS
from signals.nco import Nco

# a command that begins, as its first sample; what `plan` returns in place of a number of cells
NOWHERE = -(1 << 62)
REFUSED, NO_ROOM = -1, -2

Planned = tuple[int, int, int, int, int]
"""First sample and end of a block, end of the command, cells of the block, rows of the command"""

# columns of Work.cells
FIRST, SAMPLES, PIECE = 0, 1, 2
# columns of Work.whole
CELL, START, END, SLOT, BASE, STEP = 0, 1, 2, 3, 4, 5
# columns of Work.real
CHIPS, CHIPS_PER_SAMPLE, BEND = 0, 1, 2


class Work(NamedTuple):
    """What is to be summed in a block of samples; a channel's parts are in order of time.

    Part ``START`` <= j < ``END`` of cell ``CELL`` goes to the sums of slot ``SLOT``.  Its code
    phase is ``CHIPS`` at sample START and grows by ``CHIPS_PER_SAMPLE``.  Its carrier at sample
    j of the cell is BASE + STEP j + BEND j (SAMPLES - j), with ``BASE`` and ``STEP`` in 2^-48
    cycles, ``BEND`` in 2^-32 cycles.
    """

    cells: np.ndarray  # (n_cell, 3) int64: first sample in the block, samples, piece
    parts: np.ndarray  # (n_channel,) int64: how many
    whole: np.ndarray  # (n_channel, n_part, 6) int64
    real: np.ndarray  # (n_channel, n_part, 3)


class Rows(NamedTuple):
    """Integrations that ended, of each channel."""

    ended: np.ndarray  # (n_channel,) int64: how many
    whole: np.ndarray  # (n_channel, n_row, 4) int64: number, slot, first and end sample
    phases: np.ndarray  # (n_channel, n_row, 4): code and carrier at the first, at the end sample


class State(NamedTuple):
    """What persists between blocks and calls."""

    position: np.ndarray  # (n_channel, 6) int64: known, open, number, first sample, dump, slot
    phases: np.ndarray  # (n_channel, 2): code and carrier at the first sample


LARGEST = 1e15
"""Phases [chips, cycles] and frequencies beyond this leave float64 no fraction of a chip"""

# ---- kernels ---------------------------------------------------------------------------------

_CYCLE = 2.0**PHASE_BITS
_TURN = 2.0**32
# columns of State.position and of Rows.whole
_KNOWN, _OPEN, _NUMBER, _SINCE, _DUMP, _SLOT = 0, 1, 2, 3, 4, 5
_ROW_NUMBER, _ROW_SLOT, _ROW_FIRST, _ROW_END = 0, 1, 2, 3


@borrowing
def _room(nco: Nco, fs: float, edge: np.ndarray) -> int:
    """First samples of the pieces into ``edge``, see `first_sample_at`.

    Returns how many integrations may end in a channel; -1 if a number of the command, of a valid
    channel, cannot be run.
    """
    most, last = 0, nco.t_s.size - 1
    for p in range(last + 1):
        if not (math.isfinite(nco.t_s[p]) and (p == 0 or nco.t_s[p] > nco.t_s[p - 1])):
            return -1
        edge[p] = math.ceil(nco.t_s[p] * fs - GUARD_SAMPLES)
    for channel in range(nco.valid.size):
        if nco.valid[channel]:
            chips = 0.0
            for p in range(last):
                rate = nco.chip_rate_hz[p, channel]
                sum_ = nco.code_phase_chips[p, channel] + nco.carrier_phase_cycles[p, channel]
                sum_ += nco.carrier_freq_hz[p, channel] + nco.carrier_rate_hz_per_s[p, channel]
                if not (abs(sum_) < LARGEST and 0.0 < rate <= fs):
                    return -1
                chips += rate * (nco.t_s[p + 1] - nco.t_s[p])
            if nco.dump_chips[channel] < 1:
                return -1
            most = max(most, int(chips / nco.dump_chips[channel]) + 3 * last)
    return most


@kernel(inline="always")
def _code(line: Any, dt: float) -> float:
    """NCO code phase [chips]; ``line`` is the command of one channel in one piece."""
    return line[0] + line[1] * dt


@kernel(inline="always")
def _carrier(line: Any, dt: float) -> float:
    """NCO carrier phase [cycles]."""
    return line[2] + dt * (line[3] + 0.5 * line[4] * dt)


@borrowing
def _phases(line: Any, dt: float, n: int, start: int, sample_s: float, ratio: float) -> Any:
    """Base, step and bend of carrier and intermediate frequency over n samples from dt.

    A parabola is its chord less rate / 2 (n sample_s)^2 / 4 at the middle.
    """
    phase = _carrier(line, dt) + start * ratio
    per_sample = (line[3] + line[4] * (dt + 0.5 * n * sample_s)) * sample_s + ratio
    base = np.int64((phase - math.floor(phase)) * _CYCLE)
    return (
        base,
        np.int64(np.rint(per_sample * _CYCLE)),
        -0.5 * _TURN * line[4] * sample_s * sample_s,
    )


@borrowing
def plan(
    first: int, last_end: int, block: int, span: int, fs: float, if_hz: float,
    t_s: Any, code: Any, chip_rate: Any, cycles: Any, freq: Any, rate: Any, dumps: Any, valid: Any,
    edge: Any, position: Any, phases: Any, ended: Any, row_whole: Any, row_phases: Any,
    cells: Any, parts: Any, whole: Any, real: Any, sums: Any,
) -> Planned:  # fmt: skip
    """Plan the block of samples from ``first`` on; `NOWHERE`: the first block of the command.

    A call by the millisecond would spend more on its arguments than on its work: they come field
    by field.  ``edge`` (>= n_piece + 1,) takes the first samples of the pieces, ``sums``
    (n_channel, n_slot, n_tap, 2) has in slot 0 what was open at ``last_end``, where the last
    command ended.  Cells `REFUSED`: shapes that disagree or a number that cannot be run;
    `NO_ROOM`: arrays are too small for a command from first sample to end and as many rows.
    """
    nco = Nco(t_s, code, chip_rate, cycles, freq, rate, dumps, valid)
    rows, work = Rows(ended, row_whole, row_phases), Work(cells, parts, whole, real)
    state = State(position, phases)
    last = t_s.size - 1
    if first == NOWHERE:
        if not _agree(nco, position.shape[0]):
            return 0, 0, 0, REFUSED, 0
        if edge.size <= last:
            return 0, 0, 0, NO_ROOM, 0
        most = _room(nco, fs, edge)
        if most < 0:
            return 0, 0, 0, REFUSED, 0
        first, end = edge[0], edge[last]
        n_cell, n_slot = min(block, end - first) // span + 2 + last, most + last + 2
        if (
            row_whole.shape[1] < most
            or sums.shape[1] < n_slot
            or cells.shape[0] < n_cell
            or whole.shape[1] < n_cell + most
        ):
            return first, end, end, NO_ROOM, most
        for channel in range(valid.size):
            ended[channel] = 0
            if first != last_end:
                position[channel, _KNOWN], position[channel, _SLOT] = 0, 0
            for slot in range(1, n_slot):
                for tap in range(sums.shape[2]):
                    sums[channel, slot, tap, 0], sums[channel, slot, tap, 1] = 0.0, 0.0
    end = edge[last]
    stop = min(first - first % span + block, end)
    n_cell = _cells(first, stop, span, edge[: last + 1], cells)
    n_row = 0
    for channel in range(valid.size):
        if not valid[channel]:
            position[channel, _KNOWN] = 0
            parts[channel] = 0
        elif n_cell > 0:
            _channel(channel, n_cell, first, fs, if_hz, nco, state, rows, work)
        n_row += ended[channel]
    return first, stop, end, n_cell, n_row


@borrowing
def _agree(nco: Nco, n_channel: int) -> bool:
    """Do the shapes of a command agree?"""
    shape = (nco.t_s.size - 1, n_channel)
    return (
        shape[0] > 0
        and nco.code_phase_chips.shape == shape
        and nco.chip_rate_hz.shape == shape
        and nco.carrier_phase_cycles.shape == shape
        and nco.carrier_freq_hz.shape == shape
        and nco.carrier_rate_hz_per_s.shape == shape
        and nco.dump_chips.size == n_channel
        and nco.valid.size == n_channel
    )


@borrowing
def _cells(first: int, end: int, span: int, edge: Any, cells: Any) -> int:
    """Cells of samples first ... end - 1; how many."""
    n_cell = 0
    for p in range(edge.size - 1):
        start, stop = max(edge[p], first), min(edge[p + 1], end)
        while start < stop:
            n = min(start - start % span + span, stop) - start
            cells[n_cell, FIRST] = start - first
            cells[n_cell, SAMPLES] = n
            cells[n_cell, PIECE] = p
            n_cell += 1
            start += n
    return n_cell


@borrowing
def _under_way(x: float, dump: int, chips_per_sample: float) -> tuple[int, bool]:
    """Number of the integration at code phase x, and whether x is its first sample."""
    tolerance = GUARD_SAMPLES * chips_per_sample
    number = math.floor((x + tolerance) / dump)
    return number, x - number * dump < chips_per_sample - tolerance


@borrowing
def _channel(
    channel: int, n_cell: int, block: int, fs: float, if_hz: float, nco: Nco, state: State,
    rows: Rows, work: Work,
) -> None:  # fmt: skip
    """Parts of a channel, and the integrations that end."""
    sample_s, ratio = 1.0 / fs, if_hz / fs
    t_s, code, chip_rate, cycles, freq, rate, dumps, _ = nco
    cells, _, whole, real = work
    position, dump = state.position[channel], dumps[channel]
    known = position[_KNOWN] == 1 and position[_DUMP] == dump
    is_open, number, since = position[_OPEN] == 1, position[_NUMBER], position[_SINCE]
    begun = state.phases[channel, 0], state.phases[channel, 1]
    part, row, slot = 0, rows.ended[channel], position[_SLOT]
    for cell in range(n_cell):
        start, n, p = block + cells[cell, FIRST], cells[cell, SAMPLES], cells[cell, PIECE]
        line = (
            code[p, channel], chip_rate[p, channel],
            cycles[p, channel], freq[p, channel], rate[p, channel],
        )  # fmt: skip
        dt = start / fs - t_s[p]
        x, slope = _code(line, dt), line[1] * sample_s
        if not (known and abs(x - (number + 0.5) * dump) <= dump):
            known = True
            number, is_open = _under_way(x, dump, slope)
            slot, since, begun = slot + 1, start, (x, _carrier(line, dt))
        base, step, bend = _phases(line, dt, n, start, sample_s, ratio)
        a = 0
        while a < n:
            # first sample at or past the end of the integration under way
            to_go, bound = (number + 1) * dump - x, n + 1
            if to_go < slope * bound:  # most cells have none: no division there
                bound = max(a, math.ceil(to_go / slope - GUARD_SAMPLES))
            b = min(bound, n)
            if is_open and b > a:
                whole[channel, part, CELL], whole[channel, part, SLOT] = cell, slot
                whole[channel, part, START], whole[channel, part, END] = a, b
                whole[channel, part, BASE], whole[channel, part, STEP] = base, step
                real[channel, part, CHIPS] = x + slope * a
                real[channel, part, CHIPS_PER_SAMPLE], real[channel, part, BEND] = slope, bend
                part += 1
            if bound >= n:
                break
            a = bound
            dt_a = (start + a) / fs - t_s[p]
            now = _code(line, dt_a), _carrier(line, dt_a)
            if is_open:
                _finish(rows, channel, row, (number, slot, since, start + a), begun, now)
                row += 1
            number, is_open, slot, since, begun = number + 1, True, slot + 1, start + a, now
    rows.ended[channel], work.parts[channel] = row, part
    position[_KNOWN], position[_OPEN], position[_DUMP] = int(known), int(is_open), dump
    position[_NUMBER], position[_SINCE], position[_SLOT] = number, since, slot
    state.phases[channel, 0], state.phases[channel, 1] = begun


@borrowing
def _finish(
    rows: Rows, channel: int, row: int, whole: tuple[int, int, int, int],
    begun: tuple[float, float], now: tuple[float, float],
) -> None:  # fmt: skip
    """Write an integration of a channel as its next row."""
    for k in range(4):
        rows.whole[channel, row, k] = whole[k]
    rows.phases[channel, row, 0], rows.phases[channel, row, 1] = begun
    rows.phases[channel, row, 2], rows.phases[channel, row, 3] = now


@borrowing
def collect(
    fs: float, sigma: float, position: Any, ended: Any, row_whole: Any, row_phases: Any, sums: Any,
    whole: Any, real: Any, iq: Any,
) -> None:  # fmt: skip
    """Rows of all channels, one after the other; the open sums become slot 0 of the next call.

    ``whole`` (2, n) and ``real`` (7, n) take channel, number; bounds [s], noise variance, code at
    both bounds, carrier at both; ``iq`` is (n, n_tap).
    """
    k = 0
    for c in range(ended.size):
        for row in range(ended[c]):
            whole[0, k], whole[1, k] = c, row_whole[c, row, _ROW_NUMBER]
            first, end = row_whole[c, row, _ROW_FIRST], row_whole[c, row, _ROW_END]
            real[0, k], real[1, k], real[2, k] = first / fs, end / fs, 1.0
            real[3, k], real[4, k] = row_phases[c, row, 0], row_phases[c, row, 2]
            real[5, k], real[6, k] = row_phases[c, row, 1], row_phases[c, row, 3]
            scale = 1.0 / (sigma * math.sqrt(end - first))
            slot = row_whole[c, row, _ROW_SLOT]
            for tap in range(sums.shape[2]):
                i, q = sums[c, slot, tap, 0], sums[c, slot, tap, 1]
                iq[k, tap] = complex(i * scale, q * scale)
            k += 1
        slot = position[c, _SLOT]
        for tap in range(sums.shape[2]):
            for m in range(2):
                sums[c, 0, tap, m] = sums[c, slot, tap, m]
        position[c, _SLOT] = 0
