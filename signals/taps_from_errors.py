"""Taps of many integrations at once from constant errors of the replica: for Monte Carlo studies.

Equation (1) of `correlator_model` with delay error e, frequency error f and the phase error phi at
the middle held constant has the closed form

    X_d = sqrt(2 C/N0 T) R(e + d) sinc(f T) exp(j 2 pi phi) + n_d

(Kaplan & Hegarty, 3rd ed., ch. 8), with the same R and the same noise n_d: unit variance in each
of I and Q, covariance R(d_i - d_k).  Discriminators and loops can so be run over millions of
integrations; see `correlator_model` for commands, trajectories and data symbols.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from signals.compiled import borrowing
from signals.correlations import Correlations, correlations_of, tap_factor
from signals.elementary_double import cos_sin, normal_pair
from signals.noise import philox, stream_key
from signals.replica import Replicas

_LARGEST = 1e9
"""Most chips, cycles, Hz or s in size: beyond, a double has no 1e-7 chip or cycle left"""
_HIGHEST_DBHZ = 300.0
_BLOCK = 256
"""Integrations at a time: what a block needs stays in the first-level cache"""


def taps_from_errors(
    delay_chips: ArrayLike,
    phase_cycles: ArrayLike,
    freq_hz: ArrayLike,
    cn0_dbhz: ArrayLike,
    duration_s: ArrayLike,
    chips: np.ndarray | Replicas | Correlations,
    offset_chips: ArrayLike,
    *,
    seed: int | None = None,
    stream: str = "taps-from-errors",
    channel: ArrayLike = 0,
    number: ArrayLike | None = None,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Complex taps (..., n_tap) in units of the noise's standard deviation in each of I and Q.

    Parameters
    ----------
    delay_chips, phase_cycles, freq_hz
        Errors, true minus replica; the phase is that at the middle.  They broadcast together, and
        with all that follows.
    cn0_dbhz, duration_s
        C/N0 [dB-Hz], at most 300, and length of the integrations [s].
    chips : (1, length) int8 of +-1, `replicas` or `correlations` of one signal
    offset_chips : (n_tap,)
        Delay of each replica: negative is early, positive is late.
    seed, stream
        Noise is drawn from this named stream; without a seed there is none.
    channel, number
        Whole numbers that key the noise of each integration: channel below 65536, and the number
        of the integration (default: the position in the flattened result).
    out : (..., n_tap) complex128, contiguous, optional
        Where the taps go; fresh memory costs the system as much as the sums do.

    Raises
    ------
    ValueError
        Errors that are not finite or beyond 1e9 in size, durations that are not positive, more
        than one signal, keys out of range, an ``out`` that does not fit.
    """
    offset = np.ascontiguousarray(offset_chips, dtype=np.float64)
    if offset.ndim != 1 or not np.all(np.abs(offset) <= _LARGEST):
        raise ValueError(
            f"offset_chips is {offset_chips!r}: expected (n_tap,) of at most {_LARGEST:g} in size"
        )
    own, factor = _correlation_of(chips, offset)
    given = [np.asarray(x, np.float64) for x in (delay_chips, phase_cycles, freq_hz, duration_s)]
    cn0 = np.asarray(cn0_dbhz, np.float64)
    keys = [np.asarray(channel), np.asarray(0 if number is None else number)]
    shape = np.broadcast_shapes(*(x.shape for x in (*given, cn0, *keys)))
    for name, x in zip(
        ("delay_chips", "phase_cycles", "freq_hz", "duration_s"), given, strict=True
    ):
        least = math.ulp(0.0) if name == "duration_s" else -_LARGEST
        if not x.size or least <= x.min() <= x.max() <= _LARGEST:
            continue
        far = ~(np.abs(x) <= _LARGEST) | (x <= 0.0 if name == "duration_s" else False)
        if far.any():
            kind = "positive numbers up to" if name == "duration_s" else "numbers of at most"
            raise ValueError(f"{name} contains {x[far].flat[0]}: expected {kind} {_LARGEST:g}")
    wrong = ~(np.isfinite(cn0) & (cn0 <= _HIGHEST_DBHZ))
    if wrong.any():
        raise ValueError(
            f"cn0_dbhz contains {cn0[wrong].flat[0]}: expected up to {_HIGHEST_DBHZ:g} dB-Hz"
        )
    for name, x, end in (("channel", keys[0], 2**16), ("number", keys[1], 2**63)):
        if x.dtype.kind not in "iu" or (x.size and not 0 <= int(x.min()) <= int(x.max()) < end):
            raise ValueError(f"{name}: expected whole numbers from 0 to {end - 1}")
    n = math.prod(shape)
    amplitude = np.sqrt(2.0 * 10.0 ** (0.1 * cn0) * given[3])
    reals = [_flat(x, shape, np.float64) for x in (*given, amplitude)]
    named = _flat(keys[0], shape, np.int64)
    numbered = np.arange(n) if number is None else _flat(keys[1], shape, np.int64)
    key = (0, 0) if seed is None else stream_key(seed, stream)
    result = np.empty((*shape, offset.size), np.complex128) if out is None else out
    if result.shape != (*shape, offset.size) or result.dtype != np.complex128:
        raise ValueError(f"out: expected complex128 of shape {(*shape, offset.size)}")
    if not (result.flags.c_contiguous and result.flags.writeable):
        raise ValueError("out: expected a contiguous array that can be written")
    _all(
        *reals, named, numbered, own.table, float(own.period[0]), float(own.per_chip[0]),
        math.sqrt(own.kept[0]), offset, factor, int(key[0]), int(key[1]),
        seed is not None, np.empty((11 + 4 * ((offset.size + 1) // 2), _BLOCK)),
        np.empty((6, _BLOCK), np.uint64), result.view(np.float64).reshape(n, 2 * offset.size),
    )  # fmt: skip
    return result


def _correlation_of(
    chips: np.ndarray | Replicas | Correlations, offset: np.ndarray
) -> tuple[Correlations, np.ndarray]:
    """Correlation of the one signal and the factor of its taps' noise."""
    if isinstance(chips, np.ndarray) and chips.ndim == 2 and len(chips) == 1:
        # a call in a loop over blocks: the spectrum of the code would cost as much as the block
        return _of_row(chips.tobytes(), chips.dtype.str, offset.tobytes())
    own = correlations_of(chips)
    if len(own.first) != 1:
        raise ValueError(f"chips of {len(own.first)} signals: expected one")
    return own, tap_factor(own, 0, offset)


@lru_cache(maxsize=64)
def _of_row(row: bytes, kind: str, offset: bytes) -> tuple[Correlations, np.ndarray]:
    own = correlations_of(np.frombuffer(row, kind)[None])
    return own, tap_factor(own, 0, np.frombuffer(offset))


def _flat(x: np.ndarray, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """(1,) of what is the same for all, else (n,)."""
    x = x if x.size == 1 else np.broadcast_to(x, shape)
    # writable too: numba compiles anew for arrays that are not
    return np.require(x, dtype, ["C", "W"]).reshape(-1)


# ---- kernels ---------------------------------------------------------------------------------

_LOW, _32, _16, _1 = np.uint64(0xFFFFFFFF), np.uint64(32), np.uint64(16), np.uint64(1)
_FMA = {"contract"}


@borrowing
def _all(
    delay: np.ndarray, phase: np.ndarray, freq: np.ndarray, duration: np.ndarray,
    amplitude: np.ndarray, channel: np.ndarray, number: np.ndarray, table: np.ndarray,
    period: float, per_chip: float, kept: float, offset: np.ndarray, factor: np.ndarray, key0: int,
    key1: int, noisy: bool, work: np.ndarray, words: np.ndarray, iq: np.ndarray,
) -> None:  # fmt: skip
    """iq (n, 2 n_tap) block by block; ``work`` and ``words`` have rows of a block's length."""
    re, im, low, part, i, q = work[0], work[1], work[2], work[3], work[4], work[5]
    normal, name, count = work[11:], words[4], words[5]
    n = iq.shape[0]
    for a in range(0, n, _BLOCK):
        m = min(_BLOCK, n - a)
        _load(delay, a, work[6, :m])
        _load(phase, a, work[7, :m])
        _load(freq, a, work[8, :m])
        _load(duration, a, work[9, :m])
        _load(amplitude, a, work[10, :m])
        _phasor(work[7, :m], work[8, :m], work[9, :m], work[10, :m], kept, re, im)
        if noisy:
            _load(channel, a, name[:m])
            _load(number, a, count[:m])
            for k in range(0, normal.shape[0], 4):
                _words(key0, key1, name[:m], count[:m], k // 4, words)
                _normals(words[0], words[1], normal[k, :m], normal[k + 1, :m])
                if k + 2 < 2 * offset.size:
                    _normals(words[2], words[3], normal[k + 2, :m], normal[k + 3, :m])
        for k in range(offset.size):
            _correlation(work[6, :m], offset[k], per_chip, period, table, low, part)
            for j in range(m):
                i[j] = part[j] * re[j]
                q[j] = part[j] * im[j]
            if noisy:
                for r in range(k + 1):
                    _add(factor[k, r], normal[2 * r, :m], normal[2 * r + 1, :m], i, q)
            for j in range(m):
                iq[a + j, 2 * k] = i[j]
                iq[a + j, 2 * k + 1] = q[j]


@borrowing
def _load(x: np.ndarray, a: int, out: np.ndarray) -> None:
    """x[a : a + out.size], or the one number of x."""
    if x.size == 1:
        for j in range(out.size):
            out[j] = x[0]
    else:
        for j in range(out.size):
            out[j] = x[a + j]


@borrowing(fastmath=_FMA)
def _phasor(
    phase: np.ndarray, freq: np.ndarray, duration: np.ndarray, amplitude: np.ndarray, kept: float,
    re: np.ndarray, im: np.ndarray,
) -> None:  # fmt: skip
    """amplitude sinc(f T) exp(j 2 pi phi)."""
    for j in range(phase.size):
        c, s = cos_sin(phase[j])
        half_turns = freq[j] * duration[j]
        _, sine = cos_sin(0.5 * half_turns)
        x = math.pi * half_turns
        sinc = sine / x if abs(x) > 1e-4 else 1.0 - x * x / 6.0
        gain = kept * amplitude[j] * sinc
        re[j] = gain * c
        im[j] = gain * s


@borrowing
def _words(
    key0: int, key1: int, channel: np.ndarray, number: np.ndarray, block: int, words: np.ndarray
) -> None:
    """Four words of each integration: as `noise.normals` draws them for a dump."""
    w0, w1, w2, w3 = words[0], words[1], words[2], words[3]
    k0, k1, part = np.uint64(key0), np.uint64(key1), np.uint64(block)
    for j in range(number.size):
        c, name = number[j], (channel[j] << _16) + part
        w0[j], w1[j], w2[j], w3[j] = philox(c & _LOW, c >> _32, 0, name, k0, k1)


@borrowing(fastmath=_FMA)
def _normals(w0: np.ndarray, w1: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    for j in range(x.size):
        x[j], y[j] = normal_pair(w0[j], w1[j])


@borrowing(fastmath=_FMA)
def _correlation(
    delay: np.ndarray, offset: float, per_chip: float, period: float, table: np.ndarray,
    low: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """R(delay + offset): straight between its tabulated lags."""
    per_period = 1.0 / period
    for j in range(delay.size):
        x = per_chip * (delay[j] + offset)
        lag = np.floor(x)
        # the guard keeps a whole number of periods from rounding to one less
        low[j] = lag - period * np.floor((lag + 0.5) * per_period)
        out[j] = x - lag
    for j in range(delay.size):
        k = np.uint64(low[j])
        level = table[k]
        out[j] = level + out[j] * (table[k + _1] - level)


@borrowing(fastmath=_FMA)
def _add(gain: float, x: np.ndarray, y: np.ndarray, i: np.ndarray, q: np.ndarray) -> None:
    for j in range(x.size):
        i[j] += gain * x[j]
        q[j] += gain * y[j]
