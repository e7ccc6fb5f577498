"""Score test: the identity behind it, its distribution, and that it sees a step."""

import numpy as np
import pytest

from ultratight.filters.gaussian import update
from ultratight.filters.rules import RULES
from ultratight.filters.score import ScoreTest, score

N = 17


def linear_update(make, seed, shift=None):
    """An update whose innovation is drawn from its own S, or moved by B shift."""
    state, m = make.problem("linear", seed, nb=7, n=N)
    rng = np.random.default_rng(seed + 1000)
    u = update(state, m, RULES["linearised"])
    step = make.prediction(N, 7, phi=np.eye(N) + 0.02 * np.eye(N, k=3))
    B = u.H @ step.phi[:, [3, 4, 5, 16]]
    nu = np.linalg.cholesky(u.S) @ rng.standard_normal(len(u.S))
    u.innovation = nu if shift is None else nu + B @ shift
    return u, step, B


@pytest.mark.nojit
def test_score_is_that_of_the_dense_formula(make):
    u, _, B = linear_update(make, 3)
    S_inv = np.linalg.inv(u.S)
    found = score(B, u.H, u.noise, u.innovation, u.cov)
    np.testing.assert_allclose(found[:, :4], B.T @ S_inv @ B, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(found[:, 4], B.T @ S_inv @ u.innovation, rtol=1e-8, atol=1e-9)


def test_statistics_are_chi_square_of_four(make):
    """Mean 4 and variance 8 of chi2(4); the window keeps both (400 epochs, 5 sigma of the mean).

    Windowed values are correlated over (1 + 0.8) / (1 - 0.8) = 9 epochs.
    """
    test, single, windowed = ScoreTest(), [], []
    for seed in range(400):
        u, step, _ = linear_update(make, 5)  # one geometry, fresh innovations
        rng = np.random.default_rng(seed)
        u.innovation = np.linalg.cholesky(u.S) @ rng.standard_normal(len(u.S))
        w, s = test.watch(step, u)
        single.append(s)
        windowed.append(w)
    assert np.mean(single) == pytest.approx(4.0, abs=5.0 * np.sqrt(8.0 / 400))
    assert np.mean(windowed[20:]) == pytest.approx(4.0, abs=5.0 * np.sqrt(8.0 / 380 * 9.0))
    assert np.var(single) == pytest.approx(8.0, rel=0.4)


def test_a_step_is_seen_and_forgotten(make):
    shift = np.array([0.0, 0.0, 0.0, 40.0])
    _, _, B = linear_update(make, 7)
    u, step, _ = linear_update(make, 7, shift)
    assert u.S.shape == (21, 21)
    expected = shift @ B.T @ np.linalg.solve(u.S, B) @ shift  # noncentrality
    test = ScoreTest()
    windowed, single = test.watch(step, u)
    assert single == pytest.approx(4.0 + expected, abs=5.0 * np.sqrt(8.0 + 4.0 * expected))
    assert windowed == pytest.approx(1.8 * single)  # first of its window
    test.reset()
    assert not test.window.any()


@pytest.mark.nojit
def test_without_information_nothing_is_claimed(make):
    u, step, _ = linear_update(make, 9)
    u.H = np.zeros_like(u.H)
    assert ScoreTest().watch(step, u) == (0.0, 0.0)
    with pytest.raises(ValueError, match="memory of the score test"):
        ScoreTest(1.0)
