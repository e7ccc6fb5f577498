"""The linear error model against a platform INS mechanised in full, and its transitions."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from signals.constants import OMEGA_EARTH, STANDARD_GRAVITY
from ultratight.ins.wander_azimuth import EARTH_RADIUS, Flight, FlightProfile, fly
from ultratight.ins.wander_azimuth_errors import (
    N_NAVIGATION,
    NAVIGATION,
    SENSORS,
    error_matrix,
    propagate,
    transitions,
)

ARCSEC = math.pi / 180 / 3600
DEG_PER_H = ARCSEC
G = STANDARD_GRAVITY
ERRORS = {
    "dVx": 0.02, "dVy": 0.03, "dL": 12 * ARCSEC, "dlon": 18 * ARCSEC,
    "phi_x": 20 * ARCSEC, "phi_y": 20 * ARCSEC, "phi_z": 30 * ARCSEC, "da": -600 * ARCSEC,
    "e_x": -0.02 * DEG_PER_H, "e_y": 0.02 * DEG_PER_H, "e_z": 0.05 * DEG_PER_H,
    "b_x": 2e-5 * G, "b_y": 1e-5 * G, "th_xz": 6 * ARCSEC, "th_yz": 10 * ARCSEC,
    "Kg_x": 7e-4, "Kg_y": -7e-4, "Kg_z": 7e-4, "Ka_x": 7e-4, "Ka_y": -6e-4,
    "m_XX": 1.5 * DEG_PER_H, "q_ZX": 0.5 * DEG_PER_H,
    "m_YY": 1.0 * DEG_PER_H, "q_ZY": 0.5 * DEG_PER_H,
}  # fmt: skip
"""Initial errors of Wei et al. (2012), table 1"""
PROFILE = FlightProfile(
    # take-off, climb, acceleration, a left turn of 1.8 deg/s over 200 s, then level
    [0, 20, 23, 183, 186, 386, 426, 808, 809, 1009, 1010],
    [0, 90, 90, 90, 90, 90, 200, 200, 200, 200, 200],
    np.radians([0, 0, 8, 8, 0, 0, 0, 0, 0, 0, 0]),
    np.radians([0, 0, 0, 0, 0, 0, 0, 0, -1.8, -1.8, 0]),
)
START = {"lat": math.radians(34.25), "lon": 1.9, "heading": math.pi / 4, "wander": math.pi / 4}


def cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def rates_of_frame(lat, wander, vx, vy):
    """w_ie and w_ew in w."""
    horizontal = OMEGA_EARTH * math.cos(lat)
    w_ie = (horizontal * math.sin(wander), horizontal * math.cos(wander),
            OMEGA_EARTH * math.sin(lat))  # fmt: skip
    return w_ie, (-vy / EARTH_RADIUS, vx / EARTH_RADIUS, 0.0)


def derivative(y, truth, e):
    """Of V_x, V_y, lat, lon, wander and the columns of C_w_p: the INS's own equations.

    The platform turns at the commanded rate and its gyros' drift; the true frame w under it turns
    at its true rate; accelerometers stand on the platform.
    """
    vx, vy, lat, wander = y[0], y[1], y[2], y[4]
    t_lat, _, t_wander, t_vx, t_vy, vz, *f = truth
    columns = y[5:8], y[8:11], y[11:14]
    fx, fy, fz = (sum(c[i] * g for c, g in zip(columns, f, strict=True)) for i in range(3))
    w_ie, w_ew = rates_of_frame(lat, wander, vx, vy)
    w = tuple(a + b for a, b in zip(w_ie, w_ew, strict=True))
    true_w = tuple(a + b for a, b in zip(*rates_of_frame(t_lat, t_wander, t_vx, t_vy), strict=True))
    rate = (
        w[0] * (1 + e["Kg_x"]) + e["e_x"] + e["m_XX"] * fx / G + e["q_ZX"] * (fz / G - 1),
        w[1] * (1 + e["Kg_y"]) + e["e_y"] + e["m_YY"] * fy / G + e["q_ZY"] * (fz / G - 1),
        w[2] * (1 + e["Kg_z"]) + e["e_z"],
    )
    coriolis = cross([2 * a + b for a, b in zip(w_ie, w_ew, strict=True)], (vx, vy, vz))
    s, c = math.sin(wander), math.cos(wander)
    east, north = vx * c - vy * s, vx * s + vy * c
    out = [
        fx * (1 + e["Ka_x"]) + e["b_x"] + e["th_xz"] * fy - coriolis[0],
        fy * (1 + e["Ka_y"]) + e["b_y"] - e["th_yz"] * fx - coriolis[1],
        north / EARTH_RADIUS,
        east / (EARTH_RADIUS * math.cos(lat)),
        -east / EARTH_RADIUS * math.tan(lat),
    ]
    # C' = -[rate x] C + C [true_w x], column by column
    for j in range(3):
        a, b = columns[(j + 1) % 3], columns[(j + 2) % 3]
        p, q = true_w[(j + 2) % 3], true_w[(j + 1) % 3]
        turn = cross(rate, columns[j])
        out += [a[i] * p - b[i] * q - turn[i] for i in range(3)]
    return out


def mechanise(truth, h, e):
    """States after each step h from rows of truth at its start, middle and end (n, 3, 9)."""
    lat, lon, wander, vx, vy = truth[0, 0, :5]
    phi = [e["phi_x"], e["phi_y"], e["phi_z"]]
    K = np.array([[0, -phi[2], phi[1]], [phi[2], 0, -phi[0]], [-phi[1], phi[0], 0]])
    y = [vx + e["dVx"], vy + e["dVy"], lat + e["dL"], lon + e["dlon"], wander + e["da"]]
    y += expm(-K).T.ravel().tolist()
    history = []
    for begin, middle, end in truth.tolist():
        k1 = derivative(y, begin, e)
        k2 = derivative([a + 0.5 * h * b for a, b in zip(y, k1, strict=True)], middle, e)
        k3 = derivative([a + 0.5 * h * b for a, b in zip(y, k2, strict=True)], middle, e)
        k4 = derivative([a + h * b for a, b in zip(y, k3, strict=True)], end, e)
        y = [a + h / 6 * (b + 2 * c + 2 * d + f)
             for a, b, c, d, f in zip(y, k1, k2, k3, k4, strict=True)]  # fmt: skip
        history.append(y)
    return np.array(history)


def rows(flight):
    return np.column_stack([flight.lat, flight.lon, flight.wander, flight.v_w, flight.f_w])


def tilts(states):
    """phi of the columns of C_w_p = I - [phi x]."""
    C = states[:, 5:].reshape(-1, 3, 3)
    return 0.5 * np.stack(
        [C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], -1
    )


def test_errors_follow_the_mechanised_platform():
    """All 24 errors over take-off, climb and turn, with either sign.

    Half the difference of the two is free of the second order.  That alone, from the product of
    tilts and mass unbalance and from the wander angle's cosine, reaches 0.012 m/s, 3 m and 0.3
    arcsec: it is what a linear model leaves out, bounded here by twice as much.
    """
    n, h = 3000, 0.5
    nodes = (np.arange(n)[:, None] * h + [0.0, h / 2, h - 1e-9]).ravel()
    truth = rows(fly(PROFILE, nodes, **START)).reshape(n, 3, 9)
    clean = mechanise(truth, h, dict.fromkeys(ERRORS, 0.0))
    end = rows(fly(PROFILE, np.arange(1, n + 1) * h, **START))
    np.testing.assert_allclose(clean[:, :2], end[:, 3:5], atol=1e-5)  # an INS without error
    np.testing.assert_allclose(clean[:, 2:5], end[:, :3], atol=1e-11)

    middles = fly(PROFILE, (np.arange(15_000) + 0.5) * 0.1, **START)
    Phi, Gamma = transitions(middles, 10)
    start = [ERRORS[name] for name in (*NAVIGATION, *SENSORS)]
    x = propagate(Phi, Gamma, start, np.zeros((1500, N_NAVIGATION)))[1:]

    plus = mechanise(truth, h, ERRORS)[1::2]  # at each second
    minus = mechanise(truth, h, {name: -e for name, e in ERRORS.items()})[1::2]
    linear, curved = 0.5 * (plus - minus), 0.5 * (plus + minus) - clean[1::2]
    tilt, curved_tilt = 0.5 * (tilts(plus) - tilts(minus)), 0.5 * (tilts(plus) + tilts(minus))
    assert np.abs(linear[:, :2]).max() > 2.0  # m/s: something to reproduce
    assert np.abs(linear[:, 2:4]).max() * EARTH_RADIUS > 700.0  # m
    assert np.abs(x[:, :2] - linear[:, :2]).max() < 1e-4
    assert np.abs(x[:, 2:4] - linear[:, 2:4]).max() * EARTH_RADIUS < 0.05
    assert np.abs(x[:, 4:7] - tilt).max() < 0.01 * ARCSEC
    assert np.abs(x[:, 7] - linear[:, 4]).max() < 0.01 * ARCSEC
    assert np.abs(curved[:, :2]).max() < 0.025
    assert np.abs(curved[:, 2:4]).max() * EARTH_RADIUS < 6.0
    assert np.abs(curved_tilt).max() < 0.6 * ARCSEC


def short_flight(n=20, h=0.05):
    t = 815.0 + (np.arange(n) + 0.5) * h
    return fly(PROFILE, t, **START)


def test_transition_is_the_exponential():
    """Phi and Gamma of steps of 50 ms against expm of the 24-state matrix of each step."""
    flight = short_flight()
    Phi, Gamma = transitions(flight, 10)
    size = np.abs([ERRORS[name] for name in (*NAVIGATION, *SENSORS)])
    for k in range(2):
        whole = np.eye(24)
        largest = 0.0
        for step in range(10 * k, 10 * k + 10):
            A = error_matrix(flight, step)
            whole = expm(A * 0.05) @ whole
            largest = max(largest, np.abs(A[:11] * size / size[:11, None]).sum(1).max() * 0.05)
        # in units of the errors' own size the remainder is (A h)^3 / 6 per step
        gap = np.abs(np.hstack([Phi[k], Gamma[k]]) - whole[:11]) * size / size[:11, None]
        assert gap.max() < 10 * largest**3 / 6
        assert gap.max() < 0.01 * 10 * largest**2 / 2  # the second order is there


def test_propagation_is_the_sum():
    rng = np.random.default_rng(3)
    Phi, Gamma = transitions(short_flight(), 4)
    start, noise = rng.standard_normal(24), rng.standard_normal((5, 11))
    x = propagate(Phi, Gamma, start, noise)
    expected = start[:11]
    for k in range(5):
        expected = Phi[k] @ expected + Gamma[k] @ start[11:] + noise[k]
        np.testing.assert_allclose(x[k + 1], expected, rtol=1e-12)


def test_quadrature_models():
    flight = short_flight()
    fx, fy, fz = flight.f_w[3] / G
    A = {name: error_matrix(flight, 3, name) for name in ("calibrated", "full", "z-gyro")}
    q_zx, q_zy = 11 + SENSORS.index("q_ZX"), 11 + SENSORS.index("q_ZY")
    assert A["calibrated"][[4, 5], [q_zx, q_zy]] == pytest.approx([fz - 1] * 2, rel=1e-12)
    assert A["full"][[4, 5], [q_zx, q_zy]] == pytest.approx([fz] * 2, rel=1e-15)
    assert A["z-gyro"][6, [q_zx, q_zy]] == pytest.approx([fx, fy], rel=1e-15)
    assert A["z-gyro"][4, q_zx] == A["z-gyro"][5, q_zy] == 0.0


def test_bad_input():
    flight = short_flight()
    with pytest.raises(ValueError, match="quadrature: 'half', expected one of calibrated"):
        error_matrix(flight, 0, "half")
    with pytest.raises(ValueError, match="per_epoch: 7 for 20 steps, expected whole epochs"):
        transitions(flight, 7)
    bent = Flight(flight.t_s**2, *flight[1:])
    with pytest.raises(ValueError, match="middles of equal steps"):
        transitions(bent, 10)
    Phi, Gamma = transitions(flight, 10)
    with pytest.raises(ValueError, match="start: shape"):
        propagate(Phi, Gamma, np.zeros(11), np.zeros((2, 11)))
    with pytest.raises(ValueError, match="noise: shape"):
        propagate(Phi, Gamma, np.zeros(24), np.full((2, 11), np.nan))
