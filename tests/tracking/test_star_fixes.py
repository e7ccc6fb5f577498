"""A bank over star fixes: against predict and update, its weights, and what it refuses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ultratight.filters.gaussian import Gaussian, Measurement, predict, update
from ultratight.filters.multiple_model import merged, normalised
from ultratight.filters.rules import get_rule
from ultratight.ins.star_tracker import predicted, run_free, slope, turned_by, wrapped
from ultratight.tracking.star_fixes import Weighing, run_star_fixes

TAU, ARCSEC = 0.1, np.radians(1.0 / 3600.0)
R = (20.0 * ARCSEC) ** 2 * np.eye(3)
NOISE = 1e-6  # rad per fix
FIRST = Rotation.from_euler("xyz", [0.3, 0.2, 1.4]).as_matrix()
RATE = np.array([0.5, 0.0, 0.0])  # rolls: errors of the angles stay those of a turn, but for 4 %


def q(*scales):
    """(1, nh, 9) by scales of the gyro noise."""
    out = np.zeros((1, len(scales), 9))
    out[0, :, :3] = (NOISE * np.array(scales)[:, None]) ** 2
    out[0, :, 6:] = 1e-12
    return out


def problem(seed=1, n=40, misaligned=0.1, scale=1.0):
    """start, C_ins (n + 1), z (n, 3): a body that turns, gyros with drift and noise."""
    rng = np.random.default_rng(seed)
    alpha = np.tile(RATE * TAU, (n, 1))
    true = run_free(FIRST, alpha)
    phi0 = misaligned * rng.standard_normal(3)
    first = Rotation.from_rotvec(-phi0).as_matrix() @ FIRST
    eps = np.array([5e-6, -4e-6, 3e-6])
    C_ins = run_free(first, alpha + eps * TAU + scale * NOISE * rng.standard_normal((n, 3)))
    star = turned_by(20.0 * ARCSEC * rng.standard_normal((n, 3)), true[1:])
    turns = [Rotation.from_matrix(C).as_euler("xyz") for C in (*C_ins[1:], *star)]
    z = wrapped(np.array(turns[:n]) - np.array(turns[n:]))
    P0 = np.diag([misaligned**2] * 3 + [1e-5**2] * 3 + [1e-6] * 3)
    return Gaussian(np.zeros(9), P0), C_ins, z


def by_hand(start, C_ins, z, Q, rule, keep=1.0, passes=1):
    """Means, updates: predict and update of `gaussian`, the misalignment by scipy's rotations."""
    x, P, out = start.mean.copy(), start.cov, []
    A = np.zeros((1, 3, 9))
    A[0, :, :3] = np.eye(3)
    for k in range(len(z)):
        middle = 0.5 * (C_ins[k] + C_ins[k + 1])

        def onward(x, middle=middle):
            turn = Rotation.from_rotvec(middle @ x[3:6] * TAU) * Rotation.from_rotvec(-x[:3])
            return np.concatenate([-turn.as_rotvec(), x[3:6], keep * x[6:9]])

        steps = [1.0] * 3 + [1e-3] * 3 + [1.0] * 3
        Phi = np.eye(9)
        for j in range(3, 6):
            d = np.zeros(9)
            d[j] = steps[j]
            Phi[:, j] = (onward(x + d) - onward(x - d)) / (2.0 * steps[j])
        Phi[6:, 6:] = keep * np.eye(3)
        prior = Gaussian(onward(x), predict(Gaussian(x, P), Phi, np.diag(Q)).cov)

        def h(y, C=C_ins[k + 1]):
            Z = np.empty((3, y.shape[1]))
            predicted(C, np.ascontiguousarray(y[0].T), Z)
            return Z.T[None]

        def h_jacobian(y, C=C_ins[k + 1]):
            G = np.empty((3, 3))
            slope(C, y[0], G)
            return h(y[:, None])[:, 0], G[None]

        near = prior.mean[:3]
        zk = h(near[None, None])[0, 0] + wrapped(z[k] - h(near[None, None])[0, 0])
        found = update(
            prior, Measurement(zk[None], A, R[None], h, h_jacobian, np.arange(1)),
            get_rule(rule), passes if k == 0 else 1,
        )  # fmt: skip
        x, P = found.mean, found.cov
        out.append(found)
    return out


@pytest.mark.nojit
@pytest.mark.parametrize("rule", ["linearised", "unscented-projected", "gh3"])
@pytest.mark.parametrize("passes", [1, 3])
def test_one_model_is_its_filter(rule, passes):
    start, C_ins, z = problem(n=6)
    run = run_star_fixes(start, C_ins, z, TAU, q(1.0), R, rule, accel_tau_s=10.0, passes=passes)
    expected = by_hand(start, C_ins, z, q(1.0)[0, 0], rule, np.exp(-TAU / 10.0), passes)
    for k, found in enumerate(expected):
        np.testing.assert_allclose(run.mean[k], found.mean, atol=1e-11)
        np.testing.assert_allclose(run.variance[k], np.diag(found.cov), rtol=1e-5)
        assert run.nis[k, 0] == pytest.approx(found.nis, rel=1e-5)
    assert np.all(run.weight == 1.0)
    assert set(run.first) == {-1}


@pytest.mark.nojit
def test_weights_follow_the_likelihoods_of_filters_on_their_own():
    """Nothing is mixed: model j is the filter with Q_j, and weights are Bayes' rule on each."""
    start, C_ins, z = problem(n=6)
    Q, floor = q(0.3, 1.0, 3.0), 0.01
    run = run_star_fixes(start, C_ins, z, TAU, Q, R, weighing=Weighing(floor))
    alone = [by_hand(start, C_ins, z, Q[0, j], "linearised") for j in range(3)]
    log_weight = np.full(3, -np.log(3.0))
    for k in range(len(z)):
        gained = np.array([a[k].log_likelihood for a in alone])
        log_weight = normalised(log_weight + gained, floor)
        w = np.exp(log_weight)
        np.testing.assert_allclose(run.weight[k], w, rtol=1e-6)
        np.testing.assert_allclose(run.mean[k], w @ [a[k].mean for a in alone], atol=1e-11)
    for j, a in enumerate(alone):
        np.testing.assert_allclose(run.last.mean[j], a[-1].mean, atol=1e-11)
    np.testing.assert_allclose(merged(run.last).mean, run.mean[-1], rtol=1e-12)
    np.testing.assert_allclose(np.diag(merged(run.last).cov), run.variance[-1], rtol=1e-12)


@pytest.mark.parametrize("rule", ["linearised", "unscented-projected"])
@pytest.mark.parametrize("misaligned", [0.17, 0.003])
def test_weights_and_covariances_stay_what_they_are(rule, misaligned):
    """From 10 deg and from 10': weights of sum 1 above the floor, P definite at every fix."""
    start, C_ins, z = problem(n=600, misaligned=misaligned, scale=3.0)
    nh, floor = 5, 1e-3
    run = run_star_fixes(
        start, C_ins, z, TAU, q(*np.linspace(0.2, 4.0, nh)), R, rule, weighing=Weighing(floor)
    )
    np.testing.assert_allclose(run.weight.sum(axis=1), 1.0, rtol=1e-12)
    assert run.weight.min() >= floor / (1.0 + nh * floor) * (1.0 - 1e-12)
    assert run.weight.min() < 1.01 * floor
    assert set(run.first) == {-1}
    assert np.all(run.variance > 0.0)
    for P in run.last.cov:
        assert np.array_equal(P, P.T)
        assert np.linalg.eigvalsh(P / np.sqrt(np.outer(np.diag(P), np.diag(P))))[0] > 0.0
    # where it should point: within 5 sigma per axis
    assert np.all(np.abs(run.last.mean.mean(0)[3:6] - [5e-6, -4e-6, 3e-6]) < 5.0 * 1e-5)


def test_the_model_of_the_truth_is_found_and_serves_as_if_known():
    settled, n = slice(200, None), 3000
    squares = dict.fromkeys(("true", "off", "bank"), 0.0)
    for seed in range(3):
        start, C_ins, z = problem(seed, n=n, misaligned=0.003, scale=30.0)
        found = {
            "true": run_star_fixes(start, C_ins, z, TAU, q(30.0), R),
            "off": run_star_fixes(start, C_ins, z, TAU, q(3.0), R),
            "bank": run_star_fixes(start, C_ins, z, TAU, q(3.0, 10.0, 30.0, 100.0), R),
        }
        assert np.argmax(found["bank"].weight[settled].mean(0)) == 2
        assert 0.9 < found["true"].nis.mean() / 3.0 < 1.1
        true = run_free(FIRST, np.tile(RATE * TAU, (n, 1)))[1:]
        for name, run in found.items():
            turned = turned_by(run.mean[:, :3], C_ins[1:])
            squares[name] += ((turned - true)[settled] ** 2).mean()
    assert squares["bank"] < 1.01 * squares["true"]
    assert squares["off"] > 3.0 * squares["true"]


def test_fixes_may_be_missing():
    """Prediction alone: variances grow, weights rest; the start may be one of them."""
    start, C_ins, z = problem(n=60)
    z[:3] = z[20:40] = np.nan
    Q = q(0.3, 3.0)
    run = run_star_fixes(start, C_ins, z, TAU, Q, R, passes=2)
    np.testing.assert_allclose(run.weight[:3], 0.5, rtol=1e-15)
    assert np.all(run.weight[20:40] == run.weight[19])
    assert np.all(np.diff(run.variance[19:40, :3], axis=0) > 0.0)
    assert np.all(run.variance[40, :3] < run.variance[39, :3])
    assert np.isnan(run.nis[20:40]).all()
    assert run.first.refused == -1
    # passes are those of the first fix that is there
    again = run_star_fixes(start, C_ins, z, TAU, Q, R, passes=1)
    np.testing.assert_array_equal(again.mean[:3], run.mean[:3])
    assert np.abs(again.mean[3] - run.mean[3])[:3].max() > 1e-6


def test_weights_rest_before_the_first_that_counts_and_forget():
    start, C_ins, z = problem(n=60)
    Q = q(0.3, 3.0)
    run = run_star_fixes(start, C_ins, z, TAU, Q, R, weighing=Weighing(from_fix=30))
    assert np.all(run.weight[:30] == run.weight[0])
    assert np.all(run.weight[30] != run.weight[29])
    full, half = (
        run_star_fixes(start, C_ins, z, TAU, Q, R, weighing=Weighing(0.0, g)) for g in (1.0, 0.5)
    )
    odds = [np.log(r.weight[:, 0] / r.weight[:, 1]) for r in (full, half)]
    gained = np.diff(odds[0], prepend=0.0)
    expected = np.zeros(60)
    for k in range(60):
        expected[k] = gained[k] + (0.5 * expected[k - 1] if k else 0.0)
    np.testing.assert_allclose(odds[1], expected, atol=1e-9)


def test_zero_and_rank_deficient_noises():
    """S definite: no matter.  S = 0: the update is left out, noted, and nothing is NaN."""
    start, C_ins, z = problem(n=30)
    still = run_star_fixes(start, C_ins, z, TAU, q(0.0), R)
    flat = run_star_fixes(start, C_ins, z, TAU, q(1.0), np.diag([R[0, 0], R[0, 0], 0.0]))
    exact = run_star_fixes(start, C_ins, z, TAU, q(1.0), np.zeros((3, 3)))
    for run in (still, flat, exact):
        assert run.first.refused == run.first.overflow == -1
        assert np.isfinite(run.mean).all()
        assert run.variance.min() > -1e-15 * start.cov[0, 0]  # rounding of what R = 0 leaves
    assert still.first.P == flat.first.P == -1
    left = wrapped(z[-1] - _h(C_ins[-1], exact.mean[-1, :3]))
    np.testing.assert_allclose(left, 0.0, atol=1e-7)  # second order in innovations of 2e-4 rad

    certain = Gaussian(start.mean, np.zeros((9, 9)))
    stuck = run_star_fixes(certain, C_ins, z, TAU, np.zeros((1, 2, 9)), np.zeros((3, 3)))
    assert stuck.first == (0, -1, -1)
    assert np.all(stuck.mean == 0.0)
    assert np.all(stuck.weight == stuck.weight[0])
    one_of_two = run_star_fixes(certain, C_ins, z, TAU, q(0.0, 1.0), np.zeros((3, 3)))
    assert one_of_two.first.refused == 0
    assert np.all(one_of_two.weight[:, 1] > 0.99)
    assert np.isfinite(one_of_two.mean).all()


def _h(C, phi):
    Z = np.empty((3, 1))
    predicted(C, np.ascontiguousarray(phi).reshape(3, 1), Z)
    return Z[:, 0]


def test_a_run_that_overflows_says_where():
    start, C_ins, z = problem(n=5)
    Q = np.full((5, 1, 9), 1e-12)
    Q[3] = 1e307
    Q[4] = 1e308  # the sum of nine is beyond 1.8e308
    run = run_star_fixes(start, C_ins, np.full_like(z, np.nan), TAU, Q, R)
    assert run.first.overflow == 4
    assert np.isfinite(run.mean[:4]).all()
    assert np.isnan(run.mean[4:]).all()


START, C_INS, Z = problem(n=4)


@pytest.mark.nojit
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"Q": np.zeros((1, 0, 9))}, "Q: .*one model or more"),
        ({"Q": np.zeros((3, 1, 9))}, "Q: shape .3, 1, 9., expected .1 or 4"),
        ({"Q": -q(1.0)}, "expected variances"),
        ({"Q": np.full((1, 1, 9), np.nan)}, "Q: expected finite numbers"),
        ({"R": -R}, "R: expected a symmetric positive semi-definite matrix"),
        ({"R": R * np.nan}, "R: expected finite numbers"),
        ({"R": R[:2, :2]}, "R: shape"),
        ({"start": Gaussian(np.zeros(9), -np.eye(9))}, "start.cov: expected a symmetric"),
        ({"start": Gaussian(np.full(9, np.nan), np.eye(9))}, "start.mean: expected finite"),
        ({"C_ins": C_INS[1:]}, "C_ins: shape .4, 3, 3., expected .5, 3, 3."),
        ({"z": Z[:0], "C_ins": C_INS[:1]}, "z: shape .0, 3., expected .1, 3."),
        ({"z": np.where(np.eye(4, 3), np.nan, Z)}, "z: row 0 is . *nan .*or all NaN"),
        ({"z": np.full((4, 3), np.inf)}, "z: row 0 is .inf"),
        ({"rule": "cubature"}, "rule: 'cubature', expected one of the projected"),
        ({"rule": "gauss"}, "rule: 'gauss', expected one of linearised"),
        ({"tau_s": 0.0}, "tau_s, accel_tau_s: 0.0"),
        ({"passes": 0}, "passes: 0, expected a whole number, at least 1"),
        ({"passes": 1.5}, "passes: 1.5, expected a whole number"),
        ({"weighing": Weighing(from_fix=-1)}, "from_fix: -1, expected a whole number, at least 0"),
        ({"C_ins": 5.0 * C_INS}, "C_ins: expected rotation matrices"),
        ({"weighing": Weighing(1.0)}, "expected 0 <= floor < 1 / 1"),
        ({"weighing": Weighing(forgetting=0.0)}, "0 < forgetting <= 1"),
    ],
)
def test_bad_input(change, message):
    given = {"start": START, "C_ins": C_INS, "z": Z, "tau_s": TAU, "Q": q(1.0), "R": R} | change
    with pytest.raises(ValueError, match=message):
        run_star_fixes(**given)
