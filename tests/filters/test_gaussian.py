"""Predict and update: against dense conditioning, plain numpy, closed forms and chi-square."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, multivariate_normal

from ultratight.filters.gaussian import (
    Gaussian,
    Measurement,
    Update,
    predict,
    update,
)
from ultratight.filters.quadrature import gauss_hermite
from ultratight.filters.reference import update_reference
from ultratight.filters.rules import RULES, Rule

PLANE_RULES = [name for name in RULES if name != "gh3x7x3"]
FIELDS = (
    "mean", "cov", "innovation", "S", "gain", "log_likelihood", "nis", "H", "lam", "passes",
)  # fmt: skip
GH20 = Rule("gh20", "projected", partial(gauss_hermite, 20), "")


def distance(a, b):
    """Largest difference over all fields of two updates."""
    return max(np.abs(np.asarray(getattr(a, x)) - np.asarray(getattr(b, x))).max() for x in FIELDS)


def condition_densely(state, H, noise, z):
    """Posterior from the joint covariance of (x, z): the definition."""
    joint = np.block([[state.cov, state.cov @ H.T], [H @ state.cov, H @ state.cov @ H.T + noise]])
    n = state.mean.size
    right = np.linalg.inv(joint[n:, n:])
    mean = state.mean + joint[:n, n:] @ right @ (z - H @ state.mean)
    return mean, joint[:n, :n] - joint[:n, n:] @ right @ joint[n:, :n]


@pytest.mark.nojit
@pytest.mark.parametrize("name", PLANE_RULES)
@pytest.mark.parametrize("iterations", [1, 3])
def test_every_rule_is_the_kalman_filter_when_linear(make, name, iterations):
    state, measurement = make.problem("linear", 2)
    _, J = measurement.h_jacobian(np.zeros((4, 2)))
    H = np.einsum("bkd,bdn->bkn", J, measurement.A).reshape(12, 6)
    mean, cov = condition_densely(
        state, H, make.stacked_noise(measurement.R), measurement.z.ravel()
    )
    u = update(state, measurement, RULES[name], iterations)
    np.testing.assert_allclose(u.mean, mean, atol=1e-12)
    np.testing.assert_allclose(u.cov, cov, atol=1e-12)
    np.testing.assert_allclose(u.H, H, atol=1e-12)
    S = H @ state.cov @ H.T + make.stacked_noise(measurement.R)
    expected = multivariate_normal(H @ state.mean, S).logpdf(measurement.z.ravel())
    assert u.log_likelihood == pytest.approx(expected, abs=1e-10)
    assert u.nis == pytest.approx(u.innovation @ np.linalg.inv(S) @ u.innovation, abs=1e-10)


@pytest.mark.nojit
def test_prediction():
    rng = np.random.default_rng(4)
    root, phi = rng.standard_normal((7, 7)), np.eye(7) + np.triu(rng.standard_normal((7, 7)), 3)
    q = np.diag(rng.random(7))
    state = Gaussian(rng.standard_normal(7), root @ root.T)
    p = predict(state, phi, q)
    np.testing.assert_allclose(p.mean, phi @ state.mean, atol=1e-13)
    np.testing.assert_allclose(p.cov, phi @ state.cov @ phi.T + q, atol=1e-12)
    assert np.array_equal(p.cov, p.cov.T)


@pytest.mark.parametrize("name", list(RULES))
@pytest.mark.parametrize("iterations", [1, 2])
def test_compiled_path_is_the_numpy_reference(make, name, iterations):
    state, measurement = make.problem("phase", 8, d=3, n=9, scale=0.6)
    u = update(state, measurement, RULES[name], iterations)
    assert distance(u, update_reference(state, measurement, RULES[name], iterations)) < 1e-10


@pytest.mark.parametrize("name", ["linearised", "gh3", "gh7", "cubature-projected"])
def test_channel_by_channel_is_the_joint_update(make, name):
    # in full size: the compiled path goes channel by channel, the reference solves all at once
    state, measurement = make.problem("phase", 9, nb=10, n=17, scale=0.7)
    joint = update_reference(state, measurement, RULES[name])
    assert distance(joint, update(state, measurement, RULES[name])) < 1e-9


def sine_moments(m, P):
    """Mean, slope and residual variance of sin x, x ~ N(m, P), in closed form."""
    mean = np.exp(-P / 2) * np.sin(m)
    slope = np.exp(-P / 2) * np.cos(m)
    variance = 0.5 * (1 - np.exp(-2 * P) * np.cos(2 * m)) - mean**2
    return mean, slope, variance - slope**2 * P


@pytest.mark.nojit
@pytest.mark.parametrize("iterations", [1, 2, 5])
def test_iterated_posterior_linearisation_of_a_sine(iterations):
    m0, P0, R, z = 0.9, 0.5, 0.01, 0.3
    m, P = m0, P0
    for _ in range(iterations):
        zbar, H, omega = sine_moments(m, P)
        S = H * P0 * H + omega + R
        nu = z - zbar - H * (m0 - m)
        m, P = m0 + P0 * H / S * nu, P0 - (P0 * H) ** 2 / S
    measurement = Measurement(
        np.array([[z]]), np.ones((1, 1, 1)), np.full((1, 1, 1), R),
        np.sin, lambda y: (np.sin(y), np.cos(y)[:, :, None]), np.zeros(1, dtype=np.int64),
    )  # fmt: skip
    u = update(Gaussian(np.array([m0]), np.array([[P0]])), measurement, GH20, iterations)
    assert u.mean[0] == pytest.approx(m, abs=1e-10)
    assert u.cov[0, 0] == pytest.approx(P, abs=1e-10)
    assert u.innovation[0] == pytest.approx(nu, abs=1e-10)
    assert u.passes == iterations


def test_iteration_stops_at_small_steps_and_may_start_elsewhere(make):
    state, measurement = make.problem("phase", 12)
    rule = RULES["gh7"]
    once, twice = (update(state, measurement, rule, i) for i in (1, 2))
    step = np.abs(measurement.A @ (once.mean - state.mean)).max(axis=0)
    lazy = update(state, measurement, rule, 4, step_weight=0.49 / step)
    eager = update(state, measurement, rule, 4, step_weight=1e9 / step)
    assert (lazy.passes, eager.passes) == (1, 4)
    np.testing.assert_array_equal(lazy.mean, once.mean)
    again = update(state, measurement, rule, start=Gaussian(once.mean, once.cov))
    np.testing.assert_allclose(again.mean, twice.mean, atol=1e-14)
    np.testing.assert_allclose(again.cov, twice.cov, atol=1e-14)


def test_negative_weights_may_make_s_indefinite(make):
    # unscented with kappa = 3 - n in 17 dimensions: the bare formulas still apply, and are used
    state, measurement = make.problem("phase", 3, nb=7, n=17, scale=2.0)
    u = update(state, measurement, RULES["unscented"])
    assert np.linalg.eigvalsh(u.S)[0] < 0.0
    assert np.isnan(u.log_likelihood)
    gain = np.linalg.solve(u.S, u.H @ state.cov).T
    np.testing.assert_allclose(u.gain, gain, atol=1e-12)
    np.testing.assert_allclose(u.mean, state.mean + gain @ u.innovation, atol=1e-12)


@pytest.mark.nojit
def test_no_block_changes_nothing(make):
    state, measurement = make.problem("phase", 1)
    none = Measurement(
        measurement.z[:0], measurement.A[:0], measurement.R[:0], measurement.h,
        measurement.h_jacobian, measurement.channel[:0],
    )  # fmt: skip
    u = update(state, none, RULES["gh7"])
    np.testing.assert_array_equal(u.mean, state.mean)
    np.testing.assert_array_equal(u.cov, state.cov)
    assert (u.innovation.size, u.log_likelihood, u.nis) == (0, 0.0, 0.0)
    assert (u.gain.shape, u.H.shape) == ((6, 0), (0, 6))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    log_p=st.floats(-4, 4),
    log_r=st.floats(-4, 2),
    name=st.sampled_from(["linearised", "gh3", "gh7", "cubature"]),
)
def test_posterior_is_symmetric_and_semidefinite(make, seed, log_p, log_r, name):
    state, measurement = make.problem("phase", seed)
    state = state._replace(cov=10**log_p * state.cov)
    u = update(state, measurement._replace(R=10**log_r * measurement.R), RULES[name])
    assert np.array_equal(u.cov, u.cov.T)
    scale = np.sqrt(np.diag(state.cov))
    # rounding of P - W'W, relative to the prior
    assert np.linalg.eigvalsh(u.cov / np.outer(scale, scale))[0] > -1e-12
    assert np.linalg.eigvalsh(state.cov - u.cov)[0] > -1e-10 * np.abs(state.cov).max()


@pytest.mark.parametrize("name", ["linearised", "gh3"])
def test_nees_and_nis_are_chi_square(make, name):
    # matched linear model: NEES at the last epoch over independent runs, NIS over all epochs
    rng = np.random.default_rng(20)
    runs, epochs, T = 300, 40, 0.1
    phi = np.array([[1.0, T], [0.0, 1.0]])
    q = 0.5 * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]])
    R = np.array([[[0.3, 0.1], [0.1, 0.2]]])
    model = make.LinearH(np.array([[[1.0, 0.0], [0.4, 1.0]]]))
    root_q, root_R = np.linalg.cholesky(q), np.linalg.cholesky(R[0])
    P0 = np.diag([4.0, 1.0])
    nees = nis = 0.0
    for _ in range(runs):
        x = np.sqrt(np.diag(P0)) * rng.standard_normal(2)
        state = Gaussian(np.zeros(2), P0)
        for _ in range(epochs):
            x = phi @ x + root_q @ rng.standard_normal(2)
            z = model.B[0] @ x + root_R @ rng.standard_normal(2)
            measurement = Measurement(
                z[None], np.eye(2)[None], R, model.h, model.h_jacobian, np.zeros(1, dtype=int)
            )
            u = update(predict(state, phi, q), measurement, RULES[name])
            state, nis = Gaussian(u.mean, u.cov), nis + u.nis
        e = x - state.mean
        nees += e @ np.linalg.solve(state.cov, e)
    for total, degrees in ((nees, 2 * runs), (nis, 2 * runs * epochs)):
        assert chi2.ppf(5e-4, degrees) < total < chi2.ppf(1 - 5e-4, degrees)


@pytest.mark.nojit
def test_bad_shapes_are_named(make):
    state, measurement = make.problem("linear", 1)
    rule = RULES["gh3"]
    with pytest.raises(ValueError, match="iterations: 0"):
        update(state, measurement, rule, 0)
    with pytest.raises(ValueError, match="cov: shape"):
        update(Gaussian(state.mean, state.cov[:3]), measurement, rule)
    with pytest.raises(ValueError, match="R: shape"):
        update(state, measurement._replace(R=measurement.R[:2]), rule)
    with pytest.raises(ValueError, match="A: shape"):
        update(state, measurement._replace(A=measurement.A[:, :, :4]), rule)


@pytest.mark.nojit
def test_fields_of_an_update_that_nobody_gave(make):
    state, measurement = make.problem("phase", 2)
    u = update(state, measurement, RULES["gh3"])
    S, gain = u.S, u.gain
    np.testing.assert_allclose(u.variance(), np.diag(S), rtol=1e-13)
    again = update(state, measurement, RULES["gh3"])
    np.testing.assert_allclose(again.variance(1, 3), np.diag(S)[1::3], rtol=1e-13)
    other = u._replace(gain=2.0 * gain, lam=3.0)
    np.testing.assert_array_equal(other.gain, 2.0 * gain)
    assert (other.lam, u.lam, other.nis) == (3.0, 1.0, u.nis)
    np.testing.assert_array_equal(u.gain, gain)
    bare = Update(state.mean, state.cov, np.zeros(1))
    with pytest.raises(AttributeError, match="S: neither given nor"):
        _ = bare.S
