"""The truth beside an IF file: netCDF, written row by row, every variable with its unit."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import h5netcdf
import h5py
import numpy as np

FORMAT = "ultratight-if-truth-1"
ROW_S = 0.02
"""A row this often, of receiver time; carrier phase in between: cubic through value and Doppler"""

_SAMPLE, _CHANNEL = ("t_s",), ("t_s", "channel")
_VARIABLES: dict[str, tuple[tuple[str, ...], str, str]] = {
    "t_s": (
        _SAMPLE,
        "s",
        "receiver time since the first sample: sample n is taken at n / sample_rate_hz",
    ),
    "r_ea_e": (("t_s", "xyz"), "m", "antenna position, ECEF (WGS-84)"),
    "v_ea_e": (("t_s", "xyz"), "m/s", "antenna velocity over the Earth, ECEF"),
    "lla": (("t_s", "geodetic"), "rad, rad, m", "antenna: geodetic latitude, longitude, height"),
    "clock_m": (_SAMPLE, "m", "receiver clock bias times c, positive when the clock is ahead"),
    "clock_rate_mps": (_SAMPLE, "m/s", "its rate"),
    "code_phase_chips": (
        _CHANNEL,
        "chips",
        "C/A chip under reception, counted from the start of data bit 0; modulo 1023 the phase in "
        "the code, a multiple of 20460 at a data bit edge",
    ),
    "carrier_phase_cycles": (
        _CHANNEL,
        "cycles",
        "phase of the carrier above if_hz: grows with positive Doppler",
    ),
    "doppler_hz": (
        _CHANNEL,
        "Hz",
        "its rate by the receiver's clock, whose drift is in it: positive when approaching",
    ),
    "cn0_dbhz": (_CHANNEL, "dB-Hz", "before quantisation; NaN while below the mask (no signal)"),
    "elevation": (_CHANNEL, "rad", "of the satellite above the ellipsoid's horizon"),
    "azimuth": (_CHANNEL, "rad", "of the satellite, from north through east"),
}


class TruthRows(NamedTuple):
    """Consecutive rows: arrays with n rows, in the order of the file's variables."""

    first: int
    t_s: np.ndarray
    r_ea_e: np.ndarray
    v_ea_e: np.ndarray
    lla: np.ndarray
    clock_m: np.ndarray
    clock_rate_mps: np.ndarray
    code_phase_chips: np.ndarray
    carrier_phase_cycles: np.ndarray
    doppler_hz: np.ndarray
    cn0_dbhz: np.ndarray
    elevation: np.ndarray
    azimuth: np.ndarray


def width(n_channel: int) -> int:
    """Numbers in a row."""
    return sum(_widths(n_channel).values())


def _widths(n_channel: int) -> dict[str, int]:
    size = {"xyz": 3, "geodetic": 3, "channel": n_channel}
    return {name: size[dims[1]] if dims[1:] else 1 for name, (dims, _, _) in _VARIABLES.items()}


def table_of(rows: TruthRows) -> np.ndarray:
    """Rows as numbers, (n, width)."""
    n = len(rows.t_s)
    return np.concatenate([getattr(rows, name).reshape(n, -1) for name in _VARIABLES], axis=1)


def rows_of(table: np.ndarray, first: int, n_channel: int) -> TruthRows:
    """The rows of `table_of`, the first of which has the number ``first``."""
    widths = _widths(n_channel)
    columns = np.split(table, np.cumsum(list(widths.values()))[:-1], axis=1)
    return TruthRows(
        first=first,
        **{
            name: column if _VARIABLES[name][0] != _SAMPLE else column[:, 0]
            for name, column in zip(widths, columns, strict=True)
        },
    )


class TruthFile:
    """A truth file under way.

    Parameters
    ----------
    path : where to.
    n_row : rows that there will be.
    channels : names such as G05:L1CA.
    facts : attributes of the file.
    """

    def __init__(self, path: Path, n_row: int, channels: list[str], facts: dict[str, Any]) -> None:
        self._file = h5netcdf.File(path, "w")
        f = self._file
        f.dimensions = {"t_s": n_row, "channel": len(channels), "xyz": 3, "geodetic": 3}
        for key, value in {"format": FORMAT, **facts}.items():
            f.attrs[key] = value
        for name, labels in (
            ("channel", channels),
            ("xyz", ["x", "y", "z"]),
            ("geodetic", ["latitude", "longitude", "height"]),
        ):
            f.create_variable(name, (name,), h5py.string_dtype())[:] = np.array(labels, object)
        for name, (dims, units, long_name) in _VARIABLES.items():
            v = f.create_variable(name, dims, "f8")
            v.attrs["units"], v.attrs["long_name"] = units, long_name

    def __enter__(self) -> TruthFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, rows: TruthRows) -> None:
        """Write rows where they belong."""
        part = slice(rows.first, rows.first + len(rows.t_s))
        for name in _VARIABLES:
            self._file.variables[name][part] = getattr(rows, name)

    def write_bits(self, first: int, bits: np.ndarray) -> None:
        """Data bits (n_channel, n_bit) of +-1; bit k is sent under code phases from 20460 k on."""
        f = self._file
        f.dimensions["bit"] = bits.shape[1]
        numbers = f.create_variable("bit", ("bit",), "i8")
        numbers[:] = np.arange(first, first + bits.shape[1])
        numbers.attrs["units"] = "1"
        numbers.attrs["long_name"] = "number of the data bit: floor(code_phase_chips / 20460)"
        v = f.create_variable("data_bits", ("channel", "bit"), "i1")
        v[:] = bits
        v.attrs["units"], v.attrs["long_name"] = "1", "data bits as sent, logical 0 is +1"
