"""Moments: against closed forms, numpy's own nodes, and brute force in the full space."""

from functools import partial

import numpy as np
import pytest

from ultratight.filters.gaussian import Gaussian, Measurement
from ultratight.filters.quadrature import (
    cubature,
    gauss_hermite,
    hermite_nodes,
    unit_points,
    unscented,
)
from ultratight.filters.rules import RULES, Rule, get_rule, psd_cholesky

pytestmark = pytest.mark.nojit
GH40 = Rule("gh40", "projected", partial(gauss_hermite, 40), "")


@pytest.mark.parametrize("m", [1, 2, 3, 5, 7, 10])
def test_nodes_are_numpys(m):
    # numpy's hermegauss finds the roots by a companion matrix and Newton: another route
    x, w = np.polynomial.hermite_e.hermegauss(m)
    nodes, weights = hermite_nodes(m)
    np.testing.assert_allclose(nodes, x, atol=1e-13)
    np.testing.assert_allclose(weights, w / np.sqrt(2 * np.pi), atol=1e-14)


def double_factorial_moment(p):
    """E[x^p] for N(0, 1): (p - 1)!! for even p."""
    return 0.0 if p % 2 else float(np.prod(np.arange(1, p, 2)))


@pytest.mark.parametrize(
    ("function", "d", "degree"),
    [
        (partial(gauss_hermite, 3), 2, 5),
        (partial(gauss_hermite, 7), 2, 13),
        (partial(gauss_hermite, (3, 7, 3)), 3, 5),
        (cubature, 4, 3),
        (unscented, 2, 3),
        (unscented, 7, 3),
    ],
)
def test_exact_for_monomials_up_to_the_degree(function, d, degree):
    points, weights = function(d)
    for powers in np.ndindex(*(degree + 1,) * min(d, 3)):
        if sum(powers) <= degree:
            found = weights @ np.prod(points[:, : len(powers)] ** powers, axis=1)
            expected = np.prod([double_factorial_moment(p) for p in powers])
            assert found == pytest.approx(expected, rel=1e-11, abs=1e-9)


def test_gauss_hermite_is_not_exact_one_degree_further():
    points, weights = gauss_hermite(3, 1)
    assert weights @ points[:, 0] ** 6 == pytest.approx(9.0)  # the truth is 15


def phase_measurement(make, phase_sd, mean):
    """One block with y1 of that mean and s.d., seen through four correlated states."""
    rng = np.random.default_rng(3)
    cov, A = make.random_cov(rng, 4), rng.standard_normal((1, 2, 4))
    A[0, 1] *= phase_sd / np.sqrt(A[0, 1] @ cov @ A[0, 1])
    x = np.linalg.pinv(A[0]) @ [0.0, mean]
    model = make.PhaseH()
    zero = np.zeros((1, 3))
    measurement = Measurement(
        zero, A, np.eye(3)[None], model.h, model.h_jacobian, np.zeros(1, dtype=np.int64)
    )
    return Gaussian(x, cov), measurement


@pytest.mark.parametrize(("name", "tolerance"), [("gh7", 1e-3), ("gh5", 2e-2)])
def test_sine_and_cosine_of_a_gaussian_phase(make, name, tolerance):
    # E e^{j phi} = e^{j m - s^2/2}; E[(phi - m) e^{j phi}] = j s^2 e^{j m - s^2/2}
    s, m = 0.7, 0.3
    state, measurement = phase_measurement(make, s, m)
    zbar, H, Omega = get_rule(name).linearise(state, measurement)
    first, second = np.exp(1j * m - s**2 / 2), np.exp(2j * m - 2 * s**2)
    np.testing.assert_allclose(zbar[:2], [first.real, first.imag], atol=tolerance)
    A = measurement.A[0, 1]
    P_xz = np.outer(state.cov @ A, [(1j * first).real, (1j * first).imag])
    np.testing.assert_allclose(state.cov @ H[:2].T, P_xz, atol=tolerance)
    cov_z = np.array(
        [
            [0.5 + 0.5 * second.real, 0.5 * second.imag],
            [0.5 * second.imag, 0.5 - 0.5 * second.real],
        ]
    ) - np.outer([first.real, first.imag], [first.real, first.imag])
    np.testing.assert_allclose((H @ state.cov @ H.T + Omega[0])[:2, :2], cov_z, atol=tolerance)


def test_three_points_are_lost_where_seven_hold(make):
    # nodes of gh3 at +-1.73 s.d. sit near phase pi for 1.9 rad: the slope comes out wrong by 40 %
    s = 1.9
    state, measurement = phase_measurement(make, s, 0.0)
    exact = np.exp(-(s**2) / 2)  # slope of sin: E cos
    slope = {}
    for name in ("gh3", "gh7"):
        H = get_rule(name).linearise(state, measurement).H
        A = measurement.A[0]
        slope[name] = (H[1] @ state.cov @ A[1]) / (A[1] @ state.cov @ A[1])
    assert abs(slope["gh7"] - exact) < 0.1 * exact
    assert abs(slope["gh3"] - exact) > 0.4 * exact


def test_projected_moments_are_those_of_the_full_space(make):
    # P_xz and the diagonal blocks of Cov(z) by a 25^3 tensor in R^3: no projection, no theorem
    rng = np.random.default_rng(11)
    state = Gaussian(rng.standard_normal(3) * 0.2, make.random_cov(rng, 3, 0.6))
    A, model = rng.standard_normal((2, 2, 3)), make.PhaseH()
    measurement = Measurement(
        np.zeros((2, 3)), A, np.zeros((2, 3, 3)), model.h, model.h_jacobian, np.arange(2)
    )
    points, w = gauss_hermite(25, 3)
    dx = points @ np.linalg.cholesky(state.cov).T
    Z = np.hstack([model.h((state.mean + dx) @ A[b].T) for b in range(2)])
    dz = Z - w @ Z
    zbar, H, Omega = GH40.linearise(state, measurement)
    np.testing.assert_allclose(zbar, w @ Z, atol=1e-9)
    np.testing.assert_allclose(state.cov @ H.T, (dx.T * w) @ dz, atol=1e-9)
    cov_z, S = (dz.T * w) @ dz, H @ state.cov @ H.T + make.stacked_noise(Omega)
    for b in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(S[b, b], cov_z[b, b], atol=1e-9)


def test_full_space_rule_keeps_the_covariance_across_blocks(make):
    state, measurement = make.problem("phase", 5)
    _, H, Omega = RULES["cubature"].linearise(state, measurement)
    points, w = cubature(state.mean.size)
    x = state.mean + points @ np.linalg.cholesky(state.cov).T
    Z = np.hstack([measurement.h((x @ A.T)[None])[0] for A in measurement.A])
    np.testing.assert_allclose(
        H @ state.cov @ H.T + Omega[0], np.cov(Z.T, aweights=w, ddof=0), atol=1e-12
    )
    assert np.abs(Omega[0, :3, 3:]).max() > 1e-3


@pytest.mark.parametrize("name", ["gh7", "cubature", "unscented-projected"])
def test_directions_without_variance_do_no_harm(make, name):
    state, measurement = make.problem("phase", 7)
    direction = np.linalg.svd(measurement.A[0])[2][0]
    flat = np.eye(6) - np.outer(direction, direction)
    singular = Gaussian(state.mean, flat @ state.cov @ flat)
    nearly = Gaussian(state.mean, singular.cov + 1e-10 * np.eye(6))
    found = get_rule(name).linearise(singular, measurement)
    limit = get_rule(name).linearise(nearly, measurement)
    np.testing.assert_allclose(found.zbar, limit.zbar, atol=1e-6)
    for a, b in ((found, limit),):
        np.testing.assert_allclose(singular.cov @ a.H.T, nearly.cov @ b.H.T, atol=2e-5)
        np.testing.assert_allclose(a.Omega, b.Omega, atol=1e-5)
    nothing = Gaussian(state.mean, np.zeros((6, 6)))
    zbar, _, Omega = get_rule(name).linearise(nothing, measurement)
    expected = measurement.h((measurement.A @ state.mean)[:, None, :]).ravel()
    np.testing.assert_allclose(zbar, expected, atol=1e-14)
    np.testing.assert_allclose(Omega, 0.0, atol=1e-14)


def test_semidefinite_cholesky():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((5, 5))
    full, L = root @ root.T, np.empty((5, 5))
    psd_cholesky(full, L)
    np.testing.assert_allclose(L, np.linalg.cholesky(full), atol=1e-13)
    thin = root[:, :2] @ root[:, :2].T
    psd_cholesky(thin, L)
    np.testing.assert_allclose(L @ L.T, thin, atol=1e-13)
    full[0, 0] = np.nan
    psd_cholesky(full, L)
    assert np.isnan(L).any()


def test_points_of_a_users_rule_are_checked():
    with pytest.raises(ValueError, match="moments"):
        unit_points(lambda d: (np.zeros((1, d)), np.ones(1)), 2)
    with pytest.raises(ValueError, match="expected \\(2, 3\\)"):
        unit_points(lambda d: (np.zeros((2, d - 1)), np.full(2, 0.5)), 3)
    with pytest.raises(ValueError, match="expected one of linearised, gh3"):
        get_rule("gh99")
    with pytest.raises(ValueError, match="2 dimensions"):
        gauss_hermite((3, 7, 3), 2)
    with pytest.raises(ValueError, match="at most 100000"):
        gauss_hermite(3, 17)
    assert unit_points(RULES["gh3x7x3"].points, 3).w.size == 63


def test_shape_of_h_is_checked(make):
    state, measurement = make.problem("phase", 1)
    wrong = measurement._replace(h=lambda y: y)
    with pytest.raises(ValueError, match="h: shape"):
        RULES["gh3"].linearise(state, wrong)
    wrong = measurement._replace(h_jacobian=lambda y: (y, y))
    with pytest.raises(ValueError, match="h_jacobian: shapes"):
        RULES["linearised"].linearise(state, wrong)
