"""JTQ: trigger, spawn, opened blocks, weights, merge; what it must not do."""

from dataclasses import replace

import numpy as np
import pytest

from ultratight.filters.catalog import make_filter
from ultratight.filters.gaussian import Gaussian, Measurement
from ultratight.filters.jump_triggered import (
    ACCELERATION,
    BOTH,
    CLOCK,
    JTQ,
    JTQ_R,
    NONE,
    JumpOptions,
)
from ultratight.filters.multiple_model import bank_of, merged
from ultratight.filters.opened_blocks import seen_from_a_step

N, NB, T = 24, 7, 0.02
QUIET = replace(JTQ, gate=np.inf)
DIAGONAL = {"accel_bias": 1e-4, "v": 1e-5, "cd": 1e-5, "phase": 1e-7}


def geometry(rng):
    """Lines of sight (NB, 3) and rows (range, phase, rate) of seven channels, bits mid-epoch."""
    u = rng.standard_normal((NB, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    A = np.zeros((NB, 3, N))
    for i in range(NB):
        A[i, 0, 0:3], A[i, 0, 15] = -u[i], 1.0
        A[i, 1, 17 + i] = 1.0
        A[i, 1, 3:6], A[i, 1, 16] = 0.5 * T * u[i], -0.5 * T
        A[i, 2, 3:6], A[i, 2, 16] = -u[i], 1.0
    return u, A


def transition(u):
    """Velocity and drift move the phases, the bias the velocity."""
    phi = np.eye(N)
    phi[0:3, 3:6] = T * np.eye(3)
    phi[3:6, 9:12] = -T * np.eye(3)
    phi[15, 16] = T
    phi[17:, 3:6], phi[17:, 16] = -T * u, T
    return phi


class Phases:
    """z = (cos, sin) of the phase, and range: the tap model without its losses."""

    K = 2.0 * np.pi / 0.1903

    def h(self, y):
        p = self.K * y[..., 1]
        return np.stack([np.cos(p), np.sin(p), -y[..., 0] / 150.0], axis=-1)

    def h_jacobian(self, y):
        J = np.zeros((len(y), 3, 3))
        J[:, 0, 1], J[:, 1, 1] = (
            -self.K * np.sin(self.K * y[:, 1]),
            self.K * np.cos(self.K * y[:, 1]),
        )
        J[:, 2, 0] = -1.0 / 150.0
        return self.h(y), J


class Flight:
    """Level flight, then a step of the specific force at epoch 30 with a chosen hidden error."""

    def __init__(self, make, filter_, bias=0.0, velocity=0.0, clock=0.0, df=100.0, seed=3):
        self.make, self.filter = make, filter_
        self.rng = np.random.default_rng(seed)
        self.u, self.A = geometry(self.rng)
        self.phi = transition(self.u)
        self.hidden = {"accel_bias": bias, "v": velocity, "cd": clock}
        self.df = df
        layout = make.layout(N)
        P = np.zeros(N)
        P[:] = 1e-6
        P[0:3], P[15] = 1e-2, 1e-2
        for name, value in DIAGONAL.items():
            P[getattr(layout, name)] = value
        self.cov, self.layout = np.diag(P), layout
        self.x = np.sqrt(P) * self.rng.standard_normal(N)
        self.model = Phases()

    def fly(self, epochs, jump=30):
        """True minus estimated state after each epoch (epochs, N)."""
        out, R = [], np.tile(np.diag([0.008, 0.008, 0.01]), (NB, 1, 1))
        q = np.diag(
            np.r_[np.full(3, 1e-12), np.full(3, 2e-8), np.full(11, 1e-12), np.full(NB, 1e-10)]
        )
        for k in range(epochs):
            df = np.zeros(3)
            if k == jump:
                df[0] = self.df if k else 0.0  # the first epoch shows no change
                self.x[9] += self.hidden["accel_bias"]
                self.x[3] += self.hidden["v"]
                self.x[16] += self.hidden["cd"]
            self.x = self.phi @ self.x
            y = (self.A @ self.x)[:, None, :]
            z = self.model.h(y)[:, 0] + self.rng.standard_normal((NB, 3)) * [0.089, 0.089, 0.1]
            m = Measurement(z, self.A, R, self.model.h, self.model.h_jacobian, np.arange(NB))
            force = np.array([self.df if k >= jump else 0.0, 0.0, -9.8])
            step = self.make.prediction(
                N, NB, self.phi, q, self.layout, epoch=k, t_s=(k + 1) * T, f_b=force,
                df_b=df - self.filter.fed_bias,
            )  # fmt: skip
            u = self.filter.step(Gaussian(np.zeros(N), self.cov), step, m)
            self.cov, self.x = u.cov, self.x - u.mean
            out.append(self.x.copy())
        return np.array(out)


def weights(filter_):
    return np.exp(filter_.bank.log_weight)


def test_nothing_is_opened_in_quiet_flight(make):
    """Without a change of force, load or step, and with one pass, it is the plain filter."""
    jtq = make_filter("jtq", iterations=1, several=QUIET)
    mine = Flight(make, jtq, df=0.0).fly(20)
    plain = make_filter("qkf3")
    plain.fed_bias = np.zeros(3)
    np.testing.assert_allclose(mine, Flight(make, plain, df=0.0).fly(20), atol=1e-12)
    assert jtq.bank is None


def test_a_flight_that_begins_under_load_doubts_its_bias(make):
    """A bias of one sigma that came with the load is found; at rest nothing is opened."""
    cold = make_filter("jtq", several=replace(QUIET, cold=True))
    flight = Flight(make, cold, bias=2.0)
    flight.fly(50, jump=0)
    assert cold.notes == []
    assert cold.bank is None
    assert abs(flight.x[9]) < 4.0 * np.sqrt(flight.cov[9, 9]) < 0.2
    at_rest = Flight(make, make_filter("jtq", several=replace(QUIET, cold=True)), df=0.0)
    plain = Flight(make, make_filter("jtq", several=QUIET), df=0.0)
    np.testing.assert_array_equal(at_rest.fly(10), plain.fly(10))


def test_four_hypotheses_after_a_step_and_one_when_it_is_over(make):
    jtq = make_filter("jtq", several=QUIET)
    flight = Flight(make, jtq)
    flight.fly(30, jump=29)
    assert weights(jtq).shape == (4,)
    assert jtq.notes == [("opened", "specific force changed by 100.0 m/s2")]
    held = merged(jtq.bank)
    np.testing.assert_allclose(held.mean, 0.0, atol=1e-12)  # relative to the fed-back mean
    np.testing.assert_allclose(held.cov, flight.cov, atol=1e-12)
    flight.fly(52, jump=-1)
    assert jtq.bank is None  # at most 50 epochs


@pytest.mark.parametrize(
    ("hidden", "expected"),
    [
        ({}, NONE),
        ({"bias": 3.0}, ACCELERATION),
        ({"clock": 3.0}, CLOCK),
        ({"bias": 3.0, "clock": -3.0}, BOTH),
    ],
)
def test_the_right_hypothesis_wins(make, hidden, expected):
    jtq = make_filter("jtq", several=QUIET)
    flight = Flight(make, jtq, **hidden)
    flight.fly(31)
    best = []
    for _ in range(8):
        flight.fly(1, jump=-1)
        if jtq.bank is None:
            break
        best.append(int(np.argmax(weights(jtq))))
    assert best[-1] == expected
    flight.fly(30, jump=-1)
    assert np.abs(flight.x[16]) < 0.1
    assert np.abs(flight.x[3:6]).max() < 0.1


def opened(make, options, df, filter_name="jtq"):
    """Predicted covariances of the bank right after a change of force, and the one before."""
    jtq = make_filter(filter_name, several=options)
    flight = Flight(make, jtq, df=df)
    flight.fly(29)
    step = make.prediction(N, NB, flight.phi, layout_=flight.layout, df_b=np.array([df, 0.0, 0.0]))
    jtq.fed_bias = np.zeros(3)
    before = Gaussian(np.zeros(N), flight.cov)
    return before.cov, jtq._open(bank_of(before, np.ones(1)), step).cov


def test_sizes_of_the_opened_blocks(make):
    """w = 0.9995 at 100 m/s2; rho of the other blocks; phases and clock bias move together."""
    before, covs = opened(make, QUIET, 100.0)
    w, rho = (100.0 - 0.05) / 100.0, 0.02
    for j, (a, c) in enumerate([(rho, rho), (1.0, rho), (rho, 1.0), (1.0, 1.0)]):
        gained = covs[j] - before
        np.testing.assert_allclose(np.diag(gained)[9:12], a * 4.0 * w, rtol=1e-12)
        np.testing.assert_allclose(np.diag(gained)[3:6], a * w**2, rtol=1e-12)
        assert gained[16, 16] == pytest.approx(c * 9.0 * w, rel=1e-12)
        common = np.r_[15, 17:N]
        expected = 0.1 * T**2 * c * 9.0 * w
        np.testing.assert_allclose(gained[np.ix_(common, common)], expected, rtol=1e-9)
        gained[np.ix_(common, common)] = 0.0
        np.testing.assert_allclose(gained, np.diag(np.diag(gained)), atol=1e-15)


def test_one_hypothesis_opens_everything_and_io_nothing(make):
    before, covs = opened(make, replace(QUIET, hypotheses=False), 50.0, "j1")
    assert len(covs) == 1
    assert covs[0][9, 9] - before[9, 9] == pytest.approx(4.0 * 0.4995)
    before, covs = opened(make, replace(QUIET, hypotheses=False, trigger=False), 50.0, "io")
    np.testing.assert_array_equal(covs[0], before)
    before, covs = opened(make, QUIET, 0.04)  # inside the dead zone
    np.testing.assert_array_equal(covs[0], before)


def test_score_test_reopens_what_the_accelerometer_did_not_show(make):
    """A clock jump of 3 m/s in steady flight: only the score test can see it."""
    caught = make_filter("io")
    flight = Flight(make, caught, clock=3.0, df=0.0)
    before = flight.fly(100, jump=90)[89]
    assert np.abs(flight.x[16]) < 0.1
    assert np.abs(flight.x[3:6] - before[3:6]).max() < 0.1
    blind = Flight(
        make, make_filter("io", several=replace(QUIET, trigger=False)), clock=3.0, df=0.0
    )
    blind.fly(100, jump=90)
    assert np.abs(blind.x[16]) > 0.5


def test_a_lost_hypothesis_does_not_spoil_the_others(make):
    jtq = make_filter("jtq", several=QUIET)
    flight = Flight(make, jtq)
    flight.fly(30, jump=29)
    jtq.bank.cov[BOTH] = np.nan
    flight.fly(1, jump=-1)
    assert np.isfinite(flight.cov).all()
    assert np.isfinite(flight.x).all()


def test_four_passes_are_one_when_linear(make):
    """Acceptance 2 of the specification: relinearisation changes nothing in a linear problem."""
    state, measurement = make.problem("linear", 4, nb=NB, n=N, scale=0.5)
    step = make.prediction(N, NB, df_b=np.array([80.0, 0.0, 0.0]))
    one = make_filter("jtq", iterations=1).step(state, step, measurement)
    four = make_filter("jtq", iterations=4).step(state, step, measurement)
    np.testing.assert_allclose(four.mean, one.mean, atol=1e-9)
    np.testing.assert_allclose(four.cov, one.cov, atol=1e-9)


@pytest.mark.nojit
def test_a_step_inside_an_integration(make):
    """Mean and rate of a phase that begins to turn inside the integration, by brute force."""
    _, A = geometry(np.random.default_rng(1))
    middle = 0.3 - np.linspace(0.5 * T, 1.5 * T, NB)
    span = np.column_stack([middle, np.full(NB, 0.5 * T)])
    back = middle - 0.3
    A[:, 1, 16], A[:, 1, 3:6] = back, A[:, 2, 3:6] * back[:, None]
    m = Measurement(np.zeros((NB, 3)), A, np.zeros((NB, 3, 3)), None, None, np.arange(NB), span)
    step = make.prediction(N, NB, t_s=0.3)
    found = seen_from_a_step(m, step).A
    for i in range(NB):
        t = middle[i] + np.linspace(-0.5 * T, 0.5 * T, 200_001)
        phase = np.maximum(t - (0.3 - T), 0.0)  # of a drift of 1 m/s from the start of the epoch
        half = phase.size // 2
        assert T + found[i, 1, 16] == pytest.approx(phase.mean(), abs=1e-7)
        rate = (phase[half:].mean() - phase[: half + 1].mean()) / (0.5 * T)
        assert found[i, 2, 16] == pytest.approx(rate, abs=1e-4)
        np.testing.assert_allclose(found[i, 2, 3:6], A[i, 2, 3:6] * found[i, 2, 16], atol=1e-12)
    np.testing.assert_array_equal(found[:, 0], A[:, 0])


def test_blocks_open_along_the_change_of_force(make):
    """JTQ-R: across the change a tenth of the size; on a ramp 0.3 of the variance."""
    before, covs = opened(make, replace(JTQ_R, gate=np.inf), 100.0, "jtq-r")
    w, gained = 0.9995, covs[ACCELERATION] - before
    np.testing.assert_allclose(
        np.diag(gained)[9:12], 4.0 * w * np.array([1, 0.01, 0.01]), rtol=1e-9
    )
    np.testing.assert_allclose(np.diag(gained)[3:6], w**2 * np.array([1, 0.01, 0.01]), rtol=1e-9)
    before, covs = opened(make, replace(JTQ_R, gate=np.inf), 1.0, "jtq-r")
    ramp = np.diag(covs[ACCELERATION] - before)[9]
    assert ramp == pytest.approx(0.3 * 4.0 * 0.0095, rel=1e-9)


def test_what_is_usual_triggers_nothing(make):
    """Vibration of 2 g: after half a second no changes of force, but for one beyond them."""
    jtq = make_filter("jtq-r", several=replace(JTQ_R, gate=np.inf))
    flight = Flight(make, jtq, df=0.0)
    rng, noted = np.random.default_rng(5), []
    for k in range(120):
        df = np.array([0.0, 0.0, 0.0])
        df[0] = 600.0 if k == 100 else 20.0 * rng.standard_normal()
        step = make.prediction(N, NB, layout_=flight.layout, df_b=df - jtq.fed_bias)
        u = jtq.step(Gaussian(np.zeros(N), flight.cov), step, nothing())
        flight.cov = u.cov
        noted.append(len(jtq.notes))
    assert sum(noted[:20]) > 5
    assert sum(noted[25:100]) == 0
    assert noted[100] == 1


def nothing():
    none = Phases()
    return Measurement(
        np.zeros((0, 3)), np.zeros((0, 3, N)), np.zeros((0, 3, 3)), none.h, none.h_jacobian,
        np.zeros(0, dtype=np.int64),
    )  # fmt: skip


@pytest.mark.nojit
def test_options_that_make_no_sense():
    with pytest.raises(ValueError, match="four positive numbers of sum 1"):
        JumpOptions(prior=(0.5, 0.5, 0.5, -0.5))
    with pytest.raises(ValueError, match="expected sizes >= 0"):
        JumpOptions(accel_mps2=-1.0)
    with pytest.raises(ValueError, match="0 < stay < 1"):
        JumpOptions(stay=1.0)
