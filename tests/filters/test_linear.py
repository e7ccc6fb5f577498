"""A whole linear run: against predict/update, its course without noise, and bad input."""

import numpy as np
import pytest

from ultratight.filters.adaptive import SageHusa, is_semidefinite
from ultratight.filters.gaussian import Gaussian, Measurement, predict, update
from ultratight.filters.linear import run_linear
from ultratight.filters.robust import Ishakf
from ultratight.filters.rules import get_rule

N, M, EPOCHS = 5, 2, 30


def model(make, seed=4):
    """A random stable system, its matrices per epoch, and measurements with two gaps."""
    rng = np.random.default_rng(seed)
    Phi = 0.9 * np.linalg.qr(rng.standard_normal((EPOCHS, N, N)))[0]
    H = rng.standard_normal((M, N))
    z = rng.standard_normal((EPOCHS, M))
    z[4:7] = z[20] = np.nan
    start = Gaussian(rng.standard_normal(N), make.random_cov(rng, N))
    return start, Phi, make.random_cov(rng, N, 0.3), H, make.random_cov(rng, M), z


@pytest.mark.nojit
def test_fixed_noise_is_predict_and_update(make):
    """The conventional filter is the one that every recipe shares, epoch by epoch."""
    start, Phi, Q, H, R, z = model(make)
    run = run_linear(start, Phi, Q, H, R, z)
    linear, state = make.LinearH(H[None]), start
    for k in range(EPOCHS):
        state = predict(state, Phi[k], Q)
        if not np.isnan(z[k, 0]):
            A = np.eye(N)[None]
            block = Measurement(z[k : k + 1], A, R[None], linear.h, linear.h_jacobian, np.arange(1))
            found = update(state, block, get_rule("linearised"))
            state = Gaussian(found.mean, found.cov)
        np.testing.assert_allclose(run.mean[k], state.mean, atol=1e-12)
        np.testing.assert_allclose(run.variance[k], np.diag(state.cov), rtol=1e-12)
    np.testing.assert_allclose(run.last.cov, state.cov, atol=1e-13)
    assert set(run.first) == {-1}
    assert np.all(run.R_variance == np.diag(R))
    assert np.all(run.Q_variance == np.diag(Q))


@pytest.mark.nojit
def test_one_transition_for_all_epochs(make):
    start, Phi, Q, H, R, z = model(make)
    once = run_linear(start, Phi[:1], Q, H, R, z)
    each = run_linear(start, np.repeat(Phi[:1], EPOCHS, axis=0), Q, H, R, z)
    np.testing.assert_array_equal(once.mean, each.mean)


def test_given_arrays_are_left_alone(make):
    given = model(make)
    before = [np.copy(a) for a in given[1:]]
    run_linear(*given, SageHusa(complete=True, mean_r=True))
    for a, b in zip(given[1:], before, strict=True):
        np.testing.assert_array_equal(a, b)


def test_rank_deficient_and_zero_noises(make):
    """Definite S: an exact measurement.  S = 0: refused, noted, and the prediction stands."""
    start, Phi, Q, H, _, z = model(make)
    exact = run_linear(start, Phi, Q, H, np.zeros((M, M)), z)
    assert set(exact.first) == {-1}
    np.testing.assert_allclose(H @ exact.mean[-1], z[-1], atol=1e-10)
    line = run_linear(start, Phi, np.outer(Q[0], Q[0]), H, np.diag([0.0, 1.0]), z)
    assert set(line.first) == {-1}
    assert np.isfinite(line.mean).all()

    certain = Gaussian(start.mean, np.zeros((N, N)))
    stuck = run_linear(certain, Phi, np.zeros((N, N)), H, np.zeros((M, M)), z)
    assert stuck.first == (-1, -1, -1, 0, -1)
    expected = start.mean
    for F in Phi:
        expected = F @ expected
    np.testing.assert_allclose(stuck.last.mean, expected, rtol=1e-12)
    assert np.all(stuck.variance == 0.0)


def test_a_run_that_overflows_says_where(make):
    start, _, Q, H, R, z = model(make)
    run = run_linear(start, 1e60 * np.eye(N)[None], Q, H, R, np.full_like(z, np.nan))
    assert run.first.overflow == 2  # variances of 1e120, 1e240, then beyond 1e308
    assert np.isfinite(run.mean[:2]).all()
    assert np.isnan(run.mean[2:]).all()


def test_an_overflow_of_the_noise_alone_is_one(make):
    """A square beyond 1e308 in R^: x, P and Q would go on, with R^ not a number."""
    start, Phi, Q, H, R, z = model(make)
    z[10, 0] = 1e160
    run = run_linear(start, Phi, Q, H, R, z, SageHusa(Q=False))
    assert run.first.overflow == 10
    assert np.isfinite(run.R_epoch[:10]).all()
    assert np.isnan(run.mean[10:]).all()


def test_a_step_from_residuals_that_overflows_is_not_made(make):
    """R^ stays as it was; with the reduced gain the state stays too."""
    start, Phi, Q, H, R, z = model(make)
    z[10, 0] = 1e160
    run = run_linear(start, Phi, Q, H, R, z, Ishakf(adaptive=False, robust=False))
    assert run.first.R == 10
    np.testing.assert_array_equal(run.R_epoch[10], run.R_epoch[9])
    robust = run_linear(start, Phi, Q, H, R, z, Ishakf())
    assert set(robust.first) == {-1}
    assert np.abs(robust.mean).max() < 100.0


@pytest.mark.nojit
@pytest.mark.parametrize("seed", range(5))
def test_semidefinite_agrees_with_eigenvalues(make, seed):
    rng = np.random.default_rng(seed)
    V = np.linalg.qr(rng.standard_normal((6, 6)))[0]
    scale = np.outer(s := 10.0 ** rng.uniform(-9, 3, 6), s)
    definite = (V * [1, 0.5, 0.1, 0.1, 1e-3, 1e-5]) @ V.T
    deficient = (V * [1, 0.5, 0.1, 0, 0, 0]) @ V.T
    broken = (V * [1, 0.5, 0.1, 0.1, 0.1, -1e-5]) @ V.T
    for P, expected in ((definite, True), (deficient, True), (broken, False)):
        assert is_semidefinite(scale * (P + P.T)) == expected
    assert is_semidefinite(np.zeros((3, 3)))
    assert not is_semidefinite(np.array([[0.0, 1e-9], [1e-9, 1.0]]))
    assert not is_semidefinite(np.diag([1.0, np.nan]))


@pytest.mark.nojit
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"R": np.diag([1.0, -1.0])}, "R: expected a symmetric positive semi-definite matrix"),
        ({"R": np.diag([1.0, np.nan])}, "R: shape .2, 2., expected 2 axes of finite numbers"),
        ({"Q": np.triu(np.ones((N, N)))}, "Q: expected a symmetric positive semi-definite"),
        ({"Q": np.eye(N - 1)}, "Q: shape .4, 4., expected .5, 5."),
        ({"start": Gaussian(np.zeros(N), -np.eye(N))}, "start.cov: expected a symmetric positive"),
        ({"start": Gaussian(np.full(N, np.nan), np.eye(N))}, "start.mean: .*finite"),
        ({"Phi": np.zeros((3, N, N))}, "Phi: shape .3, 5, 5., expected .30, 5, 5."),
        ({"H": np.ones((3, N))}, "z: shape .30, 2., expected .n_epoch, 3."),
        ({"z": np.full((EPOCHS, M), np.inf)}, "z: row 0 is .inf inf., expected finite numbers or"),
        ({"z": np.array([[0.0, 1.0], [np.nan, 1.0]]), "Phi": np.eye(N)[None]}, "z: row 1 is .nan"),
    ],
)
def test_bad_input(make, change, message):
    names = ("start", "Phi", "Q", "H", "R", "z")
    good = dict(zip(names, model(make), strict=True))
    with pytest.raises(ValueError, match=message):
        run_linear(**(good | change))
