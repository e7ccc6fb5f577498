"""How IF samples stand in a file: integers, floats or packed 2-bit values, real or complex.

A complex sample is I + jQ, I before Q; a real sample is one number.  Multi-byte numbers are little
endian.  Names follow SigMF ("ci16_le" is "ci16" here); the packed formats have no SigMF name:

    bits     00  01  10  11      sign and magnitude: the higher bit is the sign, the lower one
    value    +1  +3  -1  -3      tells 3 from 1

with the first value in the two lowest bits of a byte.  "ci2p" has two samples per byte (bits 0-1:
I, 2-3: Q of the first), "ri2p" four.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

VALUES_PER_BYTE = 4
"""2-bit values in a byte of a packed format"""


class FileFormat(NamedTuple):
    """One format; a value is a component (I or Q) or a real sample."""

    name: str
    dtype: np.dtype
    """Of a value in the file; of the bytes that hold packed values"""
    components: int
    """2: I and Q; 1: real"""
    sigmf: str | None
    """core:datatype, None where SigMF has no name"""

    @property
    def packed(self) -> bool:
        """Four values in a byte."""
        return self.sigmf is None

    @property
    def real(self) -> bool:
        """No Q."""
        return self.components == 1

    @property
    def bits(self) -> int:
        """Of one sample."""
        return self.components * (2 if self.packed else 8 * self.dtype.itemsize)

    def n_bytes(self, n_samples: int) -> int:
        """Bytes that hold ``n_samples``, the last one filled up."""
        return -(-n_samples * self.bits // 8)


FORMATS = {
    f.name: f
    for f in (
        FileFormat("ci8", np.dtype("i1"), 2, "ci8"),
        FileFormat("ci16", np.dtype("<i2"), 2, "ci16_le"),
        FileFormat("cf32", np.dtype("<f4"), 2, "cf32_le"),
        FileFormat("ri8", np.dtype("i1"), 1, "ri8"),
        FileFormat("ri16", np.dtype("<i2"), 1, "ri16_le"),
        FileFormat("rf32", np.dtype("<f4"), 1, "rf32_le"),
        FileFormat("ci2p", np.dtype("u1"), 2, None),
        FileFormat("ri2p", np.dtype("u1"), 1, None),
    )
}


def file_format(name: str) -> FileFormat:
    """The format of a name; ValueError lists those that there are."""
    if name not in FORMATS:
        raise ValueError(f"format: {name!r} given, expected one of {', '.join(FORMATS)}")
    return FORMATS[name]


def pack(values: np.ndarray) -> np.ndarray:
    """2-bit values (n,) of -3, -1, 1, 3 to bytes (ceil(n / 4),); what is left over is +1.

    Raises
    ------
    ValueError : another value.
    """
    values = np.asarray(values)
    magnitude = np.abs(values)
    if not np.isin(magnitude, (1, 3)).all():
        raise ValueError("2-bit values: expected -3, -1, 1 and 3 only")
    code = np.zeros(-(-values.size // VALUES_PER_BYTE) * VALUES_PER_BYTE, np.uint8)
    code[: values.size] = 2 * (values < 0) + (magnitude == 3)
    a, b, c, d = code.reshape(-1, VALUES_PER_BYTE).T
    return a | b << 2 | c << 4 | d << 6


_LEVELS = np.array([1, 3, -1, -3], np.int8)
_UNPACKED = _LEVELS[(np.arange(256)[:, None] >> np.array([0, 2, 4, 6])) & 3]


def unpack(packed: np.ndarray) -> np.ndarray:
    """Bytes (n,) to the 2-bit values that `pack` took, int8 (4 n,)."""
    return _UNPACKED[packed].reshape(-1)


def encode(samples: np.ndarray, form: FileFormat) -> np.ndarray:
    """Samples (n, 2) (complex) or (n,) (real) as they stand in a file, (n_value,) or (n_byte,).

    Values must already be those of the format: nothing is scaled or rounded.
    """
    shape = (len(samples), 2) if form.components == 2 else (len(samples),)
    if samples.shape != shape:
        raise ValueError(f"samples are {samples.shape}: {form.name} takes {shape}")
    values = np.ascontiguousarray(samples).reshape(-1)
    return pack(values) if form.packed else values.astype(form.dtype, casting="same_kind")


def decode(stored: np.ndarray, form: FileFormat) -> np.ndarray:
    """What `encode` made, as (n, components): int8, int16 or float32."""
    values = unpack(stored) if form.packed else stored
    return values.reshape(-1, form.components)
