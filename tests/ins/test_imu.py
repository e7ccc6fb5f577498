"""IMU errors: exact where deterministic, inside derived confidence bounds where random."""

from dataclasses import fields, replace

import numpy as np
import pytest

from signals.constants import STANDARD_GRAVITY
from ultratight.ins import imu
from ultratight.ins.imu import GRADES, ImuErrors, Increments, corrupt

pytestmark = pytest.mark.nojit

RNG = np.random.default_rng(5)


def moving(m, dt=0.005):
    t = dt * np.arange(m + 1)
    rate, force = RNG.standard_normal((m, 3)), 20.0 * RNG.standard_normal((m, 3))
    return Increments(t, rate * dt, force * dt)


def still(m, dt):
    return Increments(dt * np.arange(m + 1), np.zeros((m, 3)), np.zeros((m, 3)))


def test_perfect_is_the_truth_bit_for_bit():
    true = moving(50)
    measured, truth = corrupt(true, GRADES["perfect"], seed=1)
    np.testing.assert_array_equal(measured.nu_ib_b, true.nu_ib_b)
    np.testing.assert_array_equal(measured.alpha_ib_b, true.alpha_ib_b)
    assert not truth["accel_bias"].any()
    np.testing.assert_array_equal(truth["accel_matrix"], np.eye(3))


@pytest.mark.parametrize(("name", "sensor"), [("vrw", "nu_ib_b"), ("arw", "alpha_ib_b")])
def test_random_walk_density(name, sensor):
    """Increments have variance N^2 dt, are white, and their sum over time t has N^2 t."""
    m, dt, density = 20_000, 0.01, 1e-3
    measured, _ = corrupt(still(m, dt), ImuErrors(**{name: density}), seed=3)
    w = getattr(measured, sensor) / (density * np.sqrt(dt))
    assert np.mean(w**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / w.size))
    assert abs(np.mean(w[1:] * w[:-1])) < 4 / np.sqrt(w.size)
    assert abs(np.mean(w[:, 0] * w[:, 1])) < 4 / np.sqrt(m)
    assert abs(np.mean(w)) < 4 / np.sqrt(w.size)
    other = measured.alpha_ib_b if sensor == "nu_ib_b" else measured.nu_ib_b
    assert not other.any()


@pytest.mark.parametrize("sensor", ["accel", "gyro"])
def test_in_run_bias_is_gauss_markov(sensor):
    """sigma^2 exp(-lag / tau); Bartlett: the variance of both is below 2 tau / T sigma^4."""
    m, dt, tau, sigma = 100_000, 1.0, 8.0, 0.02
    errors = ImuErrors(**{f"{sensor}_bias_in_run": sigma, f"{sensor}_bias_tau_s": tau})
    measured, truth = corrupt(still(m, dt), errors, seed=4)
    b = truth[f"{sensor}_bias"] / sigma
    tolerance = 4 * np.sqrt(2 * tau / (3 * m * dt))
    for lag in (0, 4, 8, 20):
        assert np.mean(b[lag:] * b[: b.shape[0] - lag]) == pytest.approx(
            np.exp(-lag * dt / tau), abs=tolerance
        )
    # stationary from the start: the first value is as wide as the last
    first = [corrupt(still(1, dt), errors, seed=s)[1][f"{sensor}_bias"][0] for s in range(300)]
    assert np.mean(np.square(first)) / sigma**2 == pytest.approx(1.0, abs=4 * np.sqrt(2 / 900))
    got = measured.nu_ib_b if sensor == "accel" else measured.alpha_ib_b
    np.testing.assert_allclose(got, sigma * (b[1:] + b[:-1]) / 2 * dt, atol=1e-16)


def test_turn_on_biases_over_seeds():
    errors = ImuErrors(accel_bias_turn_on=0.01, gyro_bias_turn_on=5e-5)
    drawn = [corrupt(still(2, 0.01), errors, seed=s)[1] for s in range(400)]
    for name, sigma in (("accel_bias", 0.01), ("gyro_bias", 5e-5)):
        b = np.array([d[name] for d in drawn])
        np.testing.assert_array_equal(b[:, 0], b[:, 2])
        assert np.mean(b[:, 0] ** 2) / sigma**2 == pytest.approx(1, abs=4 * np.sqrt(2 / 1200))


def test_lag_step_response():
    """A step of 100 m/s2: mean over an interval of 1 - exp(-t / tau), then a delay of tau."""
    dt, tau = 0.005, 0.0025
    force = np.where(np.arange(40) < 10, 0.0, 100.0)[:, None] * [1.0, 0.0, -0.5]
    true = Increments(dt * np.arange(41), np.zeros((40, 3)), force * dt)
    nu = corrupt(true, ImuErrors(lag_s=tau), seed=0)[0].nu_ib_b
    x = np.exp(-dt / tau)
    k = np.arange(30)
    expected = 100 * (dt - tau * (1 - x) * x**k)
    np.testing.assert_allclose(nu[10:, 0], expected, rtol=1e-13)
    np.testing.assert_allclose(nu[:, 2], -0.5 * nu[:, 0], rtol=1e-14)
    # what is lost for good is the force times the lag
    assert (true.nu_ib_b - nu)[:, 0].sum() == pytest.approx(100 * tau * (1 - x**30), rel=1e-12)


def test_saturation_acts_before_the_white_noise():
    force = np.array([[150.0, -150.0, 3.0]])
    true = Increments(np.array([0.0, 0.01]), np.zeros((1, 3)), force * 0.01)
    limit = 10 * STANDARD_GRAVITY
    nu = corrupt(true, ImuErrors(saturation_mps2=limit), seed=0)[0].nu_ib_b
    np.testing.assert_array_equal(nu, [[limit * 0.01, -limit * 0.01, 0.03]])
    noisy = ImuErrors(saturation_mps2=limit, vrw=1e-2)
    white = corrupt(still(1, 0.01), ImuErrors(vrw=1e-2), seed=0)[0].nu_ib_b
    np.testing.assert_allclose(corrupt(true, noisy, seed=0)[0].nu_ib_b, nu + white, rtol=1e-15)


def test_scale_factor_misalignment_and_g_dependence():
    true = moving(30)
    errors = ImuErrors(
        accel_scale_factor=(3e-3, 0.0, -1e-3),
        accel_misalignment=3e-4,
        gyro_scale_factor_sigma=3e-4,
        gyro_misalignment=1e-4,
        gyro_g_dependence=1e-6,
    )
    measured, truth = corrupt(true, errors, seed=8, sign=-1)
    np.testing.assert_array_equal(np.diag(truth["accel_matrix"]), [1 - 3e-3, 1.0, 1 + 1e-3])
    np.testing.assert_allclose(truth["accel_scale_factor"], [-3e-3, 0.0, 1e-3])
    for k in (0, 29):
        f, w = true.nu_ib_b[k], true.alpha_ib_b[k]
        np.testing.assert_allclose(measured.nu_ib_b[k], truth["accel_matrix"] @ f, rtol=1e-13)
        gyro = truth["gyro_matrix"] @ w + truth["g_dependence"] @ f
        np.testing.assert_allclose(measured.alpha_ib_b[k], gyro, rtol=1e-13, atol=1e-18)
    # 400 seeds: sizes as asked for
    seeds = [corrupt(true, errors, seed=s)[1] for s in range(400)]
    off = ~np.eye(3, dtype=bool)
    for name, sigma, mask in (
        ("accel_matrix", 3e-4, off),
        ("gyro_matrix", 1e-4, off),
        ("g_dependence", 1e-6, np.ones((3, 3), bool)),
    ):
        x = np.array([s[name][mask] for s in seeds]) / sigma
        assert np.mean(x**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / x.size))


SOURCES = [f.name for f in fields(ImuErrors) if "tau" not in f.name and f.name != "saturation_mps2"]


@pytest.mark.parametrize("source", SOURCES)
def test_switching_one_source_off_leaves_the_others_bits(source):
    """Every contribution that is drawn is drawn from its own stream."""
    full = replace(
        GRADES["industrial-mems"],
        accel_scale_factor=(3e-3, 0, 0),
        accel_scale_factor_sigma=1e-3,
        gyro_misalignment=1e-4,
    )
    off = replace(full, **{source: (0.0, 0.0, 0.0) if source == "accel_scale_factor" else 0.0})
    true = still(64, 0.005)
    (a, truth_a), (b, truth_b) = corrupt(true, full, 11), corrupt(true, off, 11)
    own = {
        "accel_bias_turn_on": {"accel_bias"},
        "accel_bias_in_run": {"accel_bias"},
        "gyro_bias_turn_on": {"gyro_bias"},
        "gyro_bias_in_run": {"gyro_bias"},
        "accel_scale_factor": {"accel_matrix", "accel_scale_factor"},
        "accel_scale_factor_sigma": {"accel_matrix", "accel_scale_factor"},
        "accel_misalignment": {"accel_matrix"},
        "gyro_scale_factor_sigma": {"gyro_matrix"},
        "gyro_misalignment": {"gyro_matrix"},
        "gyro_g_dependence": {"g_dependence"},
    }.get(source, set())
    for name in truth_a:
        assert np.array_equal(truth_a[name], truth_b[name]) == (name not in own), name
    accel_touched = source in {"accel_bias_turn_on", "accel_bias_in_run", "vrw"}
    gyro_touched = source in {"gyro_bias_turn_on", "gyro_bias_in_run", "arw"}
    assert np.array_equal(a.nu_ib_b, b.nu_ib_b) == (not accel_touched)
    assert np.array_equal(a.alpha_ib_b, b.alpha_ib_b) == (not gyro_touched)


def test_a_longer_run_begins_like_a_shorter_one():
    long, short = still(300, 0.005), still(100, 0.005)
    a, b = (corrupt(x, GRADES["industrial-mems"], 2)[0] for x in (long, short))
    np.testing.assert_array_equal(a.nu_ib_b[:100], b.nu_ib_b)
    np.testing.assert_array_equal(a.alpha_ib_b[:100], b.alpha_ib_b)
    other = corrupt(short, GRADES["industrial-mems"], 3)[0]
    assert not np.any(other.nu_ib_b == b.nu_ib_b)


def test_data_sheet_units():
    """By hand: the Earth turns 15.041 deg/h; 0.06 m/s/sqrt(h) is 102 ug/sqrt(Hz)."""
    assert imu.deg_per_h(15.0410671) == pytest.approx(7.292115e-5, rel=1e-6)
    assert imu.deg_per_sqrt_h(0.15) == pytest.approx(4.363e-5, rel=1e-4)
    assert imu.mps_per_sqrt_h(0.06) == pytest.approx(1e-3)
    assert imu.ug(102.0) == pytest.approx(1e-3, rel=3e-4)
    assert imu.mg(1.0) == 9.80665e-3
    assert imu.deg_per_h_per_g(2.0) == pytest.approx(9.696e-6 / 9.80665, rel=1e-4)
    assert imu.ppm(3000.0) == pytest.approx(3e-3)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ImuErrors(vrw=-1.0), "vrw = -1.0: expected"),
        (lambda: ImuErrors(accel_bias_tau_s=0.0), "correlation time > 0"),
        (lambda: ImuErrors(saturation_mps2=0.0), "saturation_mps2"),
        (lambda: ImuErrors(accel_scale_factor=(1.0, 2.0)), "three finite"),
        (lambda: corrupt(still(2, -1.0), ImuErrors(), 0), "increasing"),
        (
            lambda: corrupt(still(2, 1.0)._replace(nu_ib_b=np.zeros((3, 3))), ImuErrors(), 0),
            r"\(2, 3\)",
        ),
    ],
)
def test_refusals(build, message):
    with pytest.raises(ValueError, match=message):
        build()
