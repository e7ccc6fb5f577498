"""Phi against the mechanisation itself, Q against Van Loan's exact integral."""

import numpy as np
import pytest
from scipy.linalg import expm

from signals.constants import OMEGA_EARTH
from ultratight.ins.attitude import rotation_from_euler, vector_from_rotation
from ultratight.ins.earth import ecef_from_geodetic, gravity, rotation_e_from_n
from ultratight.ins.error_state import Layout, ProcessNoise, system_matrix, transition
from ultratight.ins.imu import Increments
from ultratight.ins.strapdown import NavState, correct, propagate

pytestmark = pytest.mark.nojit

R = ecef_from_geodetic(np.radians(39.9), np.radians(116.4), 8000.0)
C_N_E = rotation_e_from_n(np.radians(39.9), np.radians(116.4))
C = C_N_E @ rotation_from_euler(0.1, -0.2, 0.7)
V = C_N_E @ np.array([900.0, 500.0, 20.0])
FORCE = np.array([98.0, 5.0, -11.0])
RATE = np.array([0.02, -0.01, 0.05])
NOISE = ProcessNoise(1e-6, 2e-9, 5e-8, 2e-14, 4.5e-5, 0.0355, 1e-10, 1e-7)
RNG = np.random.default_rng(7)
U = RNG.standard_normal((8, 3))
U /= np.linalg.norm(U, axis=1)[:, None]
FULL = Layout.build(scale_factor=True, n_phase=8)


def test_layout_names_every_row_once():
    for layout, n in (
        (Layout.build(), 17),
        (Layout.build(scale_factor=True), 20),
        (Layout.build(n_phase=10), 27),
        (FULL, 28),
    ):
        rows = []
        for name in (
            "r", "v", "psi", "accel_bias", "gyro_bias", "cb", "cd", "accel_scale_factor", "phase",
        ):  # fmt: skip
            rows += list(range(n))[getattr(layout, name)]
        assert layout.n == n
        assert rows == list(range(n))


def difference(true, estimate, layout):
    """True minus estimate, in the order of the 20-state layout."""
    x = np.zeros(20)
    x[layout.r] = true.r_eb_e - estimate.r_eb_e
    x[layout.v] = true.v_eb_e - estimate.v_eb_e
    x[layout.psi] = vector_from_rotation(true.C_b_e @ estimate.C_b_e.T)
    x[layout.accel_bias] = true.accel_bias - estimate.accel_bias
    x[layout.gyro_bias] = true.gyro_bias - estimate.gyro_bias
    x[layout.cb] = true.clock_m - estimate.clock_m
    x[layout.cd] = true.clock_rate_mps - estimate.clock_rate_mps
    x[layout.accel_scale_factor] = true.accel_scale_factor - estimate.accel_scale_factor
    return x


STEP = [1e3] * 3 + [1.0] * 3 + [1e-4] * 3 + [0.1] * 3 + [1e-4] * 3 + [1.0, 1.0] + [1e-3] * 3


@pytest.mark.parametrize("column", range(20))
def test_phi_is_the_derivative_of_the_mechanisation(column):
    """Every column by central differences over 0.2 s at 5 g, both sides flown with the same IMU.

    Over such a long epoch the second order of Phi counts (a first-order Phi fails), and so would
    a sign or a missing Coriolis term.  The tolerance per row is the next term of the series:
    T |F|^3 T^2 / 6 with the body turning at 0.055 rad/s under C; J2's gradient in the r columns.
    """
    layout, T = Layout.build(scale_factor=True), 0.2
    n = 40
    t = np.arange(n + 1) * T / n
    dt = T / n
    increments = Increments(t, np.tile(RATE * dt, (n, 1)), np.tile(FORCE * dt, (n, 1)))
    state = NavState(0.0, R, V, C)
    x = np.zeros(20)
    x[column] = STEP[column]
    flown = []
    for sign in (1.0, -1.0):
        # the truth differs from the estimate by x: both see the same increments
        true = propagate(correct(state, sign * x, layout), increments)
        flown.append(difference(true, propagate(state, increments), layout))
    got = (flown[0] - flown[1]) / (2 * STEP[column])
    middle = propagate(state, Increments(t[: n // 2 + 1], *(a[: n // 2] for a in increments[1:])))
    Phi, _ = transition(layout, NOISE, middle.r_eb_e, middle.C_b_e, FORCE, U, T)
    force, w = np.linalg.norm(FORCE), np.linalg.norm(RATE)
    tolerance = np.zeros(20)
    block = np.arange(20) // 3 if column < 15 else np.full(20, -1)
    kind = column // 3 if column < 15 else (5 if column < 17 else 6)
    r, v, psi = (block == k if column < 15 else np.arange(20) // 3 == k for k in range(3))
    if kind == 0:
        tolerance[v], tolerance[r] = 1.5e-8 * T, 1.5e-8 * T**2
    elif kind == 1:
        tolerance[v] = tolerance[r] = 1e-8
    elif kind == 2:
        tolerance[v], tolerance[r] = force * w**2 * T**3, force * w * T**3 / 4
    elif kind == 3:
        tolerance[v], tolerance[r] = w**2 * T**3, w * T**3 / 4
    elif kind == 4:
        tolerance[psi], tolerance[v] = w**2 * T**3, force * w * T**3 / 4
        tolerance[r] = force * T**3 / 6 * 1.2  # a T^3 term, which a second-order Phi has not
    elif kind == 6:
        tolerance[v], tolerance[r] = force * w**2 * T**3, force * w * T**3 / 4
    np.testing.assert_array_less(
        np.abs(got - Phi[:, column]), tolerance + 2e-10 / STEP[column] ** 1
    )


def test_phase_rows_against_the_antenna():
    """p_i' = -u_i (v + psi x C (omega x l)) + cd: the antenna's range rate, error by error."""
    lever = np.array([1.5, -0.4, -2.0])
    w = C @ np.cross(RATE, lever)
    F = np.empty((28, 28))
    system_matrix(R, C, FORCE, U, np.zeros_like(U), tuple(w), 3, 8, F)
    rows = F[FULL.phase]
    dv, psi, cd = RNG.standard_normal(3), 1e-6 * RNG.standard_normal(3), 0.3
    x = np.zeros(28)
    x[FULL.v], x[FULL.psi], x[FULL.cd] = dv, psi, cd
    turned = correct(NavState(0.0, R, V, C), x[:20], Layout.build(scale_factor=True))
    antenna = turned.v_eb_e + turned.C_b_e @ np.cross(RATE, lever) - V - w
    np.testing.assert_allclose(rows @ x, -U @ antenna + cd, atol=1e-11)
    Phi, _ = transition(FULL, NOISE, R, C, FORCE, U, 0.02, w)
    np.testing.assert_allclose(Phi, np.eye(28) + F * 0.02 + F @ F * 0.02**2 / 2, atol=1e-15)


def test_phase_rows_of_a_turning_line_of_sight():
    """p = -u(t) . r: for a constant position error only the turn of u moves the phase."""
    turn = 1.5e-4 * RNG.standard_normal((8, 3))
    F = np.empty((28, 28))
    system_matrix(R, C, FORCE, U, turn, (0.0, 0.0, 0.0), 3, 8, F)
    x = np.zeros(28)
    x[FULL.r] = [3.0, -1.0, 2.0]
    T = 1e-3
    np.testing.assert_allclose(
        (F @ x)[FULL.phase] * T, -((U + turn * T) - U) @ x[FULL.r], rtol=1e-7, atol=1e-15
    )
    with_turn = transition(FULL, NOISE, R, C, FORCE, U, 0.02, None, turn)[0]
    without = transition(FULL, NOISE, R, C, FORCE, U, 0.02)[0]
    np.testing.assert_allclose(
        (with_turn - without)[FULL.phase, FULL.r], -turn * 0.02, rtol=1e-6, atol=1e-12
    )


def exact(T, noise, layout=FULL):
    """Phi and Q by Van Loan's exponential (IEEE Trans. AC 23, 1978)."""
    n = layout.n
    F = np.empty((n, n))
    system_matrix(
        R, C, FORCE, U, np.zeros_like(U), (0.0, 0.0, 0.0), layout.n_scale, layout.n_phase, F
    )
    G = np.zeros((n, n))
    for name, density in (
        ("v", noise.velocity),
        ("psi", noise.attitude),
        ("accel_bias", noise.accel_bias),
        ("gyro_bias", noise.gyro_bias),
        ("cd", noise.clock_sg),
        ("accel_scale_factor", noise.scale_factor),
        ("phase", noise.phase),
    ):
        s = getattr(layout, name)
        G[s, s] = density * np.eye(s.stop - s.start)
    shared = np.zeros(n)
    shared[layout.cb] = shared[layout.phase] = 1.0
    G += noise.clock_sf * np.outer(shared, shared)
    E = expm(np.block([[-F, G], [np.zeros((n, n)), F.T]]) * T)
    Phi = E[n:, n:].T
    return Phi, Phi @ E[:n, n:], F, G


def test_q_and_phi_converge_to_van_loan():
    """Phi is right to T^2 and Q to T^2: halving T divides what is missing by 8."""
    error = []
    for T in (0.2, 0.1, 0.05):
        Phi, Q = transition(FULL, NOISE, R, C, FORCE, U, T)
        Phi0, Q0, _, _ = exact(T, NOISE)
        error.append((np.abs(Phi - Phi0), np.abs(Q - Q0)))
    for k in range(2):
        coarse, fine = (max_by_block(e[k]) for e in (error[0], error[2]))
        large = fine > 1e-17
        assert large.any()
        assert np.all(coarse[large] / fine[large] > 0.9 * 4**3)


def max_by_block(A):
    """Largest entry of each block pair; the units differ between blocks."""
    cuts = [0, 3, 6, 9, 12, 15, 16, 17, 20, 28]
    pairs = [slice(a, b) for a, b in zip(cuts[:-1], cuts[1:], strict=True)]
    return np.array([[A[a, b].max() for b in pairs] for a in pairs])


def test_q_of_an_epoch_is_van_loan_to_the_trapezium():
    """20 ms: Q differs by T^3/12 (F^2 G + 2 F G F' + G F'^2), the trapezium's own error, and is
    positive semidefinite.  Next comes position by way of tilt: (f T)^2 S_psi / (4 S_v)."""
    T = 0.02
    _, Q = transition(FULL, NOISE, R, C, FORCE, U, T)
    _, Q0, F, G = exact(T, NOISE)
    second = F @ F @ G + 2 * F @ G @ F.T + G @ F.T @ F.T
    scale = np.sqrt(np.outer(Q.diagonal(), Q.diagonal()))
    next_term = (np.linalg.norm(FORCE) * T) ** 2 * NOISE.attitude / (4 * NOISE.velocity)
    np.testing.assert_array_less(np.abs(Q - Q0 - T**3 / 12 * second) / scale, next_term)
    np.testing.assert_array_equal(Q, Q.T)
    assert np.linalg.eigvalsh(Q / scale).min() > -1e-12


def test_clock_noise_is_common_to_all_phases():
    """The oscillator's white frequency noise moves cb and every phase by the same amount."""
    T = 0.02
    only = ProcessNoise(0.0, 0.0, 0.0, 0.0, 4.5e-5, 0.0)
    layout = Layout.build(n_phase=8)
    _, Q = transition(layout, only, R, C, FORCE, U, T)
    shared = np.zeros(25)
    shared[layout.cb] = shared[layout.phase] = 1.0
    np.testing.assert_allclose(Q, 4.5e-5 * T * np.outer(shared, shared), atol=1e-22)
    # clock drift noise: S_g T^2 / 2 between cd and each of them
    only = ProcessNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0355)
    _, Q = transition(layout, only, R, C, FORCE, U, T)
    np.testing.assert_allclose(Q[layout.cd][0], 0.0355 * (T**2 / 2 * shared + T * np.eye(25)[16]))


def test_the_clock_step_is_what_the_state_holds_and_a_bit_before_has_not_met():
    """Q of cb, cd, a phase and the step from the noises' own kernels, integrated numerically.

    Noise at u before t enters cb and p by 1 (S_f) and by u (S_g), cd by 1 (S_g); carried back to
    t - T - lag by the drift, cb has u - (T + lag) of S_g, hence the step's kernel is -(y + lag)
    with y = T - u.
    """
    T, lag, sf, sg = 0.02, 0.01, 4.5e-5, 0.0355
    only = ProcessNoise(0.0, 0.0, 0.0, 0.0, sf, sg)
    layout = Layout.build(n_phase=8, clock_step=True)
    Phi, Q = transition(layout, only, R, C, FORCE, U, T, clock_lag_s=lag)
    u = (np.arange(20_000) + 0.5) * T / 20_000
    of_sf = np.stack([np.ones_like(u), np.zeros_like(u), np.ones_like(u), np.ones_like(u)])
    of_sg = np.stack([u, np.ones_like(u), u, u - (T + lag)])
    expected = (sf * of_sf @ of_sf.T + sg * of_sg @ of_sg.T) * T / 20_000
    rows = [layout.cb.start, layout.cd.start, layout.phase.start + 3, layout.clock_step.start]
    np.testing.assert_allclose(Q[np.ix_(rows, rows)], expected, rtol=1e-6)
    np.testing.assert_array_equal(Q, Q.T)
    assert np.linalg.eigvalsh(Q / np.abs(Q).max()).min() > -1e-12
    # nothing follows from it, it follows from nothing
    assert layout.clock_step.stop == layout.n == Phi.shape[0] == 26
    assert not Phi[layout.clock_step].any()
    assert not Phi[:, layout.clock_step].any()


def test_gravity_enters_upside_down():
    """Higher means weaker gravity: an estimate too low (r up) falls too fast (v' up)."""
    up = R / np.linalg.norm(R)
    Phi, _ = transition(Layout.build(), NOISE, R, C, FORCE, U, 1.0)
    dv = Phi[3:6, 0:3] @ (1000.0 * up)
    change = gravity(R + 1000.0 * up) - gravity(R)
    assert up @ dv == pytest.approx(up @ change, rel=0.01)
    assert up @ dv == pytest.approx(3.08e-3, rel=0.02)  # the free-air gradient, 0.308 mGal/m
    assert Phi[6, 7] == pytest.approx(OMEGA_EARTH, rel=1e-12)


def test_refusals():
    with pytest.raises(ValueError, match="expected >= 0"):
        Layout.build(n_phase=-1)
    with pytest.raises(ValueError, match=r"expected \(8, 3\)"):
        transition(FULL, NOISE, R, C, FORCE, U[:3], 0.02)
