"""The vector closures on taps in closed form: geometry, consistency, outages, faults."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from ultratight import load, run
from ultratight.history import History
from ultratight.metrics import chi2_interval
from ultratight.results import Run
from ultratight.scenario import InvalidInput, Scenario
from ultratight.simulation import fly, new_closure
from ultratight.tracking.knows import Knows
from ultratight.tracking.scalar import ScalarSettings
from ultratight.tracking.vector import Vector
from ultratight.tracking.vector_faults import Faults
from ultratight.tracking.vector_solution import VectorSettings, transition
from ultratight.world import World

CALM = {"clock.model": "ideal", "clock.bias_m": 0.0, "clock.drift_mps": 0.0}
STILL = {"receiver.vector.states": 8, "receiver.vector.acceleration_mps2_sqrt_hz": 1e-4}
BLOCKED = {"t0_s": 3.0, "t1_s": 6.0, "prns": [6], "cn0_change_db": -50.0}
KINDS = ("model", "samples")
HALF_S, WAVELENGTH_M, CHIP_M = 0.01, 299792458.0 / 1575.42e6, 299792458.0 / 1.023e6


def static(closure: str, duration_s: float, **change: Any) -> Scenario:
    return load("static", {"receiver.closure": closure, "duration_s": duration_s} | change)


def flown(world: World, knows: Knows | None = None) -> tuple[Vector, History]:
    receiver = new_closure(world.scenario, knows or world.knows)
    assert isinstance(receiver, Vector)
    correlator, imu = world.correlator(), world.imu[0]
    return receiver, fly(receiver, correlator, imu, world.scenario.duration_s)


def error(world: World, receiver: Vector) -> np.ndarray:
    """True minus estimated r, v, clock and drift at the end."""
    t = np.array([receiver.t_s])
    r, v = world.antenna(t)
    clock = np.interp(t, world.t_s, world.clock.clock_m)
    truth = np.concatenate([r[0], v[0], clock, [world.clock.drift_mps[-1]]])
    return truth - receiver.x[:8]


def kinds(run_: Run, channel: str) -> list[str]:
    return [event.kind for event in run_.events if event.channel == channel]


# -- what is measured -----------------------------------------------------------------------------


@pytest.mark.parametrize("closure", ["vdfll", "vdll"])
def test_a_wrong_start_is_measured_with_the_right_signs(closure: str) -> None:
    """At 65 dB-Hz 0.2 s of data put each state right, within its own sigma; a wrong sign doubles
    the displacement: 40 m, or 2 m/s (10 Hz), in one epoch."""
    calm = CALM | STILL | {"cn0_dbhz": 65.0, "receiver.knows.cn0_sigma_db": 0.0}
    world = World(static(closure, 0.2, **calm), 1)
    for k in range(8):
        step = np.zeros(8)
        step[k] = 2.0 if k in (3, 4, 5, 7) else 40.0
        told = dict(vars(world.knows))
        told["r_eb_e"], told["v_eb_e"] = told["r_eb_e"] + step[:3], told["v_eb_e"] + step[3:6]
        told["clock_m"], told["clock_rate_mps"] = step[6], step[7]
        told["sigma"] = np.where(np.isin(np.arange(17), range(9)), 40.0, 1.0)
        told["sigma"][15:17] = 40.0
        receiver, _ = flown(world, Knows(**told))
        sigma = np.sqrt(np.diagonal(receiver.cov))
        assert (sigma < 0.5).all()
        assert (np.abs(error(world, receiver)) < 5.0 * sigma).all(), k


@pytest.mark.slow
def test_errors_are_what_theory_says() -> None:
    """Fixed antenna, ideal clock: NEES of 8 states and NIS over 10 seeds, and the covariance that
    weighted least squares over all bits has with the textbook's variances at the true C/N0."""
    change = CALM | STILL | {"receiver.knows.cn0_sigma_db": 0.0}
    nees, nis, n_measured, sigmas = [], 0.0, 0.0, []
    for seed in range(1, 11):
        world = World(static("vdfll", 2.0, **change), seed)
        receiver, history = flown(world)
        x = error(world, receiver)
        nees.append(x @ np.linalg.solve(receiver.cov, x))
        nis += history.rows["nis"].sum()
        n_measured += history.rows["n_measurement"].sum()
        sigmas.append(np.sqrt(np.diagonal(receiver.cov)))
    low, high = chi2_interval(80, 0.999)
    assert low < np.mean(nees) / 8.0 < high
    # A^2 is estimated over a second, 20 % at worst in a bit's own weight: 3 % of NIS
    assert nis / n_measured == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / n_measured) + 0.03)
    np.testing.assert_allclose(np.mean(sigmas, axis=0), least_squares_sigma(world, 100), rtol=0.05)


def least_squares_sigma(world: World, n_bit: int) -> np.ndarray:
    """Of x at the end, from the first sigmas and n bits of ranges and rates, 35 dB-Hz each.

    Dot product, 2 s = D = 1/2, and FLL: Kaplan & Hegarty, 3rd ed., ch. 8, of 10 ms twice a bit.
    """
    c = 10.0**3.5
    code = 0.5 / (4.0 * 2.0 * HALF_S * c) * (1.0 + 1.0 / (HALF_S * c)) * CHIP_M**2
    rate = (1.0 / (HALF_S * c)) * (1.0 + 1.0 / (2.0 * HALF_S * c))
    rate *= (WAVELENGTH_M / (2.0 * np.pi * HALF_S)) ** 2
    told = world.knows
    information = np.diag(1.0 / np.concatenate([told.sigma[:6], told.sigma[15:17]]) ** 2)
    phi = np.eye(8)
    phi[[0, 1, 2, 6], [3, 4, 5, 7]] = 2.0
    information = np.linalg.inv(phi @ np.linalg.inv(information) @ phi.T)
    line = lines_of_sight(world)
    for k in range(n_bit):
        back = -0.01 - 0.02 * k
        for e in line:
            row = np.concatenate([-e, -back * e, [1.0, back]])
            other = np.concatenate([np.zeros(3), -e, [0.0, 1.0]])
            information += np.outer(row, row) / code + np.outer(other, other) / rate
    return np.sqrt(np.diagonal(np.linalg.inv(information)))


def lines_of_sight(world: World) -> np.ndarray:
    """By orbits at the end, 0.075 s ago: 5e-6 rad of Earth rotation do not matter here."""
    from signals.arcs import arcs
    from signals.propagation import predict_channels

    tow, n = world.scenario.start_tow_s + 2.0, world.prn.size
    r, v = world.antenna(np.array([2.0]))
    rho, rate, u = np.empty(n), np.empty(n), np.empty((n, 3))
    sky = arcs(world.elements, tow, tow)
    predict_channels(sky, tow, r[0], v[0], 0.0, 0.0, rho, rate, u)
    return u


@pytest.mark.parametrize("states", [8, 11])
def test_the_motion_model_is_that_of_white_noise(states: int) -> None:
    """Phi and Q by Van Loan's matrix exponential (IEEE TAC 23, 1978)."""
    s = VectorSettings(states=states, update_s=0.04)
    F, G = np.zeros((states, states)), np.zeros((states, states))
    F[[0, 1, 2, 6], [3, 4, 5, 7]] = 1.0
    G[6, 6], G[7, 7] = 0.3, 0.2
    if states == 8:
        G[3:6, 3:6] = s.acceleration_mps2_sqrt_hz**2 * np.eye(3)
    else:
        F[[3, 4, 5], [8, 9, 10]] = 1.0
        G[8:, 8:] = s.jerk_mps3_sqrt_hz**2 * np.eye(3)
    if states == 11:
        F[[8, 9, 10], [8, 9, 10]] = -1.0 / s.acceleration_tau_s
    big = expm(np.block([[-F, G], [np.zeros_like(F), F.T]]) * 0.04)
    phi, q = transition(s, 0.3, 0.2)
    np.testing.assert_allclose(phi, big[states:, states:].T, atol=1e-12)
    np.testing.assert_allclose(q, phi @ big[:states, states:], rtol=1e-9, atol=1e-13)


# -- membership is not lock -----------------------------------------------------------------------


def test_a_blocked_satellite_keeps_its_replica_and_comes_back_at_once() -> None:
    """50 dB for 3 s.  A VDFLL needs the bits of 0.1 s to say so; the scalar loops, which search
    no frequency but their last, need their settling times of 0.3 s, twice, at least."""
    change = {"channel.disturbance": [BLOCKED], "cn0_dbhz": 45.0}
    vector, scalar = (run(static(c, 7.5, **change), 2) for c in ("vdfll", "scalar"))
    i = vector["channel"].tolist().index("G06:L1CA")
    gone = (vector.t_s > 3.5) & (vector.t_s < 6.0)
    off = vector["nco_carrier_freq"] - vector["doppler_true"]
    # every channel alike: nobody can tell from the NCO who is blocked
    others = np.delete(off, i, axis=1)[gone].std()
    assert off[gone, i].std() < 1.5 * others
    assert np.abs(off[gone, i]).max() < 12.0  # of the +-50 Hz that half bits see
    assert kinds(vector, "G06:L1CA") == ["loss of lock", "lock regained"]
    back = next(e.t_s for e in vector.events if e.kind == "lock regained")
    assert 6.0 < back < 6.1
    assert not vector["contributes"][gone, i].any()
    assert vector["member"][:, i].all()
    again = [e.t_s for e in scalar.events if e.channel == "G06:L1CA" and e.kind == "phase lock"]
    assert again[-1] > 6.6 or len(again) == 1


def test_the_carrier_loop_of_a_vdll_is_led_through_an_outage() -> None:
    change = {"channel.disturbance": [BLOCKED], "cn0_dbhz": 45.0}
    led = run(static("vdll", 7.5, **change), 2)
    i = led["channel"].tolist().index("G06:L1CA")
    gone = (led.t_s > 4.0) & (led.t_s < 6.0)
    assert np.abs((led["nco_carrier_freq"] - led["doppler_true"])[gone, i]).max() < 12.0
    assert kinds(led, "G06:L1CA")[-2:] == ["frequency lock", "phase lock"]
    assert "lock regained" in kinds(led, "G06:L1CA")


def test_a_satellite_that_contradicts_the_others_falls_back_and_returns() -> None:
    """Its clock runs away by 2 m/s for 2.5 s: 12 sigma of a bit's rate at 45 dB-Hz."""
    fault = {"t0_s": 2.0, "t1_s": 4.5, "prns": [6], "pseudorange_rate_mps": 2.0}
    change = {"channel.disturbance": [fault], "cn0_dbhz": 45.0}
    alone = run(static("vdfll", 7.0, **change), 1)
    i = alone["channel"].tolist().index("G06:L1CA")
    told = [k for k in kinds(alone, "G06:L1CA") if k in ("fall-back", "re-acquired")]
    assert told == ["fall-back", "re-acquired"]
    assert not [e for e in alone.events if e.channel not in ("G06:L1CA", "")]
    apart = (alone.t_s > 3.8) & (alone.t_s < 4.4)
    assert not alone["member"][apart, i].any()
    # its own loops follow the faulty signal: a PLL's few Hz, not the 10.5 Hz of the fault
    off = (alone["nco_carrier_freq"] - alone["doppler_true"])[apart, i]
    assert abs(off.mean()) < 1.0
    held = alone["contributes"][(alone.t_s > 2.5) & (alone.t_s < 4.4), i]
    assert not held.any()
    assert alone["member"][-1, i] == 1.0


@pytest.mark.parametrize("fault", [False, True])
def test_a_motion_that_three_of_ten_see_is_no_satellite_s_fault(fault: bool) -> None:
    """A booster's staging: a wrong velocity of 2 m/s, 7 sigma of the low pass of three rates whose
    satellites stand along it, 1 sigma of the others'.  The same on one of the three is a fault."""
    rng = np.random.default_rng(6)
    toward = np.array([0.6, 0.0, 0.8])
    # three around the direction, seven nearly across it
    across = np.linalg.svd(toward[None])[2][1:]
    turn = np.array([0.3, 2.4, 4.5, 0.0, 0.9, 1.8, 2.7, 3.6, 4.5, 5.4])
    along = np.where(np.arange(10) < 3, 0.95, 0.1 * np.cos(5.0 * turn))
    side = np.stack([np.cos(turn), np.sin(turn)], axis=1) @ across
    u = along[:, None] * toward + np.sqrt(1.0 - along**2)[:, None] * side
    line, sigma = (
        np.column_stack([-u, np.ones(10)]),
        np.column_stack([np.full(10, 9.0), np.ones(10)]),
    )
    common = np.append(2.0 * toward, 0.0)
    faults, everybody = Faults(10, 0.02), np.ones(10, dtype=np.bool_)
    z = np.zeros((10, 2))
    z[:, 1] = np.where(np.arange(10) == 1, 2.0, 0.0) if fault else line @ common
    for k in range(20):
        noise = 0.1 * rng.standard_normal((10, 2))
        faults.watch(0.02 * k, np.arange(10), z + noise, sigma, line, everybody, everybody)
    assert np.flatnonzero(faults.out).tolist() == ([1] if fault else [])


@pytest.mark.slow
def test_the_vector_holds_where_every_scalar_loop_is_lost() -> None:
    """20 dB-Hz: below the 23.8 dB-Hz at which a Costas loop of 15 Hz has 15 deg of thermal noise
    (Kaplan & Hegarty, 3rd ed., ch. 8: T 20 ms), while ten satellites still steer each other."""
    weak = {"cn0_dbhz": 20.0, "receiver.vector.jerk_mps3_sqrt_hz": 1.0}
    vector, scalar = (run(static(c, 8.0, **weak), 1) for c in ("vdfll", "scalar"))
    assert all(t is not None for t in scalar.summary["lost_lock_s"].values())
    assert vector.summary["velocity_rms_mps"]["end"] < 2.0
    off = vector["nco_carrier_freq"] - vector["doppler_true"]
    assert np.abs(off[vector.t_s > 2.0]).max() < 25.0


# -- runs -----------------------------------------------------------------------------------------


def test_same_seed_same_bits() -> None:
    for closure in ("vdfll", "vdll"):
        one, two = (run(static(closure, 0.4), 7) for _ in range(2))
        for name in one.variables:
            assert np.array_equal(one[name], two[name], equal_nan=one[name].dtype.kind == "f"), name


@pytest.mark.slow
def test_samples_and_closed_form_fly_alike() -> None:
    """Different noises: positions differ by what both covariances allow, NCOs by a few Hz."""
    change = {"cn0_dbhz": 45.0, "max_satellites": 5}
    runs = [run(static("vdfll", 0.6, **change | {"correlator.kind": k}), 1) for k in KINDS]
    for r in runs:
        cov, x = r["covariance"][-1], r["r_eb_e_true"][-1] - r["r_eb_e"][-1]
        assert x @ np.linalg.solve(cov[:3, :3], x) < 21.1  # chi-square(3), 1e-4
        assert np.abs((r["nco_carrier_freq"] - r["doppler_true"])[-1]).max() < 12.0
        assert r["nis"].sum() / r["n_measurement"].sum() == pytest.approx(1.0, abs=0.35)


def test_rows_between_updates_are_predictions() -> None:
    """Updates of 0.1 s: sigmas grow from row to row and fall at each fifth."""
    r = run(static("vdfll", 1.0, **{"receiver.vector.update_s": 0.1}), 1)
    sigma = np.sqrt(np.trace(r["covariance"][:, 3:6, 3:6], axis1=1, axis2=2))
    grows = np.diff(sigma) > 0.0
    at_update = (np.arange(1, r.t_s.size) + 1) % 5 == 0
    assert grows[~at_update].all()
    assert not grows[at_update].any()


def test_the_scenario_s_keys_reach_the_closure() -> None:
    keys = {
        "states": 8,
        "acceleration_mps2_sqrt_hz": 0.7,
        "jerk_mps3_sqrt_hz": 4.0,
        "acceleration_sigma_mps2": 2.0,
        "update_s": 0.06,
    }
    changes = {f"receiver.vector.{k}": v for k, v in keys.items()}
    world = World(static("vdll", 1.0, **changes, **{"receiver.bandwidth_hz": 7.0}), 1)
    receiver = new_closure(world.scenario, world.knows)
    assert isinstance(receiver, Vector)
    assert receiver.settings == VectorSettings(carrier=False, fall_back=True, **keys)
    assert receiver.every == 60


def test_bad_settings_are_named() -> None:
    with pytest.raises(InvalidInput, match=r"receiver.vector.update_s: 0.03 given, expected a mul"):
        static("vdfll", 1.0, **{"receiver.vector.update_s": 0.03})
    with pytest.raises(InvalidInput, match=r'receiver.closure: "vdfll" with signals L5Q given'):
        static("vdfll", 1.0, signals=["L5Q"])
    world = World(static("vdfll", 1.0), 1)
    with pytest.raises(ValueError, match=r"update_s is 0.03: expected a multiple of 0.02 s"):
        Vector(world.knows, VectorSettings(update_s=0.03), ScalarSettings(), 0.25)
