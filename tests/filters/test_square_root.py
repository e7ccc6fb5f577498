"""Square-root form: the same filter, and definite where the plain form is not."""

import numpy as np
import pytest

from ultratight.filters.catalog import make_filter
from ultratight.filters.factored import make_pair
from ultratight.filters.gaussian import Gaussian, predict, update
from ultratight.filters.reference import condition_root_reference, predict_root_reference
from ultratight.filters.rules import RULES
from ultratight.filters.square_root import (
    condition_root,
    first_root,
    predict_root,
    triangle,
)


@pytest.mark.nojit
@pytest.mark.parametrize("shape", [(2, 1), (6, 3), (10, 5), (5, 5)])
def test_triangle_is_that_of_the_library(shape):
    X = np.random.default_rng(1).standard_normal(shape)
    X[:, -1] *= 1e-9
    expected = np.linalg.qr(X, mode="r")
    expected *= np.where(np.diag(expected) < 0.0, -1.0, 1.0)[:, None]
    L = np.full((shape[1], shape[1]), np.nan)
    triangle(X.copy(), L)
    np.testing.assert_allclose(L, expected.T, rtol=1e-12, atol=1e-14)


@pytest.mark.nojit
def test_columns_without_anything_stay_empty():
    X = np.array([[1.0, 0.0, 2.0], [2.0, 0.0, 1.0], [2.0, 0.0, 3.0]])
    L = np.full((3, 3), np.nan)
    triangle(X.copy(), L)
    np.testing.assert_allclose(L @ L.T, X.T @ X, atol=1e-14)


@pytest.mark.nojit
@pytest.mark.parametrize("name", ["linearised", "gh5"])
@pytest.mark.parametrize("iterations", [1, 3])
def test_it_is_the_plain_update(make, name, iterations):
    state, measurement = make.problem("phase", 5, nb=4, n=7, scale=0.4)
    plain = update(state, measurement, RULES[name], iterations)
    found = make_pair("square-root").update(state, measurement, RULES[name], iterations)
    for key in ("mean", "cov", "innovation", "nis", "S", "gain", "log_likelihood"):
        a, b = getattr(found, key), getattr(plain, key)
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-11, err_msg=key)


def test_kernels_are_the_reference_arrays(make):
    """One Householder array of all rows at once (numpy) against rotations number by number."""
    rng = np.random.default_rng(4)
    n, nb = 25, 8
    root = np.tril(rng.standard_normal((n, n))) + 3.0 * np.eye(n)
    phi = np.eye(n) + 0.1 * rng.standard_normal((n, n))
    half = rng.standard_normal((n, 4))
    q = half @ half.T  # of rank 4, as a clock's noise is
    mean = rng.standard_normal(n)
    m1, L1 = phi @ mean, predict_root(root, phi, q)
    expected = predict_root_reference(root, phi, half)
    np.testing.assert_allclose(L1 @ L1.T, expected @ expected.T, rtol=1e-12, atol=1e-11)
    plain = predict(Gaussian(mean, root @ root.T), phi, q)
    np.testing.assert_allclose(L1 @ L1.T, plain.cov, rtol=1e-12, atol=1e-11)

    H, nu = rng.standard_normal((3 * nb, n)), rng.standard_normal(3 * nb)
    noise = np.stack([make.random_cov(rng, 3) for _ in range(nb)])
    stacked = make.stacked_noise(noise)
    m2, L2, nis = condition_root_reference(m1, L1, nu, H, stacked)
    found, factor = m1.copy(), L1.copy()
    assert condition_root(found, factor, nu, H, noise) == pytest.approx(nis, rel=1e-11)
    np.testing.assert_allclose(found, m2, atol=1e-12)
    np.testing.assert_allclose(factor @ factor.T, L2 @ L2.T, atol=1e-13)


@pytest.mark.nojit
def test_a_state_without_variance_is_no_obstacle():
    """The clock's noise of an epoch starts at zero; so do correlations of one."""
    half = np.array([[2.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.5, 3.0]])
    root = first_root(half @ half.T)
    np.testing.assert_allclose(root @ root.T, half @ half.T, atol=1e-14)
    np.testing.assert_array_equal(root, np.tril(root))


@pytest.mark.nojit
def test_refusals(make):
    state, measurement = make.problem("phase", 3, nb=2, n=4, scale=0.3)
    with pytest.raises(ValueError, match="block-diagonal"):
        make_filter("qkf-sqrt", rule="cubature").step(state, make.prediction(4, 2), measurement)
    bad = Gaussian(state.mean, -state.cov)
    with pytest.raises(np.linalg.LinAlgError):
        make_filter("qkf-sqrt").step(bad, make.prediction(4, 2), measurement)
