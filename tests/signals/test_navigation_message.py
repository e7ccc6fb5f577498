"""LNAV against a real message, against its own decoder, and against the laws of the interface."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from signals import satellites as s
from signals.constants import GM_GPS, PI_GPS, WEEK_S
from signals.lnav_fields import (
    ALMANAC,
    ALTERNATING,
    IONOSPHERE_UTC,
    SUBFRAME_1,
    SUBFRAME_2,
    SUBFRAME_3,
    into_elements,
    pack,
    quantise,
    unpack,
)
from signals.lnav_pages import Pages
from signals.lnav_words import (
    decode_subframe,
    encode_subframe,
    find_subframes,
    parity,
    put,
    take,
    with_telemetry_and_handover,
)
from signals.navigation_message import decode_navigation, lnav_bits
from signals.nominal import nominal_24
from signals.rinex import read_navigation
from signals.satellites import Constellation, embedded, orbit

REAL = json.loads(
    (Path(__file__).parents[1] / "authorities" / "lnav_prn4_week_1869.json").read_text()
)
ORBITS = Path(__file__).parents[3] / "shared" / "data" / "orbit"
WEEK, TOW = 2149, 475_200.0


def real_data(name: str) -> int:
    """Upright data of a real subframe."""
    return int("".join(f"{int(word, 16) >> 6:06x}" for word in REAL["subframes"][name]), 16)


def real_bits(name: str) -> np.ndarray:
    """(300,) of 0 and 1 as transmitted: data complemented where the word before ended in 1."""
    bits, previous = [], 0
    for word in (int(w, 16) for w in REAL["subframes"][name]):
        sent = word ^ (0x3FFFFFC0 if previous & 1 else 0)
        bits += [int(b) for b in f"{sent:030b}"]
        previous = word & 3
    return np.array(bits)


@pytest.mark.nojit
@pytest.mark.parametrize("name", REAL["subframes"])
def test_real_subframes_word_by_word(name):
    # all parities, the words in which complement and solved bits occur among them
    assert decode_subframe(real_bits(name)) == real_data(name)
    # and the encoder gives the same 300 bits, solved bits of words 2 and 10 included
    blank = put(put(real_data(name), 2, 23, 2, 0), 10, 23, 2, 0)
    np.testing.assert_array_equal(encode_subframe(blank), real_bits(name))
    # a single wrong bit anywhere is noticed
    for k in range(300):
        bits = real_bits(name)
        bits[k] ^= 1
        assert decode_subframe(bits) is None


def test_real_parities_of_a_chain_of_words():
    # bits as transmitted: upright after a word that ended in 0, complemented after one in 1
    previous = 0
    for word, expected in REAL["parity_chain"]:
        data = int(word, 16) >> 6 ^ (0xFFFFFF if previous & 1 else 0)
        assert parity(data, previous) == int(expected, 16)
        previous = int(expected, 16) & 3


def test_real_numbers():
    one = unpack(SUBFRAME_1, real_data("1"))
    two = unpack(SUBFRAME_2, real_data("2"))
    three = unpack(SUBFRAME_3, real_data("3"))
    row = np.zeros(s.N_ELEMENT)
    for table, numbers in ((SUBFRAME_1, one), (SUBFRAME_2, two), (SUBFRAME_3, three)):
        into_elements(table, numbers, row)
    expected = REAL["decoded"]
    names = {
        "tgd": s.TGD, "toc": s.TOC, "af2": s.AF2, "af1": s.AF1, "af0": s.AF0, "Crs": s.CRS,
        "dn": s.DELTA_N, "M0": s.M0, "Cuc": s.CUC, "e": s.ECC, "Cus": s.CUS, "sqrtA": s.SQRT_A,
        "toe": s.TOE, "Cic": s.CIC, "OMEGA0": s.OMEGA0, "Cis": s.CIS, "i0": s.I0, "Crc": s.CRC,
        "omega": s.OMEGA, "OMEGADOT": s.OMEGA_DOT, "idot": s.IDOT,
    }  # fmt: skip
    assert sorted(names.values()) == list(range(s.N_ELEMENT))
    for name, column in names.items():
        assert row[column] == pytest.approx(expected[name], rel=1e-15), name
    for name in ("week10", "ura", "health", "iodc"):
        assert one[name] == expected[name]
    assert two["iode"] == expected["iode"]
    assert three["iode"] == expected["iode3"]
    assert take(real_data("1"), 2, 1, 17) == expected["tow_count"]
    # what was decoded goes back to the same bits wherever the tables have a field
    for table, numbers, name in (
        (SUBFRAME_1, one, "1"), (SUBFRAME_2, two, "2"), (SUBFRAME_3, three, "3"),
    ):  # fmt: skip
        assert unpack(table, pack(table, numbers)) == unpack(table, real_data(name))


def test_real_pages_come_where_the_cycle_puts_them():
    # the almanac of PRN 25 in the second frame of the week, ionosphere and UTC in the 18th
    pages = Pages(embedded())
    for name, id_ in (("4, almanac of PRN 25", 25), ("4, ionosphere and UTC", 56)):
        data = real_data(name)
        assert take(data, 2, 20, 3) == 4
        begin = 6.0 * (take(data, 2, 1, 17) - 1)
        assert take(data, 3, 3, 6) == id_ == pages.page_id(4, begin - 18.0)


def test_real_almanac_and_ionosphere():
    # plausible by nature: 26 560 km, 55 deg, node regressing 14 deg a year, leap second of 2015
    almanac = unpack(ALMANAC, real_data("4, almanac of PRN 25"))
    row = np.zeros(s.N_ELEMENT)
    into_elements(ALMANAC, almanac, row)
    assert abs(row[s.SQRT_A] ** 2 - 26_560e3) < 20e3
    assert np.degrees(row[s.I0]) == pytest.approx(55.0, abs=2.5)
    assert np.degrees(row[s.OMEGA_DOT]) * 86_400 * 365.25 == pytest.approx(-14.3, abs=1.0)
    page = unpack(IONOSPHERE_UTC, real_data("4, ionosphere and UTC"))
    assert (page["leap_s"], page["leap_future_s"], page["day"]) == (17, 17, 3)
    assert page["wn_lsf"] == 1851 % 256  # the leap second of 2015-06-30, a Tuesday of week 1851
    assert [page[f"beta{k}"] for k in range(4)] == [63, -3, -3, 1]


# Ranges of the fields, drawn as whole numbers of the message
def numbers(table):
    return st.fixed_dictionaries(
        {
            f.name: st.integers(
                -(1 << f.length - 1) if f.signed else 0,
                (1 << f.length - 1) - 1 if f.signed else (1 << f.length) - 1,
            )
            for f in table
        }
    )


@pytest.mark.parametrize("table", [SUBFRAME_1, SUBFRAME_2, SUBFRAME_3, ALMANAC, IONOSPHERE_UTC])
@given(data=st.data())
@settings(max_examples=50, deadline=None)
def test_fields_do_not_touch_each_other_nor_lose_a_step(table, data):
    given_numbers = data.draw(numbers(table))
    assert unpack(table, pack(table, given_numbers)) == given_numbers
    for f in table:
        assert f.integer(f.value(given_numbers[f.name])) == given_numbers[f.name]


@given(data=st.integers(0, 2**240 - 1), number=st.integers(1, 5), count=st.integers(0, 100_799))
@settings(max_examples=50, deadline=None)
def test_any_subframe_survives_the_bits(data, number, count):
    data = with_telemetry_and_handover(data, number, 6.0 * count)
    bits = encode_subframe(data)
    assert bits[58:60].tolist() == bits[298:300].tolist() == [0, 0]
    back = decode_subframe(bits)
    solved = (put(put(x, 2, 23, 2, 0), 10, 23, 2, 0) for x in (data, back))
    assert next(solved) == next(solved)
    # alone, behind noise, upright and inverted
    for sign in (1, -1):
        stream = np.concatenate([np.tile([1, -1, -1], 17), 1 - 2 * bits, [1, 1]]) * sign
        (found,) = find_subframes(stream)
        assert (found.first_bit, found.inverted, found.data) == (51, sign < 0, back)
        assert (found.number, found.tow_s) == (number, 6.0 * count)


def test_frames_are_numbered_dated_and_aligned():
    bits = lnav_bits(embedded(), 1, WEEK, TOW - 0.14, 3007)
    assert bits.dtype == np.int8
    found = find_subframes(bits)
    assert [f.first_bit for f in found] == [7 + 300 * k for k in range(10)]
    assert [f.number for f in found] == [1, 2, 3, 4, 5] * 2
    assert [f.tow_s for f in found] == [TOW + 6.0 * k for k in range(10)]
    # the handover word names the next subframe (20.3.3.2)
    assert take(found[0].data, 2, 1, 17) * 6.0 == TOW + 6.0
    assert take(found[0].data, 3, 1, 10) == WEEK % 1024
    # any stretch is a part of the whole
    np.testing.assert_array_equal(lnav_bits(embedded(), 1, WEEK, TOW + 12.34, 700), bits[624:1324])
    assert len(lnav_bits(embedded(), 1, WEEK, TOW, 0)) == 0


def test_the_week_ends_inside_the_stream():
    sky = nominal_24(2200, WEEK_S - 64.0)
    bits = lnav_bits(sky, 3, 2200, WEEK_S - 30.0, 3000)
    np.testing.assert_array_equal(bits, lnav_bits(sky, 3, 2201, -30.0, 3000))
    found = find_subframes(bits)
    assert [f.tow_s for f in found[:6]] == [604_770, 604_776, 604_782, 604_788, 604_794, 0]
    assert take(found[4].data, 2, 1, 17) == 0  # the count of the next subframe, in the new week
    assert take(found[0].data, 3, 1, 10) == 2200 % 1024
    assert take(found[5].data, 3, 1, 10) == 2201 % 1024
    assert [f.data for f in found if f.number == 4][1] >> 24 * 7 == found[8].data >> 24 * 7
    # pages begin anew with the week: 604770 is frame 20159, page 10 of its cycle; then page 1
    assert [take(f.data, 3, 3, 6) for f in found if f.number == 5] == [10, 1]
    # the set belongs to week 2200 whichever week it was sent in
    for half in (bits[:1500], bits[1500:]):
        back = decode_navigation({3: half}, 2200)
        assert back.week.tolist() == [2200]
        np.testing.assert_array_equal(back.elements[0], sky.elements[2])


def everything(sky: Constellation, week: int, tow_s: float, n_frame: int) -> Constellation:
    streams = {int(p): lnav_bits(sky, int(p), week, tow_s, 1500 * n_frame) for p in sky.prn}
    return decode_navigation({p: b if p % 2 else -b for p, b in streams.items()}, week + 300)


def test_embedded_constellation_comes_back():
    sky = embedded()
    status = sky.status.copy()
    status[sky.prn == 14, s.IODC] += 512  # as the satellite had it
    sky = replace(sky, status=status)
    back = everything(sky, WEEK, TOW + 3570.0, 26)  # across the change of sets, and 12.5 min
    # of satellites with two sets about 475200, the one nearest to the time went out
    carried = []
    for prn, week, toe, iode in zip(
        back.prn, back.week, back.elements[:, s.TOE], back.iode, strict=True
    ):
        where = (sky.prn == prn) & (sky.week == week) & (sky.elements[:, s.TOE] == toe)
        (k,) = np.flatnonzero(where & (sky.iode == iode))
        carried.append(k)
    np.testing.assert_array_equal(back.status, sky.status[carried])
    np.testing.assert_array_equal(back.health, sky.health[carried])
    both = [p for p in np.unique(sky.prn) if (sky.prn == p).sum() > 1]
    assert len(both) >= 8
    for prn in both:
        assert sorted(back.elements[back.prn == prn, s.TOE] > TOW + 3600.0) == [False, True]
    # decoded is exactly quantised; quantised is what the file has, to its twelve digits
    np.testing.assert_array_equal(back.elements, quantise(sky.elements[carried]))
    np.testing.assert_allclose(back.elements, sky.elements[carried], rtol=3e-11, atol=0)
    assert (back.iono_utc.leap_s, back.iono_utc.leap_future_s) == (18, 18)
    assert back.iono_utc.week_lsf % 256 == 2031 % 256
    np.testing.assert_allclose(back.iono_utc.alpha, sky.iono_utc.alpha, rtol=5e-4)
    np.testing.assert_allclose(back.iono_utc.beta, sky.iono_utc.beta, rtol=5e-4)


def largest_change(sky: Constellation) -> float:
    """Most that any satellite moves within its two hours by being sent [m], clock included."""
    change = 0.0
    for row, sent in zip(sky.elements, quantise(sky.elements), strict=True):
        for t in row[s.TOE] + np.linspace(-7200.0, 7200.0, 9):
            difference = np.array(orbit(sent, t)) - np.array(orbit(row, t))
            change = max(change, np.abs(difference[:3]).max(), 3e8 * abs(difference[6]))
    return change


def test_broadcast_elements_lose_nothing():
    # twelve digits of 6.28 rad: 5e-12 rad or 0.1 mm on the orbit for each of three angles; the
    # message's own step would be 20 mm
    assert largest_change(embedded()) < 0.4e-3


@pytest.mark.skipif(
    not ORBITS.exists(), reason="needs the reference data folder beside the repository"
)
def test_a_day_of_broadcast_elements_loses_nothing():
    for name in ("brdc1180.21n", "brdc0010.22n"):
        assert largest_change(read_navigation(ORBITS / name)) < 0.4e-3


def test_nominal_constellation_is_what_is_sent():
    sky = nominal_24(2300, 100_008.0)
    back = everything(sky, 2300, 99_990.0, 2)
    np.testing.assert_array_equal(back.elements, sky.elements)


def test_almanacs_follow_the_ephemerides():
    sky = embedded()
    pages = Pages(sky)
    for prn, integers in pages.almanacs.items():
        row = np.zeros(s.N_ELEMENT)
        into_elements(ALMANAC, unpack(ALMANAC, pages.data(prn)), row)
        assert unpack(ALMANAC, pages.data(prn)) == integers | {"data_id": 1, "page_id": prn}
        assert row[s.TOE] == pages.toa_s == 4096.0 * 117  # between the two toe of most
        tow = sky.elements[sky.prn == prn, s.TOE].min()
        position, _, clock, _ = sky.at(WEEK, tow, prn)
        row[s.TOC] = pages.toa_s  # one reference time for both (20.3.3.5.2.3)
        away = np.array(orbit(row, tow))
        # harmonics 2 km; n instead of delta n: 2/3 dn/n A = 0.6 km; steps of e and M0 0.1 km
        assert np.linalg.norm(away[:3] - position) < 4e3
        # a step of 2^-20 s is 1 us; T_GD is not in it
        assert abs(away[6] - clock) < 1.1 * 2.0**-20
    # the mean motion is that of the set nearest to toa, delta n included: half a step of sqrt(A)
    (k,) = np.flatnonzero((sky.prn == 1) & (sky.elements[:, s.TOE] == 482_400.0))
    into_elements(ALMANAC, pages.almanacs[1], row)
    n = np.sqrt(GM_GPS) / sky.elements[k, s.SQRT_A] ** 3 + sky.elements[k, s.DELTA_N]
    half_step = 3 * 2.0**-12 / 5153.7
    assert np.sqrt(GM_GPS) / row[s.SQRT_A] ** 3 == pytest.approx(n, rel=half_step)
    assert sky.elements[k, s.DELTA_N] / n > 10 * half_step


def test_all_fifty_pages():
    sky = embedded()
    found = find_subframes(lnav_bits(sky, 1, WEEK, TOW - TOW % 750, 1500 * 25))
    four = [f.data for f in found if f.number == 4]
    five = [f.data for f in found if f.number == 5]
    # IS-GPS-200 table 20-V; satellites without a set are dummies, ID 0
    present = set(sky.prn.tolist())
    ids = [57, 25, 26, 27, 28, 57, 29, 30, 31, 32, 57, 62, 52, 53, 54, 57, 55, 56, 58, 59, 57, 60,
           61, 62, 63]  # fmt: skip
    shown = [0 if 25 <= i <= 32 and i not in present else i for i in ids]
    assert [take(d, 3, 3, 6) for d in four] == shown
    assert [take(d, 3, 3, 6) for d in five] == [p if p in present else 0 for p in range(1, 25)] + [
        51
    ]
    assert {take(d, 3, 1, 2) for d in four + five} == {1}
    # a dummy is alternating ones and zeros beyond its ID
    assert 5 not in present
    beyond = (1 << 184) - 4  # word 3 from bit 9 on, without the two solved bits of word 10
    assert five[4] & beyond == ALTERNATING & beyond
    # health: of PRN 1-24 in subframe 5, of 25-32 in subframe 4; absent ones are all ones
    health = [take(five[24], 4 + k // 4, 1 + 6 * (k % 4), 6) for k in range(24)]
    assert health == [0 if p in present else 63 for p in range(1, 25)]
    health = [take(four[24], 8, 19, 6)]
    health += [take(four[24], 9, 1 + 6 * k, 6) for k in range(4)]
    health += [take(four[24], 10, 1 + 6 * k, 6) for k in range(3)]
    assert health == [0 if p in present else 63 for p in range(25, 33)]
    configurations = [take(four[24], 3, 9 + 4 * k, 4) for k in range(4)]
    configurations += [take(four[24], 4 + k // 6, 1 + 4 * (k % 6), 4) for k in range(28)]
    assert configurations == [9 if p in present else 0 for p in range(1, 33)]
    assert (take(five[24], 3, 9, 8), take(five[24], 3, 17, 8)) == (117, WEEK % 256)
    assert take(four[12], 3, 9, 2) == 2  # no correction table


def test_a_sick_satellite_shows_in_the_almanac_and_sends_nothing_here():
    sky = embedded()
    health = sky.health.copy()
    health[sky.prn == 3] = 0b100011
    sick = replace(sky, health=health)
    page = unpack(ALMANAC, Pages(sick).data(3))
    assert page["health8"] == 0b11100011
    assert take(Pages(sick).data(51), 4, 13, 6) == 0b100011
    with pytest.raises(ValueError, match="G03 has no healthy ephemeris"):
        lnav_bits(sick, 3, WEEK, TOW, 10)


def test_issues_of_data_must_agree():
    bits = lnav_bits(embedded(), 1, WEEK, TOW, 1500)
    other = find_subframes(lnav_bits(embedded(), 1, WEEK, TOW + 4200.0, 1500))
    mixed = np.concatenate([bits[:600], 1 - 2 * encode_subframe(other[2].data)])
    with pytest.raises(ValueError, match="LNAV: no satellite's subframes 1 to 3 came whole"):
        decode_navigation({1: mixed}, WEEK)
    with pytest.raises(ValueError, match="came whole"):
        decode_navigation({1: bits[:800]}, WEEK)
    assert decode_navigation({1: bits[:900]}, WEEK).prn.tolist() == [1]


def test_requests_that_cannot_be_met():
    sky = embedded()
    for prn in (0, 33):
        with pytest.raises(ValueError, match=f"prn = {prn}: expected 1 to 32"):
            lnav_bits(sky, prn, WEEK, TOW, 10)
    for tow in (0.01, np.inf, np.nan):
        with pytest.raises(ValueError, match=r"expected a bit edge, a multiple of 0\.02 s"):
            lnav_bits(sky, 1, WEEK, tow, 10)
    with pytest.raises(ValueError, match="n_bits = -1: expected 0 or more"):
        lnav_bits(sky, 1, WEEK, TOW, -1)
    with pytest.raises(ValueError, match="G05 has no healthy ephemeris"):
        lnav_bits(sky, 5, WEEK, TOW, 10)
    # the frame under way at the end of the two hours is sent, the next is not
    last = sky.elements[sky.prn == 1, s.TOE].max() + 7200.0
    assert len(lnav_bits(sky, 1, WEEK, last, 1500)) == 1500
    with pytest.raises(ValueError, match="G01 has no healthy ephemeris within 2 h"):
        lnav_bits(sky, 1, WEEK, last + 60.0, 1500)
    elements = sky.elements.copy()
    elements[:, s.DELTA_N] = 1.2e-8
    with pytest.raises(ValueError, match=r"SEPT078M.21P, G01: delta_n = 1\.2e-08 does not fit"):
        lnav_bits(replace(sky, elements=elements), 1, WEEK, TOW, 10)
    # an angle is taken modulo a turn instead
    elements = sky.elements.copy()
    elements[:, s.M0] = 5.0
    back = decode_navigation(
        {1: lnav_bits(replace(sky, elements=elements), 1, WEEK, TOW, 1500)}, WEEK
    )
    assert back.elements[0, s.M0] == pytest.approx(5.0 - 2 * PI_GPS, abs=PI_GPS * 2.0**-32)
    for bad in (np.zeros(400), np.ones((2, 300))):
        with pytest.raises(ValueError, match=r"expected \(n,\) of \+1 and -1"):
            find_subframes(bad)
    assert find_subframes(np.ones(299, dtype=np.int8)) == []
    assert find_subframes(np.ones(3000, dtype=np.int8)) == []
