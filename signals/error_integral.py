"""The mean of a correlator in closed form: R(code error) exp(j 2 pi phase error) over time.

Truth and replica are polynomials of time, so the integral is cut where they, the data symbol or
the slope of R change, and done by Gauss-Legendre between.  Kernels only, for `correlator_model`.

One piece of truth is a row of `TRUTH_COLUMNS` numbers: from, to [s], code cubic [chips], carrier
cubic [cycles], sqrt(C/N0) [sqrt Hz] (0: absent), standard deviation of the noise.  A ``line`` is a
piece of the command: (t [s], code, chip rate, carrier, frequency, frequency rate).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from signals.compiled import FAST_SUM, borrowing
from signals.eight import fill, load, sin_cos, total
from signals.front_end import GUARD_SAMPLES

TRUTH_COLUMNS = 12
CODE, CARRIER, AMPLITUDE, SPREAD = 2, 6, 10, 11

_NODE, _WEIGHT = np.polynomial.legendre.leggauss(8)
_MAX_CYCLES = 1.5  # per interval: the 8-point rule then errs by 1.3e-7
_KINK_CHIPS = 1e-9  # a kink this near to the end of an interval is at its end


@borrowing
def edge(t: float, sample_s: float) -> float:
    """Where the integral starts whose first sample is the first one not before t.

    Sample n stands for [n - 1/2, n + 1/2) sample_s; with sample_s = 0 time is continuous.
    """
    if sample_s == 0.0:
        return t
    return (math.ceil(t / sample_s - GUARD_SAMPLES) - 0.5) * sample_s


@borrowing
def replica_at(line: Any, t: float) -> tuple[float, float]:
    """Code [chips] and carrier [cycles] of the replica."""
    dt = t - line[0]
    return line[1] + line[2] * dt, line[3] + dt * (line[4] + 0.5 * line[5] * dt)


@borrowing
def fill_truth(
    t_s: np.ndarray, code: np.ndarray, carrier: np.ndarray, gain: np.ndarray, spread: np.ndarray,
    table: np.ndarray,
) -> None:  # fmt: skip
    """Rows of `TRUTH_COLUMNS`, of all channels piece by piece: an epoch reads a few pieces."""
    for p in range(table.shape[0]):
        for i in range(table.shape[1]):
            row = table[p, i]
            row[0], row[1] = t_s[p], t_s[p + 1]
            for k in range(4):
                row[CODE + k] = code[i, p, k]
                row[CARRIER + k] = carrier[i, p, k]
            row[AMPLITUDE], row[SPREAD] = gain[i, p], spread[i, p]


@borrowing
def truth_piece(truth: np.ndarray, i: int, t: float) -> int:
    """Piece of the truth (n_piece, n_channel, TRUTH_COLUMNS) that holds t; nodes are uniform."""
    last = truth.shape[0] - 1
    p = int((t - truth[0, i, 0]) / (truth[0, i, 1] - truth[0, i, 0]))
    p = min(max(p, 0), last)
    if p < last and t >= truth[p, i, 1]:
        p += 1
    if p > 0 and t < truth[p, i, 0]:
        p -= 1
    return p


@borrowing
def integrate(
    i: int, a: float, b: float, line: Any, truth: np.ndarray, data: Any, replicas: Any,
    sums: np.ndarray, sample_s: float,
) -> None:  # fmt: skip
    """Add int sqrt(C/N0) D R(e + d) exp(j 2 pi phi) dt over [a, b) to sums[i]: I, Q of each tap.

    ``data`` is (symbols, first symbol, chips per symbol (n_channel,)), ``replicas`` the offsets
    and the first fields of a `correlations.Correlations`.
    """
    symbols, first_symbol, symbol_chips = data
    p = truth_piece(truth, i, a)
    last = truth.shape[0] - 1
    while a < b:
        stop = min(b, truth[p, i, 1]) if p < last else b
        if truth[p, i, AMPLITUDE] > 0.0:
            at_stop = _cubic(truth, i, p, CODE, stop)[0]
            k = math.floor(_cubic(truth, i, p, CODE, a)[0] / symbol_chips[i])
            while a < stop:
                cut = stop
                if at_stop > (k + 1) * symbol_chips[i]:
                    at = _time_of(truth, i, p, float((k + 1) * symbol_chips[i]))
                    cut = min(max(edge(at, sample_s), a), stop)
                gain = truth[p, i, AMPLITUDE] * symbols[i, k - first_symbol]
                _between_symbols(i, a, cut, line, truth, p, gain, replicas, sums)
                a = cut
                k += 1
        a = stop
        p += 1


@borrowing
def _cubic(truth: np.ndarray, i: int, p: int, column: int, t: float) -> Any:
    """The cubic in s of code or carrier at t + s."""
    h = t - truth[p, i, 0]
    c0, c1 = truth[p, i, column], truth[p, i, column + 1]
    c2, c3 = truth[p, i, column + 2], truth[p, i, column + 3]
    bend = c2 + 3.0 * h * c3
    return c0 + h * (c1 + h * (c2 + h * c3)), c1 + h * (c2 + bend), bend, c3


@borrowing
def _value(c: Any, s: float) -> float:
    return c[0] + s * (c[1] + s * (c[2] + s * c[3]))


@borrowing
def _time_of(truth: np.ndarray, i: int, p: int, chips: float) -> float:
    """When the true code phase, almost straight, is ``chips``: Newton from the chord."""
    t = truth[p, i, 0]
    for _ in range(3):
        code = _cubic(truth, i, p, CODE, t)
        t += (chips - code[0]) / code[1]
    return t


@borrowing
def _errors(truth: np.ndarray, i: int, p: int, line: Any, t: float) -> Any:
    """Cubics in s of code error [chips] and phase error [cycles] at t + s."""
    c, phi = _cubic(truth, i, p, CODE, t), _cubic(truth, i, p, CARRIER, t)
    code, carrier = replica_at(line, t)
    freq = line[4] + line[5] * (t - line[0])
    cycles = phi[0] - carrier
    return (
        (c[0] - code, c[1] - line[2], c[2], c[3]),
        (cycles - math.floor(cycles), phi[1] - freq, phi[2] - 0.5 * line[5], phi[3]),
    )


@borrowing
def _between_symbols(
    i: int, a: float, b: float, line: Any, truth: np.ndarray, p: int, gain: float, replicas: Any,
    sums: np.ndarray,
) -> None:  # fmt: skip
    """`integrate` with one symbol in one piece.

    Between kinks R(e + d) is straight, so two moments serve all taps: int w and int (e - e_mid) w.
    """
    offset_chips, table, first, period, per_chip = replicas
    steps, length = float(per_chip[i]), period[i]
    while a < b:
        stop = b
        e, phi = _errors(truth, i, p, line, 0.5 * (a + b))
        part = _to_kink(_value(e, 0.5 * (a - b)), _value(e, 0.5 * (b - a)), offset_chips, steps)
        if part < 1.0:
            stop = a + part * (b - a)
            stop = stop if stop > a else b
            e, phi = _errors(truth, i, p, line, 0.5 * (a + stop))
        zero, one = _moments(0.5 * (stop - a), e, phi)
        for k in range(offset_chips.size):
            x = steps * (e[0] + offset_chips[k])
            lag = math.floor(x)
            j = first[i] + lag
            if lag < 0 or lag >= length:
                j -= length * (lag // length)
            slope = table[j + 1] - table[j]
            level, slope = gain * (table[j] + slope * (x - lag)), gain * slope * steps
            sums[i, 2 * k] += level * zero.real + slope * one.real
            sums[i, 2 * k + 1] += level * zero.imag + slope * one.imag
        a = stop


@borrowing
def _to_kink(first: float, last: float, offset_chips: np.ndarray, steps: float) -> float:
    """Part of the way from code error ``first`` to ``last`` to a tap's first kink, or 1.

    Kinks of R are ``steps`` to a chip.  The way is taken as straight: within 5 ms it bends by less
    than 1e-5 chip even at 100 g, and what is left after a cut is cut again.
    """
    part = 1.0
    change = steps * (last - first)
    for k in range(offset_chips.size):
        lag = steps * (first + offset_chips[k])
        if change > 0.0:
            way = math.floor(lag + _KINK_CHIPS) + 1.0 - lag
        else:
            way = math.ceil(lag - _KINK_CHIPS) - 1.0 - lag
        if abs(way) + _KINK_CHIPS < abs(change):
            part = min(part, way / change)
    return part


@borrowing(fastmath=FAST_SUM)
def _moments(half: float, e: Any, phi: Any) -> tuple[complex, complex]:
    """int w ds and int (e - e_0) w ds over [-half, half), w = exp(j 2 pi phi): 8-point rule."""
    cycles = 2.0 * max(abs(_value(phi, -half) - phi[0]), abs(_value(phi, half) - phi[0]))
    n = 1 + int(cycles / _MAX_CYCLES)
    part = half / n
    weight = part * load(_WEIGHT, 0)
    zero_c, zero_s, one_c, one_s = fill(0.0), fill(0.0), fill(0.0), fill(0.0)
    for k in range(n):
        s = part * load(_NODE, 0) + (2 * k + 1 - n) * part
        phase = phi[0] + s * (phi[1] + s * (phi[2] + s * phi[3]))
        sine, cosine = sin_cos((2.0 * math.pi) * phase)
        sine, cosine = weight * sine, weight * cosine
        drift = s * (e[1] + s * (e[2] + s * e[3]))
        zero_c += cosine
        zero_s += sine
        one_c += drift * cosine
        one_s += drift * sine
    return complex(total(zero_c), total(zero_s)), complex(total(one_c), total(one_s))
