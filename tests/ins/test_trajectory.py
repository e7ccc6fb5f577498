"""Kinematics against calculus: closed forms, scipy's quadrature and finite differences."""

import numpy as np
import pytest
from scipy.integrate import quad, quad_vec

from signals.constants import OMEGA_EARTH
from ultratight.ins.attitude import skew
from ultratight.ins.earth import gravity, rotation_e_from_n
from ultratight.ins.trajectory import Segment, Trajectory

pytestmark = pytest.mark.nojit

START = (np.radians(39.9), np.radians(116.4), 8000.0)
JUMP = Trajectory.from_profile(START, 0.7, 200.0, [Segment(20, 30, 100, 100)])
WEAVE = Trajectory.from_profile(
    START,
    2.0,
    150.0,
    [
        Segment(5, 10, -40, 60, 0.0, 0.4),
        Segment(10, 16, 0, 20, 0.4, 0.4),
        Segment(16, 20, 10, -30, 0.4, -0.3),
        Segment(20, 24, 0, 0, -0.3, 0.0),
    ],
    banked=True,
)
# ECEF coordinates are 6.4e6 m: one unit in the last place is 9.3e-10 m
ULP = 1e-9


def plane(trajectory, t):
    """North and east displacement from the start."""
    return (trajectory.at(t).r_eb_e - trajectory.origin) @ trajectory.C_n_e


def test_jump_profile_by_hand():
    """200 m/s, 10 s at 100 m/s2, 1200 m/s to 50 s: 4000 + 7000 + 24000 m along the heading."""
    d = plane(JUMP, 50.0)
    np.testing.assert_allclose(d, 35000 * np.array([np.cos(0.7), np.sin(0.7), 0]), atol=4 * ULP)
    np.testing.assert_allclose(JUMP.speed([0, 20, 25, 30, 50]), [200, 200, 700, 1200, 1200])
    assert JUMP.first_jump_s == 20.0
    np.testing.assert_array_equal(JUMP.breakpoints_s, [20.0, 30.0])
    left, right = (np.linalg.norm(JUMP.at(20.0, side).a_eb_e) for side in ("left", "right"))
    assert (left, right) == (0.0, pytest.approx(100.0, rel=1e-14))
    np.testing.assert_array_equal(JUMP.at([0.0, 50.0]).C_b_e[0], JUMP.at(50.0).C_b_e)
    np.testing.assert_array_equal(JUMP.at(33.0).omega_eb_b, np.zeros(3))


def test_circle_closes_with_its_radius():
    """V / omega = 500 m; after a full turn to the right the start is met again."""
    w, v = 0.4, 200.0
    turn = Trajectory.from_profile(START, 0.0, v, [Segment(0, 30, 0, 0, w, w)])
    np.testing.assert_allclose(plane(turn, 2 * np.pi / w), np.zeros(3), atol=4 * ULP)
    np.testing.assert_allclose(plane(turn, np.pi / w), [0.0, 2 * v / w, 0.0], atol=4 * ULP)
    np.testing.assert_allclose(np.linalg.norm(turn.at(7.0).a_eb_e), v * w, rtol=1e-14)


@pytest.mark.parametrize("t", [7.3, 12.0, 18.9, 23.0, 40.0])
def test_position_against_adaptive_quadrature(t):
    cuts = [5.0, 10.0, 16.0, 20.0, 24.0]

    def psi(u):
        return 2.0 + quad(np.interp, 0, u, args=(cuts, [0, 0.4, 0.4, -0.3, 0]), points=cuts)[0]

    nose = WEAVE.C_n_e.T @ WEAVE.at(t).C_b_e[:, 0]
    assert nose[0] + 1j * nose[1] == pytest.approx(np.exp(1j * psi(t)), abs=1e-9)
    edges = [0, *[b for b in cuts if b < t], t]
    flown = sum(
        quad(lambda u: float(WEAVE.speed(u)) * np.exp(1j * psi(u)), lo, hi, complex_func=True)[0]
        for lo, hi in zip(edges[:-1], edges[1:], strict=True)
    )
    np.testing.assert_allclose(plane(WEAVE, t), [flown.real, flown.imag, 0.0], atol=1e-6)


def derivative(f, t, h=2e-3):
    """Five-point formula: error h^4 f5 / 30, and the rounding of f by 1.5 / h."""
    return (8 * (f(t + h) - f(t - h)) - (f(t + 2 * h) - f(t - 2 * h))) / (12 * h)


def test_derivatives():
    """v = dr/dt, a = dv/dt, C' = C [omega x], away from breakpoints, -2 s to 40 s."""
    t = np.arange(-2.0, 40.0, 0.07) + 0.013
    t = t[np.abs(t[:, None] - WEAVE.breakpoints_s).min(axis=1) > 5e-3]
    m = WEAVE.at(t)
    np.testing.assert_allclose(
        derivative(lambda u: WEAVE.at(u).r_eb_e, t), m.v_eb_e, atol=1.5 * ULP / 2e-3
    )
    np.testing.assert_allclose(derivative(lambda u: WEAVE.at(u).v_eb_e, t), m.a_eb_e, atol=1e-8)
    dC = derivative(lambda u: WEAVE.at(u).C_b_e, t)
    expected = m.C_b_e @ np.stack([skew(w) for w in m.omega_eb_b])
    np.testing.assert_allclose(dC, expected, atol=5e-8)


def test_continuity_across_breakpoints():
    for b in WEAVE.breakpoints_s:
        left, right = WEAVE.at(b, "left"), WEAVE.at(b, "right")
        np.testing.assert_allclose(left.r_eb_e, right.r_eb_e, atol=2 * ULP)
        np.testing.assert_allclose(left.v_eb_e, right.v_eb_e, atol=1e-11)
        np.testing.assert_allclose(left.C_b_e, right.C_b_e, atol=1e-13)


def test_banked_turn_is_coordinated():
    """No lateral force but Coriolis 2 W V and the tilt of the vertical along the flown distance."""
    t = np.linspace(0.0, 40.0, 200)
    f = WEAVE.specific_force(t)
    flown = np.linalg.norm(WEAVE.at(t).r_eb_e - WEAVE.origin, axis=-1)
    bound = 2 * OMEGA_EARTH * np.abs(WEAVE.speed(t)) + 9.83 * (flown / 6.35e6) + 0.01
    assert np.all(np.abs(f[:, 1]) < bound)
    level = Trajectory.from_profile(START, 0.0, 100.0, [Segment(0, 9, 0, 0, 0.2, 0.2)])
    assert level.specific_force(3.0)[1] == pytest.approx(20.0, abs=0.03)


def test_an_imu_at_rest_feels_gravity_and_the_turning_earth():
    still = Trajectory.from_profile(START, 0.3, 0.0)
    alpha, nu = still.increments([0.0, 0.005])
    C = still.at(0.0).C_b_e
    np.testing.assert_allclose(nu[0], -0.005 * C.T @ gravity(still.origin), atol=1e-16)
    np.testing.assert_allclose(alpha[0], 0.005 * C.T @ [0, 0, OMEGA_EARTH], rtol=1e-13)
    north = C.T @ rotation_e_from_n(START[0], START[1])[:, 0]
    assert north @ alpha[0] == pytest.approx(0.005 * OMEGA_EARTH * np.cos(START[0]), rel=1e-12)


def test_increments_against_adaptive_quadrature_through_a_jump():
    """Nodes astride the breakpoints, so that the split matters: a lump would be off by 0.1 m/s."""
    nodes = np.array([4.991, 5.0023, 9.99, 10.013, 15.8, 16.1, 19.7, 24.4])
    alpha, nu = WEAVE.increments(nodes)
    for k, (lo, hi) in enumerate(zip(nodes[:-1], nodes[1:], strict=True)):
        cuts = [lo, *[b for b in WEAVE.breakpoints_s if lo < b < hi], hi]
        pieces = [
            quad_vec(lambda u: np.stack(WEAVE._inertial(np.asarray(u), "right")), a, b, 1e-11)[0]
            for a, b in zip(cuts[:-1], cuts[1:], strict=True)
        ]
        expected = np.sum(pieces, axis=0)
        np.testing.assert_allclose(alpha[k], expected[0], atol=1e-10)
        np.testing.assert_allclose(nu[k], expected[1], atol=1e-10)


def test_increments_do_not_depend_on_the_grid():
    t = np.linspace(18.0, 21.0, 601)
    alpha, nu = WEAVE.increments(t)
    a2, n2 = WEAVE.increments(np.sort(np.append(t, [18.0012, 19.99999, 20.7001])))
    np.testing.assert_allclose(nu.sum(axis=0), n2.sum(axis=0), atol=1e-11)
    np.testing.assert_allclose(alpha.sum(axis=0), a2.sum(axis=0), atol=1e-13)


def test_antenna_velocity_is_the_derivative_of_its_position():
    lever = np.array([1.5, -0.4, -2.0])
    t = np.array([-1.0, 7.0, 13.0, 18.3, 30.0])
    r, v = WEAVE.antenna(t, lever)
    moved = derivative(lambda u: WEAVE.antenna(u, lever)[0], t)
    np.testing.assert_allclose(moved, v, atol=1.5 * ULP / 2e-3)
    arm = np.linalg.norm(r - WEAVE.at(t).r_eb_e, axis=1)
    np.testing.assert_allclose(arm, np.linalg.norm(lever), atol=2 * ULP)


def test_last_segment_holds_beyond_the_duration():
    accelerating = [Segment(0, 50, 20, 20)]
    beyond = Trajectory.from_profile(START, 0.0, 200.0, accelerating, duration_s=50.0)
    coasting = Trajectory.from_profile(START, 0.0, 200.0, accelerating)
    assert beyond.speed(50.5) == 1210.0
    assert coasting.speed(50.5) == 1200.0
    assert beyond.speed(-0.5) == 190.0
    assert beyond.first_jump_s is None
    assert coasting.first_jump_s == 50.0


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Segment(3, 2), "t1 must be later"),
        (lambda: Segment(0, 2, np.nan), "finite"),
        (
            lambda: Trajectory.from_profile(START, 0, 1, [Segment(0, 2), Segment(1, 3)]),
            "expected t0",
        ),
        (lambda: Trajectory.from_profile((39.9, 1, 0), 0, 1), "lat rad"),
        (lambda: Trajectory.from_profile(START, np.inf, 1), "heading_rad = inf"),
        (
            lambda: Trajectory.from_profile(START, 0, 1, [Segment(1, 2, 0, 0, 1, 1)], banked=True),
            "turn rate jumps",
        ),
        (lambda: JUMP.increments([1.0, 1.0]), "increasing"),
    ],
)
def test_refusals(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_a_loop_in_a_vertical_plane() -> None:
    """Heading 30 deg, 100 m/s upwards from level at 0.4 rad/s: a circle of 250 m.

    The body's nose is the velocity, its right horizontal and unchanged, and it pitches.
    """
    w, v, heading = 0.4, 100.0, np.radians(30.0)
    loop = Trajectory.from_profile(START, heading, v, [Segment(0, 30, 0, 0, w, w)], climb_rad=0.0)
    quarter, half = (plane(loop, k * np.pi / 2 / w) for k in (1, 2))
    radius = v / w
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    np.testing.assert_allclose(quarter, radius * (ahead - [0, 0, 1]), atol=4 * ULP)
    np.testing.assert_allclose(half, [0, 0, -2 * radius], atol=4 * ULP)
    m = loop.at(2.0)
    C_b_n = loop.C_n_e.T @ m.C_b_e
    c, s = np.cos(2.0 * w), np.sin(2.0 * w)
    np.testing.assert_allclose(C_b_n[:, 0], c * ahead - [0, 0, s], atol=1e-14)
    np.testing.assert_allclose(C_b_n[:, 1], [-np.sin(heading), np.cos(heading), 0.0], atol=1e-14)
    np.testing.assert_allclose(C_b_n[:, 2], s * ahead + [0, 0, c], atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(C_b_n), 1.0)
    np.testing.assert_allclose(m.omega_eb_b, [0.0, w, 0.0], atol=1e-16)
    np.testing.assert_allclose(derivative(lambda t: loop.at(t).v_eb_e, 2.0), m.a_eb_e, rtol=1e-9)
    np.testing.assert_allclose(
        derivative(lambda t: loop.at(t).C_b_e, 2.0), m.C_b_e @ skew(m.omega_eb_b), atol=1e-9
    )


def test_a_bank_in_a_vertical_plane_is_refused() -> None:
    with pytest.raises(ValueError, match="climb_rad"):
        Trajectory.from_profile(START, 0.0, 100.0, banked=True, climb_rad=1.0)
