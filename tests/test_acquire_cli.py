"""`ultratight acquire`: from a file to table, JSON and figure, or one line that says why not."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray

from ultratight.__main__ import main

PRNS = [2, 6, 17, 28]
FS = 4e6


@pytest.fixture(scope="module")
def sky(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four satellites at 45 dB-Hz, 100 kHz off the centre of a file, and their truth."""
    out = tmp_path_factory.mktemp("if") / "sky"
    words = ["generate", "static", "--duration", "0.4", "--if-hz", "1e5", "--format", "ci8"]
    words += ["--set", f"prns={PRNS}", "--out", str(out), "--quiet"]
    assert main(words) == 0
    return out


def values(sky: Path) -> np.ndarray:
    """Samples (n, 2) int8 of the file."""
    return np.fromfile(sky.with_name("sky.sigmf-data"), np.int8).reshape(-1, 2)


def test_what_is_found_is_the_truth_of_the_file(sky: Path, say: Callable[..., Any]) -> None:
    """From 20 ms on, where the truth has a row: Doppler 2 Hz, code 0.1 chip, C/N0 1 dB."""
    said = say("acquire", sky, "--skip", 0.02, "--json")
    assert (said.code, said.err) == (0, "")
    told = json.loads(said.out)
    assert (told["found"], told["sample_index"], told["if_hz"]) == (PRNS, 80_000, 1e5)
    assert [s["prn"] for s in told["satellites"]] == list(range(1, 33))
    with xarray.open_dataset(sky.with_name("sky.truth.nc"), engine="h5netcdf") as truth:
        for i, prn in enumerate(PRNS):
            s = told["satellites"][prn - 1]
            assert s["peak"] > s["threshold"]
            assert s["doppler_hz"] == pytest.approx(float(truth.doppler_hz[1, i]), abs=2.0)
            away = s["code_phase_chips"] - float(truth.code_phase_chips[1, i])
            assert (away + 511.5) % 1023.0 - 511.5 == pytest.approx(0.0, abs=0.1)
            assert s["cn0_dbhz"] == pytest.approx(45.0, abs=1.0)
    absent = told["satellites"][0]
    assert (absent["found"], absent["doppler_hz"], absent["cn0_dbhz"]) == (False, None, None)


def test_table_and_figure(sky: Path, tmp_path: Path, say: Callable[..., Any]) -> None:
    plot = tmp_path / "search.png"
    said = say("acquire", sky, "--prn", "1-3,17", "--plot", plot)
    lines = said.out.splitlines()
    assert said.code == 0
    assert lines[0].split()[:3] == ["PRN", "Doppler", "[Hz]"]
    assert [line.split()[0] for line in lines[1:5]] == ["1", "2", "3", "17"]
    assert lines[1].split()[1:4] == ["-", "-", "-"]
    assert lines[5] == "2 of 4 found; code phases are at sample 0"
    assert lines[6] == f"written: {plot}"
    assert plot.read_bytes()[:4] == b"\x89PNG"
    assert not list(tmp_path.glob(".*"))


def test_a_wrong_description_finds_nothing_and_says_so(sky: Path, say: Callable[..., Any]) -> None:
    """Another rate, another IF: no satellite, no wrong one either."""
    data = sky.with_name("sky.sigmf-data")
    for wrong in ({"--rate": 5e6}, {"--if-hz": -1e5}):
        given = {"--format": "ci8", "--rate": FS, "--if-hz": 1e5} | wrong
        said = say("acquire", data, *(word for pair in given.items() for word in pair))
        assert said.code == 0
        rate, if_hz = given["--rate"], given["--if-hz"]
        assert (
            f"no satellite found as ci8 at {rate:g} samples/s with the IF at {if_hz:g}" in said.out
        )
        assert "--conjugate" in said.out


def test_the_other_sideband_is_noticed(sky: Path, tmp_path: Path, say: Callable[..., Any]) -> None:
    """Q negated: codes fall behind where Dopplers say that they gain, which 0.4 s show."""
    raw = tmp_path / "negated.bin"
    values(sky).tofile(raw)
    given = ("--format", "ci8", "--rate", FS, "--prn", "2,6,17,28")
    said = say("acquire", raw, *given, "--if-hz", -1e5, "--conjugate")
    assert said.code == 0
    assert "the codes run against the carriers" in said.err
    right = say("acquire", raw, *given, "--if-hz", 1e5)
    assert right.err == ""


@pytest.mark.parametrize("form", ["ci8", "cu8"])
def test_clipped_samples_are_said_to_be(
    sky: Path, tmp_path: Path, say: Callable[..., Any], form: str
) -> None:
    """Ten times too large: about 60 % beyond 127 (sigma 240); what is left is enough."""
    raw = tmp_path / "loud.bin"
    loud = np.clip(10 * values(sky).astype(int), -128, 127)
    (loud.astype(np.int8) if form == "ci8" else (loud + 128).astype(np.uint8)).tofile(raw)
    words = ("--format", form, "--rate", FS, "--if-hz", 1e5, "--prn", "2,6,17,28", "--json")
    said = say("acquire", raw, *words)
    told = json.loads(said.out)
    assert told["found"] == PRNS
    assert len(told["warnings"]) == 1
    assert "loud.bin: clipped, " in told["warnings"][0]
    ends = {"ci8": "-128 and 127", "cu8": "0 and 255"}[form]
    assert f"at the ends of {form}, {ends};" in told["warnings"][0]
    share = float(told["warnings"][0].split("clipped, ")[1].split("%")[0])
    assert share == pytest.approx(60.0, abs=3.0)  # 2 Q(126 / 240)


BAD = {
    "silent": (bytes(8000), (), "samples are all equal"),
    "too short": (bytes(range(86)) * 93, (), "bad.bin: samples 0 to 3999, expected 0 to 40000"),
    "truncated": (bytes(range(101)), (), "truncated, the sample that begins at byte 100 of 101"),
    "constant": (bytes(200_000), (), "samples are all equal or not finite"),
    "empty": (b"", (), "empty, expected interleaved I, Q samples of ci8"),
    "IF outside": (bytes(10), ("--if-hz", "3e6"), "if_hz is 3000000.0: expected at most half of"),
    "no PRN": (bytes(10), ("--prn", "7-x"), "'7-x' given, expected numbers and ranges"),
    "falling": (bytes(10), ("--prn", "9-7"), "'9-7' given, expected a range that rises"),
    "no such code": (bytes(range(250)) * 999, ("--prn", "300"), "has codes for PRN 1-210"),
    "period": (
        bytes(range(250)) * 999,
        ("--coherent-ms", "0.5"),
        "expected a multiple of the code",
    ),
    "beyond": (bytes(range(250)), ("--skip", "9"), "--skip: 9 given, expected 0 to 3.125e-05"),
    "never": (bytes(10), ("--false-alarm", "0"), "false_alarm is 0.0: expected more than 0"),
    "signal": (bytes(10), ("--signal", "L9"), "signal 'L9': expected one of"),
    "figure": (bytes(10), ("--plot", "a.txt"), "a.txt"),
}


@pytest.mark.parametrize("kind", BAD)
def test_one_line_for_what_cannot_be_searched(
    kind: str, tmp_path: Path, say: Callable[..., Any]
) -> None:
    content, words, expected = BAD[kind]
    raw = tmp_path / "bad.bin"
    raw.write_bytes(content)
    given = {"--format": "ci8", "--rate": "4e6", "--if-hz": "0"}
    given |= dict(zip(words[::2], words[1::2], strict=True))
    said = say("acquire", raw, *(word for pair in given.items() for word in pair))
    assert (said.code, said.out) == (2, "")
    assert said.err.startswith("error: ")
    assert said.err.count("\n") == 1
    assert expected in said.err
