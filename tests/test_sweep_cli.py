"""`ultratight sweep` as a user meets it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray

import ultratight
from ultratight.__main__ import main
from ultratight.statistics import wilson
from ultratight.sweeps.cells import axes, parse_over

BASE = ["sweep", "uniform", "--set", "duration_s=1", "--set", "prns=[2,6,17,28]", "--jobs", "1"]
OVER = ["--over", "receiver.filter=kf,fiqkf-r", "--over", "cn0_dbhz=30,45"]


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("receiver.filter=kf,qkf", ["kf", "qkf"]),
        ("cn0_dbhz=30, 35.5", [30, 35.5]),
        ("imu.accel_scale_factor_ppm=[0,0,0],[3000,0,0]", [[0, 0, 0], [3000, 0, 0]]),
        ("channel.cn0_by_prn_dbhz={G02=30.0,G06=31.0},{}", [{"G02": 30.0, "G06": 31.0}, {}]),
        ("title='a,b',c", ["a,b", "c"]),
        ("receiver.fall_back=true,false", [True, False]),
    ],
)
def test_values_are_parted_at_outer_commas(text: str, values: list) -> None:
    assert parse_over(text) == (text.partition("=")[0], values)


@pytest.mark.parametrize("text", ["cn0_dbhz", "cn0_dbhz=", "=3", "cn0_dbhz=30,,31", "cn0_dbhz=30,"])
def test_what_is_no_axis_is_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*BASE, "--over", text, "--dry-run"]) == 2
    assert f"--over {text!r}" in capsys.readouterr().err


def test_dimensions_are_called_by_the_last_part_where_that_is_clear() -> None:
    over = {"receiver.filter": ["kf"], "imu.lag_s": [0.1], "clock.model": ["tcxo"], "x.model": [1]}
    assert [axis.dim for axis in axes(over)] == ["filter", "lag_s", "clock.model", "x.model"]
    assert axes({"a.window": [1]})[0].dim == "a.window"


def test_a_sweep_in_a_table_in_json_and_in_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The figures of table and JSON are those of the Dataset, by numpy's percentiles."""
    words = [*BASE, *OVER, "--runs", "5", "--seed", "3", "--out", str(tmp_path / "deep" / "out")]
    assert main([*words, "--quiet"]) == 0
    text, said = capsys.readouterr()
    assert said == ""
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    data = xarray.open_dataset(tmp_path / "deep" / "out" / "sweep.nc")
    assert told["digest"] == data.attrs["digest"]
    assert text.splitlines()[-1] == f"digest {data.attrs['digest']}"
    assert [cell["labels"] for cell in told["cells"]] == [
        {"filter": f, "cn0_dbhz": c} for f in ("kf", "fiqkf-r") for c in (30, 45)
    ]
    for cell in told["cells"]:
        at = data.sel(cell["labels"])
        end = at.velocity_rms_mps.sel(window="end").values
        expected = dict(zip(("p10", "p50", "p90"), np.percentile(end, [10, 50, 90]), strict=True))
        assert cell["end"] == expected
        converged = int(at.converged.sum())
        assert cell["converged"]["runs"] == converged
        assert cell["converged"]["low"] == wilson(converged, 5).low
        row = next(
            line for line in text.splitlines()
            if cell["labels"]["filter"] in line and f" {cell['labels']['cn0_dbhz']} " in line
        )  # fmt: skip
        assert f"{expected['p50']:.3g} [{expected['p10']:.3g}, {expected['p90']:.3g}]" in row
    assert data.seed.values.tolist() == [3, 4, 5, 6, 7]
    assert data.velocity_rms_mps.attrs["units"] == "m/s"


def test_kept_series(tmp_path: Path) -> None:
    """A kept series against the run itself, at the rows that lie on its times."""
    scenario = ultratight.load("uniform", {"duration_s": 1.0, "prns": [2, 6, 17, 28]})
    names = ("velocity_error", "velocity_error_forward", "velocity_sigma", "cn0")
    data = ultratight.sweep(scenario, runs=1, seed=2, jobs=1, keep=names, every_s=0.2, out=tmp_path)
    run = ultratight.run(scenario, 2)
    rows = [np.abs(run.t_s - t).argmin() for t in (0.2, 0.4, 0.6, 0.8, 1.0)]
    error = (run["v_eb_e_true"] - run["v_eb_e"])[rows]
    assert data.time_s.values == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    assert data.velocity_error.values[0] == pytest.approx(np.linalg.norm(error, axis=1))
    forward = [e @ C[:, 0] for e, C in zip(error, run["C_b_e_true"][rows], strict=True)]
    assert data.velocity_error_forward.values[0] == pytest.approx(forward)
    variance = run["covariance"][rows][:, [3, 4, 5], [3, 4, 5]].sum(axis=1)
    assert data.velocity_sigma.values[0] == pytest.approx(np.sqrt(variance))
    assert data.cn0.values[0] == pytest.approx(run["cn0"][rows].mean(axis=1))


def test_dry_run_flies_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*BASE, *OVER, "--runs", "100", "--out", str(tmp_path / "out"), "--dry-run"]
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines[:-1]] == [
        f"filter {f}, cn0_dbhz {c}" for f in ("kf", "fiqkf-r") for c in (30, 45)
    ]
    assert lines[-1].startswith("4 cells, 400 runs: about ")
    assert not (tmp_path / "out").exists()
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["total_s"] == pytest.approx(100 * sum(c["run_s"] for c in told["cells"]))
    assert 0.0 < told["total_s"] < 4000.0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (OVER, "--out: missing"),
        ([*OVER, "--out", "x", "--max-cells", "3"], "4 cells (2 filter x 2 cn0_dbhz)"),
        (["--over", "cn0_dbhz=30", "--over", "cn0_dbhz=31", "--out", "x"], "given twice"),
        (["--over", "receiver.filter=ekf9", "--out", "x"], 'receiver.filter: "ekf9" given'),
        (["--keep", "speed", "--out", "x"], "keep: 'speed' given"),
        (["--runs", "0", "--out", "x"], "runs: 0 given"),
        (["--runs", "1e3", "--out", "x"], "'1e3' given, expected a whole number"),
        (["--every", "often", "--out", "x"], "'often' given, expected a number"),
        (["--jobs", "0", "--out", "x"], "jobs: 0 given"),
        (["--jobs", "0", "--dry-run"], "jobs: 0 given"),
        (["--jobs", "-1", "--dry-run"], "'-1' given, expected a whole number"),
        (["--cluster", "tcp://127.0.0.1:9", "--out", "x"], "jobs: 1 given, expected none"),
        (["--max-cells", "0", "--out", "x"], "max_cells: 0 given"),
    ],
)
def test_bad_input_is_refused_before_work(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ultratight.sweeps.flights.simulate", None)
    assert main([*BASE, *words, "--json"]) == 2
    out, err = capsys.readouterr()
    assert said in err
    assert json.loads(out)["error_kind"] == "invalid_input"


def test_the_time_of_a_filter_that_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A sweep records such runs, so a dry run of it is no failure."""
    (tmp_path / "mine.py").write_text(
        "class Mine:\n    def reset(self): pass\n    def step(self, *_): raise KeyError('x')\n"
    )
    words = [*BASE, "--over", f"receiver.filter={tmp_path}/mine.py:Mine", "--dry-run"]
    assert main(words) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("1 cells, 1 runs: about ")


def test_ctrl_c_keeps_what_is_finished(tmp_path: Path) -> None:
    """130, one line that says what is kept, and the same command goes on."""
    journal = tmp_path / "out" / "journal.txt"
    words = [*BASE, "--runs", "20000", "--out", str(tmp_path / "out")]
    code = f"import sys\nfrom ultratight.__main__ import main\nsys.exit(main({words!r}))"
    wanted = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    process = subprocess.Popen(
        [sys.executable, "-c", wanted + code], stderr=subprocess.PIPE, text=True
    )
    until = time.monotonic() + 120.0
    while not (journal.exists() and journal.read_bytes().count(b"\n") > 5):
        assert time.monotonic() < until
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate()
    assert process.returncode == 130
    last = said.splitlines()[-1]
    n = journal.read_bytes().count(b"\n") - 1
    assert last.startswith(f"interrupted, {n} of 20000 runs are kept in")
    assert "the same command goes on" in last
    assert ", about " in said or n < 60  # time left, from the second line on
