"""The command line: one clear line per problem, the right exit code, never a traceback."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import ultratight.simulation
from ultratight import results
from ultratight.__main__ import main
from ultratight.filters.catalog import CATALOG
from ultratight.results import Run, Variable
from ultratight.scenario import PRESETS, Scenario


class Said(NamedTuple):
    code: int
    out: str
    err: str


@pytest.fixture
def say(capsys: pytest.CaptureFixture[str]) -> Callable[..., Said]:
    def call(*arguments: object) -> Said:
        code = main([str(a) for a in arguments])
        return Said(code, *capsys.readouterr())

    return call


def flown(scenario: Scenario, seed: int = 1, **_: object) -> Run:
    """What a simulation gives back, with a summary that was not simulated."""
    velocity = {"before": 0.002, "jump": 0.1, "after": 0.05, "end": 0.002}
    return Run(
        scenario=scenario.to_dict(),
        seed=seed,
        t_s=np.arange(3) * 0.02,
        variables={"x": Variable(np.arange(3.0), (results.EPOCH,), "m", "something")},
        events=[],
        provenance={"seed": seed, "cpu_path": "none"},
        summary={
            "scenario": scenario.name,
            "filter": scenario.receiver.filter,
            "closure": scenario.receiver.closure,
            "measurement": scenario.receiver.measurement,
            "correlator": scenario.correlator.kind,
            "seed": seed,
            "duration_s": scenario.duration_s,
            "n_satellites": 10,
            "lost_lock_s": {"G05:L1CA": 23.1, "G07:L1CA": None},
            "fall_backs": 0,
            "converged": True,
            "velocity_rms_mps": velocity,
            "position_rms_end_m": 1.5,
            "nees_velocity": None,
            "nis_per_measurement": 1.0,
            "wall_s": 2.0,
            "realtime_factor": 25.0,
            "cpu_path": "none",
        },
    )


@pytest.fixture
def instant(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the simulation by `flown`: what is tested is the command around it."""
    monkeypatch.setattr(ultratight.simulation, "run", flown)


# -- bad input -------------------------------------------------------------------------------------

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
    "not key=value": (["cn0_dbhz"], "--set 'cn0_dbhz': expected key=value"),
    "the same key twice": (["cn0_dbhz=1", "cn0_dbhz=2"], "cn0_dbhz: given twice, expected once"),
    "no navigation file": (["constellation=brdc.21p"], "there is no such file"),
}


@pytest.mark.parametrize("kind", BAD_VALUES)
def test_a_bad_value_is_one_clear_line(say: Callable[..., Said], kind: str) -> None:
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
def test_a_bad_file_is_named(say: Callable[..., Said], tmp_path: Path, kind: str) -> None:
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
    ],
)
def test_a_sky_that_cannot_be_flown(
    say: Callable[..., Said], changes: list[str], expected: str
) -> None:
    said = say("run", "jump-1", "--quiet", *(w for change in changes for w in ("--set", change)))
    assert said.code == 2
    assert said.err.count("\n") == 1
    assert expected in said.err


RINEX_4 = "     4.00           N: GNSS NAV DATA    M: MIXED            RINEX VERSION / TYPE\n"


@pytest.mark.parametrize("content", ["", "hello\n", RINEX_4, RINEX_4.replace("4.00", "3.04")])
def test_a_navigation_file_that_cannot_be_used(
    say: Callable[..., Said], tmp_path: Path, content: str
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
    ],
)
def test_bad_words_on_the_command_line(say: Callable[..., Said], arguments: list[str]) -> None:
    said = say(*arguments)
    assert (said.code, said.out) == (2, "")
    assert said.err.startswith("error: ")
    assert said.err.count("\n") == 1


def test_every_problem_is_listed_at_once(say: Callable[..., Said]) -> None:
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
    say: Callable[..., Said], monkeypatch, error: Exception, code: int, kind: str
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
    say: Callable[..., Said], option: str, closure: str
) -> None:
    said = say("run", "jump-1", "--closure", closure, option, "--json")
    assert said.code == 2
    assert json.loads(said.out)["error_kind"] == "unsupported"
    assert option.split("=")[0] in said.err


def test_a_bug_is_not_dressed_up_as_bad_input(say: Callable[..., Said], monkeypatch) -> None:
    monkeypatch.setattr(ultratight.simulation, "run", raising(TypeError("ours")))
    with pytest.raises(TypeError, match="ours"):
        say("run", "jump-1", "--quiet")


def test_an_interrupt_leaves_nothing_behind(
    say: Callable[..., Said], monkeypatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(ultratight.simulation, "run", raising(KeyboardInterrupt()))
    said = say("run", "jump-1", "--out", tmp_path / "run.nc", "--plot", tmp_path / "run.png")
    assert said.code == 130
    assert "interrupted" in said.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT for one process")
def test_ctrl_c_ends_a_process_with_130_and_no_file(tmp_path: Path) -> None:
    """A real signal in the middle of writing, when the part file is there."""
    (tmp_path / "flight.py").write_text(
        "import sys, time, pathlib, xarray, ultratight.results as r, ultratight.simulation as s\n"
        "from ultratight.__main__ import main\n"
        "s.run = lambda scenario, seed, **_: r.Run({}, seed, __import__('numpy').arange(3.0), {})\n"
        "def write(self, part, **_):\n"
        "    pathlib.Path(part).write_text('half')\n"
        "    print('writing', flush=True)\n"
        "    time.sleep(60)\n"
        "xarray.Dataset.to_netcdf = write\n"
        "sys.exit(main(['run', 'jump-1', '--quiet', '--out', 'run.nc']))\n"
    )
    process = subprocess.Popen(
        [sys.executable, "flight.py"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "writing\n"
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err.count("\n")) == (130, 1)
    assert [p.name for p in tmp_path.iterdir()] == ["flight.py"]


# -- what goes well --------------------------------------------------------------------------------


@pytest.mark.usefixtures("instant")
def test_run_prints_one_object_and_writes_what_show_shows(
    say: Callable[..., Said], tmp_path: Path
) -> None:
    path = tmp_path / "run.nc"
    said = say("run", "jump-2", "--filter", "kf", "--seed", 7, "--json", "--quiet", "--out", path)
    summary = json.loads(said.out)
    assert said[0::2] == (0, "")
    assert (summary["scenario"], summary["filter"], summary["seed"]) == ("jump-2", "kf", 7)
    assert json.loads(say("show", path, "--json").out) == summary
    shown = say("show", path)
    assert shown.code == 0
    assert "G05:L1CA at 23.1 s" in shown.out
    assert "jump-2: 200 m/s, +100" in shown.out
    assert "taps in closed form" in shown.out
    assert "before: 5 s to the jump; jump: 20 to 40 s" in shown.out
    assert "cpu_path none" in shown.out
    assert "something [m]" in shown.out


@pytest.mark.usefixtures("instant")
def test_options_become_the_scenario(say: Callable[..., Said], tmp_path: Path) -> None:
    path, nav = tmp_path / "run.nc", tmp_path / "brdc.nav"
    nav.write_text("")
    words = ["--measurement", "differential", "--correlator", "samples", "--set", "imu.lag_s=0.01"]
    assert say("run", "jump-1", *words, "--nav", nav, "--out", path, "--quiet").code == 0
    kept = results.load(path).scenario
    assert kept["receiver"]["measurement"] == "differential"
    assert kept["correlator"]["kind"] == "samples"
    assert kept["constellation"] == str(nav)
    assert kept["imu"]["lag_s"] == 0.01


@pytest.mark.usefixtures("instant")
def test_a_commensurate_sample_rate_is_warned_of_unless_quiet(say: Callable[..., Said]) -> None:
    words = ("run", "jump-1", "--set", "front_end.sample_rate_hz=4.092e6")
    assert say(*words).err.startswith("warning: front_end.sample_rate_hz: 4.092e+06 is 4 samples")
    assert say(*words, "--quiet").err == ""


def test_progress_is_plain_when_piped(say: Callable[..., Said], monkeypatch) -> None:
    def run(scenario: Scenario, seed: int, progress: Callable[[float], None]) -> Run:
        for k in range(101):
            progress(k / 100)
        return flown(scenario, seed)

    monkeypatch.setattr(ultratight.simulation, "run", run)
    lines = say("run", "jump-1").err.splitlines()
    assert lines == [f"flying jump-1: {10 * k} %" for k in range(11)]


def test_validate_takes_the_options_of_run(say: Callable[..., Said], tmp_path: Path) -> None:
    assert "valid (jump-1, 50 s, scenario hash " in say("validate", "jump-1", "--filter=kf").out
    assert say("validate", "jump-1", "--filter=kf").out != say("validate", "jump-1").out
    for words in (["--closure=loose"], ["--correlator=x"], ["--nav", tmp_path / "none.nav"]):
        assert say("validate", "jump-1", *words).code == 2
    said = say("validate", "jump-1", "--closure=scalar", "--measurement=coherent")
    assert said.err.startswith("error: --measurement: coherent given, but closure scalar")


@pytest.mark.parametrize("command", [[], ["run"], ["validate"], ["scenarios"], ["showcase"]])
def test_help_is_not_cut(say: Callable[..., Said], command: list[str]) -> None:
    said = say(*command, "--help")
    assert said.code == 0
    cut = [line for line in said.out.splitlines()[1:] if line.endswith("...")]
    assert not cut  # the first line is the usage: COMMAND [ARGS]...
    assert max(len(line) for line in said.out.splitlines()) <= 80


def test_keys_are_listed_with_unit_choices_and_default(say: Callable[..., Said]) -> None:
    listed = say("scenarios", "--keys").out
    assert "lag_s [s]: number 0 to 1; default: left out\n" in listed
    assert "\n[receiver.knows]  " in listed
    assert "model: ideal, " in listed
    assert "grade: perfect, matched" in listed
    assert all(name in listed for name in CATALOG)


def test_lists_name_everything(say: Callable[..., Said]) -> None:
    listed = say("scenarios")
    assert listed.code == 0
    assert all(name in listed.out for name in PRESETS)
    assert "breaks lock" in listed.out
    listed = say("filters")
    assert all(f"{name} " in listed.out for name in CATALOG)


@pytest.mark.parametrize("name", PRESETS)
def test_a_printed_preset_is_the_preset(
    say: Callable[..., Said], tmp_path: Path, name: str
) -> None:
    path = tmp_path / "printed.toml"
    path.write_text(say("scenarios", "--print", name).out)
    valid = say("validate", path)
    assert valid.code == 0
    assert valid.out.split("(")[1] == say("validate", name).out.split("(")[1]


# -- as a process ----------------------------------------------------------------------------------


def python(*arguments: str, cwd: Path) -> Said:
    done = subprocess.run(
        [sys.executable, *arguments], cwd=cwd, capture_output=True, text=True, timeout=120
    )
    return Said(done.returncode, done.stdout, done.stderr)


def test_module_and_exit_code(tmp_path: Path) -> None:
    assert python("-m", "ultratight", "--version", cwd=tmp_path).out == "ultratight 0.1.0\n"
    said = python("-m", "ultratight", "validate", "no.toml", cwd=tmp_path)
    assert (said.code, said.out, said.err.count("\n")) == (2, "", 1)


@pytest.mark.parametrize("foreign", ["signals.py", "signals/__init__.py"])
def test_foreign_signals_in_the_current_folder(tmp_path: Path, foreign: str) -> None:
    (tmp_path / foreign).parent.mkdir(exist_ok=True)
    (tmp_path / foreign).write_text("raise SystemExit('must not run')\n")
    said = python("-m", "ultratight", "scenarios", cwd=tmp_path)
    assert (said.code, said.out, said.err.count("\n")) == (2, "", 1)
    assert foreign.replace("/", "/") in said.err.replace("\\", "/")
    imported = python("-c", "import ultratight", cwd=tmp_path)
    assert imported.err.strip().splitlines()[-1].startswith("ImportError: ultratight: ")


def test_light_commands_load_nothing_heavy(tmp_path: Path) -> None:
    code = (
        "import sys; from ultratight.__main__ import main; main(['scenarios']); "
        "print([m for m in ('numba', 'scipy', 'matplotlib', 'xarray') if m in sys.modules])"
    )
    assert python("-c", code, cwd=tmp_path).out.splitlines()[-1] == "[]"
