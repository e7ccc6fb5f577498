"""Every format of a file: what goes in comes out, and the bytes are those that are promised."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from signals.sample_formats import FORMATS, FileFormat, Packing, decode, encode, file_format

pytestmark = pytest.mark.nojit
LIMITS = {"i1": (-128, 127), "i2": (-32768, 32767), "f4": (-1e6, 1e6)}
PACKED = [f for f in FORMATS.values() if f.packing]


def odd(packing: Packing) -> list[int]:
    """What values of so many bits can be."""
    return list(range(1 - 2**packing.bits, 2**packing.bits, 2))


@pytest.mark.parametrize("form", [f for f in PACKED if f.real], ids=lambda f: f.name)
@given(data=st.data())
def test_packed_values_come_back(form: FileFormat, data: st.DataObject) -> None:
    """What does not fill the last byte is +1."""
    assert form.packing is not None
    values = data.draw(st.lists(st.sampled_from(odd(form.packing)), max_size=30))
    packed = encode(np.array(values, np.int8), form)
    assert packed.dtype == np.uint8
    assert packed.size == form.n_bytes(len(values)) == -(-len(values) // form.per_byte)
    back = decode(packed, form)[:, 0]
    assert back[: len(values)].tolist() == values
    assert set(back[len(values) :].tolist()) <= {1}


@pytest.mark.parametrize("form", [f for f in PACKED if f.real], ids=lambda f: f.name)
def test_every_byte_is_some_packed_values(form: FileFormat) -> None:
    stored = np.arange(256, dtype=np.uint8)
    assert encode(decode(stored, form)[:, 0], form).tobytes() == stored.tobytes()


def test_packed_bits_stand_where_the_format_says() -> None:
    """Sign and magnitude, first value lowest, I before Q: worked out by hand."""
    # +1 +3 -1 -3 is 00 01 10 11, from the lowest bits upwards
    assert encode(np.array([1, 3, -1, -3]), FORMATS["ri2p"]).tolist() == [0b11_10_01_00]
    iq = np.array([[-3, 1], [3, -1], [-1, -1]], np.int8)
    assert encode(iq, FORMATS["ci2p"]).tolist() == [0b10_01_00_11, 0b00_00_10_10]
    assert encode(iq, FORMATS["ci2pm"]).tolist() == [0b11_00_01_10, 0b10_10_00_00]
    signs = np.array([1, -1, -1, 1, 1, 1, 1, -1, -1])
    assert encode(signs, FORMATS["ri1p"]).tolist() == [0b1000_0110, 0b0000_0001]
    assert encode(signs, FORMATS["ri1pm"]).tolist() == [0b0110_0001, 0b1000_0000]
    assert encode(np.array([-5, 15]), FORMATS["ri4p"]).tolist() == [0b0111_1010]


def test_packed_values_as_other_receivers_document_them() -> None:
    """2 bits: gnss-sdr, unpack_2bit_samples.h (00 +1, 01 +3, 10 -3, 11 -1, in either order in a
    byte); complex: unpack_byte_2bit_cpx_samples.h (first sample in the most significant nibble,
    nibble Q1 Q0 I1 I0, 2 x + 1); 4 bits: unpack_byte_4bit_samples.cc (lower nibble first, 2 x + 1
    of two's complement); offset binary: the ION GNSS SDR Metadata Standard's OBA, as opengpssim
    packs it (dataformats.txt: 01110010 is 01 11 00 10, that is -1, 3, -3, 1).
    """
    byte = np.array([0b01_11_00_10], np.uint8)
    assert decode(byte, FORMATS["ri2ptm"])[:, 0].tolist() == [3, -1, 1, -3]
    assert decode(byte, FORMATS["ri2pt"])[:, 0].tolist() == [-3, 1, -1, 3]
    assert decode(byte, FORMATS["ri2pom"])[:, 0].tolist() == [-1, 3, -3, 1]
    q_first = decode(byte, FORMATS["ci2ptm"])
    assert q_first[:, ::-1].tolist() == [[-1, 3], [-3, 1]]  # with --swap-iq: I, Q
    nibbles = np.array([0x7F, 0x80], np.uint8)
    assert decode(nibbles, FORMATS["ri4pt"])[:, 0].tolist() == [-1, 15, 1, -15]


def test_unsigned_bytes_have_their_zero_at_128() -> None:
    """As the SigMF library has it; its "cu8" is that of RTL-SDR."""
    stored = np.array([0, 255, 128, 127], np.uint8)
    values = decode(stored, FORMATS["cu8"])
    assert values.dtype == np.int8
    assert values.tolist() == [[-128, 127], [0, -1]]
    assert encode(values, FORMATS["cu8"]).tobytes() == stored.tobytes()


@pytest.mark.parametrize("form", PACKED, ids=lambda f: f.name)
def test_other_values_cannot_be_packed(form: FileFormat) -> None:
    assert form.packing is not None
    most = 2**form.packing.bits - 1
    shape = (-1,) if form.real else (-1, 2)
    for wrong in (0, 2, most + 2, -most - 2, -100, 100, 0.5):
        with pytest.raises(ValueError, match=f"expected odd numbers from {-most} to {most} only"):
            encode(np.array([1.0, wrong]).reshape(shape), form)


@pytest.mark.parametrize("name", FORMATS)
@given(data=st.data())
def test_every_format_comes_back(name: str, data: st.DataObject) -> None:
    form = FORMATS[name]
    n = data.draw(st.integers(0, 12)) * form.components
    if form.packing:
        n = n // form.per_byte * form.per_byte
        each = st.sampled_from(odd(form.packing))
    else:
        low, high = LIMITS[form.value_dtype.str[1:]]
        each = st.floats(low, high, width=32) if form.dtype.kind == "f" else st.integers(low, high)
    values = np.array(data.draw(st.lists(each, min_size=n, max_size=n))).astype(form.value_dtype)
    samples = values if form.real else values.reshape(-1, 2)
    stored = encode(samples, form)
    assert stored.nbytes == form.n_bytes(len(samples))
    back = decode(np.frombuffer(stored.tobytes(), form.dtype), form)
    assert back.dtype == form.value_dtype
    np.testing.assert_array_equal(back, samples.reshape(-1, form.components))


def test_the_order_of_bytes_is_that_of_the_name() -> None:
    big_endian = np.array([[1, -2]], ">i2")
    assert encode(big_endian, FORMATS["ci16"]).tobytes() == b"\x01\x00\xfe\xff"
    assert encode(big_endian, FORMATS["ci16_be"]).tobytes() == b"\x00\x01\xff\xfe"


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="'ci4' given, expected one of ci8 ci16 cf32 cu8"):
        file_format("ci4")
    with pytest.raises(ValueError, match=r"ri8 takes \(4,\)"):
        encode(np.zeros((4, 2), np.int8), FORMATS["ri8"])
    with pytest.raises(TypeError, match="same_kind"):
        encode(np.zeros((4, 2), np.float32), FORMATS["ci8"])
