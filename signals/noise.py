"""Counter-based Gaussian noise: a sample depends on its stream and its number, nothing else.

Philox4x32-10 (Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3",
SC11) turns a 64-bit key and a 128-bit counter into 128 random bits; Box and Muller (1958) make
them normal.  No state is kept, hence any block size, order or number of threads gives the same
bits.  Streams are told apart by their key, a hash of the run's seed and the stream's name.
"""

from __future__ import annotations

import hashlib
import math
from typing import Any

import numpy as np
from numba.extending import overload

from signals.compiled import kernel
from signals.elementary import cos_sin, log, wrap
from signals.elementary_double import normal_pair
from signals.noise_lanes import rows_16, rows_64
from signals.vectors import Avx2, Avx512, Body

CELL = 1024
"""Samples in a cell of `complex_gaussian_cell`"""


def stream_key(seed: int, name: str) -> np.ndarray:
    """Philox key (2,) uint32 of the stream ``name`` of a run with ``seed``."""
    digest = hashlib.blake2b(f"{_checked(seed)}/{name}".encode(), digest_size=8).digest()
    return np.frombuffer(digest, dtype="<u4").astype(np.uint32)


def generator(seed: int, name: str) -> np.random.Generator:
    """numpy Generator (Philox4x64) of the stream ``name`` of a run with ``seed``."""
    digest = hashlib.blake2b(f"{_checked(seed)}/{name}".encode(), digest_size=16).digest()
    return np.random.Generator(np.random.Philox(key=np.frombuffer(digest, dtype="<u8")))


def _checked(seed: int) -> int:
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed is {seed!r}: expected an integer >= 0")
    return int(seed)


# ---- kernels ---------------------------------------------------------------------------------

_M0, _M1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_W0, _W1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_LOW = np.uint64(0xFFFFFFFF)
_32 = np.uint64(32)
_F = np.float32
_UNIT = _F(2.0**-32)
_HALF, _MINUS_TWO = _F(0.5), _F(-2.0)


@kernel(inline="always")
def philox(c0: Any, c1: Any, c2: Any, c3: Any, k0: Any, k1: Any) -> tuple[Any, Any, Any, Any]:
    """Four random 32-bit words of a counter (c0..c3) and a key (k0, k1): Philox4x32-10.

    32-bit words are held in uint64, so that no product overflows and plain Python agrees.
    """
    c0, c1, c2, c3 = np.uint64(c0), np.uint64(c1), np.uint64(c2), np.uint64(c3)
    k0, k1 = np.uint64(k0), np.uint64(k1)
    for _ in range(10):
        p0 = _M0 * c0
        p1 = _M1 * c2
        c0 = (p1 >> _32) ^ c1 ^ k0
        c1 = p1 & _LOW
        c2 = (p0 >> _32) ^ c3 ^ k1
        c3 = p0 & _LOW
        k0 = (k0 + _W0) & _LOW
        k1 = (k1 + _W1) & _LOW
    return c0, c1, c2, c3


@kernel(inline="always")
def _box_muller(w0: Any, w1: Any, scale: Any) -> tuple[Any, Any]:
    """Two normals of two words, float32; the 32-bit uniform in the log reaches 6.7 sigma."""
    u = (_F(np.uint32(w0)) + _HALF) * _UNIT
    radius = scale * _F(math.sqrt(_MINUS_TWO * log(u)))
    c, s = cos_sin(wrap(np.int64(w1)))
    return radius * c, radius * s


def gaussian_rows(body: Body, counter: int, key: Any, scale: Any, rows: Any) -> None:
    """Normals of rms ``scale`` (float32) into four rows (n,) float32; from a kernel or Python.

    Element j of each row comes from counter ``counter + j``; ``key`` is two words.  n is a
    multiple of 64 and counters are taken in groups that do not cross a multiple of 2^32.
    """
    _rows_plain(counter, key, scale, rows)


@overload(gaussian_rows, strict=False, inline="always")
def _gaussian_rows(body: Any, counter: Any, key: Any, scale: Any, rows: Any) -> Any:
    if body.instance_class is Avx512:
        return lambda body, counter, key, scale, rows: _rows_avx512(counter, key, scale, rows)
    if body.instance_class is Avx2:
        return lambda body, counter, key, scale, rows: _rows_avx2(counter, key, scale, rows)
    return lambda body, counter, key, scale, rows: _rows_plain(counter, key, scale, rows)


@kernel
def _rows_avx512(counter: int, key: Any, scale: Any, rows: Any) -> None:
    words = counter & 0xFFFFFFFF, counter >> 32
    for j in range(0, rows[0].shape[0], 64):
        rows_64(words, key, scale, rows, j)


@kernel
def _rows_avx2(counter: int, key: Any, scale: Any, rows: Any) -> None:
    words = counter & 0xFFFFFFFF, counter >> 32
    for j in range(0, rows[0].shape[0], 16):
        rows_16(words, key, scale, rows, j)


@kernel
def _rows_plain(counter: int, key: Any, scale: Any, rows: Any) -> None:
    k0, k1 = np.uint64(key[0]), np.uint64(key[1])
    first = np.uint64(counter)
    high, first = first >> _32, first & _LOW
    a, b, c, d = rows
    for j in range(a.shape[0]):
        w0, w1, w2, w3 = philox(first + np.uint64(j), high, 0, 0, k0, k1)
        a[j], b[j] = _box_muller(w0, w1, scale)
        c[j], d[j] = _box_muller(w2, w3, scale)


@kernel
def complex_gaussian_cell(body: Body, key: Any, cell: int, i: np.ndarray, q: np.ndarray) -> None:
    """Unit normals of samples cell * CELL ... + CELL - 1 into float32 ``i`` and ``q`` (CELL,).

    Sample j < CELL / 2 is words 0 and 1 of counter cell * CELL / 2 + j, the sample half a cell
    later words 2 and 3.
    """
    half = CELL // 2
    words = np.int64(key[0]), np.int64(key[1])
    gaussian_rows(body, cell * half, words, _F(1.0), (i[:half], q[:half], i[half:], q[half:]))


@kernel
def complex_gaussian(body: Body, key: np.ndarray, n0: int, out: np.ndarray) -> None:
    """Unit complex normals of samples n0 ... n0 + n - 1 into ``out`` (n, 2) float32: I, Q.

    ``key`` is (2,) uint32 (`stream_key`); I and Q have variance 1 each.  The bits depend neither
    on n0 and n nor on the ``body``.
    """
    i, q = np.empty(CELL, np.float32), np.empty(CELL, np.float32)
    n1, flat = n0 + out.shape[0], out.reshape(-1)
    for cell in range(n0 // CELL, (n1 + CELL - 1) // CELL):
        complex_gaussian_cell(body, key, cell, i, q)
        start = cell * CELL
        a, b = max(n0, start), min(n1, start + CELL)
        interleave(i[a - start : b - start], q[a - start : b - start], flat[2 * (a - n0) :])


@kernel
def interleave(i: np.ndarray, q: np.ndarray, out: np.ndarray) -> None:
    """I, Q, I, Q ... into the first elements of ``out``."""
    for k in range(i.shape[0]):
        out[2 * k] = i[k]
        out[2 * k + 1] = q[k]


@kernel
def normals(key0: int, key1: int, c0: int, c1: int, c2: int, c3_base: int, out: np.ndarray) -> None:
    """Standard normals into ``out`` (n,) float64, keyed by (key0, key1; c0, c1, c2, c3_base).

    Four per counter: element m comes from c3 = c3_base + m // 4.  Counter words are taken modulo
    2^32.
    """
    n = out.shape[0]
    for m in range(0, n, 4):
        w0, w1, w2, w3 = philox(
            np.uint64(c0) & _LOW,
            np.uint64(c1) & _LOW,
            np.uint64(c2) & _LOW,
            np.uint64(c3_base + m // 4) & _LOW,
            key0,
            key1,
        )
        _put(out, m, w0, w1)
        if m + 2 < n:
            _put(out, m + 2, w2, w3)


@kernel(inline="always")
def _put(out: np.ndarray, m: int, word0: Any, word1: Any) -> None:
    x, y = normal_pair(word0, word1)
    out[m] = x
    if m + 1 < out.shape[0]:
        out[m + 1] = y
