"""MMAE in the loop: a bank that is weighed and not mixed."""

from dataclasses import replace

import numpy as np
import pytest

from ultratight.filters.catalog import make_filter
from ultratight.filters.gaussian import Gaussian, Measurement
from ultratight.filters.multiple_model import MMAE, ImmOptions, merged

N, T = 17, 0.02


def options(q, floor=MMAE.floor):
    return ImmOptions(q, q, None, floor)


def fly(make, filter_, density=0.0, seed=1, epochs=300, gap=range(0)):
    """Velocity errors and what the bank holds, closed loop; a velocity walk of that density."""
    rng = np.random.default_rng(seed)
    phi, q = np.eye(N), 1e-12 * np.eye(N)
    phi[0:3, 3:6] = T * np.eye(3)
    A = np.zeros((3, 2, N))
    for i in range(3):
        A[i, 0, i], A[i, 1, 3 + i] = 1.0, 1.0
    model = make.LinearH(np.tile(np.eye(2), (3, 1, 1)))
    R = np.tile(np.diag([1e-4, 1e-2]), (3, 1, 1))
    x, state = np.zeros(N), Gaussian(np.zeros(N), 1e-4 * np.eye(N))
    errors, weights = [], []
    for epoch in range(epochs):
        x = phi @ x
        x[3:6] += np.sqrt(density * T) * rng.standard_normal(3)
        z = A @ x + rng.standard_normal((3, 2)) * [1e-2, 0.1]
        m = Measurement(z, A, R, model.h, model.h_jacobian, np.arange(3))
        if epoch in gap:
            m = m._replace(z=z[:0], A=A[:0], R=R[:0], channel=np.arange(0))
        u = filter_.step(state, make.prediction(N, 3, phi, q, epoch=epoch), m)
        assert np.linalg.eigvalsh(u.cov)[0] > 0.0
        x = x - u.mean
        state = Gaussian(np.zeros(N), u.cov)
        errors.append(x[3:6].copy())
        bank = getattr(filter_, "bank", None)
        weights.append(np.ones(1) if bank is None else np.exp(bank.log_weight))
    return np.array(errors), np.array(weights)


def rms(errors):
    return np.sqrt(np.mean(errors[100:] ** 2))


def test_one_model_alone_is_its_filter(make):
    one = fly(make, make_filter("mmae", several=options((0.0,))), 0.01)[0]
    np.testing.assert_array_equal(one, fly(make, make_filter("qkf3"), 0.01)[0])


def test_models_are_not_mixed(make):
    """Each is the filter that it would be by itself; only what is reported is common."""
    both = make_filter("mmae", several=options((0.0, 0.1)))
    alone = [make_filter("mmae", several=options((q,))) for q in (0.0, 0.1)]
    end = [fly(make, f, 0.01)[0][-1] for f in (both, *alone)]
    whole = merged(both.bank)
    np.testing.assert_allclose(whole.mean, 0.0, atol=1e-15)
    for j in range(2):
        np.testing.assert_allclose(end[0] - both.bank.mean[j, 3:6], end[1 + j], atol=1e-12)
        np.testing.assert_allclose(both.bank.cov[j], alone[j].bank.cov[0], rtol=1e-9, atol=1e-18)


def test_the_true_noise_is_found_and_serves_as_if_known(make):
    oracle, off, bank = [], [], []
    for seed in range(3):
        oracle.append(fly(make, make_filter("mmae", several=options((0.1,))), 0.1, seed)[0])
        off.append(fly(make, make_filter("mmae", several=options((1e-3,))), 0.1, seed)[0])
        errors, weight = fly(make, make_filter("mmae"), 0.1, seed)
        bank.append(errors)
        assert MMAE.coherent_q[int(np.argmax(weight[-1]))] == 0.1
    oracle, off, bank = (np.concatenate([e[100:] for e in f]) for f in (oracle, off, bank))
    assert np.sqrt(np.mean(bank**2)) < 1.03 * np.sqrt(np.mean(oracle**2))
    assert np.sqrt(np.mean(off**2)) > 1.5 * np.sqrt(np.mean(oracle**2))


def test_weights_sum_to_one_above_the_floor_and_rest_without_measurement(make):
    floor = 1e-3
    gap = range(150, 200)
    made = make_filter("mmae", several=replace(MMAE, floor=floor))
    _, weight = fly(make, made, 0.1, gap=gap)
    np.testing.assert_allclose(weight.sum(axis=1), 1.0, rtol=1e-12)
    least = floor / (1.0 + len(MMAE.coherent_q) * floor)  # raised first, then normalised
    assert weight.min() >= least * (1.0 - 1e-12)
    assert weight.min() < 2.0 * floor
    np.testing.assert_allclose(weight[gap], weight[np.zeros_like(gap) + gap.start], rtol=floor)


@pytest.mark.nojit
@pytest.mark.parametrize(
    ("q", "floor", "message"),
    [
        ((), 1e-3, "expected as many densities"),
        ((0.0, -1.0), 1e-3, "expected none below 0"),
        ((0.0, np.nan), 1e-3, "expected none below 0"),
        ((0.0, 0.1), 0.5, "expected 0 <= floor < 1 / 2"),
        ((0.0, 0.1), np.nan, "expected 0 <= floor < 1 / 2"),
    ],
)
def test_bad_options(q, floor, message):
    with pytest.raises(ValueError, match=message):
        options(q, floor)
