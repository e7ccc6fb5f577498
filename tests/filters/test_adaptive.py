"""Sage-Husa noise estimation: identities of its equations, definiteness, closed loop."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from ultratight.filters.adaptive import FIXES, GAINS, NoiseMemory, SageHusa
from ultratight.filters.gaussian import Gaussian
from ultratight.filters.linear import run_linear
from ultratight.filters.rules import get_rule

B = 0.6
EPOCHS = 6
TIGHT = 1e-10


def system(seed=2, n=4, m=2):
    """A system of so noisy measurements that nothing loses definiteness within `EPOCHS` epochs."""
    rng = np.random.default_rng(seed)
    Phi = np.eye(n) + 0.1 * rng.standard_normal((EPOCHS, n, n))
    H = rng.standard_normal((m, n))
    root = rng.standard_normal((n, n))
    return SimpleNamespace(
        start=Gaussian(np.zeros(n), np.eye(n)), Phi=Phi, Q=root @ root.T + np.eye(n), H=H,
        R=1e4 * np.eye(m), z=100.0 * rng.standard_normal((EPOCHS, m)),
    )  # fmt: skip


def until(s, noise, k):
    """The run's first k epochs: P, Q^ and R^ at their end."""
    run = run_linear(s.start, s.Phi[:k], s.Q, s.H, s.R, s.z[:k], noise)
    assert set(run.first) == {-1}
    return run


def epoch(s, noise, k):
    """All that the equations of epoch k speak of, found from two runs and plain numpy."""
    H, Phi = s.H, s.Phi[k - 1]
    before = until(s, noise, k - 1) if k > 1 else SimpleNamespace(last=s.start, Q=s.Q, R=s.R)
    after = until(s, noise, k)
    A = Phi @ before.last.cov @ Phi.T
    M = A + before.Q
    v = s.z[k - 1] - H @ Phi @ before.last.mean
    R_gain = after.R if noise.gain == "current" else before.R
    S = H @ M @ H.T + R_gain
    K = M @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(after.last.mean, Phi @ before.last.mean + K @ v, rtol=TIGHT)
    return SimpleNamespace(
        A=A, M=M, v=v, S=S, K=K, H=H, P=after.last.cov, Q0=before.Q, Q=after.Q, R0=before.R,
        R=after.R, R_gain=R_gain, d=(1 - B) / (1 - B ** (k + 1)),
    )  # fmt: skip


def close(found, expected):
    """To 1e-10 of the largest entry."""
    np.testing.assert_allclose(found, expected, atol=TIGHT * np.abs(expected).max(), rtol=0)


def further_terms(e):
    """What (28b) adds to the bracket."""
    K, H, M = e.K, e.H, e.M
    return -2 * K @ e.R @ K.T - 2 * K @ H @ M @ H.T @ K.T + M @ H.T @ K.T + K @ H @ M


LITERAL = [SageHusa(b=(B, B), fix="none", gain=gain) for gain in GAINS]


@pytest.mark.nojit
@pytest.mark.parametrize("k", [1, 2, EPOCHS])
@pytest.mark.parametrize("noise", LITERAL, ids=GAINS)
def test_bracket_of_Q_is_an_integrator(noise, k):
    """(12) with the optimal gain: Q^_k = Q^_k-1 + d K (v v' - S) K', Q_0 is never forgotten."""
    s = system()
    e = epoch(s, noise, k)
    surprise = e.K @ (np.outer(e.v, e.v) - e.S) @ e.K.T
    bracket = e.K @ np.outer(e.v, e.v) @ e.K.T + e.P - e.A
    close(bracket, e.Q0 + surprise)
    close(e.Q, (1 - e.d) * e.Q0 + e.d * bracket)
    close(e.Q, e.Q0 + e.d * surprise)


@pytest.mark.nojit
@pytest.mark.parametrize("k", [1, EPOCHS])
def test_step_of_R_as_printed(k):
    """(7) with S of R^_k-1: R^_k - R^_k-1 = d (v v' - S)."""
    e = epoch(system(), SageHusa(b=(B, B), fix="none", gain="previous"), k)
    close(e.R - e.R0, e.d * (np.outer(e.v, e.v) - e.S))


@pytest.mark.nojit
@pytest.mark.parametrize("gain", GAINS)
def test_missed_terms_are_the_gap_of_two_Rs(gain):
    """-2 K R^ K' - 2 K H M H' K' + M H' K' + K H M = -2 K (R^_k - R_gain) K'; zero if current."""
    e = epoch(system(), SageHusa(b=(B, B), fix="none", gain=gain, complete=True), 3)
    terms = further_terms(e)
    scale = np.abs(e.K @ e.R @ e.K.T).max()
    assert np.abs(terms + 2 * e.K @ (e.R - e.R_gain) @ e.K.T).max() < TIGHT * scale
    assert (np.abs(terms).max() < TIGHT * scale) == (gain == "current")
    bracket = e.K @ np.outer(e.v, e.v) @ e.K.T + e.P - e.A + terms
    close(e.Q, (1 - e.d) * e.Q0 + e.d * bracket)


@pytest.mark.nojit
@pytest.mark.parametrize("k", [1, EPOCHS])
def test_improved_1_as_printed_turns_the_step_of_Q(k):
    """Q^_k = Q^_k-1 + d2 (1 - 2 d1) K (v v' - S) K': against the surprise where d1 > 1/2."""
    e = epoch(system(), SageHusa(b=(B, B), fix="none", gain="previous", complete=True), k)
    surprise = e.K @ (np.outer(e.v, e.v) - e.S) @ e.K.T
    close(e.Q - e.Q0, e.d * (1 - 2 * e.d) * surprise)
    assert (1 - 2 * e.d < 0) == (k == 1)  # d_1 = 1 / 1.6


@pytest.mark.nojit
@pytest.mark.parametrize(("fix", "b"), [*product(FIXES[1:], (0.0, 0.3, 1.0)), ("none", B)])
def test_improved_1_is_sage_husa_with_the_current_gain(fix, b):
    s = system()
    one = run_linear(s.start, s.Phi, s.Q, s.H, s.R, s.z, SageHusa(b=(b, b), fix=fix))
    two = run_linear(s.start, s.Phi, s.Q, s.H, s.R, s.z, SageHusa(b=(b, b), fix=fix, complete=True))
    np.testing.assert_allclose(two.mean, one.mean, rtol=1e-9)
    np.testing.assert_allclose(two.Q_variance, one.Q_variance, rtol=1e-9)


@pytest.mark.nojit
@pytest.mark.parametrize("b", [0.0, B, 1.0])
def test_weights_of_the_brackets(b):
    """(14): Q^_k = sum w_j B_j, w_j = (1 - b) b^(k-j) / (1 - b^(k+1)), equal ones at b = 1."""
    s, noise = system(), SageHusa(b=(B, b), fix="none")
    brackets = [s.Q]
    for k in range(1, EPOCHS + 1):
        e = epoch(s, noise, k)
        brackets.append(e.K @ np.outer(e.v, e.v) @ e.K.T + e.P - e.A)
    powers = np.array([b ** (EPOCHS - j) for j in range(EPOCHS + 1)])
    weights = powers / powers.sum()
    close(until(s, noise, EPOCHS).Q, np.tensordot(weights, brackets, 1))


@pytest.mark.nojit
@pytest.mark.parametrize("of_initial", [False, True])
def test_improved_2_blends_with_the_initial_values(of_initial):
    s, a = system(), (0.2, 0.6)
    noise = SageHusa(a=a, fix="none", complete=True, a_of_initial=of_initial)
    e = epoch(s, noise, 4)
    w = (1 - a[0], 1 - a[1]) if of_initial else a
    close(e.R, (1 - w[0]) * s.R + w[0] * (np.outer(e.v, e.v) - e.H @ e.M @ e.H.T))
    bracket = e.K @ np.outer(e.v, e.v) @ e.K.T + e.P - e.A + further_terms(e)
    close(e.Q, (1 - w[1]) * s.Q + w[1] * bracket)


@pytest.mark.nojit
@pytest.mark.parametrize("fix", FIXES[1:])
def test_fixes_are_what_they_say(fix):
    s = system()
    e = epoch(s, SageHusa(b=(B, B), fix=fix), 3)
    vv, Kv = np.outer(e.v, e.v), e.K @ e.v
    for new, old, plus, minus in (
        (e.R, e.R0, vv, e.H @ e.M @ e.H.T),
        (e.Q, e.Q0, np.outer(Kv, Kv), e.A - e.P),
    ):
        expected = {
            "second-term": (1 - e.d) * old + e.d * np.diag(np.abs(np.diag(plus - minus))),
            "whole": np.diag(np.abs(np.diag((1 - e.d) * old + e.d * (plus - minus)))),
            "drop-minus": (1 - e.d) * old + e.d * np.diag(np.diag(plus)),
            "skip": (1 - e.d) * old + e.d * (plus - minus),  # nothing is lost here
        }[fix]
        close(new, expected)


@pytest.mark.nojit
def test_means_of_the_noises():
    """(5), (6) and (11): r^ from z - H x-, v less r^, q^ from x - Phi x of the epoch before."""
    s = system()
    noise = SageHusa(R=False, Q=False, b=(0.3, B), mean_r=True, mean_q=True)
    run = run_linear(s.start, s.Phi, s.Q, s.H, s.R, s.z, noise)
    x, P, r, q = s.start.mean, s.start.cov, np.zeros(2), np.zeros(4)
    for k in range(EPOCHS):
        d1, d2 = ((1 - b) / (1 - b ** (k + 2)) for b in (0.3, B))
        prior, M = s.Phi[k] @ x + q, s.Phi[k] @ P @ s.Phi[k].T + s.Q
        r = (1 - d1) * r + d1 * (s.z[k] - s.H @ prior)
        K = M @ s.H.T @ np.linalg.inv(s.H @ M @ s.H.T + s.R)
        new = prior + K @ (s.z[k] - s.H @ prior - r)
        q = (1 - d2) * q + d2 * (new - s.Phi[k] @ x)
        x, P = new, M - K @ s.H @ M
        np.testing.assert_allclose(run.mean[k], x, rtol=1e-10, atol=1e-12)


def test_gaps_hold_the_estimates_and_the_count():
    s, noise = system(), SageHusa(b=(B, B))
    z = s.z.copy()
    z[2:4] = np.nan
    run = run_linear(s.start, s.Phi, s.Q, s.H, s.R, z, noise)
    assert np.all(run.R_variance[2:4] == run.R_variance[1])
    assert np.all(run.Q_variance[2:4] == run.Q_variance[1])
    # the same without the gap's epochs, whose Phi and Q^ are put into the epoch that follows
    Q = until(s, noise, 2).Q
    P = until(s, noise, 2).last.cov
    for k in (2, 3, 4):
        P = s.Phi[k] @ P @ s.Phi[k].T + Q
    HMH = s.H @ P @ s.H.T
    x = s.Phi[4] @ s.Phi[3] @ s.Phi[2] @ run.mean[1]
    v = z[4] - s.H @ x
    d = (1 - B) / (1 - B**4)  # the third measurement
    expected = (1 - d) * run.R_variance[1] + d * np.abs(v**2 - np.diag(HMH))
    np.testing.assert_allclose(run.R_variance[4], expected, rtol=1e-10)


QUIET = {
    "start": Gaussian(np.zeros(2), 100.0 * np.eye(2)),
    "Q": np.diag([0.0, 1.0]),
    "R": np.eye(1),
}


def quiet_run(noise, n=300):
    """Position and velocity, position measured; P_0 far larger than what is seen."""
    z = np.random.default_rng(5).standard_normal((n, 1))
    return run_linear(
        QUIET["start"], [[[1.0, 1.0], [0.0, 1.0]]], QUIET["Q"], [[1.0, 0.0]], QUIET["R"], z, noise
    )


@pytest.mark.parametrize("b", [0.2, 0.5, 0.95])
def test_without_a_fix_definiteness_is_lost_and_with_it_never(b):
    lost = quiet_run(SageHusa(b=(b, b), fix="none")).first
    assert min(k for k in lost if k >= 0) < 10
    for fix, complete, gain in product(FIXES[1:], (False, True), GAINS):
        found = quiet_run(SageHusa(b=(b, b), fix=fix, complete=complete, gain=gain))
        assert set(found.first) == {-1}
        assert np.isfinite(found.mean).all()


def test_skipped_steps_are_the_indefinite_ones():
    """R^ of each epoch is that of the step made from the one before, or the one before."""
    noise, P = SageHusa(Q=False, b=(B, B), fix="skip", gain="previous"), QUIET["start"].cov
    run, kept = quiet_run(noise), 0
    z, F = np.random.default_rng(5).standard_normal(300), np.array([[1.0, 1.0], [0.0, 1.0]])
    x, R = QUIET["start"].mean, 1.0
    for k in range(300):
        d = (1 - B) / (1 - B ** (k + 2))
        M, prior = F @ P @ F.T + QUIET["Q"], F @ x
        v, K = z[k] - prior[0], M[:, 0] / (M[0, 0] + R)
        x, P = prior + K * v, M - np.outer(K, M[0])
        step = (1 - d) * R + d * (v**2 - M[0, 0])
        R, kept = (step, kept) if step >= 0 else (R, kept + 1)
        np.testing.assert_allclose(run.R_variance[k, 0], R, rtol=1e-6)
    assert 10 < kept < 290


@pytest.mark.nojit
def test_bad_options():
    for bad in ({"b": (-0.1, 0.5)}, {"a": (0.5, 1.1)}, {"b": (0.5,)}, {"b": (np.nan, 0.5)}):
        with pytest.raises(ValueError, match="expected two numbers from 0 to 1"):
            SageHusa(**bad)
    with pytest.raises(ValueError, match="fix: 'abs', expected one of none, second-term"):
        SageHusa(fix="abs")
    with pytest.raises(ValueError, match="gain: 'old', expected one of current, previous"):
        SageHusa(gain="old")
    with pytest.raises(ValueError, match="expected a fix in closed loop"):
        NoiseMemory(SageHusa(fix="none"))
    with pytest.raises(ValueError, match="has no mean to estimate"):
        NoiseMemory(SageHusa(mean_q=True))


# --- in closed loop ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "noise",
    [
        SageHusa(b=(B, B)), SageHusa(b=(0.3, B), complete=True, gain="previous"),
        SageHusa(a=(0.1, 0.4), complete=True), SageHusa(Q=False), SageHusa(R=False),
    ],
    ids=["both", "improved-1", "improved-2", "R", "Q"],
)  # fmt: skip
def test_closed_loop_is_the_linear_run(make, noise):
    """One block of two numbers, the error fed back: the covariances of the run in one call."""
    s = system()
    run = run_linear(s.start, s.Phi, s.Q, s.H, s.R, s.z, noise)
    memory, x, P = NoiseMemory(noise), s.start.mean, s.start.cov
    linear = make.LinearH(s.H[None])
    for k in range(EPOCHS):
        offered = make.prediction(4, 1, phi=s.Phi[k], q=s.Q, layout_=())
        # open loop: the mean is handed on instead of being fed back
        block = make_block(linear, s.z[k], s.R)
        found = memory.step(Gaussian(x, P), offered, block, get_rule("linearised"))
        x, P = found.mean, found.cov
        np.testing.assert_allclose(x, run.mean[k], rtol=1e-9)
    np.testing.assert_allclose(P, run.last.cov, rtol=1e-9, atol=1e-12)


def make_block(linear, z, R):
    from ultratight.filters.gaussian import Measurement

    return Measurement(z[None], np.eye(4)[None], R[None], linear.h, linear.h_jacobian, np.arange(1))


def test_channels_that_come_and_go_keep_their_own_R(make):
    memory, rule = NoiseMemory(SageHusa(Q=False, b=(B, B))), get_rule("gh3")
    state, measurement = make.problem("linear", 3, nb=3, n=17)
    step = make.prediction(17, 3)
    memory.step(state, step, measurement, rule)
    kept = {c: R.copy() for c, R in memory.R_hat.items()}
    fewer = measurement._replace(
        **{f: getattr(measurement, f)[:0] for f in ("z", "A", "R", "channel")}
    )
    quiet = memory.step(state, step, fewer, rule)
    assert quiet.innovation.size == 0
    state, alone = make.problem("linear", 4, nb=1, n=17)
    memory.step(state, step, alone._replace(channel=np.array([2])), rule)
    np.testing.assert_array_equal(memory.R_hat[0], kept[0])
    assert not np.array_equal(memory.R_hat[2], kept[2])
    memory.reset()
    assert memory.R_hat == {}
    assert memory.Q_hat is None


def test_states_that_change_ask_for_a_reset(make):
    memory, rule = NoiseMemory(SageHusa()), get_rule("linearised")
    state, measurement = make.problem("linear", 3, nb=3, n=17)
    memory.step(state, make.prediction(17, 3), measurement, rule)
    state, measurement = make.problem("linear", 3, nb=3, n=20)
    with pytest.raises(ValueError, match=r"Q\^: 17 states, got 20: call reset"):
        memory.step(state, make.prediction(20, 3), measurement, rule)
