"""ISHAKF: identities of the residual form, a reference in plain numpy, definiteness, outliers."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ultratight.filters.gaussian import Gaussian, Measurement, predict, update
from ultratight.filters.linear import run_linear
from ultratight.filters.robust import Ishakf, fresh, gain_weight, judge
from ultratight.filters.rules import get_rule

N, M, EPOCHS = 4, 2, 80
TIGHT = 1e-10
V2 = Ishakf(adaptive=False, robust=False)
V3 = Ishakf(robust=False)
V4 = Ishakf()
SHORT = replace(V4, window=3, c4=60.0)
VARIANTS = {
    "V2": V2, "V3": V3, "V4": V4, "short": SHORT,
    "robust": Ishakf(R=False, adaptive=False, c4=60.0),
    "single": replace(V4, low_side="single"), "recursive": replace(SHORT, recursive=True),
    "max_reject": replace(SHORT, max_reject=2),
}  # fmt: skip


def system(seed=3):
    """A stable system whose noise falls to a tenth and rises again; outliers, also in a row."""
    rng = np.random.default_rng(seed)
    Phi = 0.95 * np.linalg.qr(rng.standard_normal((EPOCHS, N, N)))[0]
    H, root = rng.standard_normal((M, N)), rng.standard_normal((N, N))
    sigma = np.where((np.arange(EPOCHS) > 25) & (np.arange(EPOCHS) < 55), 0.4, 4.0)
    Q = 0.1 * (root @ root.T + np.eye(N))
    x, z = np.zeros(N), np.empty((EPOCHS, M))
    for k in range(EPOCHS):
        x = Phi[k] @ x + np.linalg.cholesky(Q) @ rng.standard_normal(N)
        z[k] = H @ x + sigma[k] * rng.standard_normal(M)
    z[[12, 40]] += 12.0
    z[62:67] += 40.0
    return SimpleNamespace(
        start=Gaussian(np.zeros(N), np.eye(N)), Phi=Phi, Q=Q, H=H, R=20.0 * np.eye(M), z=z
    )


def run(s, noise, z=None):
    return run_linear(s.start, s.Phi, s.Q, s.H, s.R, s.z if z is None else z, noise)


def reference(s, o):
    """The formulas as they stand in the module's first lines, a step at a time."""
    x, P, R = s.start.mean, s.start.cov, s.R
    last, beta, rejected, out = [1.0] * o.window, 1.0, 0, []
    for k in range(1, EPOCHS + 1):
        x, P = s.Phi[k - 1] @ x, s.Phi[k - 1] @ P @ s.Phi[k - 1].T + s.Q
        S = s.H @ P @ s.H.T + R
        v = s.z[k - 1] - s.H @ x
        eps = v @ np.linalg.solve(S, v) / M
        b, w, update_R = o.b0 + o.db, 1.0, o.R
        if o.adaptive or o.robust:
            outside = eps > o.c3
            rejected = rejected + 1 if outside else 0
            forced = outside and 0 < o.max_reject < rejected
            if forced:
                b = o.b0
            elif outside:
                update_R = False
                if o.robust:
                    slope = (o.c4 - eps) / (o.c4 - o.c3)
                    w = o.c3 / eps * slope**2 if eps < o.c4 else 0.0
            else:
                last = [*last, eps][-o.window :]
                g_high = 1.0 if eps <= o.c2 else (o.c3 - eps) / (o.c3 - o.c2)
                low = eps / o.c1 if o.low_side == "single" else o.c1 * np.mean(last)
                if o.adaptive:
                    b = o.b0 + o.db * min(1.0, low, g_high)
        K = w * P @ s.H.T @ np.linalg.inv(S)
        x, A = x + K @ v, np.eye(N) - K @ s.H
        P = A @ P @ A.T + K @ R @ K.T
        if update_R:
            beta = beta / (beta + b)
            d = beta if o.recursive else (1 - b) / (1 - b ** (k + 1))
            e = s.z[k - 1] - s.H @ x
            R = (1 - d) * R + d * (np.outer(e, e) + s.H @ P @ s.H.T)
        out.append((x, np.diag(P), R, w))
    return [np.array(column) for column in zip(*out, strict=True)]


@pytest.mark.nojit
@pytest.mark.parametrize("name", VARIANTS)
def test_against_the_formulas(name):
    """All epochs of a run that meets every branch of its variant."""
    s, noise = system(), VARIANTS[name]
    mean, variance, R, w = reference(s, noise)
    found = run(s, noise)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(found.variance, variance, rtol=1e-9)
    np.testing.assert_allclose(found.R_epoch, R, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(found.weight, w, rtol=1e-9, atol=1e-12)
    assert np.any(w < 1.0) == noise.robust
    assert np.any((w > 0.0) & (w < 1.0)) or not noise.robust or noise.c4 < 60.0
    assert set(found.first) == {-1}


@pytest.mark.nojit
def test_identities_of_the_residual():
    """I - H K = R S^-1;  (I - H K) S (I - H K)' + H P H' = R: the bracket is R on average."""
    s = system()
    P = s.Phi[0] @ s.start.cov @ s.Phi[0].T + s.Q
    S = s.H @ P @ s.H.T + s.R
    K = P @ s.H.T @ np.linalg.inv(S)
    left = np.eye(M) - s.H @ K
    np.testing.assert_allclose(left, s.R @ np.linalg.inv(S), atol=TIGHT)
    after = s.H @ (np.eye(N) - K @ s.H) @ P @ s.H.T
    np.testing.assert_allclose(left @ S @ left.T + after, s.R, atol=TIGHT * 20)


@pytest.mark.nojit
def test_mean_step():
    """E[R_1] - R_0 = d R S^-1 (S_true - S) S^-1 R, over innovations that have S_true exactly."""
    s, b = system(), V2.b0 + V2.db
    P = s.Phi[0] @ s.start.cov @ s.Phi[0].T + s.Q
    S = s.H @ P @ s.H.T + s.R
    S_true = 3.0 * S + np.array([[5.0, -2.0], [-2.0, 1.0]])
    prior = s.H @ s.Phi[0] @ s.start.mean
    steps = [
        run_linear(s.start, s.Phi[:1], s.Q, s.H, s.R, (prior + v)[None], V2).R - s.R
        for v in np.sqrt(M) * np.linalg.cholesky(S_true).T
    ]
    G = s.R @ np.linalg.inv(S)
    np.testing.assert_allclose(
        np.mean(steps, axis=0), (1 - b) / (1 - b**2) * G @ (S_true - S) @ G.T, rtol=TIGHT
    )


@pytest.mark.nojit
def test_gain_weight():
    """12/14 (2/4)^2 at the middle; without a jump at c3 and c4; NaN is an outlier."""
    assert gain_weight(14.0, 12.0, 16.0) == pytest.approx(3.0 / 14.0, rel=1e-14)
    assert gain_weight(12.0, 12.0, 16.0) == 1.0
    assert gain_weight(12.0 + 1e-9, 12.0, 16.0) == pytest.approx(1.0, abs=1e-8)
    assert gain_weight(16.0 - 1e-9, 12.0, 16.0) == pytest.approx(0.0, abs=1e-15)
    assert gain_weight(np.inf, 12.0, 16.0) == 0.0
    assert gain_weight(np.nan, 12.0, 16.0) == 0.0
    assert judge(np.nan, fresh(20), V4.codes()) == (0.0, 0.0)


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_R_stays_definite(name, scale):
    """Measured far better or worse than R_0, P_0 far too large: the least eigenvalue is > 0."""
    s = system(5)
    z = np.random.default_rng(8).standard_normal((EPOCHS, M)) * scale
    found = run_linear(
        Gaussian(s.start.mean, 1e6 * s.start.cov), s.Phi, s.Q, s.H, s.R, z, VARIANTS[name]
    )
    assert np.linalg.eigvalsh(found.R_epoch).min() > 0.0
    assert set(found.first) == {-1}


@pytest.mark.nojit
def test_missing_measurements_hold_everything():
    s, z = system(), system().z.copy()
    z[5:9] = np.nan
    found = run(s, V4, z)
    assert np.all(found.weight[5:9] == 0.0)
    assert np.all(found.R_epoch[5:9] == found.R_epoch[4])
    gone = SimpleNamespace(**vars(s))
    joined = s.Phi[9] @ s.Phi[8] @ s.Phi[7] @ s.Phi[6] @ s.Phi[5]
    Q = s.Q
    for k in (6, 7, 8, 9):
        Q = s.Phi[k] @ Q @ s.Phi[k].T + s.Q
    gone.Phi, gone.z = np.concatenate([s.Phi[:5], joined[None]]), np.concatenate([z[:5], z[9:10]])
    first = run_linear(s.start, gone.Phi[:5], s.Q, s.H, s.R, gone.z[:5], V4)
    # the count behind d, and the ring, go on as if the gap were one long epoch: with b = 1, d = 1/7
    even = replace(V2, b0=1.0, db=0.0)
    before = run_linear(s.start, gone.Phi[:5], s.Q, s.H, s.R, gone.z[:5], even)
    P = joined @ before.last.cov @ joined.T + Q
    S = s.H @ P @ s.H.T + before.R
    v = z[9] - s.H @ joined @ before.last.mean
    e = before.R @ np.linalg.solve(S, v)
    bracket = np.outer(e, e) + before.R - before.R @ np.linalg.solve(S, before.R)
    np.testing.assert_allclose(run(s, even, z).R_epoch[9], before.R + (bracket - before.R) / 7)
    np.testing.assert_array_equal(first.R, found.R_epoch[8])


@pytest.mark.nojit
def test_no_noise_and_noise_in_one_direction():
    """R_0 = 0 is kept, an exact measurement; of a rank-deficient one the image is kept."""
    s = system()
    exact = run_linear(s.start, s.Phi, s.Q, s.H, np.zeros((M, M)), s.z, V2)
    assert np.all(exact.R_epoch == 0.0)
    np.testing.assert_allclose(exact.mean @ s.H.T, s.z, atol=1e-8)
    line = np.outer([1.0, 2.0], [1.0, 2.0])
    found = run_linear(s.start, s.Phi, s.Q, s.H, line, s.z, V2)
    assert set(found.first) == {-1}
    np.testing.assert_allclose(found.R, found.R[0, 0] * line, rtol=1e-9)
    certain = Gaussian(s.start.mean, np.zeros((N, N)))
    stuck = run_linear(certain, s.Phi, np.zeros((N, N)), s.H, np.zeros((M, M)), s.z, V4)
    assert stuck.first == (-1, -1, -1, 0, -1)
    assert np.all(stuck.weight == 0.0)


@pytest.mark.nojit
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"b0": 0.0}, "b0, db: 0.0, 0.27, expected 0 < b0"),
        ({"b0": 0.8}, "b0, db: 0.8, 0.27"),
        ({"db": np.nan}, "b0, db: 0.7, nan"),
        ({"c3": 8.0}, r"c2, c3, c4: \(8.0, 8.0, 16.0\), expected rising numbers"),
        ({"c4": np.nan}, "c2, c3, c4"),
        ({"c1": -1.0}, "c1: -1.0, expected a number above 0"),
        ({"window": -1}, "window: -1, expected a whole number, at least 1"),
        ({"window": 2.5}, "window: 2.5, expected a whole number"),
        ({"max_reject": -1}, "max_reject: -1, expected a whole number, at least 0"),
        ({"low_side": "median"}, "low_side: 'median', expected one of mean, single"),
    ],
)
def test_bad_options(change, message):
    with pytest.raises(ValueError, match=message):
        Ishakf(**change)


# --- in closed loop ------------------------------------------------------------------------


def block(make, s, k):
    linear = make.LinearH(s.H[None])
    return Measurement(
        s.z[k : k + 1], np.eye(N)[None], s.R[None], linear.h, linear.h_jacobian, np.arange(1)
    )


@pytest.mark.parametrize("name", VARIANTS)
def test_closed_loop_is_the_linear_run(make, name):
    """One block: a reduced gain is that of the noise R + (1/w - 1) S, with Joseph's P of R."""
    s = system()
    expected, memory, state = run(s, VARIANTS[name]), VARIANTS[name].memory(), s.start
    for k in range(EPOCHS):
        step = make.prediction(N, 1, phi=s.Phi[k], q=s.Q, layout_=())
        found = memory.step(state, step, block(make, s, k), get_rule("linearised"))
        state = Gaussian(found.mean, found.cov)
        np.testing.assert_allclose(found.mean, expected.mean[k], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(np.diag(found.cov), expected.variance[k], rtol=1e-7)
    if VARIANTS[name].R:
        np.testing.assert_allclose(memory.R_hat[0], expected.R, rtol=1e-7)
    memory.reset()
    assert memory.R_hat == {}


@pytest.mark.parametrize("rule", ["linearised", "gh3"])
def test_one_bad_channel_is_left_out_and_spoils_no_other(make, rule):
    """The others' estimate and their R are as without it; its own R is held."""
    state, good = make.problem("linear", 3, nb=4, n=17)
    bad = good._replace(z=good.z + np.array([0.0, 0.0, 500.0, 0.0])[:, None])
    keep = [0, 1, 3]
    fewer = make.LinearH(good.h.__self__.B[keep])
    rest = good._replace(
        h=fewer.h, h_jacobian=fewer.h_jacobian,
        **{f: getattr(good, f)[keep] for f in ("z", "A", "R", "channel")},
    )  # fmt: skip
    step = make.prediction(17, 4)
    full, without = V4.memory(), V4.memory()
    found = full.step(state, step, bad, get_rule(rule))
    expected = without.step(state, step, rest, get_rule(rule))
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(found.cov, expected.cov, rtol=1e-6, atol=1e-9)
    for channel in keep:
        np.testing.assert_allclose(full.R_hat[channel], without.R_hat[channel], rtol=1e-6)
    np.testing.assert_array_equal(full.R_hat[2], bad.R[2])
    assert found.innovation.size == bad.z.size
    honest = update(predict(state, step.phi, step.q), bad, get_rule(rule))
    np.testing.assert_allclose(found.nis, honest.nis)
    assert np.abs(found.gain[:, 6:9]).max() < 1e-6 * np.abs(honest.gain[:, 6:9]).max()


def test_channels_that_come_and_go_keep_their_own_R(make):
    memory, rule = V3.memory(), get_rule("gh3")
    state, measurement = make.problem("linear", 3, nb=3, n=17)
    step = make.prediction(17, 3)
    memory.step(state, step, measurement, rule)
    kept = {c: R.copy() for c, R in memory.R_hat.items()}
    none = measurement._replace(
        **{f: getattr(measurement, f)[:0] for f in ("z", "A", "R", "channel")}
    )
    assert memory.step(state, step, none, rule).innovation.size == 0
    state, alone = make.problem("linear", 4, nb=1, n=17)
    memory.step(state, step, alone._replace(channel=np.array([2])), rule)
    np.testing.assert_array_equal(memory.R_hat[0], kept[0])
    assert not np.array_equal(memory.R_hat[2], kept[2])
