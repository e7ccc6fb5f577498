"""Fields of the LNAV subframes as tables: place, scale, and the element that they carry.

IS-GPS-200 figure 20-1 (places), tables 20-I and 20-III (ephemeris and clock), 20-VI (almanac) and
20.3.3.5.1.6-7 (UTC, ionosphere).  Numbers are two's complement where signed; a number of the
message times its scale, plus its offset, is the element in the unit of `signals.satellites`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from signals import satellites as s
from signals.constants import PI_GPS
from signals.lnav_words import put, take

ALTERNATING = int("10" * 120, 2)
"""240 bits of alternating ones and zeros: what spare bits hold (20.3.3.5.1)"""


class Field(NamedTuple):
    """One number of a subframe."""

    name: str
    places: tuple[tuple[int, int, int], ...]
    """(word, first bit, length), most significant part first; a part may run on into the next word
    without its parity"""
    scale: float = 1.0
    signed: bool = False
    column: int = -1
    """Column of `satellites`, or -1"""
    offset: float = 0.0
    circular: bool = False
    """An angle whose full turn is the number's range"""

    @property
    def length(self) -> int:
        """Number of bits."""
        return sum(length for _, _, length in self.places)

    def integer(self, value: float) -> int:
        """Nearest number of the message; ValueError where it does not fit."""
        n = round((value - self.offset) / self.scale)
        low = -(1 << self.length - 1) if self.signed else 0
        high = low + (1 << self.length) - 1
        if self.circular:
            n = (n - low) % (1 << self.length) + low
        if not low <= n <= high:
            raise ValueError(
                f"{self.name} = {value:.10g} does not fit the LNAV message: expected "
                f"{low * self.scale + self.offset:.10g} to {high * self.scale + self.offset:.10g}"
            )
        return n

    def value(self, integer: int) -> float:
        """Element from the number of the message."""
        return integer * self.scale + self.offset


_PI = PI_GPS  # semicircles to radians


def _angle(name: str, at: tuple[int, int, int], power: int, column: int) -> Field:
    return Field(name, (at,), _PI * 2.0**power, True, column, circular=True)


SUBFRAME_1 = (
    Field("week10", ((3, 1, 10),)),
    Field("code_on_l2", ((3, 11, 2),)),
    Field("ura", ((3, 13, 4),)),
    Field("health", ((3, 17, 6),)),
    Field("iodc", ((3, 23, 2), (8, 1, 8))),
    Field("l2p_off", ((4, 1, 1),)),
    Field("T_GD", ((7, 17, 8),), 2.0**-31, True, s.TGD),
    Field("toc", ((8, 9, 16),), 16.0, False, s.TOC),
    Field("a_f2", ((9, 1, 8),), 2.0**-55, True, s.AF2),
    Field("a_f1", ((9, 9, 16),), 2.0**-43, True, s.AF1),
    Field("a_f0", ((10, 1, 22),), 2.0**-31, True, s.AF0),
)
SUBFRAME_2 = (
    Field("iode", ((3, 1, 8),)),
    Field("C_rs", ((3, 9, 16),), 2.0**-5, True, s.CRS),
    Field("delta_n", ((4, 1, 16),), _PI * 2.0**-43, True, s.DELTA_N),
    _angle("M_0", (4, 17, 32), -31, s.M0),
    Field("C_uc", ((6, 1, 16),), 2.0**-29, True, s.CUC),
    Field("e", ((6, 17, 32),), 2.0**-33, False, s.ECC),
    Field("C_us", ((8, 1, 16),), 2.0**-29, True, s.CUS),
    Field("sqrt(A)", ((8, 17, 32),), 2.0**-19, False, s.SQRT_A),
    Field("toe", ((10, 1, 16),), 16.0, False, s.TOE),
    Field("fit_interval", ((10, 17, 1),)),
    Field("aodo", ((10, 18, 5),)),
)
SUBFRAME_3 = (
    Field("C_ic", ((3, 1, 16),), 2.0**-29, True, s.CIC),
    _angle("Omega_0", (3, 17, 32), -31, s.OMEGA0),
    Field("C_is", ((5, 1, 16),), 2.0**-29, True, s.CIS),
    _angle("i_0", (5, 17, 32), -31, s.I0),
    Field("C_rc", ((7, 1, 16),), 2.0**-5, True, s.CRC),
    _angle("omega", (7, 17, 32), -31, s.OMEGA),
    Field("Omega_dot", ((9, 1, 24),), _PI * 2.0**-43, True, s.OMEGA_DOT),
    Field("iode", ((10, 1, 8),)),
    Field("IDOT", ((10, 9, 14),), _PI * 2.0**-43, True, s.IDOT),
)
PAGE_ID = (Field("data_id", ((3, 1, 2),)), Field("page_id", ((3, 3, 6),)))
ALMANAC = (
    *PAGE_ID,
    Field("e", ((3, 9, 16),), 2.0**-21, False, s.ECC),
    Field("toa", ((4, 1, 8),), 4096.0, False, s.TOE),
    Field("delta_i", ((4, 9, 16),), _PI * 2.0**-19, True, s.I0, offset=0.3 * _PI),
    Field("Omega_dot", ((5, 1, 16),), _PI * 2.0**-38, True, s.OMEGA_DOT),
    Field("health8", ((5, 17, 8),)),
    Field("sqrt(A)", ((6, 1, 24),), 2.0**-11, False, s.SQRT_A),
    _angle("Omega_0", (7, 1, 24), -23, s.OMEGA0),
    _angle("omega", (8, 1, 24), -23, s.OMEGA),
    _angle("M_0", (9, 1, 24), -23, s.M0),
    Field("a_f0", ((10, 1, 8), (10, 20, 3)), 2.0**-20, True, s.AF0),
    Field("a_f1", ((10, 9, 11),), 2.0**-38, True, s.AF1),
)
IONOSPHERE_UTC = (
    *PAGE_ID,
    *(
        Field(f"alpha{k}", (place,), 2.0**power, True)
        for k, (place, power) in enumerate(
            (((3, 9, 8), -30), ((3, 17, 8), -27), ((4, 1, 8), -24), ((4, 9, 8), -24))
        )
    ),
    *(
        Field(f"beta{k}", (place,), 2.0**power, True)
        for k, (place, power) in enumerate(
            (((4, 17, 8), 11), ((5, 1, 8), 14), ((5, 9, 8), 16), ((5, 17, 8), 16))
        )
    ),
    Field("a1", ((6, 1, 24),), 2.0**-50, True),
    Field("a0", ((7, 1, 32),), 2.0**-30, True),
    Field("tot_s", ((8, 9, 8),), 4096.0),
    Field("wn_t", ((8, 17, 8),)),
    Field("leap_s", ((9, 1, 8),), 1.0, True),
    Field("wn_lsf", ((9, 9, 8),)),
    Field("day", ((9, 17, 8),)),
    Field("leap_future_s", ((10, 1, 8),), 1.0, True),
)
_EPHEMERIS = tuple(f for f in (*SUBFRAME_1, *SUBFRAME_2, *SUBFRAME_3) if f.column >= 0)


def pack(fields: tuple[Field, ...], integers: Mapping[str, int]) -> int:
    """Subframe data with the fields in their places and alternating bits elsewhere."""
    data = ALTERNATING
    for field in fields:
        n = integers[field.name]
        left = field.length
        for word, bit, length in field.places:
            left -= length
            data = put(data, word, bit, length, n >> left)
    return data


def unpack(fields: tuple[Field, ...], data: int) -> dict[str, int]:
    """Whole numbers of a subframe, signed where the field is."""
    integers = {}
    for field in fields:
        n = 0
        for word, bit, length in field.places:
            n = n << length | take(data, word, bit, length)
        if field.signed and n >> field.length - 1:
            n -= 1 << field.length
        integers[field.name] = n
    return integers


def from_elements(fields: tuple[Field, ...], row: np.ndarray) -> dict[str, int]:
    """Numbers of the fields that carry an element of ``row`` (N_ELEMENT,)."""
    return {f.name: f.integer(float(row[f.column])) for f in fields if f.column >= 0}


def into_elements(fields: tuple[Field, ...], integers: Mapping[str, int], row: np.ndarray) -> None:
    """Write the elements that the fields carry into ``row`` (N_ELEMENT,)."""
    for f in fields:
        if f.column >= 0:
            row[f.column] = f.value(integers[f.name])


def quantise(rows: np.ndarray) -> np.ndarray:
    """Elements (n, N_ELEMENT) as a receiver decodes them from LNAV.

    Raises
    ------
    ValueError
        An element outside the range of its field.
    """
    out = np.array(rows, dtype=np.float64)
    for row in out:
        into_elements(_EPHEMERIS, from_elements(_EPHEMERIS, row), row)
    return out
