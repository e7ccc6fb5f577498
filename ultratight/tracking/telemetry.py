"""From soft bits to subframes: frame synchronisation, and words that are taken only when sure.

With D29* D30* of the word before, the 30 bits of an LNAV word are a code word of 32 bits (extended
Hamming, IS-GPS-200 20.3.5.2): two words differ in at least 4 places, and 1240 do in just 4.  A bit
of soft value I (amplitude A, noise sigma) is wrong with odds of exp(-lambda), lambda = 2 A |I| /
sigma^2 (Proakis, Digital Communications, 8.1), so that another word than the one whose parities
are right was sent with a probability of at most

    1240 exp(-(sum of the four smallest lambda)),                                             (1)

rarer words at larger distances apart.  A and sigma are those of the word itself, from I and Q, so
that prompts without phase lock weigh nothing: the parities alone would let one in 64 pass.
Complementing all 32 bits of a word changes neither parities nor data: a half-cycle slip costs the
word in which it happens and no other.

A stream is synchronised where telemetry and handover word are right (preamble, parities, the
number of the subframe that belongs to its time of week), and the time of week goes on in another
pair of them or all ten words are right.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.constants import WEEK_S
from signals.lnav_words import BIT_S, PREAMBLE, SUBFRAME_BITS, SUBFRAME_S, Subframe, parity

WORD_BITS = 30
N_WORD = 10
WRONG = 1e-6
"""Probability of a wrong word that is tolerated, equation (1)"""
_NEIGHBOURS = 1240
_SURE = math.log(_NEIGHBOURS / WRONG)
_HEAD_BITS = 2 * WORD_BITS
_WEEK_SUBFRAMES = round(WEEK_S / SUBFRAME_S)
_WEEK_BITS = round(WEEK_S / BIT_S)
_BIT_NOISE2 = 20.0
"""Variance of the noise in each part of a bit's sum of 20 prompts of unit noise"""
_NEVER = 1 << 60
_KNOWN = {False: np.full(2, np.inf + 0j), True: np.full(2, -np.inf + 0j)}
"""D29 D30 before the first word are zeros (20.3.3.5.1.2)"""


class Words(NamedTuple):
    """How the words of a synchronised stream came."""

    right: int = 0
    wrong: int = 0
    """A parity failed"""
    unsure: int = 0
    """Parities right, but the bits are too weak to believe them"""

    def plus(self, other: Words) -> Words:
        """The sum of two counts."""
        return Words(*(a + b for a, b in zip(self, other, strict=True)))


class Mark(NamedTuple):
    """A subframe whose first two words are right."""

    bit: int
    """Number of its first bit"""
    inverted: bool
    """The bits are the complement of what was sent"""
    until: int
    """Number of the bit from which on words are wrong though strong: bits are missing there"""


class Clock(NamedTuple):
    """What a stream says of the time: bit n began to be sent at 0.02 (week_bit + n) s of week."""

    week_bit: int
    """Bit of the week that bit 0 is, by the satellite's clock; may be negative"""
    known_bit: int
    """All bits before this one had to come until it was sure"""
    marks: list[Mark]
    """In order of time"""


class Telemetry(NamedTuple):
    """What one channel's bits hold."""

    clocks: list[Clock]
    """Usually one; another one after a slip of whole code periods"""
    subframes: list[Subframe]
    """Those with ten right words; ``first_bit`` is numbered as the bits are"""
    words: Words


class _Head(NamedTuple):
    bit: int
    inverted: bool
    week_bit: int
    whole: bool
    """All ten words are right"""
    until: int


def read(sums: np.ndarray, numbers: np.ndarray) -> Telemetry:
    """Subframes in the prompts of whole data bits (n,), complex, and the bits' numbers (n,) int.

    Bits that are missing between two numbers make their words wrong.

    Raises
    ------
    ValueError
        Numbers that do not rise, sums that are not finite.
    """
    sums, numbers = np.asarray(sums, complex), np.asarray(numbers, np.int64)
    if sums.shape != numbers.shape or sums.ndim != 1 or not np.isfinite(sums).all():
        raise ValueError(f"sums {sums.shape}, numbers {numbers.shape}: expected (n,) finite each")
    if (np.diff(numbers) < 1).any():
        raise ValueError("numbers of the bits do not rise")
    if not len(sums):
        return Telemetry([], [], Words())
    base = int(numbers[0])
    soft = np.zeros(int(numbers[-1]) - base + 1, complex)
    soft[numbers - base] = sums
    heads = [h for start in _preambles(soft) for h in _head(soft, start)]
    clocks = _apart([c for c in (_clock(g) for g in _groups(heads)) if c is not None])
    subframes: list[Subframe] = []
    words = Words()
    for clock, start in _places(clocks, len(soft)):
        data, count = _subframe(soft, start)
        words = words.plus(count)
        if data is not None:
            subframe = Subframe(base + start, _inverted_at(soft, start), data)
            away = round(subframe.tow_s / BIT_S) - (clock.week_bit + start)
            if away % _WEEK_BITS == 0:
                subframes.append(subframe)
    return Telemetry([_numbered(c, base) for c in clocks], subframes, words)


def word(soft: np.ndarray, previous: np.ndarray) -> tuple[int | None, bool]:
    """Data (24 bits) of a word's soft bits (30,), complex, after those of D29* D30* (2,).

    Returns None where a parity fails or (1) is above `WRONG`; then whether parities were right.
    A ``previous`` of infinite size is known.
    """
    bits = soft.real < 0.0
    before = previous.real < 0.0
    value = int("".join("1" if b else "0" for b in bits), 2)
    last = int(before[0]) << 1 | int(before[1])
    data = value >> 6 ^ (0xFFFFFF if last & 1 else 0)
    if parity(data, last) != value & 0x3F:
        return None, False
    return (data if _is_strong(soft, previous) else None), True


def _is_strong(soft: np.ndarray, previous: np.ndarray) -> bool:
    """Is (1) below `WRONG`?"""
    noise2 = max(_BIT_NOISE2, float(np.mean(soft.imag**2)))
    amplitude = math.sqrt(max(float(np.mean(soft.real**2)) - noise2, 0.0))
    size = np.abs(np.concatenate([previous.real, soft.real]))
    least = float(np.sum(np.partition(size, 4)[:4]))
    return 2.0 * amplitude * least / noise2 > _SURE


def _until(soft: np.ndarray, start: int) -> int:
    """First bit of two words in a row that are wrong though strong, from a subframe's start on.

    A slip of half a cycle spoils one word; where samples were lost all words have moved.
    """
    before = False
    for first in range(start + WORD_BITS, len(soft) - WORD_BITS + 1, WORD_BITS):
        one, previous = soft[first : first + WORD_BITS], soft[first - 2 : first]
        wrong = not word(one, previous)[1] and _is_strong(one, previous)
        if wrong and before:
            return first - WORD_BITS
        before = wrong
    return _NEVER


def _preambles(soft: np.ndarray) -> list[int]:
    """Where eight bits are the preamble or its complement."""
    n = len(soft) - _HEAD_BITS + 1
    if n < 1:
        return []
    bits = (soft.real < 0.0).astype(np.uint8)
    octet: np.ndarray = np.zeros(n, np.uint8)
    for k in range(8):
        octet = octet << 1 | bits[k : k + n]
    found: list[int] = np.flatnonzero((octet == PREAMBLE) | (octet == 0xFF ^ PREAMBLE)).tolist()
    return found


def _inverted_at(soft: np.ndarray, start: int) -> bool:
    return bool(soft[start].real >= 0.0)  # the preamble begins with 1, which is -1


def _head(soft: np.ndarray, start: int) -> list[_Head]:
    """Telemetry and handover word at ``start``, or none."""
    inverted = _inverted_at(soft, start)
    telemetry, _ = word(soft[start : start + WORD_BITS], _KNOWN[inverted])
    second = soft[start + WORD_BITS : start + _HEAD_BITS]
    handover, _ = word(second, soft[start + WORD_BITS - 2 : start + WORD_BITS])
    if telemetry is None or handover is None:
        return []
    ends_in_zeros = not (((second[-2:].real < 0.0) != inverted).any())
    count, number = handover >> 7, handover >> 2 & 7
    begun = (count - 1) % _WEEK_SUBFRAMES
    if not ends_in_zeros or count >= _WEEK_SUBFRAMES or number != begun % 5 + 1:
        return []
    data, _ = _subframe(soft, start)
    week_bit = begun * SUBFRAME_BITS - start
    return [_Head(start, inverted, week_bit, data is not None, _until(soft, start))]


def _subframe(soft: np.ndarray, start: int) -> tuple[int | None, Words]:
    """Data (240 bits) of a subframe if all its words are right, and how they came."""
    data, count, whole = 0, Words(), True
    for k in range(N_WORD):
        first = start + k * WORD_BITS
        if first + WORD_BITS > len(soft):
            return None, count
        previous = _KNOWN[_inverted_at(soft, start)] if k == 0 else soft[first - 2 : first]
        one, parities = word(soft[first : first + WORD_BITS], previous)
        whole = whole and one is not None
        data = data << 24 | (one or 0)
        count = count.plus(Words(int(one is not None), int(not parities),
                                 int(parities and one is None)))  # fmt: skip
    return (data if whole else None), count


def _groups(heads: list[_Head]) -> list[list[_Head]]:
    """Heads that tell the same time, whatever the week."""
    groups: dict[int, list[_Head]] = {}
    for head in heads:
        groups.setdefault(head.week_bit % _WEEK_BITS, []).append(head)
    return list(groups.values())


def _clock(group: list[_Head]) -> Clock | None:
    """Of heads that agree, if they suffice."""
    known = [h.bit + SUBFRAME_BITS for h in group if h.whole]
    known += [second.bit + _HEAD_BITS for second in group[1:2]]
    if not known:
        return None
    marks = [Mark(h.bit, h.inverted, h.until) for h in group]
    return Clock(group[0].week_bit, min(known), marks)


def _apart(clocks: list[Clock]) -> list[Clock]:
    """In order of time, without those in the midst of another one that has more marks."""
    kept = []
    for c in clocks:
        first, last = c.marks[0].bit, c.marks[-1].bit
        if not any(
            len(o.marks) > len(c.marks) and o.marks[0].bit <= last and first <= o.marks[-1].bit
            for o in clocks
        ):
            kept.append(c)
    return sorted(kept, key=lambda c: c.marks[0].bit)


def _places(clocks: list[Clock], n: int) -> list[tuple[Clock, int]]:
    """Where whole subframes begin, n bits in all: those without a mark too."""
    found = []
    before = 0
    for k, clock in enumerate(clocks):
        first = clock.marks[0].bit
        end = clocks[k + 1].marks[0].bit if k + 1 < len(clocks) else n
        first -= (first - before) // SUBFRAME_BITS * SUBFRAME_BITS
        starts = range(first, end - SUBFRAME_BITS + 1, SUBFRAME_BITS)
        found += [(clock, start) for start in starts]
        before = end
    return found


def _numbered(clock: Clock, base: int) -> Clock:
    """The clock for bits whose first one has the number ``base``."""
    marks = [m._replace(bit=m.bit + base, until=m.until + base) for m in clock.marks]
    return Clock(clock.week_bit - base, clock.known_bit + base, marks)
