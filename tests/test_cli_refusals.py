"""The command line refuses: one clear line per problem, the right exit code, never a traceback."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ultratight.simulation
from ultratight import results
from ultratight.results import Run

# kind: (overrides, what the line must hold)
BAD_VALUES = {
    "NaN": (["cn0_dbhz=nan"], "cn0_dbhz: nan given, expected a finite number"),
    "inf": (["clock.drift_mps=inf"], "clock.drift_mps: inf given, expected a finite number"),
    "negative": (["imu.lag_s=-0.01"], "imu.lag_s: -0.01 given, expected 0 or more"),
    "text for a number": (["duration_s=long"], 'duration_s: "long" given, expected a number'),
    "a number in quotes": (["duration_s='50'"], 'duration_s: "50" given, expected a number'),
    "unit suffix": (["cn0_dbhz=35 dBHz"], 'cn0_dbhz: "35 dBHz" given, expected a number without'),
    "true for a number": (["mask_deg=true"], "mask_deg: true given, expected a number"),
    "number for true": (["receiver.fall_back=1"], "receiver.fall_back: 1 given, expected true or"),
    "fraction for a count": (["max_satellites=4.5"], "max_satellites: 4.5 given, expected a whole"),
    "list for a number": (["speed_mps=[1, 2]"], "speed_mps: [1, 2] given, expected a number"),
    "number for a table": (["clock=3"], "clock: 3 given, expected a table of keys"),
    "short list": (["imu.lever_arm_b_m=[1, 2]"], "imu.lever_arm_b_m: [1, 2] given, expected 3"),
    "long list": (["position_lla_deg_m=[1, 2, 3, 4]"], "[1, 2, 3, 4] given, expected 3 values"),
    "number for a list": (["imu.lever_arm_b_m=1"], "1 given, expected a list of 3 numbers"),
    "short duration": (["duration_s=3"], "duration_s = 3 (no profile at all: --set 'profile=[]')"),
    "unknown key": (["imu.lags_s=1"], "imu.lags_s: unknown key, did you mean lag_s?"),
    "key with a prefix": (["receiver.pll_bandwidth=18"], "did you mean bandwidth_hz?"),
    "key without unit": (["receiver.fll_bandwidth=2"], "did you mean fll_bandwidth_hz?"),
    "unknown table": (["antenna.gain_db=1"], "antenna: unknown key, expected one of name, title"),
    "unknown word": (["receiver.closure=loose"], 'receiver.closure: "loose" given, expected one'),
    "unknown filter": (["receiver.filter=ekf2"], 'receiver.filter: "ekf2" given, expected one of'),
    "unknown grade": (["imu.grade=tactical-9"], 'imu.grade: "tactical-9" given, expected one of'),
    "unknown clock": (["clock.model=quarz"], 'clock.model: "quarz" given, expected one of ideal'),
    "duration 0": (["duration_s=0"], "duration_s: 0 given, expected more than 0"),
    "duration between epochs": (["duration_s=30.011"], "expected a multiple of epoch_s = 0.02"),
    "sample rate below chip rate": (["front_end.sample_rate_hz=1e6"], "at least the chip rate"),
    "IF outside the band": (["front_end.if_hz=-2e6"], "less than half the sample rate"),
    "spacing over one chip": (["correlator.spacing_chips=1.5"], "1.5 given, expected 1 or less"),
    "absurd speed": (["speed_mps=20000"], "speed_mps: 20000 given, expected 12000 or less"),
    "absurd acceleration": (
        ["profile=[{t0_s=1,t1_s=2,accel0_mps2=99999}]"],
        "profile[0].accel0_mps2: 99999 given, expected 10000 or less",
    ),
    "absurd latitude": (["position_lla_deg_m=[91, 0, 0]"], "position_lla_deg_m[0]: 91 given"),
    "time of week": (["start_tow_s=604800"], "start_tow_s: 604800 given, expected less than"),
    "segments overlap": (["profile=[{t0_s=1,t1_s=5},{t0_s=4,t1_s=6}]"], "expected 5 or more"),
    "segment after the end": (["profile=[{t0_s=1,t1_s=60}]"], "expected at most duration_s = 50"),
    "coherent without bits": (["receiver.knows.data_bits=false"], "expected data_bits = true"),
    "satellite twice": (["prns=[7, 8, 7]"], "prns: [7, 8, 7] given, expected each satellite once"),
    "satellite name": (['channel.cn0_by_prn_dbhz={"GPS7"=30}'], "channel.cn0_by_prn_dbhz.GPS7"),
    "disturbance NaN": (
        ["channel.disturbance=[{t0_s=1,t1_s=2,cn0_change_db=nan}]"],
        "channel.disturbance[0].cn0_change_db: nan given, expected a finite number",
    ),
    "disturbance backwards": (
        ["channel.disturbance=[{t0_s=2,t1_s=2,cn0_change_db=-15}]"],
        "channel.disturbance[0].t1_s: 2 given, expected more than t0_s = 2",
    ),
    "disturbance after the end": (
        ["channel.disturbance=[{t0_s=50,cn0_change_db=-15}]"],
        "channel.disturbance[0].t0_s: 50 given, expected less than duration_s = 50",
    ),
    "disturbance beyond the end": (
        ["channel.disturbance=[{t0_s=1,t1_s=50.5,cn0_change_db=-15}]"],
        "channel.disturbance[0].t1_s: 50.5 given, expected at most duration_s = 50",
    ),
    "disturbance before the start": (
        ["channel.disturbance=[{t0_s=-1,cn0_change_db=-15}]"],
        "channel.disturbance[0].t0_s: -1 given, expected 0 or more",
    ),
    "disturbance between nodes": (
        ["channel.disturbance=[{t0_s=1.001,pseudorange_m=100}]"],
        "channel.disturbance[0].t0_s: 1.001 given, expected a multiple of 0.005 s",
    ),
    "disturbance of nothing": (
        ["channel.disturbance=[{t0_s=1}]"],
        "channel.disturbance[0]: no change given, expected cn0_change_db, pseudorange_m or",
    ),
    "disturbance of nobody": (
        ["channel.disturbance=[{t0_s=1,prns=[],pseudorange_m=100}]"],
        "channel.disturbance[0].prns: [] given, expected some satellites",
    ),
    "disturbance without begin": (
        ["channel.disturbance=[{cn0_change_db=-15}]"],
        "channel.disturbance[0].t0_s: missing, expected a value",
    ),
    "fault that grows too far": (
        ["channel.disturbance=[{t0_s=1,pseudorange_rate_mps=9000}]"],
        "expected a fault of at most 100000 m at the end, not 441000",
    ),
    "disturbance with an unknown key": (
        ["channel.disturbance=[{t0_s=1,cn0_db=-15}]"],
        "channel.disturbance[0].cn0_db: unknown key, did you mean cn0_change_db?",
    ),
    "not key=value": (["cn0_dbhz"], "--set 'cn0_dbhz': expected key=value"),
    "the same key twice": (["cn0_dbhz=1", "cn0_dbhz=2"], "cn0_dbhz: given twice, expected once"),
    "no navigation file": (["constellation=brdc.21p"], "there is no such file"),
}


@pytest.mark.parametrize("kind", BAD_VALUES)
def test_a_bad_value_is_one_clear_line(say: Callable[..., Any], kind: str) -> None:
    changes, expected = BAD_VALUES[kind]
    said = say("validate", "jump-1", *(word for change in changes for word in ("--set", change)))
    assert said.code == 2
    assert said.out == ""
    assert said.err.startswith("error: ")
    assert said.err.count("\n") == 1
    assert expected in said.err


BAD_FILES = {
    "missing": (None, "no such file"),
    "empty": (b"", "duration_s: missing, expected a value"),
    "binary": (bytes(range(128, 256)), "not a text file"),
    "truncated": (b'extends = "jump-1"\n[imu', "line 2: not valid TOML"),
    "duplicate key": (b"mask_deg = 1\nmask_deg = 2\n", "line 2: not valid TOML: given twice"),
    "duplicate table": (b"[imu]\nlag_s = 1\n[imu]\n", "given twice"),
    "unit without quotes": (b"duration_s = 50 s\n", "line 1: not valid TOML"),
    "extends nothing": (b'extends = "jump-9"\n', "jump-9: neither a preset nor a TOML file"),
    "extends a number": (b"extends = 1\n", "extends: 1 given, expected a preset"),
    "extends itself": (b'extends = "bad.toml"\n', "extends itself"),
    "unknown key": (b'extends = "jump-1"\ncn0 = 3\n', "cn0: unknown key, did you mean cn0_dbhz?"),
}


@pytest.mark.parametrize("kind", BAD_FILES)
def test_a_bad_file_is_named(say: Callable[..., Any], tmp_path: Path, kind: str) -> None:
    content, expected = BAD_FILES[kind]
    path = tmp_path / "bad.toml"
    if content is not None:
        path.write_bytes(content)
    said = say("validate", path)
    assert said.code == 2
    assert said.err.count("\n") == 1
    assert expected in said.err
    assert "bad.toml" in said.err or "jump-9" in said.err


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            ["start_week=2200"],
            'constellation = "nominal-24", or --nav',
        ),  # a day without ephemerides
        (["mask_deg=60"], "satellites of embedded at or above 60 deg"),
        (["prns=[7, 8]"], "expected at least 4"),
        (
            ["channel.disturbance=[{t0_s=1,prns=[7, 9, 32],pseudorange_m=100}]"],
            "channel.disturbance[0].prns: 7, 32 given, expected some of the satellites in view: 2,",
        ),
    ],
)
def test_a_sky_that_cannot_be_flown(
    say: Callable[..., Any], changes: list[str], expected: str
) -> None:
    said = say("run", "jump-1", "--quiet", *(w for change in changes for w in ("--set", change)))
    assert said.code == 2
    assert said.err.count("\n") == 1
    assert expected in said.err


RINEX_4 = "     4.00           N: GNSS NAV DATA    M: MIXED            RINEX VERSION / TYPE\n"


@pytest.mark.parametrize("content", ["", "hello\n", RINEX_4, RINEX_4.replace("4.00", "3.04")])
def test_a_navigation_file_that_cannot_be_used(
    say: Callable[..., Any], tmp_path: Path, content: str
) -> None:
    path = tmp_path / "brdc.nav"
    path.write_text(content)
    said = say("run", "jump-1", "--quiet", "--nav", path)
    assert said.code == 2
    assert said.err.count("\n") == 1
    assert "brdc.nav" in said.err


@pytest.mark.parametrize(
    "arguments",
    [
        ["run"],
        ["fly", "jump-1"],
        ["run", "jump-1", "--speed", "3"],
        ["run", "jump-1", "--seed", "one"],
        ["run", "jump-1", "--seed", "-1"],
        ["run", "jump-9"],
        ["run", "jump-1", "--correlator", "sample"],
        ["run", "jump-1", "--out", "no-such-folder/run.nc"],
        ["run", "jump-1", "--out", "run.csv"],
        ["run", "jump-1", "--plot", "run.doc"],
        ["run", "jump-1", "--nav", "no-such-file.21p"],
        ["scenarios", "--print", "jump-9"],
        ["show", "no-such-file.nc"],
        ["info", "no-such-file"],
        ["info", "."],
    ],
)
def test_bad_words_on_the_command_line(say: Callable[..., Any], arguments: list[str]) -> None:
    said = say(*arguments)
    assert (said.code, said.out) == (2, "")
    assert said.err.startswith("error: ")
    assert said.err.count("\n") == 1


def test_every_problem_is_listed_at_once(say: Callable[..., Any]) -> None:
    said = say("run", "jump-1", "--filter", "best", "--set", "imu.lag=3", "--set", "cn0_dbhz=99")
    assert said.code == 2
    assert said.err.count("error: ") == said.err.count("\n") == 3


# -- failures in JSON ------------------------------------------------------------------------------


def raising(error: BaseException) -> Callable[..., Run]:
    def run(*_: object, **__: object) -> Run:
        raise error

    return run


@pytest.mark.parametrize(
    ("error", "code", "kind"),
    [
        (results.InvalidInput("mask_deg: 89 given, expected less"), 2, "invalid_input"),
        (ValueError("seed is -1: expected an integer >= 0"), 2, "invalid_input"),
        (np.linalg.LinAlgError("Matrix is not positive definite"), 1, "numerical"),
        (FloatingPointError("covariance is not finite"), 1, "numerical"),
        (OSError(28, "No space left on device"), 1, "io"),
    ],
)
def test_a_failure_has_its_kind_and_code(
    say: Callable[..., Any], monkeypatch, error: Exception, code: int, kind: str
) -> None:
    monkeypatch.setattr(ultratight.simulation, "run", raising(error))
    said = say("run", "jump-1", "--json", "--quiet")
    told = json.loads(said.out)
    assert (said.code, told["error_kind"]) == (code, kind)
    assert told["message"] in said.err
    assert said.err.count("\n") == 1


@pytest.mark.parametrize("option", ["--filter=kf", "--measurement=coherent"])
@pytest.mark.parametrize("closure", ["scalar", "scalar-ins"])
def test_options_that_mean_nothing_together(
    say: Callable[..., Any], option: str, closure: str
) -> None:
    said = say("run", "jump-1", "--closure", closure, option, "--json")
    assert said.code == 2
    assert json.loads(said.out)["error_kind"] == "unsupported"
    assert option.split("=")[0] in said.err


def test_a_bug_is_not_dressed_up_as_bad_input(say: Callable[..., Any], monkeypatch) -> None:
    monkeypatch.setattr(ultratight.simulation, "run", raising(TypeError("ours")))
    with pytest.raises(TypeError, match="ours"):
        say("run", "jump-1", "--quiet")
