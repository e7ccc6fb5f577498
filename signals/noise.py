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

from signals.compiled import kernel
from signals.elementary import cos_sin, log, wrap
from signals.elementary_double import normal_pair

CELL = 1024
"""Samples in a cell of `complex_gaussian_cell`: sample j and j + CELL / 2 share a counter"""


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
_HALF, _MINUS_TWO, _ZERO = _F(0.5), _F(-2.0), _F(0.0)


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
def _box_muller(w0: Any, w1: Any) -> tuple[Any, Any]:
    """Two float32 normals of two words; the 32-bit uniform in the log reaches 6.7 sigma."""
    u = (_F(np.uint32(w0)) + _HALF) * _UNIT
    radius = _F(math.sqrt(max(_MINUS_TWO * log(u), _ZERO)))
    c, s = cos_sin(wrap(np.int64(w1)))
    return radius * c, radius * s


@kernel
def complex_gaussian_cell(key: np.ndarray, cell: int, i: np.ndarray, q: np.ndarray) -> None:
    """Unit normals of samples cell * CELL ... + CELL - 1 into float32 ``i`` and ``q`` (CELL,)."""
    k0, k1 = np.uint64(key[0]), np.uint64(key[1])
    half = i.shape[0] // 2
    first = np.uint64(cell) * np.uint64(CELL // 2)
    high = first >> _32
    i0, q0, i1, q1 = i[:half], q[:half], i[half:], q[half:]
    for j in range(half):
        # the lower 9 bits of `first` are zero: no carry into `high`
        w0, w1, w2, w3 = philox((first + np.uint64(j)) & _LOW, high, 0, 0, k0, k1)
        i0[j], q0[j] = _box_muller(w0, w1)
        i1[j], q1[j] = _box_muller(w2, w3)


@kernel
def complex_gaussian(key: np.ndarray, n0: int, out: np.ndarray) -> None:
    """Unit complex normals of samples n0 ... n0 + n - 1 into ``out`` (n, 2) float32: I, Q.

    ``key`` is (2,) uint32 (`stream_key`); I and Q have variance 1 each.
    """
    i, q = np.empty(CELL, np.float32), np.empty(CELL, np.float32)
    n1 = n0 + out.shape[0]
    for cell in range(n0 // CELL, (n1 + CELL - 1) // CELL):
        complex_gaussian_cell(key, cell, i, q)
        start = cell * CELL
        for n in range(max(n0, start), min(n1, start + CELL)):
            out[n - n0, 0] = i[n - start]
            out[n - n0, 1] = q[n - start]


@kernel
def normals(key0: int, key1: int, c0: int, c1: int, c2: int, c3_base: int, out: np.ndarray) -> None:
    """Standard normals into ``out`` (n,) float64, keyed by (key0, key1; c0, c1, c2, c3_base).

    Four per counter: element m comes from c3 = c3_base + m // 4.  Counter words are taken modulo
    2^32.
    """
    n = out.shape[0]
    for block in range((n + 3) // 4):
        words = philox(
            np.uint64(c0) & _LOW,
            np.uint64(c1) & _LOW,
            np.uint64(c2) & _LOW,
            np.uint64(c3_base + block) & _LOW,
            key0,
            key1,
        )
        for pair in range(2):
            m = 4 * block + 2 * pair
            if m < n:
                x, y = normal_pair(words[2 * pair], words[2 * pair + 1])
                out[m] = x
                if m + 1 < n:
                    out[m + 1] = y
