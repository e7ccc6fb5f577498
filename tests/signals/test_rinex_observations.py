"""RINEX observations: another program's reader finds the numbers that were written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import georinex
import numpy as np
import pytest

from signals.constants import C_MPS, GPS_L1_HZ
from signals.rinex_observations import write_observations

WEEK = 2149
PRN = np.array([17, 2])


def some(n: int = 3) -> dict[str, Any]:
    """Epochs of 0.5 s over the end of a week; PRN 2 is not there in the second."""
    k = np.arange(n)[:, None]
    rho = 2.1e7 + 1e6 * np.arange(2) + 300.25 * k
    rho[1, 1] = np.nan
    return {
        "week": WEEK,
        "tow_ms": 604_799_000 + 500 * np.arange(n),
        "prn": PRN,
        "pseudorange_m": rho,
        "carrier_cycles": -rho * GPS_L1_HZ / C_MPS + 123_456.0,
        "doppler_hz": np.where(np.isnan(rho), np.nan, -1000.125 + 2500.0 * np.arange(2)),
        "cn0_dbhz": np.where(np.isnan(rho), np.nan, 44.25 - 20.0 * np.arange(2)),
        "restarted": np.array([[True, True], [False, False], [False, True]]),
        "program": "ultratight 0.1.0",
        "made": "20211125 004000",
    }


def test_another_reader_finds_what_was_written(tmp_path: Path) -> None:
    told = some()
    path = tmp_path / "some.obs"
    place = np.array([-2178660.5, 4388883.1, 4069512.2])
    assert write_observations(path, **told, position_m=place) == 3
    read = georinex.load(path, useindicators=True)
    # 2021-03-20 is the Saturday that ends week 2149
    expected = ["2021-03-20T23:59:59.0", "2021-03-20T23:59:59.5", "2021-03-21T00:00:00.0"]
    assert (read.time.values == np.array(expected, "datetime64[ns]")).all()
    np.testing.assert_allclose(read.position, place, atol=1e-4)
    for i, sv in enumerate(("G17", "G02")):
        of = read.sel(sv=sv)
        rho = told["pseudorange_m"][:, i]
        np.testing.assert_allclose(of.C1C.values, rho, atol=5.1e-4)
        np.testing.assert_allclose(of.D1C.values, told["doppler_hz"][:, i], atol=5.1e-4)
        np.testing.assert_allclose(of.S1C.values, told["cn0_dbhz"][:, i], atol=5.1e-4)
        # RINEX 3.05, 5.2.4.2: phase grows with range, and begins near it by whole cycles
        np.testing.assert_allclose(of.L1C.values, rho * GPS_L1_HZ / C_MPS, atol=1.0)
        taken = of.L1C.values + told["carrier_cycles"][:, i]
        here = np.isfinite(rho)
        np.testing.assert_allclose(taken[here], np.rint(taken[here][0]), atol=2e-3)
    lost = read.L1Clli.sel(sv="G02").values
    assert lost[2] == 1  # it came back with another phase
    assert np.isnan(lost[0])  # an arc's beginning is no loss


def test_columns_and_header_are_those_of_the_format(tmp_path: Path) -> None:
    path = tmp_path / "some.obs"
    write_observations(path, **some())
    lines = path.read_text().splitlines()
    assert lines[0][:9].strip() == "3.05"
    assert {line[60:].strip() for line in lines[: lines.index(" " * 60 + "END OF HEADER")]} >= {
        "PGM / RUN BY / DATE", "MARKER NAME", "OBSERVER / AGENCY", "REC # / TYPE / VERS",
        "ANT # / TYPE", "APPROX POSITION XYZ", "ANTENNA: DELTA H/E/N", "SYS / # / OBS TYPES",
        "TIME OF FIRST OBS", "SYS / PHASE SHIFT",
    }  # fmt: skip
    assert "> 2021 03 21 00 00  0.0000000  0  2" in lines
    # A3: satellite, then F14.3, loss of lock, strength of each; strength 24 dB-Hz is 4 (table 12)
    row = lines[-2]
    assert row[:3] == "G02"
    assert (row[3 + 29].isdecimal(), row[3 + 30], row[3 + 31]) == (True, "1", "4")


def test_what_cannot_be_written(tmp_path: Path) -> None:
    path = tmp_path / "some.obs"
    with pytest.raises(ValueError, match="observations: none, expected at least one"):
        write_observations(path, **some() | {"pseudorange_m": np.full((3, 2), np.nan)})
    with pytest.raises(ValueError, match=r"prn is .*: expected 1 to 99"):
        write_observations(path, **some() | {"prn": np.array([2, 120])})
    with pytest.raises(ValueError, match=r"expected \(3, 2\)"):
        write_observations(path, **some() | {"doppler_hz": np.zeros((3, 1))})
    assert not path.exists()
