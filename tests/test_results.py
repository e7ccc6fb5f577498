"""Run: what is saved is what is loaded, bit for bit, or nothing at all."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from ultratight import results
from ultratight.results import Event, InvalidInput, Run, Variable
from ultratight.scenario import load as load_scenario


@pytest.fixture
def run() -> Run:
    rng = np.random.default_rng(1)
    n_epoch, n_channel = 7, 3
    velocity = rng.standard_normal((n_epoch, 3))
    velocity[2, 1] = np.nan
    velocity[3, 0], velocity[4, 0] = np.inf, -0.0
    iq = rng.standard_normal((5, 3)) + 1j * rng.standard_normal((5, 3))
    scenario = load_scenario("jump-1")
    return Run(
        scenario=scenario.to_dict(),
        seed=12,
        t_s=np.cumsum(np.full(n_epoch, 0.1)),
        variables={
            "v_eb_e": Variable(velocity, (results.EPOCH, "axis"), "m/s", "velocity", "estimate"),
            "iq": Variable(iq, ("dump", "tap"), "1", "correlator taps", "taps"),
            "locked": Variable(
                rng.random((n_epoch, n_channel)) > 0.5, (results.EPOCH, "channel"), "1", "locked"
            ),
            "index": Variable(np.array([-1, 2**62]), ("pair",), "1", "whole numbers"),
            "channel": Variable(
                np.array(["G05:L1CA", "G07:L1CA", "G130:L1CA"]), ("channel",), "", "signal"
            ),
            "mode": Variable(np.full(n_epoch, 3, np.int8), (results.EPOCH,), "1", "mode"),
        },
        events=[Event(0.3, "G07:L1CA", "loss-of-lock", "phase"), Event(0.4, "", "hand-over", "")],
        provenance={"seed": 12, "scenario_sha256": scenario.digest()},
        summary={"converged": True, "velocity_rms_mps": {"end": 0.1 + 0.2}, "nees_velocity": None},
    )


def same(a: Run, b: Run) -> None:
    assert a.t_s.tobytes() == b.t_s.tobytes()
    assert set(a.variables) == set(b.variables)
    for name, left in a.variables.items():
        right = b.variables[name]
        assert left.data.dtype == right.data.dtype, name
        assert left.data.shape == right.data.shape, name
        assert left.data.tobytes() == right.data.tobytes(), name
        assert (left.dims, left.units, left.long_name, left.group) == (
            right.dims,
            right.units,
            right.long_name,
            right.group,
        )
    for field in ("scenario", "seed", "events", "provenance", "summary"):
        assert getattr(a, field) == getattr(b, field), field


def test_saved_and_loaded_bit_for_bit(run: Run, tmp_path) -> None:
    run.save(tmp_path / "run.nc")
    same(run, results.load(tmp_path / "run.nc"))
    assert [p.name for p in tmp_path.iterdir()] == ["run.nc"]


def test_a_run_without_events(run: Run, tmp_path) -> None:
    bare = Run(run.scenario, 1, run.t_s, {"mode": run.variables["mode"]})
    bare.save(tmp_path / "run.nc")
    same(bare, results.load(tmp_path / "run.nc"))


def test_a_long_scenario_fits(run: Run, tmp_path) -> None:
    """HDF5 attributes end at 64 kB; a profile in time may well be longer."""
    profile = [[0.1 * k, -0.01 * k] for k in range(20_000)]
    long = Run({**run.scenario, "channel": {"cn0_profile_s_db": profile}}, 1, run.t_s, {})
    long.save(tmp_path / "run.nc")
    same(long, results.load(tmp_path / "run.nc"))


def test_dataset_has_units_everywhere(run: Run) -> None:
    dataset = run.to_xarray()
    for name, array in dataset.variables.items():
        assert "units" in array.attrs, name
        assert array.attrs["long_name"], name
    assert dataset["locked"].sel(channel="G07:L1CA").dims == ("t_s",)
    same(run, Run.from_xarray(dataset))


def test_time_and_names_are_labels(run: Run) -> None:
    dataset = run.to_xarray()
    assert dataset.indexes["t_s"].size == run.t_s.size
    near = dataset["v_eb_e"].sel(t_s=0.52, method="nearest")
    np.testing.assert_array_equal(near, run["v_eb_e"][4])  # 0.1, 0.2, ... 0.5 is the fifth


def test_a_run_shows_itself_in_a_line(run: Run) -> None:
    assert repr(run) == (
        "<Run jump-1, seed 12: ; 7 epochs to 0.7 s, 6 variables, 2 events; "
        "velocity r.m.s. of the end 0.3 m/s>"
    )


def test_others_can_read_the_file(run: Run, tmp_path) -> None:
    """Plain xarray, nothing decoded by us: times stay numbers, no name is invented."""
    run.save(tmp_path / "run.nc")
    with xr.open_dataset(tmp_path / "run.nc", engine="h5netcdf") as dataset:
        assert dataset["t_s"].dtype == np.float64
        assert dataset["v_eb_e"].attrs["units"] == "m/s"
        assert list(dataset["channel"].values) == list(run["channel"])


def test_an_interrupt_leaves_the_old_file_and_no_part(run: Run, tmp_path, monkeypatch) -> None:
    path = tmp_path / "run.nc"
    run.save(path)
    before = path.read_bytes()

    def stop(dataset: xr.Dataset, part, **_: object) -> None:
        part.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(xr.Dataset, "to_netcdf", stop)
    with pytest.raises(KeyboardInterrupt):
        run.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kept", [0, 10, 200, 0.5, 0.99])
def test_truncated_file_is_named(run: Run, tmp_path, kept: float) -> None:
    path = tmp_path / "run.nc"
    run.save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole)) if isinstance(kept, float) else kept])
    with pytest.raises(InvalidInput, match=r"run\.nc: truncated or foreign"):
        results.load(path)


def test_foreign_and_missing_files_are_named(tmp_path) -> None:
    xr.Dataset({"a": ("x", [1.0])}).to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    (tmp_path / "b.nc").write_text("no netCDF")
    for name in ("a.nc", "b.nc", "c.nc"):
        with pytest.raises(InvalidInput, match=name) as caught:
            results.load(tmp_path / name)
        assert len(caught.value.problems) == 1
        assert "\n" not in str(caught.value)


def test_unknown_variable_lists_the_known(run: Run) -> None:
    with pytest.raises(KeyError, match="locked"):
        run["speed"]
    with pytest.raises(KeyError, match=r"time is run\.t_s"):
        run["t_s"]


def test_wrong_number_of_axes() -> None:
    with pytest.raises(ValueError, match="2 axes given, expected 1"):
        Variable(np.zeros((2, 2)), ("epoch",), "m", "something")


def test_output_is_checked_before_work(tmp_path) -> None:
    results.check_writable(tmp_path / "run.nc")
    assert not list(tmp_path.iterdir())
    for bad in (tmp_path / "none" / "run.nc", tmp_path / "run.txt", tmp_path / "run"):
        with pytest.raises(InvalidInput, match="expected"):
            results.check_writable(bad)
