"""The flight over the sphere: what it feels follows from where it is, by numerical derivatives."""

import numpy as np
import pytest

from signals.constants import OMEGA_EARTH, STANDARD_GRAVITY
from ultratight.ins.wander_azimuth import EARTH_RADIUS, FlightProfile, fly

WIE = np.array([0.0, 0.0, OMEGA_EARTH])


def earth_axes(lat, lon, wander):
    """C_w_e (n, 3, 3) and the unit vector up (n, 3), from spherical trigonometry."""
    sl, cl, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    east = np.stack([-so, co, 0 * so], -1)
    north = np.stack([-sl * co, -sl * so, cl], -1)
    up = np.stack([cl * co, cl * so, sl], -1)
    s, c = np.sin(wander)[:, None], np.cos(wander)[:, None]
    return np.stack([east * c + north * s, -east * s + north * c, up], -1), up


def level_turn(t):
    """A turn of changing rate at changing speed, in level flight at 50 degrees south."""
    profile = FlightProfile([0.0, 100.0], [150.0, 250.0], [0.0, 0.0], [0.01, -0.03])
    return fly(profile, t, lat=-0.9, lon=2.0, heading=1.0, wander=0.7)


@pytest.mark.nojit
def test_specific_force_is_the_second_derivative_of_position():
    h = 0.25
    flight = level_turn(np.arange(0.0, 25.0, h))
    C, up = earth_axes(flight.lat, flight.lon, flight.wander)
    r = EARTH_RADIUS * up
    # fourth-order central differences; the motion's fifth derivative is below 1e-4 m/s5
    v = (r[:-4] - 8 * r[1:-3] + 8 * r[3:-1] - r[4:]) / (12 * h)
    a = (-r[:-4] + 16 * r[1:-3] - 30 * r[2:-2] + 16 * r[3:-1] - r[4:]) / (12 * h * h)
    inside = slice(2, -2)
    C, up = C[inside], up[inside]
    # centrifugal acceleration is part of g, which points to the centre in this model
    force = a + 2.0 * np.cross(WIE, v) + STANDARD_GRAVITY * up
    # rounding: positions of 6e6 m to 1e-9 m, over h^2 (a) and h (v)
    found = np.einsum("nji,nj->ni", C, v)
    np.testing.assert_allclose(flight.v_w[inside], found, atol=1e-6)
    np.testing.assert_allclose(
        flight.f_w[inside], np.einsum("nji,nj->ni", C, force), atol=1e-5, rtol=0
    )


@pytest.mark.nojit
def test_the_frame_does_not_turn_about_the_vertical():
    h = 0.05
    flight = level_turn(np.arange(0.0, 5.0, h))
    C, _ = earth_axes(flight.lat, flight.lon, flight.wander)
    turn = np.einsum("nji,njk->nik", C[:-1], C[1:])  # C_w'_w from step to step
    about_z = 0.5 * (turn[:, 1, 0] - turn[:, 0, 1]) / h
    # what is left is the commutator of the two levelling rates over a step, (V/R)^2 h
    assert np.abs(about_z).max() < (250.0 / EARTH_RADIUS) ** 2 * h
    east = np.abs(flight.v_w).max() / EARTH_RADIUS * np.tan(0.9)
    assert np.ptp(flight.wander) > 0.3 * east * 5.0  # and that took a turn against north


@pytest.mark.nojit
def test_meridian_climb_and_heading():
    profile = FlightProfile([0.0, 10.0, 20.0], [100.0, 100.0, 100.0], [0.0, 0.1, 0.1], [0.0] * 3)
    t = np.linspace(0.0, 20.0, 201)
    flight = fly(profile, t, lat=0.3, lon=-1.0, heading=0.0, wander=0.0)
    # northwards: L' = V cos(climb) / R, the integral of cos(0.01 t) in closed form
    expected = 0.3 + 100.0 / EARTH_RADIUS * (np.sin(0.1) / 0.01 + np.cos(0.1) * 10.0)
    assert flight.lat[-1] == pytest.approx(expected, abs=1e-14)
    assert np.all(flight.lon == -1.0)
    np.testing.assert_allclose(flight.v_w[-1], [0.0, 100 * np.cos(0.1), 100 * np.sin(0.1)])
    # steady climb: Coriolis east of (2 w + V/R) x V, gravity less V_N^2 / R
    level = 100.0 * np.cos(0.1)
    lat = flight.lat[-1]
    coriolis = (
        2 * OMEGA_EARTH * np.cos(lat) * 100 * np.sin(0.1) - 2 * OMEGA_EARTH * np.sin(lat) * level
    )
    np.testing.assert_allclose(
        flight.f_w[-1],
        [coriolis, level * 100 * np.sin(0.1) / EARTH_RADIUS,
         STANDARD_GRAVITY - level**2 / EARTH_RADIUS], rtol=1e-9,
    )  # fmt: skip
    turn = FlightProfile([0.0, 2.0, 5.0], [1.0] * 3, [0.0] * 3, [0.0, 0.2, 0.2])
    assert turn.heading(0.5) == pytest.approx([0.5, 0.7, 1.3])


@pytest.mark.nojit
def test_at_rest_it_feels_gravity_alone():
    rest = FlightProfile([0.0], [0.0], [0.0], [0.0])
    flight = fly(rest, [0.0, 50.0], lat=0.6, lon=0.1, heading=0.3, wander=0.8)
    assert np.all(flight.f_w == [0.0, 0.0, STANDARD_GRAVITY])
    assert np.all(flight.lat == 0.6)


@pytest.mark.nojit
def test_bad_input():
    good = FlightProfile([0.0, 1.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match=r"t_s: \[1\. 1\.\], expected increasing knots"):
        FlightProfile([1.0, 1.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match="climb_rad: 1 values for 2 knots"):
        FlightProfile([0.0, 1.0], [0.0, 1.0], [0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match=r"speed_mps: .*finite"):
        FlightProfile([0.0, 1.0], [0.0, np.nan], [0.0, 0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match="expected increasing finite times"):
        fly(good, [1.0, 0.0], lat=0.0, lon=0.0, heading=0.0)
    with pytest.raises(ValueError, match=r"expected >= 0\.0 s, the knots'"):
        fly(good, [-1.0, 0.0], lat=0.0, lon=0.0, heading=0.0)
    with pytest.raises(ValueError, match="expected finite angles"):
        fly(good, [0.0], lat=np.nan, lon=0.0, heading=0.0)
    with pytest.raises(ValueError, match=r"the flight reaches 89\.5"):
        fly(good, [0.0], lat=np.radians(89.5), lon=0.0, heading=0.0)
