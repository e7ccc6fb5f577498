"""Files of Galileo E1 memory codes: what is read, and what is said of a bad one."""

import numpy as np
import pytest

from signals.codes import galileo_e1
from signals.memory_codes import HEADER, read_memory_codes

# made up: 4092 chips that begin 1111 0101 and end 1010
B = "F5" + "0" * 1020 + "A"
C = "3" * 1023
GOOD = f"{HEADER}\n2,E1B,{B}\n1,E1C,{C}\n\n2,E1C,{B.lower()}\n"


@pytest.fixture
def write(tmp_path):
    def build(text: str | bytes):
        path = tmp_path / "codes.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return build


def test_rows_become_chips(write):
    codes = read_memory_codes(write(GOOD))
    assert list(codes["E1B"]) == [2]
    assert list(codes["E1C"]) == [1, 2]
    chips = codes["E1B"][2]
    assert chips.shape == (4092,)
    assert chips[:8].tolist() == [1, 1, 1, 1, 0, 1, 0, 1]  # most significant bit first
    assert chips[-4:].tolist() == [1, 0, 1, 0]
    assert chips[8:-4].sum() == 0
    np.testing.assert_array_equal(codes["E1C"][2], chips)


def test_signals_have_the_codes_of_the_file(write):
    e1b, e1c = galileo_e1(write(GOOD))
    assert (e1b.prns, e1c.prns) == ((2,), (1, 2))
    assert e1b.chips(2)[:5].tolist() == [-1, -1, -1, -1, 1]
    assert e1c.pilot
    assert not e1b.pilot
    # Galileo OS SIS ICD 3.5: CS25 of 4 ms chips is 380AD90 in hexadecimal, 100 ms
    text = "".join("0" if chip > 0 else "1" for chip in e1c.secondary_chips(1))
    assert text == f"{0x380AD90 >> 3:025b}"
    assert e1c.tiered_chips(1).size == e1c.symbol_chips == 25 * 4092
    assert e1c.subchips(1).size == 25 * 4092 * 12
    with pytest.raises(ValueError, match=r"^prn 1: Galileo E1-B has codes for PRN 2-2$"):
        e1b.chips(1)


def test_a_changed_file_is_read_again(write):
    import os

    path = write(GOOD)
    first = read_memory_codes(path)
    assert read_memory_codes(path) is first
    write(GOOD.replace("2,E1B", "3,E1B"))
    os.utime(path, ns=(1, 1))
    assert list(read_memory_codes(path)["E1B"]) == [3]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "line 1: an empty file given, expected the header"),
        ("prn;signal\n", "line 1: 'prn;signal' given, expected the header prn,signal,hex"),
        (f"{HEADER}\n1,E1B\n", "line 2: 2 fields, expected 3"),
        (f"{HEADER}\n1,E1B,{B}\n51,E1C,{B}\n", "line 3: prn '51' given, expected a whole number"),
        (f"{HEADER}\n1.0,E1B,{B}\n", "line 2: prn '1.0' given, expected a whole number 1 to 50"),
        (f"{HEADER}\n1,E5a,{B}\n", "line 2: signal 'E5a' given, expected E1B or E1C"),
        (f"{HEADER}\n1,E1B,{B[:-1]}\n", "line 2: 1022 digits, expected 1023"),
        (f"{HEADER}\n1,E1B,{B[:-1]}G\n", "line 2: 'G' in the code, expected hexadecimal digits"),
        (f"{HEADER}\n1,E1B,{B}\n1,E1B,{B}\n", "line 3: E1B of PRN 1 is given twice"),
        (f"{HEADER}\n1,E1B,{B}\n", "no E1C code in the file, expected at least one"),
        (b"\x80\x81\n", "not a text file, expected Galileo E1 memory codes"),
    ],
)
def test_a_bad_file_is_answered_with_file_line_and_expectation(write, text, said):
    path = write(text)
    with pytest.raises(ValueError) as caught:
        galileo_e1(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert said in message
    assert "\n" not in message


def test_a_missing_file_and_a_folder(tmp_path):
    with pytest.raises(ValueError, match=r"none\.csv: no such file, expected Galileo E1 memory"):
        galileo_e1(tmp_path / "none.csv")
    with pytest.raises(ValueError, match="cannot be read"):
        galileo_e1(tmp_path)
