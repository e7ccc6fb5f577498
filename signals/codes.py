"""Ranging codes: every signal is a row of facts with the clause of its interface document."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from signals import icd_beidou, icd_galileo, icd_gps, modulation
from signals.constants import (
    BEIDOU_B1I_HZ,
    CA_CHIP_RATE_HZ,
    GPS_L1_HZ,
    GPS_L2_HZ,
    GPS_L5_HZ,
)
from signals.generators import (
    L2C_PRNS,
    beidou_b1i,
    beidou_weil,
    galileo_cs100,
    galileo_e5a,
    gps_ca,
    gps_l1c,
    gps_l1c_overlay,
    gps_l2c,
    gps_l5,
    shared_code,
)
from signals.memory_codes import read_memory_codes
from signals.modulation import bpsk
from signals.signal_row import Signal

# -- GPS -----------------------------------------------------------------------------------------


_NH10 = shared_code("0000110101")
_NH20 = shared_code("00000100110101001110")
_HALF_RATE_HZ = CA_CHIP_RATE_HZ / 2.0

GPS_L1CA = Signal(
    label="L1CA",
    system="G",
    name="GPS L1 C/A",
    carrier_hz=GPS_L1_HZ,  # IS-GPS-200 3.3.1.1
    chip_rate_hz=CA_CHIP_RATE_HZ,  # 3.2.1.3
    length_chips=1023,
    symbol_s=0.02,  # 50 bit/s, 3.3.2.2
    modulation=bpsk(1),
    prns=range(1, 211),
    generate=gps_ca,
)
# IS-GPS-200 3.2.1.4, 3.2.1.5, 3.2.2: chips of both codes take turns at 1.023 Mcps; CNAV 50 symb/s
_L2C = partial(Signal, system="G", carrier_hz=GPS_L2_HZ, chip_rate_hz=_HALF_RATE_HZ, prns=L2C_PRNS)
GPS_L2CM = _L2C(
    label="L2CM",
    name="GPS L2 CM",
    length_chips=10_230,
    symbol_s=0.02,
    modulation=modulation.FIRST_HALF,
    generate=partial(gps_l2c, icd_gps.L2CM_INITIAL, 10_230),
)
GPS_L2CL = _L2C(
    label="L2CL",
    name="GPS L2 CL",
    length_chips=767_250,
    symbol_s=1.5,
    modulation=modulation.SECOND_HALF,
    generate=partial(gps_l2c, icd_gps.L2CL_INITIAL, 767_250),
    pilot=True,
)
# IS-GPS-705 3.2.1.1, 3.3.2, 3.3.3: 100 symb/s with NH10 on I5; NH20 on Q5
_L5 = partial(
    Signal,
    system="G",
    carrier_hz=GPS_L5_HZ,
    chip_rate_hz=10.0 * CA_CHIP_RATE_HZ,
    length_chips=10_230,
    modulation=bpsk(10),
    prns=range(1, 211),
)
GPS_L5I = _L5(
    label="L5I",
    name="GPS L5 I5",
    symbol_s=0.01,
    generate=partial(gps_l5, icd_gps.L5I_XB_ADVANCE),
    secondary=_NH10,
)
GPS_L5Q = _L5(
    label="L5Q",
    name="GPS L5 Q5",
    symbol_s=0.02,
    generate=partial(gps_l5, icd_gps.L5Q_XB_ADVANCE),
    secondary=_NH20,
    pilot=True,
)
# IS-GPS-800 3.2.1.6, 3.2.2.1, 3.3: 100 symb/s data, 1800 overlay chips of 10 ms on the pilot
_L1C = partial(
    Signal,
    system="G",
    carrier_hz=GPS_L1_HZ,
    chip_rate_hz=CA_CHIP_RATE_HZ,
    length_chips=10_230,
    symbol_s=0.01,
    prns=range(1, 64),
)
GPS_L1CD = _L1C(
    label="L1CD",
    name="GPS L1C data",
    modulation=modulation.BOC11,
    generate=partial(gps_l1c, icd_gps.L1CD_WEIL),
)
GPS_L1CP = _L1C(
    label="L1CP",
    name="GPS L1C pilot",
    modulation=modulation.TMBOC,
    generate=partial(gps_l1c, icd_gps.L1CP_WEIL),
    secondary=gps_l1c_overlay,
    pilot=True,
)


# -- Galileo -------------------------------------------------------------------------------------


# Galileo OS SIS ICD 2.1, 2.3.1, 3.4.1, 3.5: F/NAV 50 symb/s with CS20 on E5a-I, CS100 on E5a-Q
_E5A = partial(
    Signal,
    system="E",
    carrier_hz=GPS_L5_HZ,
    chip_rate_hz=10.0 * CA_CHIP_RATE_HZ,
    length_chips=10_230,
    modulation=bpsk(10),
    prns=range(1, 51),
)
GALILEO_E5AI = _E5A(
    label="E5AI",
    name="Galileo E5a-I",
    symbol_s=0.02,
    generate=partial(galileo_e5a, (4, 5, 7, 8, 12, 14), icd_galileo.E5AI_START),
    secondary=shared_code("10000100001011101001"),
)
GALILEO_E5AQ = _E5A(
    label="E5AQ",
    name="Galileo E5a-Q",
    symbol_s=0.1,
    generate=partial(galileo_e5a, (4, 5, 7, 8, 12, 14), icd_galileo.E5AQ_START),
    secondary=galileo_cs100,
    pilot=True,
)


_NO_CODES: dict[int, np.ndarray] = {}
# Galileo OS SIS ICD 2.1, 2.3.3, 3.4.2, 3.5: I/NAV at 250 symb/s on E1-B, CS25 on E1-C; the codes
# are those of a file
_E1 = partial(
    Signal,
    system="E",
    carrier_hz=GPS_L1_HZ,
    chip_rate_hz=CA_CHIP_RATE_HZ,
    length_chips=4092,
    prns=(),
    generate=_NO_CODES.__getitem__,
)
_E1B = _E1(
    label="E1B",
    name="Galileo E1-B",
    symbol_s=0.004,
    modulation=modulation.CBOC_PLUS,
)
_E1C = _E1(
    label="E1C",
    name="Galileo E1-C",
    symbol_s=0.1,
    modulation=modulation.CBOC_MINUS,
    secondary=shared_code("0011100000001010110110010"),
    pilot=True,
)


def galileo_e1(path: str | Path) -> tuple[Signal, Signal]:
    """E1-B and E1-C with the memory codes of a file (`memory_codes.read_memory_codes`).

    Raises
    ------
    ValueError
        The file is missing, or something in it is not as expected.
    """
    codes = read_memory_codes(Path(path))
    e1b, e1c = (
        replace(row, prns=tuple(codes[row.label]), generate=codes[row.label].__getitem__)
        for row in (_E1B, _E1C)
    )
    return e1b, e1c


# -- BeiDou --------------------------------------------------------------------------------------


_B1I = partial(
    Signal,
    system="C",
    carrier_hz=BEIDOU_B1I_HZ,
    chip_rate_hz=2.0 * CA_CHIP_RATE_HZ,
    length_chips=2046,
    modulation=bpsk(2),
    generate=beidou_b1i,
)
# BDS-SIS-ICD-B1I 4.2, 5.1: D1 with NH20 at 50 bit/s, D2 of geostationary satellites at 500 bit/s
BEIDOU_B1I = _B1I(label="B1I", name="BeiDou B1I", symbol_s=0.02, prns=range(6, 59), secondary=_NH20)
BEIDOU_B1I_GEO = _B1I(
    label="B1IG", name="BeiDou B1I (D2)", symbol_s=0.002, prns=(*range(1, 6), *range(59, 64))
)
# BDS-SIS-ICD-B1C 4.2, 5.2: 100 symb/s data, 1800 secondary chips of 10 ms on the pilot
_B1C = partial(
    Signal,
    system="C",
    carrier_hz=GPS_L1_HZ,
    chip_rate_hz=CA_CHIP_RATE_HZ,
    length_chips=10_230,
    symbol_s=0.01,
    prns=range(1, 64),
)
BEIDOU_B1CD = _B1C(
    label="B1CD",
    name="BeiDou B1C data",
    modulation=modulation.BOC11,
    generate=partial(beidou_weil, 10_243, 10_230, icd_beidou.B1CD_WEIL),
)
BEIDOU_B1CP = _B1C(
    label="B1CP",
    name="BeiDou B1C pilot",
    modulation=modulation.QMBOC,
    generate=partial(beidou_weil, 10_243, 10_230, icd_beidou.B1CP_WEIL),
    secondary=partial(beidou_weil, 3607, 1800, icd_beidou.B1CP_SECONDARY),
    pilot=True,
)

SIGNALS = {
    row.label: row
    for row in (
        GPS_L1CA, GPS_L1CD, GPS_L1CP, GPS_L2CM, GPS_L2CL, GPS_L5I, GPS_L5Q,
        GALILEO_E5AI, GALILEO_E5AQ, BEIDOU_B1I, BEIDOU_B1I_GEO, BEIDOU_B1CD, BEIDOU_B1CP,
    )
}  # fmt: skip
"""Signals whose codes can be generated, by label; for E1B and E1C see `galileo_e1`"""
_ROWS = SIGNALS | {row.label: row for row in (_E1B, _E1C)}
LABELS = tuple(_ROWS)
PILOTS = frozenset(row.label for row in _ROWS.values() if row.pilot)


def facts(label: str) -> Signal:
    """The row of a label of `LABELS`; those of E1B and E1C are without their codes."""
    return _ROWS[label]


def signal(label: str, memory_codes: str | Path | None = None) -> Signal:
    """The row of a label; E1B and E1C need the file of their memory codes.

    Raises
    ------
    ValueError
        There is no such signal, or its file is missing, not given, or not as expected.
    """
    if label in SIGNALS:
        return SIGNALS[label]
    if label not in ("E1B", "E1C"):
        raise ValueError(f"signal {label!r}: expected one of {', '.join(LABELS)}")
    if memory_codes is None:
        raise ValueError(f"{label}: no memory codes given, expected a file that has them")
    return galileo_e1(memory_codes)[label == "E1C"]
