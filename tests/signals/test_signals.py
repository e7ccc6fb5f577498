"""Rows of all signals against the numbers of their interface documents.

Octal numbers are first chips first, logical 0 and 1; those written here are printed in the
documents, so that they are checked where the reference folder is absent too.
"""

import csv
import hashlib
from pathlib import Path

import numpy as np
import pytest

from signals import icd_gps
from signals.codes import (
    BEIDOU_B1CD,
    BEIDOU_B1CP,
    BEIDOU_B1I,
    BEIDOU_B1I_GEO,
    GALILEO_E5AI,
    GALILEO_E5AQ,
    GPS_L1CD,
    GPS_L1CP,
    GPS_L2CL,
    GPS_L2CM,
    GPS_L5I,
    GPS_L5Q,
    SIGNALS,
    Signal,
    galileo_e1,
    signal,
)
from signals.sequences import modular_register, shift_register, weil

DATA = Path(__file__).parents[3] / "shared" / "data" / "codes"
needs_data = pytest.mark.skipif(
    not DATA.exists(), reason="needs the reference data folder beside the repository"
)


def bits(chips: np.ndarray) -> np.ndarray:
    return ((1 - chips) // 2).astype(np.uint8)


def octal(chips: np.ndarray) -> str:
    return f"{int(''.join(map(str, bits(chips))), 2):0{len(chips) // 3}o}"


def table(name: str) -> list[dict[str, str]]:
    with (DATA / name).open() as file:
        return list(csv.DictReader(file))


# (signal, PRN, first 24 chips, last 24 chips)
ENDS = [
    (GPS_L1CP, 1, "05752067", "20173742"),  # IS-GPS-800 table 3.2-2
    (GPS_L1CP, 2, "70146401", "35437154"),
    (GPS_L1CD, 1, "77001425", "52231646"),
    (GPS_L1CD, 2, "23342754", "46703351"),
    (BEIDOU_B1CD, 1, "53773116", "42711657"),  # BDS-SIS-ICD-B1C table 5-2
    (BEIDOU_B1CP, 1, "71676756", "13053205"),  # table 5-3
    (GPS_L5I, 1, "66124275", "65654756"),  # two public generators
]


@pytest.mark.nojit
@pytest.mark.parametrize(("row", "prn", "first", "last"), ENDS)
def test_first_and_last_chips_are_those_of_the_document(row, prn, first, last):
    chips = row.chips(prn)
    assert (octal(chips[:24]), octal(chips[-24:])) == (first, last)


def test_secondary_codes_are_those_of_the_documents():
    def text(row: Signal, prn: int) -> str:
        return "".join(map(str, bits(row.secondary_chips(prn))))

    assert text(GPS_L5I, 9) == "0000110101"  # IS-GPS-705 3.3.3: NH10, NH20
    assert text(GPS_L5Q, 9) == text(BEIDOU_B1I, 9) == "00000100110101001110"
    assert text(GALILEO_E5AI, 9) == f"{0x842E9:020b}"  # Galileo OS SIS ICD 3.5: CS20
    assert text(GALILEO_E5AQ, 1).startswith(f"{0x83F6F69D:032b}")  # CS100_1
    assert text(GPS_L1CP, 1).startswith(f"{0o3266:011b}")  # IS-GPS-800 table 3.2-3: first, last
    assert text(GPS_L1CP, 1).endswith(f"{0o0410:011b}")
    assert octal(BEIDOU_B1CP.secondary_chips(1)[:24]) == "27516364"  # B1C table 5-4
    assert octal(BEIDOU_B1CP.secondary_chips(1)[-24:]) == "67377026"
    lengths = {r.label: len(r.secondary_chips(r.prns[0])) for r in SIGNALS.values()}
    assert lengths == {
        "L1CA": 1, "L1CD": 1, "L1CP": 1800, "L2CM": 1, "L2CL": 1, "L5I": 10, "L5Q": 20,
        "E5AI": 20, "E5AQ": 100, "B1I": 20, "B1IG": 1, "B1CD": 1, "B1CP": 1800,
    }  # fmt: skip
    codes = {GALILEO_E5AQ.secondary_chips(prn).tobytes() for prn in GALILEO_E5AQ.prns}
    assert len(codes) == 50
    # each of length 100, nearly balanced as the document's table is (own count of its two copies)
    ones = [int(bits(GALILEO_E5AQ.secondary_chips(prn)).sum()) for prn in GALILEO_E5AQ.prns]
    assert min(ones) >= 42
    assert max(ones) <= 58


def test_xb_starts_in_the_states_of_the_document():
    # IS-GPS-705 table 3-I, initial XB code state of I5 PRN 1 and 2 and Q5 PRN 1: the state is the
    # register's contents, whose outputs are its digits from the last to the first
    xb = shift_register((1, 3, 4, 6, 7, 8, 12, 13), "1" * 13, 8191)
    for advances, prn, state in (
        (icd_gps.L5I_XB_ADVANCE, 1, "0101011100100"),
        (icd_gps.L5I_XB_ADVANCE, 2, "1100000110101"),
        (icd_gps.L5Q_XB_ADVANCE, 1, "1001011001100"),
    ):
        outputs = np.roll(xb, -advances[prn - 1])[:13]
        assert "".join(map(str, outputs[::-1])) == state


def test_l2c_registers_end_where_the_document_says():
    # IS-GPS-200 table 3-II, end states of PRN 1
    mask = 0o445112474
    assert modular_register(mask, icd_gps.L2CM_INITIAL[0], 10_230)[1] == 0o552566002
    assert modular_register(mask, icd_gps.L2CL_INITIAL[0], 767_250)[1] == 0o267724236


def digest(chips: np.ndarray) -> str:
    return hashlib.sha256(bits(chips).tobytes()).hexdigest()


@needs_data
@pytest.mark.parametrize(
    ("file", "kind", "row", "count"),
    [
        ("gps_l5_codes.csv", "I5", GPS_L5I, 210),
        ("gps_l5_codes.csv", "Q5", GPS_L5Q, 210),
        ("gps_l1c_codes.csv", "L1Cp", GPS_L1CP, 63),
        ("gps_l1c_codes.csv", "L1Cd", GPS_L1CD, 63),
        ("galileo_e5a_codes.csv", "E5aI", GALILEO_E5AI, 50),
        ("galileo_e5a_codes.csv", "E5aQ", GALILEO_E5AQ, 50),
        ("beidou_b1c_codes.csv", "B1C_data", BEIDOU_B1CD, 63),
        ("beidou_b1c_codes.csv", "B1C_pilot", BEIDOU_B1CP, 63),
        ("beidou_b1i_codes.csv", None, BEIDOU_B1I, 53),
        ("beidou_b1i_codes.csv", None, BEIDOU_B1I_GEO, 10),
    ],
)
def test_every_code_is_the_reference_code(file, kind, row, count):
    given = [r for r in table(file) if kind is None or r["signal"] == kind]
    given = [r for r in given if int(r["prn"]) in row.prns]
    assert len(given) == count == len(row.prns)
    for r in given:
        chips = row.chips(int(r["prn"]))
        assert chips.shape == (row.length_chips,)
        assert octal(chips[:24]) == r["first24_octal"], r["prn"]
        assert octal(chips[-24:]) == r["last24_octal"], r["prn"]
        assert digest(chips) == r["sha256_bits"], r["prn"]


@needs_data
def test_every_overlay_is_the_reference_overlay():
    rows = [r for r in table("beidou_b1c_codes.csv") if r["signal"] == "B1C_pilot_secondary"]
    assert len(rows) == 63
    for r in rows:
        assert digest(BEIDOU_B1CP.secondary_chips(int(r["prn"]))) == r["sha256_bits"]
    rows = table("gps_l1c_overlay.csv")
    assert len(rows) == 63
    for r in rows:
        overlay = bits(GPS_L1CP.secondary_chips(int(r["prn"])))
        assert f"{int(''.join(map(str, overlay[:11])), 2):04o}" == r["s1_initial_octal"]
        assert f"{int(''.join(map(str, overlay[-11:])), 2):04o}" == r["final_11_octal"]


@needs_data
def test_l2c_registers_end_in_the_reference_states():
    rows = table("gps_l2c_states.csv")
    assert [int(r["prn"]) for r in rows] == list(GPS_L2CM.prns) == list(GPS_L2CL.prns)
    for i, r in enumerate(rows):
        start = icd_gps.L2CM_INITIAL[i]
        chips, end = modular_register(0o445112474, start, 10_230)
        assert end == int(r["cm_end_octal"], 8)
        np.testing.assert_array_equal(chips, bits(GPS_L2CM.chips(int(r["prn"]))))
    for i in (0, 36, 62, 63, 114):  # 0.13 s each
        start = icd_gps.L2CL_INITIAL[i]
        chips, end = modular_register(0o445112474, start, 767_250)
        assert end == int(rows[i]["cl_end_octal"], 8)
    np.testing.assert_array_equal(chips, bits(GPS_L2CL.chips(210)))


@needs_data
def test_memory_codes_are_those_of_the_file():
    e1b, e1c = galileo_e1(DATA / "galileo_e1_memory_codes.csv")
    assert len(e1b.prns) == len(e1c.prns) == 50
    for r in table("galileo_e1_memory_codes.csv"):
        row = e1b if r["signal"] == "E1B" else e1c
        sent = "".join(map(str, bits(row.chips(int(r["prn"])))))
        assert f"{int(sent, 2):01023X}" == r["hex_1023_digits_msb_first"]


def test_a_weil_code_is_the_xor_it_claims_to_be():
    n, w = 10_223, 5111
    squares = {k * k % n for k in range(1, n)}
    brute = [(k in squares) ^ ((k + w) % n in squares) for k in range(n)]
    np.testing.assert_array_equal(weil(n, w), brute)


def test_registers_run_through_their_whole_period():
    for m, taps in ((10, (3, 10)), (13, (1, 3, 4, 6, 7, 8, 12, 13)), (14, (1, 6, 8, 14))):
        period = 2**m - 1  # maximal length: balanced, and every window once
        out = shift_register(taps, "1" * m, 2 * period)
        np.testing.assert_array_equal(out[:period], out[period:])
        assert out[:period].sum() == 2 ** (m - 1)
        weights = 1 << np.arange(m)
        windows = np.convolve(out[: period + m - 1].astype(np.int64), weights, "valid")
        assert len(set(windows.tolist())) == period


@pytest.mark.parametrize("row", SIGNALS.values(), ids=lambda r: r.label)
def test_rows_are_consistent(row):
    prn = row.prns[-1]
    chips = row.chips(prn)
    assert chips.shape == (row.length_chips,)
    assert set(np.unique(chips)) == {-1, 1}
    # the code period is a whole number of ms, and symbols are whole periods of the replica
    period_ms = 1e3 * row.length_chips / row.chip_rate_hz
    assert period_ms == pytest.approx(round(period_ms), abs=1e-12)
    tiered = row.tiered_chips(prn)
    assert row.symbol_chips % tiered.size == 0
    assert row.symbol_chips == pytest.approx(row.symbol_s * row.chip_rate_hz, abs=1e-6)
    values = row.subchips(prn)
    assert values.dtype == np.float32
    assert values.size == tiered.size * row.per_chip
    assert np.mean(values.astype(float) ** 2) == pytest.approx(1.0, abs=1e-7)
    assert row.channel(prn) == f"{row.system}{prn:02d}:{row.label}"
    assert signal(row.label) is row
    correlation = row.autocorrelation(prn)
    assert correlation.shape == values.shape
    assert correlation[0] == 1.0
    assert np.abs(correlation[2 * row.per_chip : -2 * row.per_chip]).max() < 0.5


def test_tiered_code_carries_the_secondary_chips():
    tiered = GPS_L5Q.tiered_chips(7).reshape(20, 10_230)
    np.testing.assert_array_equal(tiered, np.outer(GPS_L5Q.secondary_chips(7), GPS_L5Q.chips(7)))
    # the overlays of 18 s are symbols: the replica is the primary code
    assert GPS_L1CP.tiered_chips(7) is GPS_L1CP.chips(7)
    assert BEIDOU_B1CP.tiered_chips(7) is BEIDOU_B1CP.chips(7)


def test_l2c_codes_take_turns():
    # IS-GPS-200 3.2.2, 3.3.2.4: CM first; together they are on the air all the time, never both
    cm = GPS_L2CM.subchips(5)
    cl = GPS_L2CL.subchips(5)[: cm.size]
    assert (cm[1::2] == 0).all()
    assert (cl[::2] == 0).all()
    np.testing.assert_array_equal(np.sign(cm[::2]), GPS_L2CM.chips(5))
    np.testing.assert_array_equal(np.sign(cl[1::2]), GPS_L2CL.chips(5)[:10_230])


def test_prns_without_a_code_are_refused():
    with pytest.raises(ValueError, match=r"^prn 64: GPS L2 CM has codes for PRN 1-63, 159-210$"):
        GPS_L2CM.chips(64)
    for ask in (GPS_L5Q.secondary_chips, GPS_L5Q.subchips, GPS_L5Q.autocorrelation):
        with pytest.raises(ValueError, match=r"^prn 0: GPS L5 Q5 has codes for PRN 1-210$"):
            ask(0)


def test_unknown_signals_are_refused():
    with pytest.raises(ValueError, match=r"signal 'L1': expected one of L1CA, .* E1B, E1C"):
        signal("L1")
    with pytest.raises(ValueError, match=r"E1C: no memory codes given"):
        signal("E1C")
