"""`ultratight track` from tracks on: what it prints and writes where the message came."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import georinex
import numpy as np
import pytest

from ultratight import track_commands
from ultratight.ins.earth import ecef_from_geodetic
from ultratight.tracking import acquisition, from_samples
from ultratight.tracking.acquisition import Acquisition
from ultratight.tracking.from_samples import Tracks


@pytest.fixture
def sky(
    make_tracks: Callable[..., Tracks], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[object, ...]:
    """The command with a recording of noise, in which tracks of 29 s are found."""
    noise = 20.0 * np.random.default_rng(1).standard_normal((105_000, 2))  # 42 ms
    np.rint(noise).astype(np.int8).tofile(tmp_path / "sky.bin")
    of = make_tracks(29.0, code_noise_m=1.2)
    rows = [Acquisition(int(p), 0.0, 37.0 * p, 45.0, 10.0, 1.0, 0) for p in of.prn]
    monkeypatch.setattr(acquisition, "acquire", lambda *_: rows)
    monkeypatch.setattr(acquisition, "misfit", lambda *_: acquisition.Misfit(False, 0.0))
    monkeypatch.setattr(from_samples, "track", lambda *_: of)
    raw = ("--format", "ci8", "--rate", "2.5e6", "--if-hz", 0)
    return ("track", tmp_path / "sky.bin", *raw, "--no-atmosphere")


def test_positions_files_and_figures(
    sky: tuple[object, ...], place: np.ndarray, tmp_path: Path, say: Callable[..., Any]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    said = say(*sky, "--out", out, "--plot", tmp_path / "sky.png", "--json")
    assert said.code == 0
    told = json.loads(said.out)["navigation"]
    assert told["why_not"] is None
    assert told["week"] == 2149
    assert {tuple(c["subframes"]) for c in told["channels"]} == {(5, 1, 2, 3)}
    assert told["first_fix_s"] == told["possible_s"] == pytest.approx(28.1, abs=0.05)
    last = told["last"]
    r = ecef_from_geodetic(
        np.radians(last["lat_deg"]), np.radians(last["lon_deg"]), last["height_m"]
    )
    # 1.2 m a channel, PDOP 1.5: 1.8 m
    assert np.linalg.norm(r - place) < 4 * 1.8
    names = {p.name for p in out.iterdir()}
    assert names == {"sky.obs", "sky.nmea", "sky.geojson", "sky.kml"}
    read = georinex.load(out / "sky.obs")
    assert sorted(read.sv.values) == sorted(
        f"G{p:02d}" for p in (c["prn"] for c in told["channels"])
    )
    for name in ("sky.png", "sky-position.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


def test_lines_for_people(sky: tuple[object, ...], say: Callable[..., Any]) -> None:
    lines = say(*sky).out.splitlines()
    assert lines[-3].startswith("message: 400 words right, 0 with a wrong parity, 0 too weak")
    assert "positions, the first after 28.1 s (the message allowed it after 28.1 s)" in lines[-2]
    assert lines[-1].startswith("2021-03-19T12:00:3")


@pytest.mark.parametrize(
    ("said", "expected"), [({"ultratight:atmosphere": []}, False), ({}, True),
                           ({"ultratight:atmosphere": ["troposphere"]}, True)]
)  # fmt: skip
def test_a_file_may_say_that_it_has_no_atmosphere(
    tmp_path: Path, said: dict[str, list[str]], expected: bool
) -> None:
    assert track_commands.has_atmosphere(tmp_path / "raw.bin")
    (tmp_path / "sky.sigmf-meta").write_text(json.dumps({"global": said}))
    assert track_commands.has_atmosphere(tmp_path / "sky") is expected


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--out", "nowhere"), "--out: nowhere given, expected a folder that exists"),
        (("--interval-ms", "0"), "--interval-ms: 0 given, expected 1 to 60000"),
        (("--near-week", "-1"), "--near-week: -1 given, expected 0 to 9999"),
    ],
)
def test_one_line_for_what_makes_no_sense(
    sky: tuple[object, ...], words: tuple[str, str], expected: str, say: Callable[..., Any]
) -> None:
    said = say(*sky, *words)
    assert (said.code, said.out) == (2, "")
    assert said.err.strip().endswith(expected)
