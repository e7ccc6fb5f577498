"""Words of the GPS LNAV message: parity, telemetry and handover words, subframes in a bit stream.

IS-GPS-200 20.3.3.1-2 (words 1 and 2) and 20.3.5 (parity).  A word is 24 data bits d1 ... d24 and
6 parity bits; d_i goes out as D_i = d_i xor D30*, with D29* D30* the last bits of the word before.
Data are whole numbers with d1 as the highest bit: a word has 24 bits, a subframe 240.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

BIT_S = 0.02
SUBFRAME_S = 6.0
FRAME_S = 30.0
SUBFRAME_BITS = 300
PREAMBLE = 0b10001011
_N_WORD = 10
_SUBFRAME_DATA_BITS = 240
_SUBFRAMES_PER_WEEK = 100_800
_SOLVED = (1, 9)  # words 2 and 10, whose d23 d24 make D29 D30 = 0

# Rows D25 ... D30 of table 20-XIV: 1 if the sum has D30* (else D29*), then the indices of d
_PARITY = (
    (0, (1, 2, 3, 5, 6, 10, 11, 12, 13, 14, 17, 18, 20, 23)),
    (1, (2, 3, 4, 6, 7, 11, 12, 13, 14, 15, 18, 19, 21, 24)),
    (0, (1, 3, 4, 5, 7, 8, 12, 13, 14, 15, 16, 19, 20, 22)),
    (1, (2, 4, 5, 6, 8, 9, 13, 14, 15, 16, 17, 20, 21, 23)),
    (1, (1, 3, 5, 6, 7, 9, 10, 14, 15, 16, 17, 18, 21, 22, 24)),
    (0, (3, 5, 6, 8, 9, 10, 11, 13, 15, 19, 22, 23, 24)),
)
# over d1 ... d24 D29* D30* as one number of 26 bits
_MASKS = tuple(sum(1 << (26 - i) for i in d) | (1 if last else 2) for last, d in _PARITY)


class Subframe(NamedTuple):
    """One subframe that was found in a stream with all ten parities right."""

    first_bit: int
    """Index of its first bit in the stream"""
    inverted: bool
    """The stream is the complement of what was sent (a half-cycle slip of a Costas loop)"""
    data: int
    """240 data bits"""

    @property
    def number(self) -> int:
        """1 to 5 (bits 20-22 of the handover word)."""
        return take(self.data, 2, 20, 3)

    @property
    def tow_s(self) -> float:
        """Time of week at which this subframe began; the handover word names the next one."""
        return ((take(self.data, 2, 1, 17) - 1) % _SUBFRAMES_PER_WEEK) * SUBFRAME_S


def take(data: int, word: int, bit: int, length: int) -> int:
    """Unsigned number in a subframe's data; word and first bit count from 1."""
    return data >> _shift(word, bit, length) & ((1 << length) - 1)


def put(data: int, word: int, bit: int, length: int, value: int) -> int:
    """Data with an unsigned number in its place."""
    mask = (1 << length) - 1
    shift = _shift(word, bit, length)
    return data & ~(mask << shift) | (value & mask) << shift


def _shift(word: int, bit: int, length: int) -> int:
    return _SUBFRAME_DATA_BITS - 24 * (word - 1) - (bit - 1) - length


def parity(data: int, previous: int) -> int:
    """D25 ... D30 of a word of 24 bits; ``previous`` is D29* D30*, a number of 2 bits."""
    whole = data << 2 | previous
    bits = 0
    for mask in _MASKS:
        bits = bits << 1 | (whole & mask).bit_count() & 1
    return bits


def with_telemetry_and_handover(data: int, number: int, tow_s: float) -> int:
    """Fill words 1 and 2 of subframe ``number`` (1 to 5) that begins at ``tow_s``.

    The telemetry message, for authorised users, is zero; anti-spoofing is on, as it has been on
    all satellites since 1994; no alert.
    """
    data = put(data, 1, 1, 24, PREAMBLE << 16)
    count = (round(tow_s / SUBFRAME_S) + 1) % _SUBFRAMES_PER_WEEK
    return put(data, 2, 1, 24, count << 7 | 1 << 5 | number << 2)


def encode_subframe(data: int) -> np.ndarray:
    """Bits as transmitted, (300,) int8 of 0 and 1, after a word that ended in D29 D30 = 0."""
    sent = 0
    previous = 0
    for k in range(_N_WORD):
        word = take(data, k + 1, 1, 24)
        if k in _SOLVED:
            word &= ~3
            word |= next(t for t in range(4) if parity(word | t, previous) & 3 == 0)
        check = parity(word, previous)
        if previous & 1:
            word ^= 0xFFFFFF
        sent = sent << 30 | word << 6 | check
        previous = check & 3
    packed = np.frombuffer((sent << 4).to_bytes(38, "big"), np.uint8)
    return np.unpackbits(packed)[:SUBFRAME_BITS].view(np.int8)


def decode_subframe(bits: np.ndarray) -> int | None:
    """Data (240 bits) of (300,) bits of 0 and 1 that begin a subframe; None: a parity fails."""
    sent = int.from_bytes(np.packbits(bits.astype(np.uint8)).tobytes(), "big") >> 4
    data = 0
    previous = 0
    for k in range(_N_WORD):
        received = sent >> 30 * (_N_WORD - 1 - k) & 0x3FFFFFFF
        word = received >> 6
        if previous & 1:
            word ^= 0xFFFFFF
        if parity(word, previous) != received & 0x3F:
            return None
        data = data << 24 | word
        previous = received & 3
    return data


def find_subframes(bits: np.ndarray) -> list[Subframe]:
    """Find the whole subframes in a stream that begins anywhere and may be inverted.

    Parameters
    ----------
    bits : (n,) of +-1
        As received, logical 0 is +1.

    Returns
    -------
    In order of time; a subframe counts when preamble, number (1-5) and all ten parities are right.

    Raises
    ------
    ValueError
        The bits are not a row of +-1.
    """
    bits = np.asarray(bits)
    if bits.ndim != 1 or not (np.abs(bits) == 1).all():
        raise ValueError(f"bits are {bits.dtype} {bits.shape}: expected (n,) of +1 and -1")
    logical = (bits < 0).astype(np.uint8)
    n_start = len(logical) - SUBFRAME_BITS + 1
    if n_start < 1:
        return []
    octet: np.ndarray = np.zeros(n_start, dtype=np.uint8)
    for k in range(8):
        octet = octet << 1 | logical[k : k + n_start]
    found: list[Subframe] = []
    free = 0
    for start in np.flatnonzero((octet == PREAMBLE) | (octet == 0xFF ^ PREAMBLE)).tolist():
        if start < free:
            continue
        inverted = int(octet[start]) != PREAMBLE
        data = decode_subframe(logical[start : start + SUBFRAME_BITS] ^ inverted)
        if data is None:
            continue
        subframe = Subframe(start, inverted, data)
        if 1 <= subframe.number <= 5:
            found.append(subframe)
            free = start + SUBFRAME_BITS
    return found
