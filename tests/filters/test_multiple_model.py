"""The bank: moments of a mixture, weights, mixing; and an IMM that notices what a filter misses."""

import numpy as np
import pytest

from ultratight.filters.catalog import make_filter
from ultratight.filters.gaussian import Gaussian, Measurement
from ultratight.filters.multiple_model import (
    Bank,
    ImmOptions,
    bank_of,
    fed_back,
    merged,
    mixed,
    normalised,
    stay,
    with_noise,
)


def bank(make, seed, weight=(0.5, 0.3, 0.2), n=4):
    rng = np.random.default_rng(seed)
    w = np.array(weight)
    cov = np.stack([make.random_cov(rng, n) for _ in w])
    return Bank(np.log(w), rng.standard_normal((w.size, n)), cov)


@pytest.mark.nojit
def test_merge_has_the_moments_of_the_mixture(make):
    b = bank(make, 1)
    w = np.exp(b.log_weight)
    mean, cov = merged(b)
    np.testing.assert_allclose(mean, w @ b.mean, atol=1e-14)
    second = np.einsum("j,jab->ab", w, b.cov + np.einsum("ja,jb->jab", b.mean, b.mean))
    np.testing.assert_allclose(cov, second - np.outer(mean, mean), atol=1e-13)
    assert np.array_equal(cov, cov.T)


@pytest.mark.nojit
def test_merge_does_not_look_at_what_has_no_weight(make):
    b = bank(make, 2)
    b.mean[2], b.cov[2], b.log_weight[:] = np.nan, np.nan, np.log([0.25, 0.75, 1e-300])
    b.log_weight[2] = -np.inf
    assert np.isfinite(merged(b).mean).all()
    assert np.isfinite(merged(b).cov).all()


@pytest.mark.nojit
def test_weights_survive_likelihoods_beyond_float64():
    found = np.exp(normalised(np.array([-4000.0, -4001.0, -9000.0]), 1e-12))
    np.testing.assert_allclose(found, [1 / (1 + np.exp(-1)), 1 / (1 + np.e), 1e-12], rtol=1e-9)
    assert normalised(np.array([0.0, np.nan]), 0.0).tolist() == [0.0, -np.inf]
    np.testing.assert_allclose(np.exp(normalised(np.full(4, np.nan))), 0.25)


@pytest.mark.nojit
def test_mixing_keeps_the_moments_of_the_whole(make):
    """The law of total probability: mixing redistributes, the mixture stays what it was."""
    b = bank(make, 3)
    after = mixed(b, stay((0.9, 0.8, 0.7)))
    np.testing.assert_allclose(np.exp(after.log_weight).sum(), 1.0)
    np.testing.assert_allclose(
        np.exp(after.log_weight), np.exp(b.log_weight) @ stay((0.9, 0.8, 0.7))
    )
    for found, expected in zip(merged(after), merged(b), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-13)


@pytest.mark.nojit
def test_stay_is_a_transition_matrix():
    p = stay((0.99, 0.95, 0.5))
    np.testing.assert_allclose(p.sum(axis=1), 1.0)
    np.testing.assert_allclose(np.diag(p), [0.99, 0.95, 0.5])
    with pytest.raises(ValueError, match="expected two or more in"):
        stay((1.0, 0.5))
    with pytest.raises(ValueError, match="as many densities in both models"):
        ImmOptions(coherent_q=(0.0, 0.1, 0.2))


@pytest.mark.nojit
def test_added_noise_is_that_of_the_trapezium_rule(make):
    phi = np.eye(17) + 0.02 * np.eye(17, k=3)
    step = make.prediction(17, 7, phi=phi)
    G = np.zeros((17, 17))
    G[3:6, 3:6] = 0.7 * np.eye(3)
    expected = step.q + 0.5 * step.T * (phi @ G @ phi.T + G)
    np.testing.assert_allclose(with_noise(step, slice(3, 6), 0.7), expected, atol=1e-15)


def test_bank_relative_to_the_reference_it_corrected(make):
    b = bank(make, 4)
    whole = merged(b)
    after = merged(fed_back(b, whole.mean))
    np.testing.assert_allclose(after.mean, 0.0, atol=1e-14)
    np.testing.assert_allclose(after.cov, whole.cov, atol=1e-13)
    assert np.exp(bank_of(whole, np.array([0.4, 0.6])).log_weight) == pytest.approx([0.4, 0.6])


class Drifting:
    """One range-like number per epoch and axis; the velocity (state v) walks from epoch 100 on."""

    def run(self, make, filter_, walk, seed=1):
        rng = np.random.default_rng(seed)
        n, T = 17, 0.02
        phi = np.eye(n)
        phi[0:3, 3:6] = T * np.eye(3)
        q = 1e-12 * np.eye(n)
        A = np.zeros((3, 2, n))
        for i in range(3):
            A[i, 0, i], A[i, 1, 3 + i] = 1.0, 1.0
        model = make.LinearH(np.tile([[[1.0, 0.0], [0.0, 1.0]]], (3, 1, 1)))
        R = np.tile(np.diag([1e-4, 1e-2]), (3, 1, 1))
        x, state = np.zeros(n), Gaussian(np.zeros(n), 1e-4 * np.eye(n))
        errors = []
        for epoch in range(400):
            x = phi @ x
            if epoch >= 100:
                x[3:6] += walk * np.sqrt(T) * rng.standard_normal(3)
            z = (A @ x) + rng.standard_normal((3, 2)) * [1e-2, 0.1]
            m = Measurement(z, A, R, model.h, model.h_jacobian, np.arange(3))
            u = filter_.step(state, make.prediction(n, 3, phi, q, epoch=epoch), m)
            x = x - u.mean  # closed loop
            state = Gaussian(np.zeros(n), u.cov)
            errors.append(x[3:6].copy())
        return np.array(errors)


def test_imm_follows_a_walk_that_one_filter_does_not_know(make):
    world = Drifting()
    plain = world.run(make, make_filter("qkf3"), 0.3)[150:]
    imm = world.run(make, make_filter("imm2", rule="gh3"), 0.3)[150:]
    assert np.sqrt(np.mean(imm**2)) < 0.4 * np.sqrt(np.mean(plain**2))
    # in quiet it is between the filter without noise and the one that always adds it
    noisy = make_filter("imm2", rule="gh3", several=ImmOptions((0.1, 0.1), (0.1, 0.1), (0.9, 0.9)))
    always = world.run(make, noisy, 0.0)[150:]
    imm = world.run(make, make_filter("imm2", rule="gh3"), 0.0)[150:]
    assert np.sqrt(np.mean(imm**2)) < 0.6 * np.sqrt(np.mean(always**2))


def test_imm_without_differing_hypotheses_is_the_filter_itself(make):
    """All densities zero: mixing, weighing and merging must cancel."""
    same = ImmOptions((0.0, 0.0), (0.0, 0.0), (0.9, 0.8))
    one = Drifting().run(make, make_filter("qkf3"), 0.1)
    bank = Drifting().run(make, make_filter("imm2", rule="gh3", several=same), 0.1)
    np.testing.assert_allclose(bank, one, atol=1e-9)
