"""The missile: outside figures, orbits, the rocket equation, the pitch programme."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ultratight.ins.attitude import euler_from_rotation, rotation_from_vector
from ultratight.ins.ballistic_missile import (
    EARTH_RADIUS_M,
    SURFACE_GRAVITY,
    Missile,
    fly,
    turned,
)

MISSILE = Missile(30_000.0, 185.0, 2755.0, 0.25, 140.0)


def test_flight_of_the_prototype():
    """Specification B3.1, to 0.5 %: an implementation apart from this one."""
    flight = fly(MISSILE, 1000.0)
    k = 14_000
    assert np.hypot(*flight.velocity_mps[k]) == pytest.approx(4458.0, rel=5e-3)
    np.testing.assert_allclose(flight.position_m[k], [140.9e3, 117.3e3], rtol=5e-3)
    top = int(np.argmax(flight.height_m))
    assert flight.height_m[top] == pytest.approx(683e3, rel=5e-3)
    assert flight.t_s[top] == pytest.approx(550.0, rel=5e-3)
    assert flight.ground_range_m[-1] == pytest.approx(2763e3, rel=5e-3)
    assert flight.height_m[-1] == pytest.approx(1.1e3, abs=0.005 * flight.height_m[top])


def test_free_flight_keeps_energy_and_angular_momentum():
    """An orbit about the centre: both are constant, and force is felt no more."""
    flight = fly(MISSILE, 600.0)
    free = slice(14_000, None)
    r = flight.position_m[free] + [0.0, EARTH_RADIUS_M]
    v = flight.velocity_mps[free]
    energy = 0.5 * (v**2).sum(1) - SURFACE_GRAVITY * EARTH_RADIUS_M**2 / np.hypot(*r.T)
    momentum = r[:, 0] * v[:, 1] - r[:, 1] * v[:, 0]
    np.testing.assert_allclose(energy, energy[0], rtol=1e-5)
    np.testing.assert_allclose(momentum, momentum[0], rtol=1e-9)
    assert np.all(flight.force_mps2[free] == 0.0)


def test_rocket_equation():
    """Without drag thrust adds u ln(m0 / m); gravity takes the integral of g sin theta."""
    flight = fly(replace(MISSILE, drag_area_m2=0.0), 140.0)
    g = SURFACE_GRAVITY * (EARTH_RADIUS_M / (EARTH_RADIUS_M + flight.height_m)) ** 2
    lost = np.trapezoid(g * np.sin(flight.pitch), flight.t_s)
    gained = MISSILE.exhaust_mps * math.log(30_000.0 / (30_000.0 - 185.0 * 140.0))
    assert np.hypot(*flight.velocity_mps[-1]) == pytest.approx(gained - lost, rel=1e-3)
    slower = fly(MISSILE, 140.0)
    assert np.hypot(*slower.velocity_mps[-1]) < np.hypot(*flight.velocity_mps[-1])
    np.testing.assert_allclose(
        slower.force_mps2[0], [0.0, 2755.0 * 185.0 / 30_000.0, 0.0], atol=1e-12
    )


def test_force_is_acceleration_less_gravity():
    flight = fly(MISSILE, 140.0)
    k = np.arange(100, 13_900, 100)
    a = (flight.velocity_mps[k + 1] - flight.velocity_mps[k - 1]) / 0.02
    along = flight.force_mps2[k, :2]
    g = SURFACE_GRAVITY * (EARTH_RADIUS_M / (EARTH_RADIUS_M + flight.height_m[k])) ** 2
    axis = np.stack([np.cos(flight.pitch[k]), np.sin(flight.pitch[k])], axis=1)
    felt = (a * axis).sum(1) + g * axis[:, 1]  # what gravity does across is not modelled in boost
    np.testing.assert_allclose(felt, np.hypot(*along.T), rtol=2e-3)


def test_pitch_programme_is_continuous():
    """(15) as corrected: 90 deg, then a parabola that ends level with 38 deg."""
    found = np.degrees(MISSILE.pitch_at([0.0, 10.0, 45.0, 80.0, 500.0]))
    np.testing.assert_allclose(found, [90.0, 90.0, 38.0 + 52.0 / 4.0, 38.0, 38.0])


@pytest.mark.nojit
def test_increments_carry_one_attitude_to_the_next():
    rng = np.random.default_rng(1)
    angles = np.cumsum(0.05 * rng.standard_normal((20, 3)), axis=0) + [0.1, 0.2, 1.5]
    C, alpha = turned(angles)
    np.testing.assert_allclose(euler_from_rotation(C), angles, atol=1e-13)
    for k in range(19):
        np.testing.assert_allclose(C[k] @ rotation_from_vector(alpha[k]), C[k + 1], atol=1e-14)


@pytest.mark.nojit
@pytest.mark.parametrize("seed", range(5))
def test_increments_are_body_rates(seed):
    """(18) and (19) as corrected: C omega_b = M times the rates; omega_b by differences."""
    rng = np.random.default_rng(seed)
    gamma, psi, phi = angles = rng.uniform([-3.0, -1.2, -3.0], [3.0, 1.2, 3.0])
    rates = rng.standard_normal(3)  # roll', heading', pitch'
    body = np.array([
        [-np.sin(psi), 0.0, 1.0],
        [np.sin(gamma) * np.cos(psi), np.cos(gamma), 0.0],
        [np.cos(gamma) * np.cos(psi), -np.sin(gamma), 0.0],
    ]) @ rates[::-1]  # fmt: skip
    inertial = np.array([
        [0.0, -np.sin(phi), np.cos(psi) * np.cos(phi)],
        [0.0, np.cos(phi), np.cos(psi) * np.sin(phi)],
        [1.0, 0.0, -np.sin(psi)],
    ]) @ rates[::-1]  # fmt: skip
    C, _ = turned([angles, angles])
    np.testing.assert_allclose(C[0] @ body, inertial, atol=1e-14)
    h = 1e-5
    _, alpha = turned([angles - h * rates, angles + h * rates])
    np.testing.assert_allclose(alpha[0] / (2.0 * h), body, atol=1e-9)


@pytest.mark.nojit
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass_kg": 25_000.0}, "mass_kg: 25000.0, expected more than the 25900.0 that burn"),
        ({"exhaust_mps": 1500.0}, "thrust: .*expected more than the weight"),
        ({"exhaust_mps": math.nan}, "thrust: nan"),
        ({"drag_area_m2": -1.0}, "drag_area_m2: -1.0"),
        ({"turn_s": (80.0, 10.0)}, "turn_s: .*expected rising"),
        ({"pitch": (2.0, 0.5)}, "pitch: .*at most pi / 2"),
    ],
)
def test_bad_missiles(change, message):
    with pytest.raises(ValueError, match=message):
        replace(MISSILE, **change)


@pytest.mark.nojit
def test_bad_times_and_angles():
    for duration, dt in ((1.0, 0.3), (0.0, 0.1), (math.nan, 0.1), (1.0, -0.1)):
        with pytest.raises(ValueError, match="expected a multiple of dt_s"):
            fly(MISSILE, duration, dt)
    for angles in (np.zeros((1, 3)), np.zeros((4, 2)), np.full((4, 3), np.nan)):
        with pytest.raises(ValueError, match="angles: shape"):
            turned(angles)
