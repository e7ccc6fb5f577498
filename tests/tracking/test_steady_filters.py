"""Filters in their steady state, against the scalar case by hand, scipy and plain recursions."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from ultratight.ins.error_state import ProcessNoise
from ultratight.tracking.steady_filters import (
    averaged_code,
    federated_filter,
    peak_response,
    phase_filter,
    sigma,
    steady,
    tight_filter,
    vector_filter,
)
from ultratight.tracking.vector_solution import VectorSettings

NOISE = ProcessNoise(1e-6, 2e-9, 5e-9, 2e-12, 4.5e-5, 0.0355)


def sky(n=8):
    rng = np.random.default_rng(4)
    u = rng.standard_normal((n, 3))
    u[:, 2] = np.abs(u[:, 2])
    return u / np.linalg.norm(u, axis=1)[:, None]


def test_a_random_walk_by_hand():
    # P = (q + sqrt(q^2 + 4 q r)) / 2 before an update, gain P / (P + r)
    found = steady(np.eye(1), np.array([[0.3]]), np.eye(1), np.array([2.0]))
    P = 0.5 * (0.3 + np.sqrt(0.09 + 2.4))
    assert found.prior[0, 0] == pytest.approx(P, rel=1e-9)
    assert found.gain[0, 0] == pytest.approx(P / (P + 2.0), rel=1e-9)
    assert found.after[0, 0] == pytest.approx(2.0 * P / (P + 2.0), rel=1e-9)
    # a step of 1 that is not in the model dies out with 1 - K; a push ends at push (1 - K) / K + 1
    K = found.gain[0, 0]
    one, none = np.ones(1), np.zeros(1)
    assert peak_response(found, np.eye(1), one, none, 0, 50)[0] == pytest.approx(1.0)
    assert peak_response(found, np.eye(1), none, one, 500, 500)[0] == pytest.approx(1.0 / K)


def test_vector_filter_is_scipys_solution():
    u = sky()
    code, rate = np.full(8, 4.0), np.full(8, 0.2)
    settings = VectorSettings()
    found = vector_filter(settings, NOISE, u, code, rate)
    from ultratight.tracking.vector_solution import transition

    phi, q = transition(settings, NOISE.clock_sf, NOISE.clock_sg)
    H = np.zeros((16, 11))
    H[:8, :3], H[:8, 6], H[8:, 3:6], H[8:, 7] = -u, 1.0, -u, 1.0
    P = solve_discrete_are(phi.T, H.T, q, np.diag(np.append(code, rate)))
    np.testing.assert_allclose(found.prior, P, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("coherent", [True, False])
def test_tight_filter_is_where_the_recursion_ends(coherent):
    u, T = sky(), 0.02
    phase = np.full(8, 1e-6) if coherent else None
    rate = np.full(8, 0.05)
    found = tight_filter(NOISE, 9.8, u, T, phase, rate)
    H, R = found.rows, np.diag(np.full(8, 1e-6) if coherent else rate)
    # Q from the recursion's own fixed point: P = Phi (P - P H' S^-1 H P) Phi' + Q
    Q = found.prior - found.phi @ found.after @ found.phi.T
    assert np.linalg.eigvalsh(Q).min() > -1e-9 * np.abs(Q).max()
    drive = np.diag(Q)[:7]
    np.testing.assert_allclose(drive[:3], NOISE.velocity * T, rtol=1e-3)
    walk = NOISE.accel_bias + 9.8**2 * NOISE.attitude
    np.testing.assert_allclose(drive[3:6], walk * T, rtol=1e-3)
    assert drive[6] == pytest.approx(NOISE.clock_sg * T, rel=1e-6)
    unit, P = np.eye(len(Q)), 4.0 * found.prior
    for _ in range(4000):
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        after = (unit - K @ H) @ P @ (unit - K @ H).T + K @ R @ K.T
        P = found.phi @ after @ found.phi.T + Q
    np.testing.assert_allclose(sigma(P, unit), sigma(found.prior, unit), rtol=2e-3)


def test_a_line_says_the_rate_in_the_middle_of_its_interval():
    """A body that has accelerated by a for T seconds and is at v now: v - a T / 2 along the line;
    the drift and the clock's step add.  Sigma of the slope of n phases, h apart: R 12 / (h^2 n
    (n^2 - 1)) by numpy's polyfit."""
    u, T, half = sky(), 0.1, np.full(8, 0.01)
    found = federated_filter(NOISE, 9.8, u, T, half, np.full(8, 1e-5))
    v, a = np.array([3.0, -2.0, 1.0]), np.array([0.5, 0.2, -0.4])
    x = np.concatenate([v, a, [0.7, 0.1]])
    np.testing.assert_allclose(found.rows @ x, -u @ (v - 0.5 * T * a) + 0.7 + 0.1, rtol=1e-12)
    t = 0.01 * np.arange(10)
    weights = np.linalg.pinv(np.stack([np.ones(10), t], axis=1))[1]
    told = np.linalg.inv(found.after) - np.linalg.inv(found.prior)  # H' R^-1 H
    one = found.rows.T @ found.rows
    assert np.trace(one) / np.trace(told) == pytest.approx(1e-5 * weights @ weights, rel=1e-3)


def test_a_phase_lags_behind_an_acceleration_by_what_its_gain_takes_off():
    """Each step adds a h to the rate, the gain K takes K e off: e = a h / K."""
    h = 0.01
    found = phase_filter(NOISE.clock_sf, NOISE.clock_sg + NOISE.velocity, h, 1e-5)
    push = np.array([h * h / 2.0, h])
    peak = peak_response(found, np.array([[1.0, 0.0]]), np.zeros(2), push, 300, 300)
    assert peak[0] == pytest.approx(h / found.gain[1, 0], rel=0.02)
    P = solve_discrete_are(
        found.phi.T, found.rows.T, found.prior - found.phi @ found.after @ found.phi.T, [[1e-5]]
    )
    np.testing.assert_allclose(found.prior, P, rtol=1e-6)


def test_code_averages_like_a_mean():
    # four satellites and four unknowns: each range is known by itself, sigma / sqrt(n)
    u = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-0.6, -0.6, 0.52915]])
    found = averaged_code(np.full(4, 1e4), u, np.full(4, 9.0), 2500.0)
    np.testing.assert_allclose(found, 3.0 / 50.0, rtol=1e-4)


def test_what_nothing_measures_has_no_steady_state():
    with pytest.raises(ArithmeticError, match="no measurement sees"):
        steady(np.eye(2), np.diag([1.0, 1.0]), np.array([[1.0, 0.0]]), np.ones(1))
