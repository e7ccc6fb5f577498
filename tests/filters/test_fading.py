"""Fading: the three readings, the memory, the gate, the two regularised forms, and the harm."""

from dataclasses import replace

import numpy as np
import pytest

from ultratight.filters.fading import (
    AS_PRINTED,
    BLOCK,
    CLAMPED,
    FITTED,
    Fading,
    FadingOptions,
    _fading_factor,
    _gate_is_open,
    _remember,
    block_mask,
    reading_i,
    reading_ii,
    reading_iii,
)
from ultratight.filters.gaussian import Gaussian, predict, update
from ultratight.filters.rules import RULES

RULE = RULES["linearised"]
N, M = 17, 21


def system(make, seed):
    """P1, Q, H, noise and S of a filter with 17 states and 21 measurements."""
    rng = np.random.default_rng(seed)
    P1, Q, H = make.random_cov(rng, N), 1e-3 * make.random_cov(rng, N), rng.standard_normal((M, N))
    noise = make.random_cov(rng, M, 0.5)
    return rng, P1, Q, H, noise, H @ (P1 + Q) @ H.T + noise


def remembered(rng, S, scale, epochs=60, rho=0.95):
    """V0 after innovations drawn from scale * S."""
    root, V0 = np.linalg.cholesky(scale * S), np.zeros_like(S)
    for _ in range(epochs):
        nu = root @ rng.standard_normal(len(S))
        V0 = (rho * V0 + np.outer(nu, nu)) / (1 + rho)
    return V0


@pytest.mark.nojit
@pytest.mark.parametrize("a", [1.0, 0.5, 3.7])
def test_reading_i_is_one_at_s_and_homogeneous(make, a):
    _, P1, Q, H, _, S = system(make, 1)
    P_xz = (P1 + Q) @ H.T
    assert reading_i(P_xz, S, a * S) == pytest.approx(a, rel=1e-12)
    assert reading_iii(H @ P1 @ H.T, S, S) == pytest.approx(1.0)
    gain = np.linalg.solve(S, P_xz.T).T
    mask = block_mask(make.layout(N), BLOCK.blocks, N)
    found = _fading_factor(mask, S, gain, a * S)
    assert found == pytest.approx(max(1.0, a), rel=1e-10)


@pytest.mark.nojit
def test_compiled_factor_is_reading_i_over_the_inflated_states(make):
    rng, P1, Q, H, _, S = system(make, 2)
    V0, P_xz = remembered(rng, S, 6.0), (P1 + Q) @ H.T
    gain = np.linalg.solve(S, P_xz.T).T
    mask = block_mask(make.layout(N), BLOCK.blocks, N)
    rows = mask > 0
    expected = np.sum(P_xz[rows] * (gain @ V0)[rows]) / np.sum(P_xz[rows] ** 2)
    found = _fading_factor(mask, S, gain, V0)
    assert found == pytest.approx(expected, rel=1e-10)
    assert expected > 1.5
    assert rows.sum() == 8


def model_d():
    """Rows of I, Q, S of seven channels at 35 dB-Hz on (r, v, cb, cd), 10 ms halves, C/A code."""
    rng = np.random.default_rng(3)
    half_s, wavelength, chip, A2 = 0.01, 0.1903, 293.05, 2 * 10**3.5 * 0.01
    u = rng.standard_normal((7, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    H = np.zeros((21, 8))
    H[1::3, 3:6], H[1::3, 7] = -u, 1.0
    H[2::3, 0:3], H[2::3, 6] = -u, 1.0
    H[1::3] *= 2 * np.pi * half_s / wavelength
    H[2::3] *= 2 / chip
    per_block = [2 / A2 + 2 / A2**2, 2 / A2 + 2 / A2**2, (1 / A2 + 2 / A2**2) / 2]
    return H, np.diag(np.tile(per_block, 7))


@pytest.mark.parametrize("acceleration", [0.0, 0.5, 5.0])
def test_reading_ii_is_stuck_at_one_in_tracking(acceleration):
    # documented negative result: at 50 Hz the noise of one epoch exceeds M = H P1 H' by far, and
    # even an acceleration that the filter does not know leaves the minimum of g at the bound,
    # while reading (i) sees it
    rng, T, (H, R) = np.random.default_rng(1), 0.02, model_d()
    phi = np.eye(8)
    phi[:3, 3:6], phi[6, 7] = T * np.eye(3), T
    Q = np.diag([0, 0, 0, 2e-8, 2e-8, 2e-8, 9e-7, 7.1e-4])
    P, V0 = np.diag([25.0, 25, 25, 0.25, 0.25, 0.25, 100, 0.25]), np.zeros((21, 21))
    x, m = np.sqrt(np.diag(P)) * rng.standard_normal(8), np.zeros(8)
    seen_by_i = 0.0
    for epoch in range(250):
        x = phi @ x + np.sqrt(np.diag(Q)) * rng.standard_normal(8)
        x[3] += acceleration * T if epoch >= 150 else 0.0
        P1, m = phi @ P @ phi.T, phi @ m
        nu = H @ (x - m) + np.sqrt(np.diag(R)) * rng.standard_normal(21)
        V0 = (0.95 * V0 + np.outer(nu, nu)) / 1.95
        S = H @ (P1 + Q) @ H.T + R
        K = np.linalg.solve(S, H @ (P1 + Q)).T
        if epoch >= 50 and epoch % 10 == 9:
            assert reading_ii(P1, Q, H, R, V0) == 1.0
            seen_by_i = max(seen_by_i, reading_i((P1 + Q) @ H.T, S, V0))
        m, P = m + K @ nu, P1 + Q - K @ S @ K.T
    assert seen_by_i > (3.0 if acceleration == 5.0 else 1.2)


@pytest.mark.parametrize("seed", range(4))
def test_reading_ii_follows_v0_only_where_the_prior_dominates(make, seed):
    rng, P1, Q, H, noise, S = system(make, 30 + seed)
    assert reading_ii(P1, Q, H, noise, remembered(rng, S, 20.0)) > 3.0
    noise = 100.0 * noise
    S = H @ (P1 + Q) @ H.T + noise
    V0 = remembered(rng, S, 20.0)
    assert reading_i((P1 + Q) @ H.T, S, V0) > 3.0
    assert reading_ii(P1, Q, H, noise, V0) == 1.0


@pytest.mark.nojit
def test_reading_ii_is_right_for_one_measurement():
    P1, h, R, V = np.array([[2.0]]), np.array([[1.5]]), np.array([[0.7]]), 20.0
    lam = reading_ii(P1, np.zeros((1, 1)), h, R, np.array([[V]]))
    assert lam == pytest.approx((V - 0.7) / (1.5**2 * 2.0), rel=1e-3)  # S(lambda) = V


@pytest.mark.nojit
def test_memory_with_channels_that_come_and_go(make):
    fading = Fading(FadingOptions(start_s=1e9))
    rng, k, n_channel = np.random.default_rng(5), 3, 5
    expected, seen = np.zeros((15, 15)), np.zeros(15, dtype=bool)
    for present in ([0, 1, 3], [0, 3], [1, 2, 3], [], [0, 1, 2, 3], [4, 2]):
        state, measurement = make.problem("linear", int(rng.integers(1000)), max(len(present), 1))
        nb = len(present)
        measurement = measurement._replace(
            z=measurement.z[:nb], A=measurement.A[:nb], R=measurement.R[:nb],
            channel=np.array(present, dtype=np.int64),
        )  # fmt: skip
        _, u = fading.step(
            state, make.prediction(6, n_channel, layout_=make.layout(6)), measurement, RULE
        )
        rows = [i * k + q for i in present for q in range(k)]
        for a, i in enumerate(rows):
            for b, j in enumerate(rows):
                fresh = u.innovation[a] * u.innovation[b]
                both = seen[i] and seen[j]
                expected[i, j] = (0.95 * expected[i, j] + fresh) / 1.95 if both else fresh
        seen[rows] = True
    np.testing.assert_allclose(fading.V0, expected, atol=1e-14)
    assert fading.elapsed_s == pytest.approx(0.12)


@pytest.mark.nojit
def test_channel_present_twice_leaves_its_later_block():
    V0, seen = 2.0 * np.ones((1, 1)), np.ones(1, dtype=bool)
    V = np.empty((2, 2))
    _remember(V0, seen, np.zeros(2, dtype=np.int64), np.array([1.0, 3.0]), 0.95, V)
    np.testing.assert_allclose(V, (1.9 + np.array([[1.0, 3.0], [3.0, 9.0]])) / 1.95)
    assert V0[0, 0] == V[1, 1]


def run_once(make, options, offset, n=17, seed=4, kind="phase"):
    """One step with all innovations shifted by ``offset``; memory and inputs for the checks."""
    state, measurement = make.problem(kind, seed, nb=7, n=n, scale=0.3)
    measurement = measurement._replace(z=measurement.z + offset)
    step = make.prediction(n, 7)
    fading = Fading(options)
    prior, u = fading.step(state, step, measurement, RULE)
    plain = predict(state, step.phi, step.q)
    return fading, state, step, measurement, plain, prior, u


@pytest.mark.nojit
def test_as_printed_inflates_all_states_from_the_first_epoch(make):
    _, state, step, measurement, plain, prior, u = run_once(make, AS_PRINTED, 3.0)
    first = update(plain, measurement, RULE)
    P_xz, V0 = plain.cov @ first.H.T, np.outer(first.innovation, first.innovation)
    lam = reading_i(P_xz, first.S, V0)
    assert lam > 2.0
    assert u.lam == pytest.approx(lam, rel=1e-10)
    P1 = step.phi @ state.cov @ step.phi.T
    np.testing.assert_allclose(prior.cov, lam * P1 + step.q, rtol=1e-10)
    again = update(prior, measurement, RULE)
    np.testing.assert_array_equal(u.mean, again.mean)
    np.testing.assert_array_equal(u.S, again.S)


@pytest.mark.nojit
def test_block_form_leaves_attitude_and_biases(make):
    options = FadingOptions(start_s=0.0)
    *_, step, _, plain, prior, u = run_once(make, options, 3.0, n=20)
    assert u.lam > 2.0
    mask = np.zeros(20, dtype=bool)
    mask[[0, 1, 2, 3, 4, 5, 15, 16, 17, 18, 19]] = True
    inner = np.outer(mask, mask)
    np.testing.assert_array_equal(prior.cov[~inner], plain.cov[~inner])
    P1 = plain.cov - step.q
    np.testing.assert_allclose(prior.cov[inner], (u.lam * P1 + step.q)[inner], rtol=1e-9)
    assert np.linalg.eigvalsh(prior.cov)[0] > 0.0


@pytest.mark.nojit
def test_no_inflation_in_the_first_second(make):
    *_, plain, prior, u = run_once(make, BLOCK, 3.0)
    assert u.lam == 1.0
    assert prior.cov is plain.cov or np.array_equal(prior.cov, plain.cov)
    state, measurement = make.problem("phase", 4, nb=7, n=17, scale=0.3)
    measurement = measurement._replace(z=measurement.z + 3.0)
    fading = Fading(BLOCK)
    lams = [fading.step(state, make.prediction(17, 7), measurement, RULE)[1].lam for _ in range(52)]
    assert max(lams[:49]) == 1.0
    assert min(lams[51:]) > 2.0
    fading.reset()
    assert fading.step(state, make.prediction(17, 7), measurement, RULE)[1].lam == 1.0


@pytest.mark.nojit
def test_gate_threshold(make):
    # three rows of one channel: I without information (H = 0), Q, S; a = 1 / (1 + rho)
    cov, Q, a = np.eye(2), np.zeros((2, 2)), 1 / 1.95
    H = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.5]])
    noise = np.diag([0.5, 0.5, 0.3])[None]
    S = H @ H.T + noise[0]
    threshold = 3.0 * np.sqrt(2.0 * (S[1, 1] ** 2 + S[2, 2] ** 2) * a / (2.0 - a))

    def is_open(excess_q, excess_i=0.0, slope_s=0.5):
        slope = H.copy()
        slope[2, 1] = slope_s
        V = S + np.diag([excess_i, excess_q, 0.0])
        return _gate_is_open(cov, Q, np.ones(2), slope, noise, V, 3, 1, 3.0, a)

    assert not is_open(0.999 * threshold)
    assert is_open(1.001 * threshold)
    assert not is_open(0.0, excess_i=1e6)  # a row without information counts for nothing
    alone = 3.0 * np.sqrt(2.0 * S[1, 1] ** 2 * a / (2.0 - a))  # S row: M = 9e-4 of the Q row
    assert alone < 0.999 * threshold
    assert is_open(1.001 * alone, slope_s=0.03)


@pytest.mark.nojit
def test_clamp_holds_inflated_variances_at_the_first(make):
    options = FadingOptions(blocks=None, clamp=True, start_s=0.0)
    fading, state, _, measurement, plain, prior, u = run_once(make, options, 3.0)
    assert u.lam > 2.0
    top = np.maximum(np.diag(state.cov), np.diag(plain.cov))
    np.testing.assert_allclose(np.diag(prior.cov), top, rtol=1e-12)  # lambda > 2: all at the top
    assert np.linalg.eigvalsh(prior.cov)[0] > 0.0
    # correlations are those of the inflated covariance: rows and columns were scaled
    P = u.lam * (plain.cov - 1e-4 * np.eye(17)) + 1e-4 * np.eye(17)
    scale = np.sqrt(np.diag(P))
    found = prior.cov / np.sqrt(np.outer(top, top))
    np.testing.assert_allclose(found, P / np.outer(scale, scale), atol=1e-9)
    small = Gaussian(state.mean, 0.01 * state.cov)
    prior, u = fading.step(small, make.prediction(17, 7), measurement, RULE)
    assert u.lam > 2.0
    assert np.all(np.diag(prior.cov) <= np.diag(state.cov) * (1 + 1e-12))
    before = fading.first_variance.copy()
    fading.reset()
    larger, measurement = make.problem("phase", 6, nb=7, n=20, scale=0.3)
    fading.step(larger, make.prediction(20, 7), measurement, RULE)
    np.testing.assert_array_equal(fading.first_variance[:17], before)
    np.testing.assert_array_equal(fading.first_variance[17:], np.diag(larger.cov)[17:])


@pytest.mark.nojit
def test_change_of_size_needs_a_reset(make):
    fading, *_ = run_once(make, CLAMPED, 0.0)
    state, measurement = make.problem("phase", 6, nb=7, n=20)
    with pytest.raises(ValueError, match="call reset"):
        fading.step(state, make.prediction(20, 7), measurement, RULE)
    with pytest.raises(ValueError, match="rho: 0"):
        FadingOptions(rho=0.0)
    with pytest.raises(ValueError, match="expected >= 0"):
        FadingOptions(gate=-1.0)


def steady_flight(make, options, seconds=20.0):
    """A matched filter at 50 Hz: v observed; attitude and biases not.  Lambdas and variances."""
    rng, n, nb = np.random.default_rng(8), 17, 7
    A = np.zeros((nb, 1, n))
    A[:, 0, 3:6] = rng.standard_normal((nb, 3))
    A[:, 0, 16] = 1.0
    model = make.LinearH(np.ones((nb, 1, 1)))
    q = np.zeros((n, n))
    q[range(3, 6), range(3, 6)] = q[16, 16] = 1e-4
    R = np.full((nb, 1, 1), 0.01)
    state, x = Gaussian(np.zeros(n), np.diag(np.full(n, 0.1))), np.zeros(n)
    fading, lams = Fading(options), []
    template = make.problem("linear", 0)[1]
    for _ in range(round(seconds / 0.02)):
        x = x + np.sqrt(np.diag(q)) * rng.standard_normal(n)
        z = (A @ x)[:, 0] + 0.1 * rng.standard_normal(nb)
        measurement = template._replace(
            z=z[:, None], A=A, R=R, h=model.h, h_jacobian=model.h_jacobian, channel=np.arange(nb)
        )
        _, u = fading.step(state, make.prediction(n, nb, q=q), measurement, RULE)
        state = Gaussian(u.mean, u.cov)
        lams.append(u.lam)
    return np.array(lams), np.diag(state.cov)


def test_the_printed_form_blows_up_what_is_not_observed(make):
    # documented negative result: E[max(1, lambda)] > 1 with a perfect model, lambda^50 per second
    lams, variance = steady_flight(make, AS_PRINTED, seconds=4.0)
    assert 1.05 < lams.mean() < 1.6
    assert variance[6] > 1e6 * 0.1
    lams, variance = steady_flight(make, BLOCK)
    assert lams.mean() < 1.02
    assert variance[6] == pytest.approx(0.1, rel=1e-6)
    lams, variance = steady_flight(make, CLAMPED)
    assert lams.mean() < 1.02
    assert variance[6] <= 0.1 * (1 + 1e-9)


def test_a_fitted_factor_is_reading_iii_over_its_own_memory(make):
    """V0 by its recursion, M = H E (P - Q) E H', lambda = 1 + <M, V0 - S> / <M, M>.

    20 epochs: (1 + q) / (1 - q) = 20 has q = 19 / 21, and q = rho / (1 + rho) then rho = 9.5.
    """
    assert FITTED.rho / (1.0 + FITTED.rho) == pytest.approx(19.0 / 21.0)
    state, measurement = make.problem("phase", 4, nb=7, n=17, scale=0.3)
    far = measurement._replace(z=measurement.z + 3.0)
    step = make.prediction(17, 7)
    fading = Fading(replace(FITTED, gate=0.0, start_s=0.0))
    prior = predict(state, step.phi, step.q)
    plain, V = update(prior, far, RULE), None
    mask = np.ones(17)
    mask[6:15] = 0.0  # attitude and biases
    M = plain.H @ ((prior.cov - step.q) * np.outer(mask, mask)) @ plain.H.T
    for _ in range(3):
        found = fading.step(state, step, far, RULE)[1]
        new = np.outer(plain.innovation, plain.innovation)
        V = new if V is None else (9.5 * V + new) / 10.5
        lam = 1.0 + np.sum(M * (V - plain.S)) / np.sum(M * M)
        assert lam > 1.0
        assert found.lam == pytest.approx(lam, rel=1e-9)
    with pytest.raises(ValueError, match="expected 0 < rho <= 20"):
        FadingOptions(fit=True, rho=21.0)
