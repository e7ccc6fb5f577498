"""The federated form in the loop: consistency, the centralised form beside it, lock, refusals."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from signals.codes import GPS_L1CA
from signals.correlator import SampleCorrelator
from signals.recording import Recording
from ultratight import load, metrics, run
from ultratight.filters.catalog import CATALOG, make_filter, reads_taps
from ultratight.plots_text import label
from ultratight.results import Run
from ultratight.scenario import InvalidInput, Scenario
from ultratight.simulation import fly, new_closure
from ultratight.tracking.federated import Federated
from ultratight.tracking.ultra_tight import Settings
from ultratight.world import World

FEDERATED = {"receiver.closure": "federated", "receiver.filter": "kf"}
MATCHED = {
    "imu.accel_scale_factor_ppm": [0.0, 0.0, 0.0], "imu.grade": "matched", "imu.lag_s": 0.0,
}  # fmt: skip
"""An IMU that obeys the filter's model: biases and white noise, nothing else"""
SHORT = {"duration_s": 0.4, "profile": []}


def chosen(preset: str, **change: Any) -> Scenario:
    return load(preset, FEDERATED | (SHORT if preset == "jump-1" else {}) | change)


@cache
def calm(closure: str, update_s: float, measurement: str, seed: int) -> Run:
    """20 s of uniform motion."""
    change = MATCHED | {
        "duration_s": 20.0, "receiver.closure": closure, "receiver.federated.update_s": update_s,
        "receiver.measurement": measurement,
    }  # fmt: skip
    return run(chosen("uniform", **change), seed, whole=False)


SEEDS = range(1, 7)
KINDS = [(0.02, "differential"), (0.04, "coherent"), (0.1, "differential")]


# -- consistency ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("update_s", "measurement"), KINDS)
def test_errors_and_innovations_are_as_wide_as_said(update_s: float, measurement: str) -> None:
    """NEES of 17 states at 20 s over 6 seeds by chi-square (99.9 %); NIS: four standard errors and
    4 % below, since what channels of different bit edges share of the clock counts as their own."""
    runs = [calm("federated", update_s, measurement, seed) for seed in SEEDS]
    nees = np.array([metrics.nees_17(r, [20.0]) for r in runs])
    low, high = metrics.chi2_interval(17 * nees.size, 0.999)
    assert low < nees.mean() / 17.0 < high
    settled = [r.t_s > 5.0 for r in runs]
    n = sum(r["n_measurement"][m].sum() for r, m in zip(runs, settled, strict=True))
    nis = sum(r["nis"][m].sum() for r, m in zip(runs, settled, strict=True)) / n
    spread = 4.0 * np.sqrt(2.0 / n)
    assert 1.0 - 0.04 - spread < nis < 1.0 + spread
    assert not [e for r in runs for e in r.events if e.kind == "loss of lock"]


def test_hand_overs_are_independent_in_time() -> None:
    """Rates of successive intervals, their mean over the channels taken off: a phase carried on
    would correlate them by -1/2, data counted twice by more than 0."""
    r = calm("federated", 0.02, "differential", 1)
    x = (r["rate_residual"] / r["rate_sigma"])[r.t_s > 5.0]
    x = x - np.nanmean(x, axis=1, keepdims=True)
    n, square = np.isfinite(x).sum(), np.nansum(x * x)
    assert abs(np.nansum(x[1:] * x[:-1]) / square) < 4.0 / np.sqrt(n)
    # the reference is off by less than a tenth of a bit's own noise
    assert square / n == pytest.approx(1.0 - 1.0 / x.shape[1], abs=0.05)


def test_a_data_bit_at_a_time_knows_what_the_centralised_form_knows() -> None:
    """Model D weighs the same halves of the same bits: sigmas agree in 5 % (the squaring loss of
    model D's I, the clock's share), and estimates of the same seeds differ by no more than
    independent errors of both would: chi-square over 6 seeds, 99.9 %."""
    differences = []
    for seed in SEEDS:
        ours, central = (calm(c, 0.02, "differential", seed) for c in ("federated", "ultra-tight"))
        a, b = ours["covariance"][-1], central["covariance"][-1]
        for rows in (slice(0, 3), slice(3, 6), slice(16, 17)):
            ratio = np.sqrt(np.trace(a[rows, rows]) / np.trace(b[rows, rows]))
            assert ratio == pytest.approx(1.0, abs=0.05)
        x = ours["v_eb_e"][-1] - central["v_eb_e"][-1]
        differences.append(x @ np.linalg.solve((a + b)[3:6, 3:6], x))
    high = metrics.chi2_interval(3 * len(differences), 0.999)[1]
    assert np.mean(differences) / 3.0 < high


def test_longer_intervals_know_the_velocity_better() -> None:
    """Slope of a line through n halves 10 ms apart: sigma^2 12 / (n (n^2 - 1)), so that 100 ms at
    10 Hz weigh (10 * 99) / (2 * 3) / 5 = 33 times as much as 20 ms at 50 Hz; the IMU's noise and
    the clock keep most of that from the velocity, not all of it."""
    sigma = {}
    for update_s in (0.02, 0.1):
        r = calm("federated", update_s, "differential", 1)
        sigma[update_s] = np.nanmedian(r["rate_sigma"][r.t_s > 5.0])
        sigma[-update_s] = np.sqrt(np.trace(r["covariance"][-1, 3:6, 3:6]))
    assert sigma[0.02] / sigma[0.1] == pytest.approx(np.sqrt(10 * 99 / 6), rel=0.05)
    assert sigma[-0.02] / sigma[-0.1] > 3.0


# -- lock -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("measurement", ["coherent", "differential"])
def test_the_jump_with_its_cause_leaves_lock_and_convergence(measurement: str) -> None:
    """10 g for 10 s and 3000 ppm: 3 m/s if nothing corrected; the differential centralised form has
    0.47 m/s (README)."""
    change = {"receiver.filter": "fiqkf-r", "receiver.measurement": measurement}
    r = run(load("jump-1", FEDERATED | change), 1, whole=False)
    assert r.summary["converged"]
    assert all(t is None for t in r.summary["lost_lock_s"].values())
    assert r.summary["velocity_rms_mps"]["jump"] < 0.8


def test_a_blocked_satellite_is_left_out_and_comes_back() -> None:
    """50 dB for 3 s at 45 dB-Hz: the first interval without signal is not handed over, the loss is
    told when the indicator (0.4 s) says so, the return likewise; INS and clock keep its replica."""
    blocked = {"t0_s": 3.0, "t1_s": 6.0, "prns": [6], "cn0_change_db": -50.0}
    change = {"channel.disturbance": [blocked], "cn0_dbhz": 45.0, "duration_s": 9.0}
    for measurement in ("coherent", "differential"):
        r = run(chosen("uniform", **change, **{"receiver.measurement": measurement}), 2)
        i = r["channel"].tolist().index("G06:L1CA")
        events = [e for e in r.events if e.channel]
        assert {e.channel for e in events} == {"G06:L1CA"}
        assert [e.kind for e in events] == ["loss of lock", "lock regained"]
        lost, back = events
        assert 3.0 < lost.t_s < 3.6
        assert 6.0 < back.t_s < 7.0
        assert "left to INS and clock" in lost.reason
        assert f"after {back.t_s - lost.t_s:.2f} s" in back.reason
        gone = (r.t_s > 3.05) & (r.t_s < 6.0)
        assert not r["contributes"][gone, i].any()
        others = np.delete(r["contributes"], i, axis=1)
        assert others.all()
        assert r["contributes"][r.t_s > back.t_s + 0.05, i].all()
        # 0.5 m/s: two seconds of drift of the oscillator would be 0.3 m/s without the others
        off = (r["nco_carrier_freq"] - r["doppler_true"])[gone, i]
        assert np.abs(off).max() < 2.6
        assert r.summary["nis_per_measurement"] == pytest.approx(1.0, abs=0.1)


def test_a_wrong_start_is_pulled_in() -> None:
    """First sigmas of 5 m, 10 m of clock and 0.5 m/s; at 25 dB-Hz a bit's rate has 1.8 m/s, and a
    channel may find its phase at the second attempt."""
    for measurement in ("coherent", "differential"):
        change = {"cn0_dbhz": 25.0, "duration_s": 10.0, "receiver.measurement": measurement}
        r = run(chosen("uniform", **MATCHED, **change), 3, whole=False)
        assert r.summary["velocity_rms_mps"]["end"] < 0.5
        assert not [e for e in r.events if e.kind == "loss of lock" and e.t_s > 1.0]
        assert r["contributes"][r.t_s > 2.0].mean() > 0.99
        assert metrics.nis_per_measurement(r, r.t_s > 2.0) == pytest.approx(1.0, abs=0.06)


# -- runs -----------------------------------------------------------------------------------------


def test_same_seed_same_bits() -> None:
    one, two = (run(chosen("jump-1"), 7) for _ in range(2))
    for name in one.variables:
        assert np.array_equal(one[name], two[name], equal_nan=one[name].dtype.kind == "f"), name
    assert label(one) == "KF, federated"
    assert one.summary["measurement"] == "coherent"


def test_samples_from_a_file_give_the_same_bits(tmp_path) -> None:
    """Whether they are made epoch by epoch or were written in blocks before."""
    some = {"max_satellites": 5, "correlator.kind": "samples", "duration_s": 0.2}
    scenario = chosen("jump-1", **some)
    world = World(scenario, 5)
    made = run(scenario, 5)
    recording = world.samples.record(path=tmp_path / "samples.bin")
    samples = Recording(
        tmp_path / "samples.bin", recording.sample_rate_hz, recording.if_hz, recording.sigma
    )
    chips = np.stack([GPS_L1CA.chips(int(p)) for p in world.knows.prn])
    correlator = SampleCorrelator(samples, chips, np.array([-0.25, 0.0, 0.25]))
    again = fly(new_closure(scenario, world.knows), correlator, world.imu[0], scenario.duration_s)
    for name in ("r_eb_e", "v_eb_e", "covariance", "nis", "rate_residual", "cn0"):
        np.testing.assert_array_equal(again.rows[name], made[name], err_msg=name)
    # and what was measured is the signal: NIS of some 60 numbers
    m = made["n_measurement"] > 0
    n = made["n_measurement"][m].sum()
    assert made["nis"][m].sum() / n == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / n))


def test_pilots_need_no_data_bits() -> None:
    """L5's chips are 29 m: the start is told well enough for early and late 7 m apart."""
    told = {"position_sigma_m": 1.0, "clock_sigma_m": 1.0, "data_bits": False}
    change = {f"receiver.knows.{key}": value for key, value in told.items()}
    more = {"signals": ["L5Q"], "cn0_dbhz": 40.0, "duration_s": 2.0}
    r = run(chosen("jump-1", **change, **more), 1)
    assert r["contributes"].all()
    assert r.summary["nis_per_measurement"] == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("name", ["qkf", "fiqkf-r", "imm2", "kf-acekf", "qkf-20", "qkf-sqrt"])
def test_other_central_filters_serve(name: str) -> None:
    """With a linear measurement a quadrature filter is the Kalman filter."""
    plain, other = (run(chosen("jump-1", **{"receiver.filter": f}), 2) for f in ("kf", name))
    assert np.isfinite(other["v_eb_e"]).all()
    sigma = np.sqrt(np.trace(plain["covariance"][-1, 3:6, 3:6]))
    assert np.linalg.norm(other["v_eb_e"][-1] - plain["v_eb_e"][-1]) < sigma
    if name in ("qkf", "qkf-sqrt"):
        np.testing.assert_allclose(other["v_eb_e"], plain["v_eb_e"], rtol=0, atol=1e-6)


# -- refusals -------------------------------------------------------------------------------------


def test_filters_that_look_into_the_taps_are_refused() -> None:
    refused = [name for name in CATALOG if reads_taps(name)]
    assert set(refused) == {"qkf-cf", "fiqkf-r-cf", "jtq", "jtq-e", "jtq-r", "j1", "io"}
    for name in refused:
        with pytest.raises(InvalidInput, match=rf'^receiver.filter: "{name}" given, expected a f'):
            chosen("jump-1", **{"receiver.filter": name})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"receiver.measurement": "half-bits"}, 'receiver.measurement: "half-bits" given, expect'),
        (
            {"receiver.federated.update_s": 0.2},
            "receiver.federated.update_s: 0.2 given, expected 0",
        ),
        ({"receiver.federated.update_s": 0.01}, "receiver.federated.update_s: 0.01 given, expect"),
        (
            {"receiver.federated.update_s": 0.032, "duration_s": 0.32},
            "receiver.federated.update_s: 0.032 given, expected a multiple of the IMU interval",
        ),
        ({"duration_s": 0.5}, "duration_s: 0.5 given, expected a multiple of update_s = 0.04"),
        ({"receiver.knows.data_bits": False}, 'receiver.measurement: "coherent" without receive'),
        (
            {"receiver.federated.update": 0.1},
            "receiver.federated.update: unknown key, did you mean",
        ),
    ],
)
def test_bad_input_is_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInput) as error:
        chosen("jump-1", **change)
    assert error.value.problems[0].startswith(message)


def test_the_class_itself_refuses_what_it_cannot_do() -> None:
    world = World(chosen("jump-1"), 1)

    def make(**settings: Any) -> Federated:
        return Federated(world.knows, Settings(**settings), make_filter("kf"), 0.25, 0.005)

    with pytest.raises(ValueError, match=r"^update_s is 0.2: expected 0.02 to 0.1 s$"):
        make(epoch_s=0.2)
    with pytest.raises(ValueError, match=r"^measurement is 'half-bits': expected \"coherent\""):
        make(half_bits=True)
    assert make(epoch_s=0.1).epoch_s == 0.1


def test_a_data_bit_that_was_not_told_is_named() -> None:
    world = World(chosen("jump-1"), 1)
    told = dict(vars(world.knows))
    told["data_bits"] = told["data_bits"][:, :5]
    receiver = new_closure(world.scenario, type(world.knows)(**told))
    with pytest.raises(ValueError, match=r"^receiver.knows.data_bits: none for bit "):
        fly(receiver, world.correlator(), world.imu[0], 0.4)
