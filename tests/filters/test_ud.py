"""UD form: the same filter in double precision, and a better one in single."""

import numpy as np
import pytest

from ultratight.filters.catalog import make_filter
from ultratight.filters.factored import FORMS, make_pair
from ultratight.filters.gaussian import Gaussian, predict, update
from ultratight.filters.rules import RULES
from ultratight.filters.ud import condition_ud, cov_ud, factor_ud, predict_ud


def ud():
    return make_pair("ud")


@pytest.mark.nojit
def test_factor_is_the_one_of_rational_arithmetic():
    """P = U D U' of small whole numbers, by hand (Bierman 1977, III.4, upper triangular)."""
    U = np.array([[1.0, 2.0, -3.0], [0.0, 1.0, 5.0], [0.0, 0.0, 1.0]])
    D = np.array([7.0, 0.5, 2.0])
    F = factor_ud(U @ np.diag(D) @ U.T)
    np.testing.assert_allclose(np.diag(F), D, rtol=1e-13)
    np.testing.assert_allclose(F - np.diag(np.diag(F)), U - np.eye(3), atol=1e-13)
    np.testing.assert_allclose(cov_ud(F), U @ np.diag(D) @ U.T, rtol=1e-13, atol=1e-13)


@pytest.mark.nojit
def test_nearly_dependent_noises_keep_their_covariance():
    """As the receiver's phases: one common noise, small own ones; unpivoted elimination would
    amplify rounding by the ratio of their sizes."""
    n = 8
    common, own = np.ones(n), np.zeros((n, 3))
    own[:, 0], own[:, 1], own[:, 2] = np.sin(np.arange(n)), np.cos(np.arange(n)), np.arange(n)
    q = np.outer(common, common) + 1e-6 * own @ own.T
    found = cov_ud(predict_ud(np.zeros((n, n)), np.eye(n), q))
    np.testing.assert_allclose(found, q, rtol=1e-13)


@pytest.mark.nojit
def test_prediction_is_the_plain_one(make):
    rng = np.random.default_rng(2)
    n = 7
    P = make.random_cov(rng, n)
    phi = np.eye(n) + 0.3 * rng.standard_normal((n, n))
    half = rng.standard_normal((n, 3))
    for q in (half @ half.T, np.diag([1.0, 0, 0, 2.0, 0, 0, 0]), np.zeros((n, n))):
        found = cov_ud(predict_ud(factor_ud(P), phi, q))
        np.testing.assert_allclose(found, phi @ P @ phi.T + q, rtol=1e-11, atol=1e-12)


@pytest.mark.nojit
@pytest.mark.parametrize("name", ["linearised", "gh5"])
@pytest.mark.parametrize("iterations", [1, 3])
def test_the_pair_is_the_plain_pair(make, name, iterations):
    """Correlated noise in every block, several iterations, curved h: the same figures."""
    state, measurement = make.problem("phase", 5, nb=4, n=7, scale=0.4)
    phi, q = np.eye(7) + 0.05 * np.eye(7, k=1), 1e-3 * np.eye(7)
    pair, rule = ud(), RULES[name]
    prior, plain = pair.predict(state, phi, q), predict(state, phi, q)
    np.testing.assert_allclose(prior.mean, plain.mean, rtol=1e-14)
    np.testing.assert_allclose(prior.cov, plain.cov, rtol=1e-12)
    found, expected = (
        pair.update(prior, measurement, rule, iterations),
        update(plain, measurement, rule, iterations),
    )
    for key in ("mean", "cov", "innovation", "nis", "S", "gain", "log_likelihood"):
        a, b = getattr(found, key), getattr(expected, key)
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-11, err_msg=key)


@pytest.mark.nojit
def test_no_measurement_leaves_the_prediction(make):
    state, measurement = make.problem("phase", 5, nb=2, n=7, scale=0.4)
    none = measurement._replace(z=measurement.z[:0], A=measurement.A[:0], R=measurement.R[:0])
    found = ud().update(state, none, RULES["linearised"])
    np.testing.assert_array_equal(found.cov, state.cov)
    assert found.nis == 0.0


@pytest.mark.nojit
@pytest.mark.parametrize("r", [1.0, 0.0])
def test_exact_measurements(make, r):
    """Also a noise of zero, after which nothing is left of that direction; against rationals."""
    P = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, 0.0], [0.5, 0.0, 2.0]])
    H, noise = np.array([[1.0, 2.0, 0.0], [0.0, 1.0, -1.0]]), np.array([0.0, r])
    F, mean = factor_ud(P), np.zeros(3)
    nis = condition_ud(mean, F, np.array([1.0, 2.0]), H, noise[:, None, None])
    expected = make.exact_posterior(P, H, noise)
    np.testing.assert_allclose(cov_ud(F), expected, atol=1e-14)
    assert H[0] @ mean == pytest.approx(1.0, abs=1e-14)
    S = H @ P @ H.T + np.diag(noise)
    assert nis == pytest.approx([1.0, 2.0] @ np.linalg.solve(S, [1.0, 2.0]), rel=1e-13)
    # the same number once more says nothing, and breaks nothing
    again, later = F.copy(), mean.copy()
    condition_ud(later, again, np.array([0.0]), H[:1], np.zeros((1, 1, 1)))
    np.testing.assert_allclose(cov_ud(again), expected, atol=1e-14)
    np.testing.assert_allclose(later, mean, atol=1e-13)


@pytest.mark.nojit
def test_a_column_too_small_for_the_sum_still_moves_the_state():
    """Var = 1 + 1e-20 rounds to 1, but the gain of the other state is 1e-11: P h' / S, by hand."""
    P = np.array([[1.0, 1e-11], [1e-11, 1e-20]])
    F, mean = factor_ud(P), np.zeros(2)
    condition_ud(mean, F, np.ones(1), np.array([[0.0, 1.0]]), np.ones((1, 1, 1)))
    np.testing.assert_allclose(mean, [1e-11, 1e-20], rtol=1e-12)


@pytest.mark.nojit
def test_singular_noise_of_a_block(make):
    """Two numbers with one noise between them: their difference is known exactly."""
    rng = np.random.default_rng(3)
    P, H = make.random_cov(rng, 4), rng.standard_normal((2, 4))
    R = np.full((1, 2, 2), 0.3)
    F, mean = factor_ud(P), np.zeros(4)
    condition_ud(mean, F, np.array([0.5, -0.25]), H, R)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R[0])
    np.testing.assert_allclose(cov_ud(F), P - K @ H @ P, atol=1e-13)
    np.testing.assert_allclose(mean, K @ [0.5, -0.25], atol=1e-13)


@pytest.mark.parametrize("form", FORMS)
def test_covariances_of_others_are_factored_anew(make, form):
    """At a hand-over the receiver makes its own covariance: a kept factor must not be used."""
    state, measurement = make.problem("phase", 3, nb=4, n=7, scale=0.3)
    rule, phi, q = RULES["gh5"], np.eye(7), 1e-4 * np.eye(7)

    def step(pair, state):
        return pair.update(pair.predict(state, phi, q), measurement, rule)

    used = make_pair(form)
    first = step(used, state)
    kept = step(used, Gaussian(state.mean, first.cov))
    again = step(make_pair(form), Gaussian(state.mean, first.cov.copy()))
    np.testing.assert_allclose(kept.cov, again.cov, atol=1e-13)
    wider = Gaussian(state.mean, 4.0 * first.cov)
    np.testing.assert_array_equal(step(used, wider).cov, step(make_pair(form), wider).cov)


@pytest.mark.nojit
def test_refusals(make):
    state, measurement = make.problem("phase", 3, nb=2, n=4, scale=0.3)
    rule, eye = RULES["gh3"], np.eye(4)
    with pytest.raises(ValueError, match="form: 'u-d', expected one of plain, square-root, ud"):
        make_filter("kf", form="u-d")
    for name in ("fiqkf-r", "kf-sage-husa", "jtq"):
        with pytest.raises(ValueError, match="form: 'ud', expected 'plain' beside"):
            make_filter(name, form="ud")
    with pytest.raises(ValueError, match="iterations: 0"):
        ud().update(state, measurement, rule, 0)
    with pytest.raises(ValueError, match="block-diagonal"):
        ud().update(state, measurement, RULES["cubature"])
    nan, inf = np.full((4, 4), np.nan), np.diag([1.0, np.inf, 1.0, 1.0])
    for bad in (-state.cov, nan, inf, np.triu(np.ones((4, 4))), np.array([[0.0, 1], [1, 1.0]])):
        with pytest.raises(ValueError, match="positive semi-definite"):
            ud().predict(
                Gaussian(np.zeros(len(bad)), bad), np.eye(len(bad)), 0.0 * np.eye(len(bad))
            )
    for phi, q in ((eye, -eye), (eye, nan), (eye, inf), (nan, eye)):
        with pytest.raises(ValueError, match="Phi, Q: expected finite"):
            ud().predict(state, phi, q)
    for change in ({"R": -measurement.R}, {"R": np.nan * measurement.R},
                   {"z": np.nan * measurement.z}):  # fmt: skip
        with pytest.raises(ValueError, match="z, R: expected finite"):
            ud().update(state, measurement._replace(**change), rule)
