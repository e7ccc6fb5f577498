"""Studies: the ledger's verdicts follow from its numbers, the page from the ledger, and the command
runs what it finds."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ultratight import study
from ultratight.__main__ import main
from ultratight.options import Interrupted

STUDIES = Path(__file__).parents[1] / "studies"
ROWS = json.loads((STUDIES / "ledger.json").read_text())
SCRIPTS = sorted(path.stem for path in STUDIES.glob("*.py"))


@pytest.fixture
def common(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], object]:
    """What the studies share; a folder that is on no path but theirs."""
    monkeypatch.syspath_prepend(STUDIES)
    from importlib import import_module

    return lambda name: import_module(f"common.{name}")


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    """A folder with a study that takes no time, and one that fails."""
    (tmp_path / "studies").mkdir()
    head = "import argparse, json, pathlib, sys\np = argparse.ArgumentParser()\n"
    head += "p.add_argument('--out', type=pathlib.Path); p.add_argument('--jobs')\n"
    head += "[p.add_argument(f, action='store_true') for f in "
    head += "('--quick', '--fresh', '--record', '--count')]\no = p.parse_args()\n"
    head += "if o.count: print(5.0); sys.exit()\n"
    row = {"id": "x", "study": "first", "claim": "c", "verdict": "met", "quick": None}
    body = f"row = {row!r} | dict(quick=o.quick)\nprint('flown')\n"
    body += "(o.out.parent / 'ledger.json').write_text(json.dumps([row]))\n"
    (tmp_path / "studies" / "first.py").write_text(f'"""Asks first."""\n{head}{body}')
    (tmp_path / "studies" / "second.py").write_text(f'"""Fails."""\n{head}sys.exit(3)\n')
    (tmp_path / "studies" / "helper.py").write_text("x = 1\n")
    return tmp_path


# -- the committed ledger -------------------------------------------------------------------------


def test_verdicts_follow_from_numbers_and_conditions(common) -> None:
    """By hand here, apart from the code that wrote them."""
    words = {(False, True): "reproduced", (True, True): "met", (True, False): "not met"}
    for row in ROWS:
        stands = True
        judged = [q for q in row["ours"] if q["must"]]
        for q in judged:
            kind, bound, value = q["must"]["kind"], q["must"]["bound"], q[q["must"]["on"]]
            stands &= {
                "above": lambda v=value, b=bound: v is not None and v >= b,
                "below": lambda v=value, b=bound: v is not None and v <= b,
                "within": lambda v=value, b=bound: v is not None and b[0] <= v <= b[1],
                "covers": lambda q=q, b=bound: (
                    None not in (q["low"], q["high"]) and q["low"] <= b <= q["high"]
                ),
            }[kind]()
        expected = words.get((row["target"], stands), "not reproduced")
        if expected == "reproduced" and row["change"]:
            expected = "reproduced with a stated change"
        assert judged, row["id"]
        assert row["verdict"] == expected == common("ledger").verdict(row), row["id"]


def test_ledger_is_complete(common) -> None:
    """Ids are unique, intervals hold their values, nothing is quick."""
    assert {row["study"] for row in ROWS} <= set(SCRIPTS)
    ids = [row["id"] for row in ROWS]
    assert len(set(ids)) == len(ids)
    for row in ROWS:
        assert not row["quick"], row["id"]
        assert row["command"] == f"ultratight study {row['study']}"
        assert row["claim"]
        assert row["theirs"]
        assert row["why"], row["id"]
        for q in row["ours"]:
            if q["value"] is not None and None not in (q["low"], q["high"]):
                assert q["low"] - 1e-12 <= q["value"] <= q["high"] + 1e-12, (row["id"], q)


def test_page_shows_the_ledger(common) -> None:
    ledger = common("ledger")
    page = (STUDIES / "README.md").read_text()
    table = page.partition(ledger.BEGIN)[2].partition(ledger.END)[0]
    assert table == "\n" + ledger.markdown(ROWS)


def test_page_shows_figures_that_are_there_and_small() -> None:
    page = (STUDIES / "README.md").read_text()
    figures = sorted((STUDIES / "figures").glob("*.png"))
    assert figures
    for path in figures:
        assert f"figures/{path.name}" in page
        assert path.stat().st_size < 200_000, path


# -- what it is made of ---------------------------------------------------------------------------


def test_counts_have_wilsons_interval(common) -> None:
    """Wilson (JASA 22, 1927), written out."""
    statistics = common("statistics")
    for hits, low, high in ((39, 0.648, 0.873), (50, 0.929, 1.0)):
        q = statistics.count("x", np.arange(50) < hits)
        # (p + z2/2n -+ z sqrt(pq/n + z2/4n2)) / (1 + z2/n)
        p, z2 = hits / 50, 1.959964**2
        half = (z2 * (p * (1 - p) / 50 + z2 / 10_000)) ** 0.5
        ends = [(p + z2 / 100 + sign * half) / (1 + z2 / 50) for sign in (-1, 1)]
        assert [q.low / 50, q.high / 50] == pytest.approx(ends, abs=1e-6)
        assert [q.low / 50, q.high / 50] == pytest.approx([low, high], abs=2e-3)


def test_bootstrap_of_a_mean_has_the_normal_width(common) -> None:
    """Of 400 standard normal numbers: +-1.96/20, to the Monte Carlo error of width and draws."""
    values = np.random.default_rng(5).standard_normal(400)
    q = common("statistics").mean("x", values, "")
    assert q.value == pytest.approx(values.mean())
    assert q.high - q.low == pytest.approx(2 * 1.96 * values.std() / 20.0, rel=0.1)


def test_a_run_without_a_number_is_no_small_error(common) -> None:
    """Diverged runs must not vanish from a median."""
    q = common("statistics").typical("x", np.array([1.0, 2.0, np.nan, np.nan, np.nan]), "m/s")
    assert q.value is None
    assert not common("ledger").holds({"must": {"kind": "below", "bound": 9.0, "on": "value"},
                                       "value": q.value, "low": q.low, "high": q.high})  # fmt: skip


def test_threshold_is_where_the_loss_crosses_ten_percent(common) -> None:
    crossing = common("thresholds").crossing
    levels = np.array([20.0, 25.0, 30.0])
    loss = np.array([[0.9, 0.2, 0.0], [0.2, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    assert crossing(levels, loss) == pytest.approx([27.5, 22.5, 20.0, 30.0])


def test_vibration_has_the_power_asked_for(common) -> None:
    profile = common("motions").vibration(2.0, 10.0, 40.0)
    t = np.arange(10.0, 40.0, 0.0005)
    nodes = [segment["accel0_mps2"] for segment in profile] + [profile[-1]["accel1_mps2"]]
    a = np.interp(t, np.linspace(10.0, 40.0, len(nodes)), nodes)
    assert np.sqrt(np.mean(a**2)) == pytest.approx(2.0 * 9.80665, rel=0.03)  # 1500 values


def test_bound_knows_what_is_free(common) -> None:
    """A clock jump costs the velocity nothing; an unknown acceleration costs 0.008-0.016 m/s for
    0.3-2 m/s2 on a sky of seven (specification of JTQ, section 4)."""
    bound = common("bound")
    u = bound.lines_of_sight()[:7]
    none, clock, acceleration = (
        bound.velocity_bound(u, opened) for opened in ({}, {"clock": 3.0}, {"acceleration": 2.0})
    )
    assert clock == pytest.approx(none, rel=1e-3)
    assert none == pytest.approx(0.0016, rel=0.1)
    assert acceleration == pytest.approx(0.016, rel=0.1)


@pytest.mark.parametrize("quick", [True, False])
def test_verdicts_of_a_quick_look_are_said_to_be_no_more(
    common, quick: bool, tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["toy.py", "--out", str(tmp_path / "toy"), *(["--quick"] if quick else [])]
    monkeypatch.setattr(sys, "argv", words)
    study = common("campaign").Study("toy.py", {})
    ledger = common("ledger")
    ours = ledger.Quantity("error", 1.0, 0.9, 1.1, "m", ledger.Must("below", 2.0))
    study.conclude([ledger.Claim("toy-1", "a claim", "a source", "theirs", (ours,), "")])
    said = capsys.readouterr().out
    assert said == (tmp_path / "toy" / "report.txt").read_text()
    before, _, after = said.partition("not those of the ledger")
    assert ("a claim" in before, "a claim" in after) == (not quick, quick)


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_say_what_they_cost_without_flying(name: str) -> None:
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, STUDIES / f"{name}.py", "--count", "--quick"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert float(done.stdout) > 1.0  # runs of 50 s in closed form
    assert time.monotonic() - began < 60.0


# -- the command ----------------------------------------------------------------------------------


def test_command_lists_runs_and_tells_failures(
    toy: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder, out = ["--dir", str(toy / "studies")], ["--out", str(toy / "out")]
    assert main(["study", *folder]) == 0
    assert "first" in (said := capfd.readouterr().out)
    assert "Asks first." in said
    assert "helper" not in said
    assert main(["study", "first", "--quick", *folder, *out]) == 0
    said = capfd.readouterr()
    assert "flown" in said.out
    assert "1 claims: 1 met" in said.out
    assert "study 1 of 1, first: 5 runs" in said.err
    assert main(["study", "--all", "--json", *folder, *out]) == 1
    said = capfd.readouterr()
    told = json.loads(said.out)
    assert [s["exit_code"] for s in told["studies"]] == [0, 3]
    assert told["claims"][0]["quick"] is False
    assert "second: failed (exit code 3)" in said.err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--all"], "no studies here"),
        (["third", "--dir", "{toy}/studies"], "'third', expected one of first, second"),
        (["first", "--all", "--dir", "{toy}/studies"], "expected names or --all"),
        (["first", "--quick", "--record", "--dir", "{toy}/studies"], "full numbers of seeds"),
        (["first", "--jobs", "0", "--dir", "{toy}/studies"], "0 given, expected a whole number"),
        (["first", "--out", "{toy}/file", "--dir", "{toy}/studies"], "file: cannot be written to"),
        (["first", "--out", "{toy}/old", "--dir", "{toy}/studies"], "ledger.json: damaged"),
        (["--dir", "{toy}/broken"], "bad.py: no Python script (invalid syntax"),
    ],
)
def test_command_refuses_in_one_line(arguments, expected, toy, capsys, monkeypatch) -> None:
    monkeypatch.chdir(toy / "studies")  # there is no ./studies in it
    (toy / "file").write_text("")
    for name, text in (("old/ledger.json", "[{"), ("broken/bad.py", "def (:\n")):
        (toy / name).parent.mkdir()
        (toy / name).write_text(text)
    assert main(["study", *(a.format(toy=toy) for a in arguments)]) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1


def test_a_study_that_fails_has_no_claims(toy: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Those of an earlier run are not told as if they were new."""
    row = {"id": "y", "study": "second", "claim": "c", "verdict": "met"}
    (toy / "out").mkdir()
    (toy / "out" / "ledger.json").write_text(json.dumps([row]))
    words = ["study", "second", "--dir", str(toy / "studies"), "--out", str(toy / "out"), "--json"]
    assert main(words) == 1
    assert json.loads(capfd.readouterr().out)["claims"] == []


def test_sigterm_ends_the_script_too(toy: Path) -> None:
    """Nothing flies on unseen in the folder, which it would hold."""
    path = toy / "studies" / "first.py"
    mark = toy / "pid"
    path.write_text(
        f"import os, pathlib, time\npathlib.Path({str(mark)!r}).write_text(str(os.getpid()))\n"
        "time.sleep(300.0)\n"
    )

    def terminate() -> None:
        until = time.monotonic() + 60.0
        while not (mark.exists() and mark.read_text()) and time.monotonic() < until:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGTERM)

    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=terminate)
    thread.start()
    began = time.monotonic()
    with pytest.raises(Interrupted, match="finished runs are kept"):
        study._run(path, [], toy / "out" / "first", None)
    assert time.monotonic() - began < 150.0  # of the script's 300 s
    thread.join()
    assert signal.getsignal(signal.SIGTERM) is before
    with pytest.raises(ProcessLookupError):
        os.kill(int(mark.read_text()), 0)


def test_counting_left_to_a_script_that_cannot_is_no_failure(toy: Path) -> None:
    assert study._count(toy / "studies" / "helper.py", [], toy) == 0.0
