"""Frame synchronisation and words: real subframes, the code's own distances, statistics, slips."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from signals.lnav_words import encode_subframe, parity, with_telemetry_and_handover
from signals.navigation_message import constellation_of, lnav_bits
from signals.satellites import embedded
from ultratight.tracking.telemetry import N_WORD, Telemetry, read, word

REAL = json.loads(
    (Path(__file__).parents[1] / "authorities" / "lnav_prn4_week_1869.json").read_text()
)
WEEK, TOW = 2149, 475_200.0


def soft(bits: np.ndarray, cn0_dbhz: float, rng: np.random.Generator) -> np.ndarray:
    """Sums of 20 prompts of unit noise of bits of +-1."""
    amplitude = 20.0 * np.sqrt(2.0 * 10 ** (cn0_dbhz / 10) * 1e-3)
    noise = rng.standard_normal((2, len(bits))) * np.sqrt(20.0)
    return amplitude * bits + noise[0] + 1j * noise[1]


def stream(n_bits: int, cn0_dbhz: float = 45.0, first: float = TOW + 10.0) -> np.ndarray:
    """Of PRN 2, from 10 s after the start of a frame."""
    rng = np.random.default_rng(n_bits)
    return soft(lnav_bits(embedded(), 2, WEEK, first, n_bits), cn0_dbhz, rng)


def heard(z: np.ndarray, base: int = 0) -> Telemetry:
    return read(z, base + np.arange(len(z)))


def real_bits(name: str, number: int, tow_s: float) -> np.ndarray:
    """A real subframe's words 3-10, the heads being of one time line."""
    words = REAL["subframes"][name]
    data = int("".join(f"{int(w, 16) >> 6:06x}" for w in words), 16)
    return 1.0 - 2.0 * encode_subframe(with_telemetry_and_handover(data, number, tow_s))


def test_a_stream_that_begins_anywhere():
    """From 10 s of a frame: 4 s lost to the rest of subframe 2, then 3, 4, 5, 1 whole in 28 s."""
    told = heard(stream(1400), 5000)
    (clock,) = told.clocks
    assert (clock.week_bit + 5000) * 0.02 == pytest.approx(TOW + 10.0)
    assert [s.number for s in told.subframes] == [3, 4, 5, 1]
    assert [s.first_bit - 5000 for s in told.subframes] == [100, 400, 700, 1000]
    assert [s.tow_s for s in told.subframes] == [TOW + 12.0 + 6.0 * k for k in range(4)]
    assert told.words == (4 * N_WORD, 0, 0)
    assert clock.known_bit == 5000 + 400  # ten words
    assert [m.bit - 5000 for m in clock.marks] == [100, 400, 700, 1000, 1300]


def test_one_subframe_is_enough_two_words_are_not():
    told = heard(stream(420))
    assert told.clocks[0].known_bit == 400
    assert not heard(stream(399)).clocks


def test_real_subframes_give_the_published_elements():
    """gnsstk's subframes of PRN 4, week 1869, and what it reads in them."""
    bits = np.concatenate([real_bits(str(k + 1), k + 1, 6.0 * k) for k in range(3)])
    told = heard(-soft(bits, 40.0, np.random.default_rng(1)))
    assert all(s.inverted for s in told.subframes)
    sky = constellation_of({4: told.subframes}, 1900)
    expected = REAL["decoded"]
    assert (sky.prn[0], sky.week[0], sky.iode[0]) == (4, 1869, expected["iode"])
    row = sky.elements[0].tolist()
    for name, value in zip(("toe", "toc", "sqrtA", "e", "M0"), row, strict=False):
        assert value == pytest.approx(expected[name], rel=1e-15)


def test_a_half_cycle_slip_costs_the_words_it_touches():
    """In word 5 of a subframe: all others are right, and what follows is known to be inverted."""
    z = stream(1400)
    slip = 400 + 4 * 30 + 11
    z[slip:] *= -1.0
    told = heard(z)
    (clock,) = told.clocks
    assert told.words == (39, 1, 0)
    assert [s.number for s in told.subframes] == [3, 5, 1]
    assert [m.inverted for m in clock.marks] == [False, False, True, True, True]


def test_a_second_handover_word_settles_a_time_that_ten_words_do_not():
    z = stream(1400)
    z[350] *= -1.0  # word 9 of subframe 3
    assert heard(z).clocks[0].known_bit == 400 + 60
    assert not heard(z[:459]).clocks
    assert heard(z[:460]).clocks[0].known_bit == 460


def test_missing_and_damaged_bits_are_never_believed():
    z = stream(1400)
    keep = np.ones(1400, bool)
    keep[[215, 216, 217]] = False  # word 4 of subframe 3
    z[751] *= -1.0  # word 2 of subframe 5: its head is gone, its place is known
    told = read(z[keep], np.arange(1400)[keep])
    assert told.words.right == 38
    assert told.words.wrong + told.words.unsure == 2
    assert [s.number for s in told.subframes] == [4, 1]
    assert [m.bit for m in told.clocks[0].marks] == [100, 400, 1000, 1300]


def test_slip_of_bits_begins_a_new_time():
    """A code that slips by a period of bits: two clocks, 7 bits apart, each with its subframes."""
    z = np.concatenate([stream(1000), stream(1900)[1007:]])
    told = heard(z)
    first, second = told.clocks
    assert second.week_bit - first.week_bit == 7
    assert [s.number for s in told.subframes] == [3, 4, 5, 2, 3]


def test_time_is_not_believed_where_bits_went_missing_until_a_head_says_it_anew():
    """One bit lost in word 5 of a subframe: from that word on all are wrong, though strong; the
    next two heads tell a time that is one bit later.  A half-cycle slip costs nothing."""
    whole = stream(2500)
    z = np.delete(whole, 1000 + 4 * 30 + 7)
    first, second = heard(z, 40).clocks
    assert second.week_bit - first.week_bit == 1
    assert {m.until for m in first.marks} == {40 + 1000 + 4 * 30}
    assert min(m.until for m in second.marks) > 10**9
    slipped = whole.copy()
    slipped[1000 + 4 * 30 + 7 :] *= -1.0
    (clock,) = heard(slipped).clocks
    assert min(m.until for m in clock.marks) > 10**9


def test_without_phase_lock_no_word_is_believed():
    """A phase that turns: parities are right by chance in one word of 64, none is taken."""
    rng = np.random.default_rng(4)
    taken, by_chance = 0, 0
    for _ in range(3000):
        z = 250.0 * np.exp(2j * np.pi * (0.13 * np.arange(32) + rng.uniform()))
        z *= rng.choice([-1.0, 1.0], 32)
        data, parities = word(z[2:], z[:2])
        taken, by_chance = taken + (data is not None), by_chance + parities
    assert 10 < by_chance < 120  # 47 expected
    assert taken == 0


def test_two_words_differ_in_four_places_at_least():
    """1240 neighbours: the extended Hamming code of 32 bits (MacWilliams & Sloane, 1.9)."""

    def syndrome(bits: int) -> int:
        last = bits >> 30
        d30 = last & 1
        data = bits >> 6 & 0xFFFFFF
        return parity(data ^ (0xFFFFFF if d30 else 0), last) ^ bits & 0x3F

    columns = [syndrome(1 << k) for k in range(32)]
    assert 0 not in columns
    for n in (2, 3):
        assert all(np.bitwise_xor.reduce(c) for c in combinations(columns, n))
    assert sum(np.bitwise_xor.reduce(c) == 0 for c in combinations(columns, 4)) == 1240


@pytest.mark.parametrize("cn0_dbhz", [19.0, 22.0])
def test_weak_words_are_right_or_refused(cn0_dbhz: float):
    """Bits wrong in one of 25 (19 dB-Hz) and 170: parities let wrong words pass, (1) does not."""
    rng = np.random.default_rng(11)
    sent = _words(rng)
    wrong_parities, taken = 0, 0
    for _ in range(4000):
        bits, data = next(sent)
        z = soft(bits, cn0_dbhz, rng)
        found, parities = word(z[2:], z[:2])
        by_parity = parities and not np.array_equal(np.sign(z.real), bits)
        wrong_parities += by_parity
        taken += found is not None
        assert found in (None, data)
    if cn0_dbhz == 19.0:
        assert wrong_parities > 0
    else:
        assert taken > 60


def _words(rng: np.random.Generator) -> Iterator[tuple[np.ndarray, int]]:
    """32 bits of +-1 of random words, and their data."""
    while True:
        last, data = int(rng.integers(4)), int(rng.integers(1 << 24))
        sent = last << 30 | (data ^ (0xFFFFFF if last & 1 else 0)) << 6 | parity(data, last)
        yield np.array([1.0 - 2.0 * (sent >> 31 - k & 1) for k in range(32)]), data


def test_what_is_no_stream():
    with pytest.raises(ValueError, match="numbers of the bits do not rise"):
        read(np.ones(3), np.array([1, 3, 3]))
    with pytest.raises(ValueError, match=r"expected \(n,\) finite each"):
        read(np.ones(3) * np.nan, np.arange(3))
    assert read(np.ones(0), np.arange(0)).clocks == []
