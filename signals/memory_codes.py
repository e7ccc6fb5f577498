"""Galileo E1 memory codes, read from a file: they cannot be generated, and do not ship."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

HEADER = "prn,signal,hex_1023_digits_msb_first"
_DIGITS = 1023  # 4092 chips
_HEX = frozenset("0123456789abcdefABCDEF")

Codes = dict[str, dict[int, np.ndarray]]


def read_memory_codes(path: Path) -> Codes:
    """E1B and E1C -> prn -> (4092,) of logical 0 and 1, read-only.

    A line is ``prn,E1B or E1C,1023 hexadecimal digits`` below the header `HEADER`; the most
    significant bit of the first digit is the first chip (Galileo OS SIS ICD, annex C).

    Raises
    ------
    ValueError
        Names file, line and what was expected.
    """
    try:
        stamp = path.stat().st_mtime_ns
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file, expected Galileo E1 memory codes (CSV)") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    return _read(path, stamp)


@cache
def _read(path: Path, stamp: int) -> Codes:
    """`read_memory_codes` of a file as it was at the time ``stamp``."""
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file, expected Galileo E1 memory codes") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    if not lines or lines[0].strip() != HEADER:
        given = repr(lines[0][:40]) if lines else "an empty file"
        raise ValueError(f"{path} line 1: {given} given, expected the header {HEADER}")
    codes: Codes = {"E1B": {}, "E1C": {}}
    for number, line in enumerate(lines[1:], start=2):
        if line.strip():
            prn, signal, bits = _row(f"{path} line {number}", line)
            if prn in codes[signal]:
                raise ValueError(f"{path} line {number}: {signal} of PRN {prn} is given twice")
            codes[signal][prn] = bits
    for signal, rows in codes.items():
        if not rows:
            raise ValueError(f"{path}: no {signal} code in the file, expected at least one")
    return {signal: dict(sorted(rows.items())) for signal, rows in codes.items()}


def _row(where: str, line: str) -> tuple[int, str, np.ndarray]:
    fields = [field.strip() for field in line.split(",")]
    if len(fields) != 3:
        raise ValueError(f"{where}: {len(fields)} fields, expected 3 ({HEADER})")
    prn, signal, digits = fields
    if not (prn.isdecimal() and 1 <= int(prn) <= 50):
        raise ValueError(f"{where}: prn {prn!r} given, expected a whole number 1 to 50")
    if signal not in ("E1B", "E1C"):
        raise ValueError(f"{where}: signal {signal!r} given, expected E1B or E1C")
    foreign = next((d for d in digits if d not in _HEX), None)
    if foreign is not None:
        raise ValueError(f"{where}: {foreign!r} in the code, expected hexadecimal digits")
    if len(digits) != _DIGITS:
        raise ValueError(f"{where}: {len(digits)} digits, expected {_DIGITS} (4092 chips)")
    bits = np.unpackbits(np.frombuffer(bytes.fromhex(digits + "0"), np.uint8))[: 4 * _DIGITS]
    bits.flags.writeable = False
    return int(prn), signal, bits
