"""C/A codes against IS-GPS-200 and their own laws."""

import csv
from pathlib import Path

import numpy as np
import pytest

from signals.codes import GPS_L1CA

DATA = Path(__file__).parents[3] / "shared" / "data" / "codes"
needs_data = pytest.mark.skipif(
    not DATA.exists(), reason="needs the reference data folder beside the repository"
)

# First 10 chips of PRN 1-32, octal: the first digit is the first chip, the other three are the
# next nine (IS-GPS-200 table 3-Ia, last columns)
FIRST_10 = (
    "1440 1620 1710 1744 1133 1455 1131 1454 1626 1504 1642 1750 1764 1772 1775 1776 "
    "1156 1467 1633 1715 1746 1763 1063 1706 1743 1761 1770 1774 1127 1453 1625 1712"
)
# Initial G2 setting of PRN 120-138 (IS-GPS-200 table 6-I): as G1 starts with ten ones, the first
# ten chips are its complement
INITIAL_G2 = (
    "1106 1241 0267 0232 1617 1076 1764 0717 1532 1250 0341 0551 0520 1731 0706 1216 0740 1007 0450"
)


def octal(chips: np.ndarray) -> str:
    bits = "".join("1" if chip < 0 else "0" for chip in chips)
    return bits[0] + f"{int(bits[1:], 2):03o}"


def lfsr_by_taps(tap_a: int, tap_b: int) -> np.ndarray:
    """C/A code as G1 xor two stages of G2 (IS-GPS-200 figure 3-10), bit by bit: 0 and 1."""
    g1, g2, out = [1] * 10, [1] * 10, []
    for _ in range(1023):
        out.append(g1[9] ^ g2[tap_a - 1] ^ g2[tap_b - 1])
        g1 = [g1[2] ^ g1[9], *g1[:9]]
        g2 = [g2[1] ^ g2[2] ^ g2[5] ^ g2[7] ^ g2[8] ^ g2[9], *g2[:9]]
    return np.array(out)


@pytest.mark.nojit
def test_first_chips_are_those_of_the_interface_specification():
    assert [octal(GPS_L1CA.chips(prn)[:10]) for prn in range(1, 33)] == FIRST_10.split()
    assert [octal(-GPS_L1CA.chips(prn)[:10]) for prn in range(120, 139)] == INITIAL_G2.split()


@needs_data
def test_whole_codes_equal_the_two_tap_form_and_the_tabulated_ends():
    with (DATA / "gps_ca_known_answers_prn1_37.csv").open() as file:
        for row in csv.DictReader(file):
            chips = GPS_L1CA.chips(int(row["prn"]))
            bits = lfsr_by_taps(int(row["g2_tap_a"]), int(row["g2_tap_b"]))
            np.testing.assert_array_equal(chips, 1 - 2 * bits)
            assert octal(chips[:10]) == row["first10_octal"]
            assert octal(chips[-10:]) == row["last10_octal"]
            assert (chips < 0).sum() == int(row["ones_count"])


@needs_data
def test_delays_of_all_codes():
    g1 = np.array([1 - 2 * b for b in lfsr_by_taps(10, 10)])  # the two stages cancel: G1 alone
    g2 = lfsr_g2()
    with (DATA / "gps_ca_g2_delay.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["prn"]) for row in rows] == list(range(1, 211))
    for row in rows:
        expected = g1 * np.roll(g2, int(row["g2_delay_chips"]))
        np.testing.assert_array_equal(GPS_L1CA.chips(int(row["prn"])), expected)


def lfsr_g2() -> np.ndarray:
    """G2 as +-1 from its recurrence x[n] = x[n-2]^x[n-3]^x[n-6]^x[n-8]^x[n-9]^x[n-10]."""
    x = [1] * 10
    for _ in range(1013):
        x.append(x[-2] ^ x[-3] ^ x[-6] ^ x[-8] ^ x[-9] ^ x[-10])
    return 1 - 2 * np.array(x)


def test_periodic_correlation_has_the_three_gold_levels():
    # Gold codes of degree 10: -1, 63, -65 (of 1023) off the peak; counts for PRN 1 and for PRN 1
    # against PRN 2 by brute force in two public generators
    auto = GPS_L1CA.autocorrelation(1)
    assert auto.shape == (1023,)
    assert auto[0] == 1.0
    levels, counts = np.unique(np.rint(auto[1:] * 1023).astype(int), return_counts=True)
    assert dict(zip(levels.tolist(), counts.tolist(), strict=True)) == {-65: 120, -1: 782, 63: 120}
    a, b = (GPS_L1CA.chips(prn).astype(int) for prn in (1, 2))
    cross = np.array([a @ np.roll(b, k) for k in range(1023)])
    levels, counts = np.unique(cross, return_counts=True)
    assert dict(zip(levels.tolist(), counts.tolist(), strict=True)) == {-65: 128, -1: 751, 63: 144}


@pytest.mark.parametrize("prn", [3, 17, 65, 210])
def test_autocorrelation_is_the_sum_it_claims_to_be(prn):
    chips = GPS_L1CA.chips(prn).astype(int)
    brute = np.array([chips @ np.roll(chips, k) for k in range(1023)]) / 1023
    np.testing.assert_array_equal(GPS_L1CA.autocorrelation(prn), brute)


def test_codes_are_signs_balanced_as_the_polynomials_say_and_all_different():
    codes = np.array([GPS_L1CA.chips(prn) for prn in range(1, 211)])
    assert codes.dtype == np.int8
    assert (np.abs(codes) == 1).all()
    # members of a Gold family of degree 10 have 511 +- 32 or 512 ones; PRN 34 and 37 are one code
    assert set((codes < 0).sum(axis=1).tolist()) <= {480, 512, 544}
    assert len(np.unique(codes, axis=0)) == 209
    np.testing.assert_array_equal(GPS_L1CA.chips(34), GPS_L1CA.chips(37))


def test_results_are_shared_and_cannot_be_written():
    for array in (GPS_L1CA.chips(5), GPS_L1CA.autocorrelation(5)):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    assert GPS_L1CA.chips(5) is GPS_L1CA.chips(5)


@pytest.mark.parametrize("prn", [0, -1, 211])
def test_unknown_prn_is_refused_by_name(prn):
    for ask in (GPS_L1CA.chips, GPS_L1CA.autocorrelation):
        with pytest.raises(ValueError, match=f"^prn {prn}: GPS L1 C/A has codes for PRN 1-210$"):
            ask(prn)


def test_facts_of_the_signal():
    # IS-GPS-200 3.3.1.1, 3.2.1.3, 3.3.2.2: 1540 carrier cycles per chip, 20 codes per bit
    assert GPS_L1CA.carrier_hz / GPS_L1CA.chip_rate_hz == 1540.0
    assert GPS_L1CA.symbol_s * GPS_L1CA.chip_rate_hz / GPS_L1CA.length_chips == 20.0
