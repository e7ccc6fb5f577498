"""The mechanisation against exact trajectories and against the laws of inertial error growth."""

import numpy as np
import pytest

from signals.constants import OMEGA_EARTH, STANDARD_GRAVITY, WGS84_A, WGS84_E2
from ultratight.ins.attitude import rotation_from_vector, vector_from_rotation
from ultratight.ins.earth import ecef_from_geodetic, rotation_e_from_n
from ultratight.ins.error_state import Layout
from ultratight.ins.imu import Increments, deg_per_h, ug
from ultratight.ins.strapdown import NavState, compensate, correct, propagate, trace
from ultratight.ins.trajectory import Segment, Trajectory

START = (np.radians(39.9), np.radians(116.4), 8000.0)


def flown(trajectory, duration_s, rate_hz=200.0):
    """Error-free increments, the true motion at their nodes and the true first state."""
    t = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
    m = trajectory.at(t)
    increments = Increments(t, *trajectory.increments(t))
    return increments, m, NavState(0.0, m.r_eb_e[0], m.v_eb_e[0], m.C_b_e[0])


def slalom(**options):
    """600 s of turns at 17 deg/s, each while the speed changes by 5 m/s2."""
    segments = []
    for k in range(20):
        s, t = (-1) ** k, 30.0 * k
        segments += [
            Segment(t, t + 5, 0, 0, 0, 0.3 * s),
            Segment(t + 5, t + 20, 5 * s, 5 * s, 0.3 * s, 0.3 * s),
            Segment(t + 20, t + 25, 0, 0, 0.3 * s, 0),
        ]
    return Trajectory.from_profile(START, 0.7, 200.0, segments, **options)


def test_jump_of_100_mps2_is_reproduced():
    """50 s, 200 to 1200 m/s, edges of the jump on the IMU's grid: below 1 mm and 1 um/s.

    Rounding of the position (9e-10 m per step) allows about 1e-7 m by itself.
    """
    trajectory = Trajectory.from_profile(START, 0.7, 200.0, [Segment(20, 30, 100, 100)])
    increments, m, state = flown(trajectory, 50.0)
    r, v, C = trace(state, increments)
    assert np.linalg.norm(r - m.r_eb_e, axis=1).max() < 1e-4
    assert np.linalg.norm(v - m.v_eb_e, axis=1).max() < 1e-6
    np.testing.assert_allclose(C, m.C_b_e, atol=1e-11)


def test_a_jump_between_samples_costs_its_lever_only():
    """A jump inside an interval is taken as spread over it: a velocity step dv early or late by
    at most dt / 2 leaves a position error below a dt^2 / 8 (0.3 mm), and no velocity error."""
    trajectory = Trajectory.from_profile(START, 0.7, 200.0, [Segment(20.0025, 20.5025, 100, 100)])
    increments, m, state = flown(trajectory, 30.0)
    end = propagate(state, increments)
    assert np.linalg.norm(end.v_eb_e - m.v_eb_e[-1]) < 1e-6
    assert np.linalg.norm(end.r_eb_e - m.r_eb_e[-1]) < 2 * 100 * 0.005**2 / 8


def test_ten_minutes_of_turns():
    increments, m, state = flown(slalom(), 600.0)
    r, v, C = trace(state, increments)
    assert np.linalg.norm(r - m.r_eb_e, axis=1).max() < 0.01
    assert np.linalg.norm(v - m.v_eb_e, axis=1).max() < 1e-4
    np.testing.assert_allclose(C, m.C_b_e, atol=1e-10)


def test_ten_minutes_of_banked_turns():
    """With 80 deg of bank and kinks of the roll rate, which a two-sample algorithm must miss."""
    increments, m, state = flown(slalom(banked=True), 600.0)
    r, _, _ = trace(state, increments)
    assert np.linalg.norm(r - m.r_eb_e, axis=1).max() < 1.0


def test_coning():
    """1 deg at 5 Hz, 40 samples per turn: 99 % of what plain sums of angles drift by is undone.

    Their drift is 2 pi f sin(a)^2 / 2 (1 - sinc 2 pi f T) (Savage, part I), 4.1 deg/h here.
    """
    rate, a, f, n = 200.0, np.radians(1.0), 5.0, 2000
    t, w = np.arange(n + 1) / rate, 2 * np.pi * f

    def attitude(t):
        return rotation_from_vector(a * np.array([0.0, np.cos(w * t), np.sin(w * t)]))

    # exact integrals of the body rates of that motion
    middle, sinc = w * (t[1:] + t[:-1]) / 2, np.sinc(f / rate)
    alpha = np.empty((n, 3))
    alpha[:, 0] = -(1 - np.cos(a)) * w / rate
    alpha[:, 1] = -np.sin(a) * w / rate * sinc * np.sin(middle)
    alpha[:, 2] = np.sin(a) * w / rate * sinc * np.cos(middle)
    law = w * np.sin(a) ** 2 / 2 * (1 - np.sinc(2 * f / rate))

    plain = attitude(0.0)
    for increment in alpha:
        plain = plain @ rotation_from_vector(increment)
    state = NavState(0.0, ecef_from_geodetic(*START), np.zeros(3), attitude(0.0))
    C = trace(state, Increments(t, alpha, np.zeros((n, 3))))[2][-1]
    C = rotation_from_vector(np.array([0, 0, OMEGA_EARTH * t[-1]])) @ C  # to inertial axes
    drift = [vector_from_rotation(X @ attitude(t[-1]).T) / t[-1] for X in (plain, C)]
    assert drift[0][0] == pytest.approx(-law, rel=1e-4)
    assert np.linalg.norm(drift[1]) < 0.01 * law


LAT45 = np.radians(45.0)
GRAVITY_45, RADIUS_45 = 9.8062, WGS84_A * (1 - WGS84_E2) / (1 - WGS84_E2 / 2) ** 1.5
SCHULER = np.sqrt(GRAVITY_45 / RADIUS_45)


def drift_north(duration_s, accel_bias=None, gyro_bias=None, tilt=None):
    """North position error [m] of an IMU at rest, by full mechanisation, against one without."""
    rate = 10.0
    C = rotation_e_from_n(LAT45, 0.3)
    still = Trajectory.from_profile((LAT45, 0.3, 0.0), 0.0, 0.0)
    increments, _, state = flown(still, duration_s, rate)
    bad = state._replace(
        accel_bias=np.zeros(3) if accel_bias is None else -accel_bias,
        gyro_bias=np.zeros(3) if gyro_bias is None else -gyro_bias,
        C_b_e=state.C_b_e if tilt is None else C @ rotation_from_vector(tilt),
    )
    e = propagate(bad, increments).r_eb_e - propagate(state, increments).r_eb_e
    return float(C[:, 0] @ e), float(C[:, 2] @ e)


@pytest.mark.parametrize(("t", "published"), [(60.0, 1.76), (600.0, 168.5)])
def test_schuler_accelerometer_bias(t, published):
    """b / ws^2 (1 - cos ws t), 100 ug north: Groves 5.7.2."""
    b = ug(100.0)
    got, _ = drift_north(t, accel_bias=np.array([b, 0, 0]))
    assert got == pytest.approx(b / SCHULER**2 * (1 - np.cos(SCHULER * t)), rel=0.003)
    assert got == pytest.approx(published, rel=0.01)


@pytest.mark.parametrize(("t", "published"), [(60.0, 0.017), (600.0, 16.6)])
def test_schuler_gyro_bias(t, published):
    """R e (t - sin(ws t) / ws), 0.01 deg/h about east: a positive rate tilts to the south."""
    e = deg_per_h(0.01)
    got, _ = drift_north(t, gyro_bias=np.array([0, -e, 0]))
    law = RADIUS_45 * e * (t - np.sin(SCHULER * t) / SCHULER)
    assert got == pytest.approx(law, rel=0.005)
    assert got == pytest.approx(published, rel=0.04 if t < 100 else 0.01)


def test_schuler_tilt():
    """R p (1 - cos ws t), 0.1 mrad about east: 168.4 m after 600 s."""
    got, _ = drift_north(600.0, tilt=np.array([0, -1e-4, 0]))
    assert got == pytest.approx(RADIUS_45 * 1e-4 * (1 - np.cos(SCHULER * 600)), rel=0.003)
    assert got == pytest.approx(168.4, rel=0.01)


def test_vertical_channel_is_unstable():
    """A vertical bias b grows as b / k^2 (cosh k t - 1), k^2 = 2 g / R (Groves 5.7.1)."""
    b, t = ug(100.0), 600.0
    _, down = drift_north(t, accel_bias=np.array([0, 0, b]))
    k = np.sqrt(2 * STANDARD_GRAVITY / 6.3675e6)
    assert down == pytest.approx(b / k**2 * (np.cosh(k * t) - 1), rel=0.005)


def test_propagate_continues_where_it_stopped():
    """In two parts with the previous increments handed on: the run in one, to rounding."""
    increments, _, state = flown(slalom(), 12.0)
    k = 1100
    first = Increments(increments.t_s[: k + 1], increments.alpha_ib_b[:k], increments.nu_ib_b[:k])
    second = Increments(increments.t_s[k:], increments.alpha_ib_b[k:], increments.nu_ib_b[k:])
    state = state._replace(clock_m=5.0, clock_rate_mps=0.25)
    once, middle = propagate(state, increments), propagate(state, first)
    twice = propagate(middle, second, previous=first)
    np.testing.assert_allclose(twice.r_eb_e, once.r_eb_e, rtol=0, atol=2e-9)
    np.testing.assert_allclose(twice.v_eb_e, once.v_eb_e, rtol=0, atol=1e-12)
    np.testing.assert_allclose(twice.C_b_e, once.C_b_e, rtol=0, atol=1e-15)
    assert once.clock_m == pytest.approx(5.0 + 0.25 * 12.0)
    assert once.t_s == pytest.approx(12.0)


def test_compensate_undoes_bias_and_scale_factor():
    increments, _, state = flown(slalom(), 0.1)
    b_g, b_a, s = (
        np.array([1e-4, 0, -2e-4]),
        np.array([0.02, -0.01, 0.0]),
        np.array([5e-3, 0, -1e-3]),
    )
    measured = Increments(
        increments.t_s,
        increments.alpha_ib_b + b_g * 0.005,
        increments.nu_ib_b * (1 + s) + b_a * 0.005,
    )
    knowing = state._replace(gyro_bias=b_g, accel_bias=b_a, accel_scale_factor=s)
    alpha, nu = compensate(knowing, measured)
    np.testing.assert_allclose(alpha, increments.alpha_ib_b, atol=1e-17)
    np.testing.assert_allclose(nu, increments.nu_ib_b, atol=1e-16)


def test_correct_adds_what_is_missing():
    """error = true - estimate: the state plus its error is the truth, for every quantity."""
    layout = Layout.build(scale_factor=True)
    rng = np.random.default_rng(2)
    r = ecef_from_geodetic(*START)
    true = NavState(1.0, r, rng.standard_normal(3), rotation_from_vector(rng.standard_normal(3)),
                    *rng.standard_normal((2, 3)), 30.0, 0.2, rng.standard_normal(3))  # fmt: skip
    psi = np.array([3e-3, -2e-3, 1e-3])
    x = rng.standard_normal(20)
    x[layout.psi] = psi
    estimate = true._replace(
        r_eb_e=true.r_eb_e - x[layout.r],
        v_eb_e=true.v_eb_e - x[layout.v],
        C_b_e=rotation_from_vector(-psi) @ true.C_b_e,
        accel_bias=true.accel_bias - x[layout.accel_bias],
        gyro_bias=true.gyro_bias - x[layout.gyro_bias],
        clock_m=true.clock_m - x[layout.cb][0],
        clock_rate_mps=true.clock_rate_mps - x[layout.cd][0],
        accel_scale_factor=true.accel_scale_factor - x[layout.accel_scale_factor],
    )
    got = correct(estimate, x, layout)
    for name, value in got._asdict().items():
        np.testing.assert_allclose(value, getattr(true, name), atol=2e-9, err_msg=name)
    np.testing.assert_allclose(got.C_b_e @ got.C_b_e.T, np.eye(3), atol=1e-15)


def test_refusals():
    increments, _, state = flown(slalom(), 0.1)
    with pytest.raises(ValueError, match=r"begin at 0.0 s: expected 3.0 s"):
        propagate(state._replace(t_s=3.0), increments)
    with pytest.raises(ValueError, match=r"expected \(17,\)"):
        correct(state, np.zeros(15))
