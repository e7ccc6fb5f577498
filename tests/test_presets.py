"""Presets of vehicles: what they do, from kinematics; every closure flies them to the end."""

from __future__ import annotations

import math

import numpy as np
import pytest

from signals.constants import STANDARD_GRAVITY as G
from ultratight import load, run
from ultratight.motion import motion
from ultratight.world import World

NAMES = ("rocket-launch", "urban-outage")


def along(t0: float, t1: float) -> float:
    """Integral of the rocket's specific force along its nose, without vibration [m/s]."""
    rocket = motion(load("rocket-launch", {"vibration": []}))
    t = np.linspace(t0, t1, 40_001)
    return float(np.trapezoid(rocket.specific_force(t)[:, 0], t))


def test_rocket_obeys_the_rocket_equation() -> None:
    """Constant thrust: v = Isp g ln(m0 / m1), m0 / m1 = f1 / f0.  The first 0.2 s are a rise from
    1 g, which is 2 m/s less; lines between the points of a curve, 0.1 % more."""
    assert along(10.0, 77.5) == pytest.approx(270.0 * G * math.log(12.0 / 3.0) - 0.2 * G, rel=2e-3)
    second = 290.0 * G * math.log(1.0 / (1.0 - 3.0 * 39.0 / 290.0))
    assert along(81.0, 120.0) == pytest.approx(second - 0.15 * 3.0 * G, rel=2e-3)


def test_rocket_burns_at_constant_thrust() -> None:
    """f0 / (1 - f0 t / Isp) all along; chords of up to 5 s lie 0.02 g above the curve."""
    rocket = motion(load("rocket-launch", {"vibration": []}))
    for t0, t1, lit_s, isp_s in ((10.3, 77.4, 10.0, 270.0), (81.4, 119.9, 81.0, 290.0)):
        t = np.arange(t0, t1, 0.1)
        thrust = 3.0 / (1.0 - 3.0 * (t - lit_s) / isp_s)
        np.testing.assert_allclose(rocket.specific_force(t)[:, 0] / G, thrust, atol=0.06)


def test_rocket_pitches_over_by_12_degrees() -> None:
    """2 deg/s for 4 s and two ramps of 2 s to it; then the path falls over by itself."""
    rocket = motion(load("rocket-launch", {"vibration": []}))
    up = -rocket.C_n_e[:, 2]
    for at, angle_deg in ((14.9, 0.0), (23.0, 12.0)):
        off = math.acos(min(1.0, float(rocket.at(at).C_b_e[:, 0] @ up)))
        assert math.degrees(off) == pytest.approx(angle_deg, abs=0.05)


def test_rocket_loads_and_times() -> None:
    """1 g on the pad, 3 to 12 g, nothing between the stages, a gravity turn without side force."""
    rocket = motion(load("rocket-launch", {"vibration": []}))
    for t, load_g in ((5.0, 1.0), (10.2, 3.0), (77.499, 12.0), (79.5, 0.0), (81.3, 3.0)):
        assert rocket.specific_force(t)[0] / G == pytest.approx(load_g, abs=0.03)
    side = rocket.specific_force(np.arange(23.1, 120.0, 0.1))[:, 1:]
    assert np.abs(side).max() < 0.1 * G
    assert np.abs(rocket.specific_force(np.arange(10.0, 23.0, 0.1))[:, 1:]).max() < 0.8 * G
    assert rocket.speed(120.0) == pytest.approx(4193.0, abs=10.0)  # less gravity's 2100 m/s
    up = -(rocket.at(119.9).r_eb_e - rocket.at(0.0).r_eb_e) @ rocket.C_n_e[:, 2]
    assert 195e3 < up < 215e3


def test_rocket_shakes() -> None:
    """0.7 g r.m.s. per axis, then 0.3 g; not on the pad, and not between the stages.

    The mean over the axes: they are those of the Earth, and the rocket turns in them.
    """
    whole, calm = (motion(load("rocket-launch", c)) for c in ({}, {"vibration": []}))
    for t0, t1, rms_g in ((0.0, 10.0, 0.0), (11.0, 77.0, 0.7), (78.5, 81.0, 0.0), (82, 119, 0.3)):
        t = np.arange(t0, t1, 0.002)
        shaken = whole.specific_force(t) - calm.specific_force(t)
        assert np.sqrt((shaken**2).mean()) / G == pytest.approx(rms_g, rel=0.04, abs=1e-5)


def test_rocket_pulls_its_oscillator() -> None:
    """1 ppb/g at 12 g: c 12e-9 = 3.6 m/s more than on the pad's 1 g, 0.3 m/s."""
    changes = {"vibration": [], "clock.model": "ideal"}
    clock = World(load("rocket-launch", changes), 1).clock
    rate = clock.clock_rate_mps[round(77.4 / 0.005)] - clock.clock_rate_mps[round(5.0 / 0.005)]
    assert rate == pytest.approx(299_792_458.0 * 11e-9, rel=0.01)


def test_car_stops_and_turns() -> None:
    """14 m/s after 7 s at 2 m/s2, a stop of 8 s, right, 15 m/s, left, a stop."""
    car = motion(load("urban-outage"))
    t = np.arange(0.0, 120.0, 0.01)
    assert car.speed(t).max() == pytest.approx(15.0)
    for at, speed in ((4.0, 0.0), (20.0, 14.0), (35.1, 0.0), (42.9, 0.0), (47.5, 6.0),
                      (70.0, 15.0), (98.0, 6.0), (108.0, 14.0), (119.5, 0.0)):  # fmt: skip
        assert car.speed(at) == pytest.approx(speed, abs=1e-9)
    for at, heading_deg in ((20.0, 0.0), (70.0, 90.0), (110.0, 0.0)):
        nose = car.C_n_e.T @ car.at(at).C_b_e[:, 0]
        assert math.degrees(math.atan2(nose[1], nose[0])) == pytest.approx(heading_deg, abs=1e-9)
    assert np.linalg.norm(car.at(t).a_eb_e, axis=1).max() < 2.5


def test_car_sees_what_the_streets_leave() -> None:
    """Counted by hand on the sky of the start: walls of 60 deg, an underpass, a tower."""
    world = World(load("urban-outage"), 1)
    at = {2.0: 10, 30.0: 5, 50.0: 10, 70.0: 6, 82.0: 10, 87.0: 0, 92.0: 10, 110.0: 7, 118.0: 10}
    seen = (world.cn0_dbhz(np.array(list(at))) > 40.0).sum(axis=1)
    assert seen.tolist() == list(at.values())
    assert (world.knows.cn0_dbhz > 35.0).all()  # of the start: the receiver is told of no wall


@pytest.mark.parametrize("name", NAMES)
def test_ultra_tight_flies_them(name: str) -> None:
    """To the end, with an answer at every epoch, and right there."""
    r = run(load(name), 1, whole=False)
    assert r.t_s[-1] == 120.0
    assert np.isfinite(r["r_eb_e"]).all()
    assert r.summary["converged"]
    assert r.summary["position_rms_end_m"] < 5.0


@pytest.mark.campaign
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("closure", ["scalar", "scalar-ins", "vdll", "vdfll"])
def test_every_closure_flies_them(name: str, closure: str) -> None:
    """To the end without an exception; scalar closures have no answer without four satellites."""
    r = run(load(name, {"receiver.closure": closure}), 1, whole=False)
    assert r.t_s[-1] == 120.0
    assert np.isfinite(r["r_eb_e"][-1]).all()
