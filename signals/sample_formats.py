"""How IF samples stand in a file: integers, floats or packed values, real or complex.

A complex sample is I + jQ, I before Q; a real sample is one number.  Names follow SigMF, without
"_le" ("ci16_le" is "ci16" here): c or r, kind and bits of a number, "_be" where the higher byte
comes first.  Unsigned bytes ("cu8" of RTL-SDR, "ru8") have their zero at 128, as SigMF has it.

Packed values of 1, 2 or 4 bits have no SigMF name; here they are ci1p, ri2pm, ci4pt and so on: c
or r, i, the bits of a value, p, then how they mean a number and which is the first:

    (none)  sign and magnitude: the highest bit is the sign, the others, m, mean 2 m + 1
    t       two's complement x, means 2 x + 1
    o       offset binary x, means 2 x + 1 - 2^bits
    m       the first value stands in the highest bits of a byte; else in the lowest

    bits    00  01  10  11
    ri2p    +1  +3  -1  -3
    ri2pt   +1  +3  -3  -1
    ri2po   -3  -1  +1  +3

"ci2p" has two samples per byte (bits 0-1: I, 2-3: Q of the first), "ri2p" four.  One bit is a sign
alone, 0 is +1; where 0 means -1 all turns by half a cycle, as unknown as the sign of data bits.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

ZERO = 128
"""What unsigned bytes have for 0; the 127.5 said of RTL-SDR is an offset of half a step from it"""


class Packing(NamedTuple):
    """How values of a few bits stand in a byte."""

    bits: int
    """Of a value: 1, 2 or 4"""
    code: str = ""
    """Sign and magnitude; "t" two's complement, "o" offset binary"""
    highest_first: bool = False

    @property
    def per_byte(self) -> int:
        """Values in a byte."""
        return 8 // self.bits

    @property
    def levels(self) -> np.ndarray:
        """What each code means, int8 (2^bits,): the odd numbers between -2^bits and 2^bits."""
        n = 1 << self.bits
        x = np.arange(n)
        negative, m = x >= n // 2, x % (n // 2)
        if self.code == "":
            x = np.where(negative, -m - 1, m)
        else:
            x = x - n * negative if self.code == "t" else x - n // 2
        return (2 * x + 1).astype(np.int8)

    @property
    def shifts(self) -> np.ndarray:
        """Bits of a byte below its first, second ... value (per_byte,)."""
        up = np.arange(0, 8, self.bits)
        return up[::-1] if self.highest_first else up

    @property
    def text(self) -> str:
        """What one must know to read it."""
        what = {"": "sign and magnitude", "t": "two's complement", "o": "offset binary"}[self.code]
        table = ", ".join(f"{k:0{self.bits}b} {v:+d}" for k, v in enumerate(self.levels.tolist()))
        end = "highest" if self.highest_first else "lowest"
        return f"{self.bits}-bit {what} ({table}), first value in the {end} bits of a byte"


class FileFormat(NamedTuple):
    """One format; a value is a component (I or Q) or a real sample."""

    name: str
    dtype: np.dtype
    """Of a value in the file; of the bytes that hold packed values"""
    components: int
    """2: I and Q; 1: real"""
    sigmf: str | None
    """core:datatype, None where SigMF has no name"""
    packing: Packing | None = None

    @property
    def packed(self) -> bool:
        """Several values in a byte."""
        return self.packing is not None

    @property
    def per_byte(self) -> int:
        """Values that share a byte."""
        return 1 if self.packing is None else self.packing.per_byte

    @property
    def unsigned(self) -> bool:
        """Bytes with `ZERO` for 0."""
        return self.dtype.kind == "u" and not self.packed

    @property
    def real(self) -> bool:
        """No Q."""
        return self.components == 1

    @property
    def bits(self) -> int:
        """Of one sample."""
        return self.components * (self.packing.bits if self.packing else 8 * self.dtype.itemsize)

    @property
    def value_dtype(self) -> np.dtype:
        """Of a value that has been read."""
        return np.dtype(np.int8) if self.dtype.itemsize == 1 else self.dtype.newbyteorder("=")

    def n_bytes(self, n_samples: int) -> int:
        """Bytes that hold ``n_samples``, the last one filled up."""
        return -(-n_samples * self.bits // 8)


_NUMBERS = (
    ("i8", "i1", "i8"), ("i16", "<i2", "i16_le"), ("f32", "<f4", "f32_le"), ("u8", "u1", "u8"),
    ("i16_be", ">i2", "i16_be"), ("f32_be", ">f4", "f32_be"),
)  # fmt: skip
_PACKINGS = [Packing(1, "", m) for m in (False, True)]
_PACKINGS += [Packing(*of) for of in product((2, 4), ("", "t", "o"), (False, True))]
_KINDS = (("c", 2), ("r", 1))
FORMATS = {
    f.name: f
    for f in [
        FileFormat(c + name, np.dtype(dtype), n, c + sigmf)
        for (c, n), (name, dtype, sigmf) in product(_KINDS, _NUMBERS)
    ]
    + [
        FileFormat(f"{c}i{p.bits}p{p.code}{'m' * p.highest_first}", np.dtype("u1"), n, None, p)
        for (c, n), p in product(_KINDS, _PACKINGS)
    ]
}


def file_format(name: str) -> FileFormat:
    """The format of a name; ValueError says those that there are."""
    if name not in FORMATS:
        raise ValueError(
            f"format: {name!r} given, expected one of ci8 ci16 cf32 cu8 ri8 ri16 rf32 ru8, ci16_be "
            "and so on, or packed ci1p ci2p ci4p ri1p ri2p ri4p (t after it: two's complement, o: "
            "offset binary; then m: the first value in the highest bits)"
        )
    return FORMATS[name]


def pack(values: np.ndarray, packing: Packing) -> np.ndarray:
    """Odd values (n,) of few bits to bytes (ceil(n / per_byte),); what is left over is +1.

    Raises
    ------
    ValueError : another value.
    """
    values = np.asarray(values)
    levels, n = packing.levels, 1 << packing.bits
    order = np.argsort(levels)
    at = np.searchsorted(levels[order], values)
    if not (levels[order[np.minimum(at, n - 1)]] == values).all():
        raise ValueError(
            f"{packing.bits}-bit values: expected odd numbers from {1 - n} to {n - 1} only"
        )
    plus_one = int(np.flatnonzero(levels == 1)[0])
    code = np.full(-(-values.size // packing.per_byte) * packing.per_byte, plus_one, np.uint8)
    code[: values.size] = order[at]
    in_byte = code.reshape(-1, packing.per_byte) << packing.shifts
    return np.asarray(in_byte.sum(axis=1), np.uint8)


_UNPACKED = {
    p: p.levels[(np.arange(256)[:, None] >> p.shifts) & ((1 << p.bits) - 1)] for p in _PACKINGS
}


def unpack(packed: np.ndarray, packing: Packing) -> np.ndarray:
    """Bytes (n,) to the values that `pack` took, int8 (per_byte n,)."""
    return _UNPACKED[packing][packed].reshape(-1)


def encode(samples: np.ndarray, form: FileFormat) -> np.ndarray:
    """Samples (n, 2) (complex) or (n,) (real) as they stand in a file, (n_value,) or (n_byte,).

    Values must already be those of the format: nothing is scaled or rounded.
    """
    shape = (len(samples), 2) if form.components == 2 else (len(samples),)
    if samples.shape != shape:
        raise ValueError(f"samples are {samples.shape}: {form.name} takes {shape}")
    values = np.ascontiguousarray(samples).reshape(-1)
    if form.packing:
        return pack(values, form.packing)
    if form.unsigned:
        return _flipped(values.astype(np.int8, casting="same_kind")).view(np.uint8)
    return values.astype(form.dtype, casting="same_kind")


def decode(stored: np.ndarray, form: FileFormat) -> np.ndarray:
    """What `encode` made, as (n, components) of `FileFormat.value_dtype`."""
    if form.packing:
        values = unpack(stored, form.packing)
    elif form.unsigned:
        values = _flipped(stored.view(np.int8))
    else:
        values = stored.astype(form.value_dtype, copy=False)
    return values.reshape(-1, form.components)


def _flipped(values: np.ndarray) -> np.ndarray:
    """128 more or less, int8 as uint8 and back: the highest bit."""
    return values ^ np.int8(-128)
