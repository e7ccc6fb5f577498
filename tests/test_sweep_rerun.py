"""One run of a sweep again, from its folder alone; runs that fail are recorded."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path
from types import FunctionType

import numpy as np
import pytest

import ultratight
from ultratight.__main__ import main
from ultratight.filters.catalog import make_filter
from ultratight.filters.gaussian import Gaussian, Measurement, Prediction, Update
from ultratight.sweeps.work import factory_sha256

SHORT = {"duration_s": 1.0, "prns": [2, 6, 17, 28]}
MINE = """
from ultratight.filters.catalog import make_filter
def mine():
    return make_filter("qkf3")
"""


class Fails:
    """Quadrature filter that raises in runs whose first noise it does not like."""

    def __init__(self) -> None:
        self.filter, self.first = make_filter("kf"), True

    def reset(self) -> None:
        self.filter.reset()

    def step(self, state: Gaussian, prediction: Prediction, measurement: Measurement) -> Update:
        if self.first and measurement.z.size:
            self.first = False
            if float(measurement.z.sum()) * 1e6 % 2.0 < 1.0:
                raise ZeroDivisionError("one run in two")
        return self.filter.step(state, prediction, measurement)


class Diverges(Fails):
    """Its estimate is infinite from the first measurement on."""

    def step(self, state: Gaussian, prediction: Prediction, measurement: Measurement) -> Update:
        result = self.filter.step(state, prediction, measurement)
        return result._replace(mean=result.mean * np.inf) if measurement.z.size else result


def scenario(**changes: object) -> ultratight.Scenario:
    return ultratight.load("uniform", SHORT | changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep with two axes, one of them named, and a filter from a file."""
    home = tmp_path_factory.mktemp("home")
    (home / "mine.py").write_text(MINE)
    over = {
        "receiver.filter": ["kf", f"{home}/mine.py:mine"],
        "cause": {"off": {}, "late": {"imu.lag_s": 0.01, "cn0_dbhz": 40.0}},
    }
    ultratight.sweep(scenario(), over, runs=3, seed=4, jobs=1, out=home / "out", keep=("nis",))
    return home / "out"


@pytest.mark.parametrize("cause", ["off", "late"])
def test_a_rerun_agrees_and_is_the_run(folder: Path, cause: str) -> None:
    again = ultratight.rerun(folder, 2, {"filter": "kf", "cause": cause})
    assert again.agrees is True
    assert again.other == {}
    changes = {"imu.lag_s": 0.01, "cn0_dbhz": 40.0} if cause == "late" else {}
    alone = ultratight.run(scenario(**changes, **{"receiver.filter": "kf"}), seed=4 + 2)
    assert again.run is not None
    assert again.run["v_eb_e"].tolist() == alone["v_eb_e"].tolist()


def test_a_folder_says_it_all(folder: Path, tmp_path: Path) -> None:
    """Moved elsewhere, and the filter's own file is gone: its copy is in the folder."""
    moved = shutil.copytree(folder, tmp_path / "elsewhere")
    label = swept(folder)["filter"][1]
    source = Path(label.rpartition(":")[0])
    kept = source.read_text()
    source.unlink()
    try:
        assert ultratight.rerun(moved, 0, {"filter": label, "cause": "late"}).agrees is True
    finally:
        source.write_text(kept)


def swept(folder: Path) -> dict[str, list]:
    """Labels of each dimension, as the first line of the journal says."""
    header = (folder / "journal.txt").read_text().splitlines()[0].partition(" ")[2]
    return {axis["dim"]: axis["labels"] for axis in json.loads(header)["about"]["axes"]}


def test_a_rerun_that_differs_says_so(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Other bits: as if the receiver's noise had another stream."""
    from ultratight.sweeps import flights

    simulate = flights.simulate
    monkeypatch.setattr(
        flights, "simulate", lambda scenario, seed, **more: simulate(scenario, seed + 1, **more)
    )
    code = main(["rerun", str(folder), "--run", "1", "--cell", "filter=kf", "--cell", "cause=off"])
    assert code == 1
    assert capsys.readouterr().out.splitlines()[-1] == "bits differ from the sweep's"


def test_the_command(folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["rerun", str(folder), "--run", "1", "--cell", "filter=kf", "--cell", "cause=off"]
    assert main([*words, "--out", str(tmp_path / "run.nc")]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[-1] == "bits agree with the sweep's"
    assert any("seed 5" in line for line in out)
    assert ultratight.load_run(tmp_path / "run.nc").seed == 5
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["agrees"] is True
    assert told["summary"]["seed"] == 5
    words[3] = "7"
    assert main(words) == 0
    assert "has not finished this run" in capsys.readouterr().out.splitlines()[-1]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--run", "1"], "cell: filter missing, expected one of kf,"),
        (["--run", "1", "--cell", "filter=qkf"], 'cell: filter "qkf" given, expected one of kf,'),
        (["--run", "1", "--cell", "colour=red"], "cell: colour given, expected one of filter, "),
        (["--run", "-1"], "'--run': '-1' given, expected a whole number"),
    ],
)
def test_a_run_that_is_none_is_refused(
    folder: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rerun", str(folder), *words]) == 2
    assert said in capsys.readouterr().err


def test_a_folder_that_is_no_sweep_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rerun", str(tmp_path), "--run", "0"]) == 2
    assert "holds no sweep" in capsys.readouterr().err


def test_a_run_that_fails_is_recorded_and_stops_no_other(tmp_path: Path) -> None:
    over = {"receiver.filter": ["kf", "fails"]}
    arguments = {"runs": 8, "jobs": 1, "filters": {"fails": Fails}, "out": tmp_path}
    data = ultratight.sweep(scenario(), over, **arguments)
    failure = data.failure.sel(filter="fails").values
    failed = failure != ""
    assert 0 < failed.sum() < 8
    assert all(text.startswith("ZeroDivisionError: one run in two (test_sweep_rerun.py:")
               for text in failure[failed])  # fmt: skip
    assert (data.failure.sel(filter="kf") == "").all()
    end = data.velocity_rms_mps.sel(window="end")
    assert np.isnan(end.sel(filter="fails").values[failed]).all()
    assert not data.converged.sel(filter="fails").values[failed].any()
    assert (
        end.sel(filter="fails").values[~failed].tolist()
        == end.sel(filter="kf").values[~failed].tolist()
    )
    r = int(np.flatnonzero(failed)[0])
    with pytest.raises(ultratight.InvalidInput, match="fails given in Python"):
        ultratight.rerun(tmp_path, r, {"filter": "fails"})
    again = ultratight.rerun(tmp_path, r, {"filter": "fails"}, filters={"fails": Fails})
    assert again.run is None
    assert again.agrees is True
    with pytest.raises(ultratight.InvalidInput, match="another source than then"):
        ultratight.rerun(tmp_path, r, {"filter": "fails"}, filters={"fails": Diverges})


def test_divergence_is_a_result() -> None:
    """The receiver that has nothing left to steer with ends its run: no failure, no convergence."""
    over = {"receiver.filter": ["diverges"]}
    data = ultratight.sweep(scenario(), over, runs=2, jobs=1, filters={"diverges": Diverges})
    assert (data.failure == "").all()
    assert not data.converged.any()
    assert np.isnan(data.velocity_rms_mps.sel(window="end")).all()


def test_copies_are_what_the_sweep_flew_with(folder: Path, tmp_path: Path) -> None:
    """A changed copy is refused where a run is flown again, and made good where they go on."""
    moved = shutil.copytree(folder, tmp_path / "elsewhere")
    label = swept(folder)["filter"][1]
    (copy,) = moved.glob("inputs/*/mine.py")
    copy.write_text(MINE.replace("qkf3", "kf"))
    with pytest.raises(ultratight.InvalidInput, match="has been changed, expected the copy"):
        ultratight.rerun(moved, 0, {"filter": label, "cause": "off"})
    over = {
        "receiver.filter": ["kf", label],
        "cause": {"off": {}, "late": {"imu.lag_s": 0.01, "cn0_dbhz": 40.0}},
    }
    ultratight.sweep(scenario(), over, runs=3, seed=4, jobs=1, out=moved, keep=("nis",))
    assert copy.read_text() == MINE


def test_a_factory_is_known_by_what_it_is_bound_to() -> None:
    """A folder must not mix filters that differ in a number which their source does not say."""

    def known(sigma: object) -> list[str]:
        return [
            factory_sha256(factory, "mine")
            for factory in (
                lambda: (make_filter("kf"), sigma),
                lambda s=sigma: (make_filter("kf"), s),
                partial(make_filter, sigma),
            )
        ]

    assert known(0.1) == known(0.1)
    assert not set(known(0.1)) & set(known(0.2))
    assert known(make_filter) == known(make_filter)
    with pytest.raises(ultratight.InvalidInput, match="mine is bound to"):
        known(object())


def test_a_factory_is_known_by_the_numbers_of_its_module() -> None:
    def known(sigma: float) -> str:
        names: dict = {"sigma": sigma, "make_filter": make_filter, "__name__": __name__}
        return factory_sha256(FunctionType(made_globally.__code__, names), "mine")

    assert known(0.1) == known(0.1) != known(0.2)


def made_globally() -> object:
    return make_filter("kf"), sigma  # noqa: F821
