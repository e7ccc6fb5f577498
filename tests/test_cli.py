"""The command line when all goes well, when it is interrupted, and as a process."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ultratight.simulation
from ultratight import results
from ultratight.filters.catalog import CATALOG
from ultratight.report import report
from ultratight.results import Event, Run, Variable
from ultratight.scenario import PRESETS, Scenario, load


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
            "n_satellites": 2,
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


# -- interrupts ------------------------------------------------------------------------------------


def test_an_interrupt_leaves_nothing_behind(
    say: Callable[..., Any], monkeypatch, tmp_path: Path
) -> None:
    def interrupted(*_: object, **__: object) -> Run:
        raise KeyboardInterrupt

    monkeypatch.setattr(ultratight.simulation, "run", interrupted)
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
    say: Callable[..., Any], tmp_path: Path
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


def test_the_report_says_that_a_filter_diverged_and_how_many_channels_there_are() -> None:
    run = flown(load("jump-1"))
    channels = dict.fromkeys(f"G{prn:02d}:{label}" for label in ("L1CA", "L5Q") for prn in (5, 7))
    run.summary.update(converged=False, n_satellites=2, lost_lock_s=channels)
    lines = "\n".join(report(run))
    assert "sky                  2 satellites in 4 channels, seed 1" in lines
    assert "converged            no\n" in lines
    run.events.append(Event(22.1, "", "diverged", "the covariance is not positive definite"))
    lines = " ".join(" ".join(report(run)).split())
    assert "converged no; the filter diverged at 22.1 s and was stopped: the covariance is" in lines


@pytest.mark.usefixtures("instant")
def test_options_become_the_scenario(say: Callable[..., Any], tmp_path: Path) -> None:
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
def test_a_commensurate_sample_rate_is_warned_of_unless_quiet(say: Callable[..., Any]) -> None:
    words = ("run", "jump-1", "--set", "front_end.sample_rate_hz=4.092e6")
    assert say(*words).err.startswith("warning: front_end.sample_rate_hz: 4.092e+06 is 4 samples")
    assert say(*words, "--quiet").err == ""


def test_progress_is_plain_when_piped(say: Callable[..., Any], monkeypatch) -> None:
    def run(scenario: Scenario, seed: int, progress: Callable[[float], None]) -> Run:
        for k in range(101):
            progress(k / 100)
        return flown(scenario, seed)

    monkeypatch.setattr(ultratight.simulation, "run", run)
    lines = say("run", "jump-1").err.splitlines()
    assert [line.split(",")[0] for line in lines] == [
        f"flying jump-1: {10 * k} %" for k in range(11)
    ]
    assert "," not in lines[0] + lines[-1]  # nothing is known at first, nothing left at last
    assert all(re.fullmatch(r"[^,]*(, about \d+ s left)?", line) for line in lines)


def test_validate_takes_the_options_of_run(say: Callable[..., Any], tmp_path: Path) -> None:
    assert "valid (jump-1, 50 s, scenario hash " in say("validate", "jump-1", "--filter=kf").out
    assert say("validate", "jump-1", "--filter=kf").out != say("validate", "jump-1").out
    for words in (["--closure=loose"], ["--correlator=x"], ["--nav", tmp_path / "none.nav"]):
        assert say("validate", "jump-1", *words).code == 2
    said = say("validate", "jump-1", "--closure=scalar", "--measurement=coherent")
    assert said.err.startswith("error: --measurement: coherent given, but closure scalar")


@pytest.mark.parametrize("command", [[], ["run"], ["validate"], ["scenarios"], ["showcase"]])
def test_help_is_not_cut(say: Callable[..., Any], command: list[str]) -> None:
    said = say(*command, "--help")
    assert said.code == 0
    cut = [line for line in said.out.splitlines()[1:] if line.endswith("...")]
    assert not cut  # the first line is the usage: COMMAND [ARGS]...
    assert max(len(line) for line in said.out.splitlines()) <= 80


def test_keys_are_listed_with_unit_choices_and_default(say: Callable[..., Any]) -> None:
    listed = say("scenarios", "--keys").out
    assert "lag_s [s]: number 0 to 1; default: left out\n" in listed
    assert "\n[receiver.knows]  " in listed
    assert "model: ideal, " in listed
    assert "grade: perfect, matched" in listed
    assert all(name in listed for name in CATALOG)


def test_lists_name_everything(say: Callable[..., Any]) -> None:
    listed = say("scenarios")
    assert listed.code == 0
    assert all(name in listed.out for name in PRESETS)
    assert "breaks lock" in listed.out
    listed = say("filters")
    assert all(f"{name} " in listed.out for name in CATALOG)


@pytest.mark.parametrize("name", PRESETS)
def test_a_printed_preset_is_the_preset(say: Callable[..., Any], tmp_path: Path, name: str) -> None:
    path = tmp_path / "printed.toml"
    path.write_text(say("scenarios", "--print", name).out)
    valid = say("validate", path)
    assert valid.code == 0
    assert valid.out.split("(")[1] == say("validate", name).out.split("(")[1]


# -- as a process ----------------------------------------------------------------------------------


def python(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, capture_output=True, text=True, timeout=120
    )


def test_module_and_exit_code(tmp_path: Path) -> None:
    assert python("-m", "ultratight", "--version", cwd=tmp_path).stdout == "ultratight 0.1.0\n"
    said = python("-m", "ultratight", "validate", "no.toml", cwd=tmp_path)
    assert (said.returncode, said.stdout, said.stderr.count("\n")) == (2, "", 1)


@pytest.mark.parametrize("foreign", ["signals.py", "signals/__init__.py"])
def test_foreign_signals_in_the_current_folder(tmp_path: Path, foreign: str) -> None:
    (tmp_path / foreign).parent.mkdir(exist_ok=True)
    (tmp_path / foreign).write_text("raise SystemExit('must not run')\n")
    said = python("-m", "ultratight", "scenarios", cwd=tmp_path)
    assert (said.returncode, said.stdout, said.stderr.count("\n")) == (2, "", 1)
    assert foreign.replace("/", "/") in said.stderr.replace("\\", "/")
    imported = python("-c", "import ultratight", cwd=tmp_path)
    assert imported.stderr.strip().splitlines()[-1].startswith("ImportError: ultratight: ")


def test_light_commands_load_nothing_heavy(tmp_path: Path) -> None:
    code = (
        "import sys; from ultratight.__main__ import main; main(['scenarios']); "
        "print([m for m in ('numba', 'scipy', 'matplotlib', 'xarray') if m in sys.modules])"
    )
    assert python("-c", code, cwd=tmp_path).stdout.splitlines()[-1] == "[]"
