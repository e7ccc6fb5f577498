"""Interval parts: the printed one halves the gain; interval-Q has the physics of its bounds."""

import numpy as np
import pytest

from ultratight.filters.gaussian import Gaussian, predict, update
from ultratight.filters.interval import IntervalQ, VelocityQ, intersect_boxes, intersect_printed
from ultratight.filters.rules import RULES
from ultratight.ins.error_state import Layout, ProcessNoise, transition

pytestmark = pytest.mark.nojit


def test_printed_intersection_is_half_the_gain(make):
    state, measurement = make.problem("phase", 2)
    u = update(state, measurement, RULES["gh3"])
    printed = intersect_printed(state, u)
    np.testing.assert_allclose(printed.mean, state.mean + 0.5 * u.gain @ u.innovation, atol=1e-13)
    np.testing.assert_array_equal(printed.cov, u.cov)


def test_printed_intersection_by_intervals():
    # state 0: prior [-3, 3] and shifted [1, 7] meet in [1, 3]; state 1: shift 7 > w = 6, empty
    prior = Gaussian(np.zeros(2), np.eye(2))
    u = update(prior, _identity(), RULES["linearised"])._replace(mean=np.array([4.0, 7.0]))
    np.testing.assert_allclose(intersect_printed(prior, u).mean, [2.0, 7.0])


def test_intersection_of_boxes():
    # state 0: prior [-3, 3], posterior 2 +- 1.5: [0.5, 3] -> 1.75; state 1: inside, unchanged;
    # state 2: [-3, 3] and [5.5, 8.5] do not meet
    prior = Gaussian(np.zeros(3), np.eye(3))
    u = update(prior, _identity(3), RULES["linearised"])._replace(
        mean=np.array([2.0, 1.0, 7.0]), cov=0.25 * np.eye(3)
    )
    np.testing.assert_allclose(intersect_boxes(prior, u).mean, [1.75, 1.0, 7.0])


def _identity(n=2):
    from ultratight.filters.gaussian import Measurement

    return Measurement(
        np.zeros((1, n)), np.eye(n)[None], np.eye(n)[None], lambda y: y,
        lambda y: (y, np.broadcast_to(np.eye(n), (1, n, n)).copy()), np.zeros(1, dtype=np.int64),
    )  # fmt: skip


def test_interval_q_sizes(make):
    # 10 ms of latency at a jump of 100 m/s2 is 1 m/s; 1 ppb/g at 10 g is 2.998 m/s of clock drift;
    # 3000 ppm at 100 m/s2 is 0.3 m/s2, correlated over tau_c on both sides: 2 tau_c T
    state = Gaussian(np.zeros(17), np.eye(17))
    yaw = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    jump = make.prediction(
        17, 7, f_b=np.array([100.0, 0.0, 0.0]), df_b=np.array([100.0, 0.0, 0.0]), C_b_e=yaw
    )
    bounds = IntervalQ(3e-3, 10e-3, 1.0)
    wide, step = bounds.apply(state, jump)
    assert wide.cov[4, 4] - 1.0 == pytest.approx(1.0)
    assert wide.cov[16, 16] - 1.0 == pytest.approx((2.998 * 100.0 / 98.0665) ** 2, rel=1e-3)
    assert step.q[4, 4] - jump.q[4, 4] == pytest.approx(0.3**2 * 2 * 0.1 * 0.02)
    for before, after, rows in ((state.cov, wide.cov, [4, 16]), (jump.q, step.q, [4])):
        changed = np.argwhere(np.abs(after - before) > 1e-12)
        assert sorted(map(tuple, changed)) == [(i, i) for i in rows]
    assert state.cov[4, 4] == 1.0  # the caller's arrays are left alone
    # before propagation: P_v is carried by Phi into the position
    phi = np.eye(17)
    phi[1, 4] = 0.02
    assert predict(wide, phi, step.q).cov[1, 1] > predict(state, phi, jump.q).cov[1, 1]


def test_interval_q_turns_with_the_body(make):
    rng = np.random.default_rng(1)
    C = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    f, df = rng.standard_normal((2, 3)) * 20.0
    step = make.prediction(17, 7, f_b=f, df_b=df, C_b_e=C)
    state = Gaussian(np.zeros(17), make.random_cov(rng, 17))
    wide, widened = IntervalQ(2e-3, 5e-3).apply(state, step)
    v = slice(3, 6)
    np.testing.assert_allclose(
        (widened.q - step.q)[v, v], C @ np.diag((2e-3 * f) ** 2) @ C.T * 2 * 0.1 * 0.02, atol=1e-15
    )
    np.testing.assert_allclose(
        (wide.cov - state.cov)[v, v], C @ np.diag((5e-3 * df) ** 2) @ C.T, atol=1e-14
    )


def test_velocity_noise_is_that_of_a_worse_data_sheet(make):
    """The same Q as `transition` gives with the larger density: phases and all."""
    rng = np.random.default_rng(2)
    layout, T = Layout.build(True, 7), 0.02
    u = rng.standard_normal((7, 3))
    where = (rng.standard_normal(3) * 6.4e6, np.eye(3), np.array([50.0, 2.0, -9.8]), u, T)
    sheet = ProcessNoise(1e-6, 2e-9, 5e-8, 2e-14, 4.5e-5, 0.0355)
    phi, q = transition(layout, sheet, *where)
    step = make.prediction(27, 7, phi, q, layout)
    _, expected = transition(layout, sheet._replace(velocity=1e-6 + 0.1**2), *where)
    found = VelocityQ(0.1).apply(step).q
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-22)
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_array_equal(step.q, q)  # the caller's array is left alone
    assert found[3, 3] - q[3, 3] == pytest.approx(0.1**2 * T, rel=1e-6)


def test_bad_bounds_are_refused():
    with pytest.raises(ValueError, match="velocity random walk: 0"):
        VelocityQ(0.0)
    with pytest.raises(ValueError, match="none below 0"):
        IntervalQ(scale_factor=-1e-3)
    with pytest.raises(ValueError, match="correlation_s: 0"):
        IntervalQ(correlation_s=0.0)
