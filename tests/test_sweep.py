"""Sweeps: same bits however they are flown, whatever else is asked for."""

from __future__ import annotations

import numpy as np
import pytest

import ultratight
from ultratight.monte_carlo import plan
from ultratight.sweeps import dataset

SHORT = {"duration_s": 1.0, "prns": [2, 6, 17, 28], "jump_window_s": [0.2, 0.5]}
OVER = {"receiver.filter": ["kf", "fiqkf-r"], "cause": {"off": {}, "lag": {"imu.lag_s": 0.01}}}


def short(**changes: object) -> ultratight.Scenario:
    return ultratight.load("uniform", SHORT | changes)


def test_a_sweep_is_what_single_runs_are() -> None:
    """Every cell against `ultratight.run` with the seed that the documentation promises."""
    data = ultratight.sweep(short(), OVER, runs=2, seed=5, jobs=1)
    assert data.velocity_rms_mps.dims == ("filter", "cause", "run", "window")
    for name in ("kf", "fiqkf-r"):
        for cause, changes in OVER["cause"].items():
            for r in range(2):
                alone = ultratight.run(
                    short().replace({"receiver.filter": name, **changes}), seed=5 + r
                )
                at = data.sel(filter=name, cause=cause, run=r)
                assert at.seed == 5 + r
                for window in ("jump", "end"):
                    assert (
                        at.velocity_rms_mps.sel(window=window)
                        == alone.summary["velocity_rms_mps"][window]
                    )
                assert at.converged == alone.summary["converged"]


def test_closures_without_attitude_can_be_swept() -> None:
    data = ultratight.sweep(short(), {"receiver.closure": ["scalar", "ultra-tight"]}, jobs=1)
    assert not any(data.failure.values.ravel())
    assert (data.n_satellites == 4).all()


def test_run_r_depends_on_nothing_else() -> None:
    full = ultratight.sweep(short(), OVER, runs=3, seed=5, jobs=1)
    part = ultratight.sweep(short(), {"receiver.filter": ["fiqkf-r"]}, runs=2, seed=6, jobs=1)
    both = full.estimate_sha256.sel(filter="fiqkf-r", cause="off").values[1:]
    assert part.estimate_sha256.values[0].tolist() == both.tolist()
    assert len(np.unique(full.estimate_sha256)) == full.estimate_sha256.size


@pytest.mark.parametrize(
    ("over", "words"),
    [
        ({"receiver.filtr": ["kf"]}, "receiver.filtr: unknown key, did you mean filter"),
        ({"imu.lag_s": [-1.0]}, "imu.lag_s: -1.0 given, expected 0 or more"),
        ({"imu.lag_s": []}, "over imu.lag_s: nothing given"),
        ({"imu.lag_s": 0.1}, "over imu.lag_s: 0.1 given, expected a list"),
        ({"receiver.filter": "kf"}, 'over receiver.filter: "kf" given, expected a list'),
        ({"imu.lag_s": [0.1, 0.1]}, "over imu.lag_s: 0.1 given twice"),
        ({"prns": [[2, 6, 17]]}, "prns: leaves 3 of"),
        ({"imu.lag_s": [0.0], "x": {"a": {"imu.lag_s": 1.0}}}, "over imu.lag_s: set by two axes"),
        (
            {"cn0_dbhz": list(range(20, 60)), "imu.lag_s": [k / 100 for k in range(26)]},
            "1040 cells",
        ),
        ([("imu.lag_s", [0.1])], "over: "),
        ({3: [0.1]}, "over: "),
        ({"cause": {"late": 0.1}}, "over cause: late is 0.1, expected a table of keys"),
        ({"run": {"a": {}}}, "over run: a name that results have"),
        ({"converged": {"a": {}}}, "over converged: a name that results have"),
        ({"position_rms_end_m": {"a": {}}}, "over position_rms_end_m: a name that results have"),
        ({"nis": {"a": {}}}, "over nis: a name that results have"),
        ({"a/b": {"a": {}}}, "over a/b: a name that results have or no file can hold"),
    ],
)
def test_bad_axes_are_refused_before_work(over: dict, words: str) -> None:
    with pytest.raises(ultratight.InvalidInput) as refused:
        plan(short(), over)
    assert len(refused.value.problems) == 1
    assert words in str(refused.value)


def test_no_result_has_the_name_of_an_axis() -> None:
    """Every variable and dimension of a sweep's Dataset is refused as the name of an axis."""
    data = ultratight.sweep(short(), {"cause": {"off": {}}}, jobs=1, keep=("cn0",))
    assert {str(name) for name in data.variables} - {"cause"} <= dataset.TAKEN


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"keep": ("cn0", "cn0")}, "keep: 'cn0' given twice"),
        ({"keep": "cn0"}, "keep: 'cn0' given, expected a list"),
        ({"keep": ("cn0",), "every_s": 2.0}, "every_s: 2.0 given, expected no more than the 1 s"),
        ({"every_s": "fast"}, "every_s: fast given"),
        ({"filters": ["mine"]}, 'filters: ["mine"] given'),
        ({"max_cells": 0}, "max_cells: 0 given"),
        ({"runs": 10**12}, "runs: 1000000000000 of 1 cells given, expected at most 100000000"),
    ],
)
def test_bad_arguments_are_refused_before_work(arguments: dict, words: str) -> None:
    with pytest.raises(ultratight.InvalidInput) as refused:
        plan(short(), **arguments)
    assert words in str(refused.value)


def test_numpy_values_are_values() -> None:
    """A grid by `numpy.arange` or a matrix of scale factors is what the same lists are."""
    cn0, ppm = np.arange(30, 32), np.diag([1.0, 2.0, 3.0])[:2]
    given = plan(short(), {"cn0_dbhz": cn0, "imu.accel_scale_factor_ppm": list(ppm)})
    plain = plan(short(), {"cn0_dbhz": [30, 31], "imu.accel_scale_factor_ppm": ppm.tolist()})
    assert given.axes == plain.axes


def test_ctrl_c_inside_a_compiled_call_is_no_failed_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """numba hands a KeyboardInterrupt on as the cause of a SystemError."""

    def interrupted(*args: object, **more: object) -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise SystemError("returned a result with an exception set") from error

    monkeypatch.setattr("ultratight.sweeps.flights.simulate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        ultratight.sweep("uniform", runs=2, jobs=1)
