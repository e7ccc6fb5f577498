"""Every format of a file: what goes in comes out, and the bytes are those that are promised."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from signals.sample_formats import FORMATS, decode, encode, file_format, pack, unpack

pytestmark = pytest.mark.nojit
LIMITS = {"i1": (-128, 127), "<i2": (-32768, 32767), "<f4": (-1e6, 1e6)}


@given(st.lists(st.sampled_from([-3, -1, 1, 3]), max_size=50))
def test_2_bit_values_come_back(values: list[int]) -> None:
    packed = pack(np.array(values, np.int8))
    assert packed.size == -(-len(values) // 4)
    back = unpack(packed)
    assert back[: len(values)].tolist() == values
    assert set(back[len(values) :].tolist()) <= {1}


@given(st.binary(max_size=40))
def test_every_byte_is_some_2_bit_values(content: bytes) -> None:
    stored = np.frombuffer(content, np.uint8)
    assert pack(unpack(stored)).tobytes() == content


def test_packed_bits_stand_where_the_format_says() -> None:
    """Sign and magnitude, first value lowest, I before Q: worked out by hand."""
    # +1 +3 -1 -3 is 00 01 10 11, from the lowest bits upwards
    assert pack(np.array([1, 3, -1, -3])).tolist() == [0b11_10_01_00]
    iq = np.array([[-3, 1], [3, -1], [-1, -1]], np.int8)
    assert encode(iq, FORMATS["ci2p"]).tolist() == [0b10_01_00_11, 0b00_00_10_10]


def test_other_values_cannot_be_packed() -> None:
    for wrong in (0, 2, -4, 0.5):
        with pytest.raises(ValueError, match="expected -3, -1, 1 and 3 only"):
            pack(np.array([1.0, wrong]))


@pytest.mark.parametrize("name", FORMATS)
@given(data=st.data())
def test_every_format_comes_back(name: str, data: st.DataObject) -> None:
    form = FORMATS[name]
    n = data.draw(st.integers(0, 12)) * form.components
    if form.packed:
        n = n // 4 * 4
        each = st.sampled_from([-3, -1, 1, 3])
    else:
        low, high = LIMITS[form.dtype.str.replace("|", "")]
        each = st.floats(low, high, width=32) if form.dtype.kind == "f" else st.integers(low, high)
    values = np.array(data.draw(st.lists(each, min_size=n, max_size=n)))
    values = values.astype(np.int8 if form.packed else form.dtype)
    samples = values if form.real else values.reshape(-1, 2)
    stored = encode(samples, form)
    assert stored.nbytes == form.n_bytes(len(samples))
    back = decode(np.frombuffer(stored.tobytes(), form.dtype), form)
    np.testing.assert_array_equal(back, samples.reshape(-1, form.components))


def test_multi_byte_numbers_are_little_endian() -> None:
    big_endian = np.array([[1, -2]], ">i2")
    assert encode(big_endian, FORMATS["ci16"]).tobytes() == b"\x01\x00\xfe\xff"


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="'ci4' given, expected one of ci8, ci16"):
        file_format("ci4")
    with pytest.raises(ValueError, match=r"ri8 takes \(4,\)"):
        encode(np.zeros((4, 2), np.int8), FORMATS["ri8"])
    with pytest.raises(TypeError, match="same_kind"):
        encode(np.zeros((4, 2), np.float32), FORMATS["ci8"])
