"""Angles, slopes and the misalignment's course: closed forms, differences, scipy's rotations."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ultratight.ins.attitude import euler_from_rotation
from ultratight.ins.star_tracker import (
    angles_of,
    difference,
    misalign,
    predicted,
    run_free,
    slope,
    turn_between,
    turned_by,
    wrapped,
)


def attitudes(seed, n=1):
    """Random, heading within 60 deg: at 90 deg roll and pitch are one."""
    rng = np.random.default_rng(seed)
    turns = rng.uniform([-np.pi, -1.0, -np.pi], [np.pi, 1.0, np.pi], (n, 3))
    return Rotation.from_euler("xyz", turns).as_matrix(), turns


def h(C, phi):
    Z = np.empty((3, 1))
    predicted(C, np.ascontiguousarray(phi).reshape(3, 1), Z)
    return Z[:, 0]


@pytest.mark.nojit
def test_angles_are_those_of_the_attitude_module():
    C, turns = attitudes(1, 50)
    np.testing.assert_allclose(angles_of(C), turns, atol=1e-13)
    np.testing.assert_allclose(angles_of(C), euler_from_rotation(C), atol=1e-14)


@pytest.mark.nojit
@pytest.mark.parametrize("seed", range(5))
def test_slope_without_misalignment_is_the_inverse_of_the_rates_matrix(seed):
    """M of (19), corrected: columns are the axes that pitch, heading and roll turn about."""
    C, turns = attitudes(seed)
    _, psi, phi = turns[0]
    M = np.array([
        [np.cos(psi) * np.cos(phi), -np.sin(phi), 0.0],
        [np.cos(psi) * np.sin(phi), np.cos(phi), 0.0],
        [-np.sin(psi), 0.0, 1.0],
    ])  # fmt: skip
    G = np.empty((3, 3))
    slope(C[0], np.zeros(3), G)
    np.testing.assert_allclose(M @ G, -np.eye(3), atol=1e-14)


@pytest.mark.nojit
@pytest.mark.parametrize("size", [0.0, 1e-4, 0.2, 0.4])
def test_slope_is_that_of_the_prediction(size):
    """Central differences; 0.4 rad is 23 deg, twice what a first fix may find."""
    rng = np.random.default_rng(7)
    for C in attitudes(3, 5)[0]:
        phi, G = size * rng.standard_normal(3) / 2.0, np.empty((3, 3))
        slope(C, phi, G)
        d = 1e-5 * np.eye(3)
        expected = [wrapped(h(C, phi + d[j]) - h(C, phi - d[j])) / 2e-5 for j in range(3)]
        np.testing.assert_allclose(G, np.transpose(expected), atol=3e-9)


@pytest.mark.nojit
def test_points_across_a_half_turn_stay_together():
    """Roll near 180 deg: values of h differ by what the points do, not by 2 pi."""
    C = Rotation.from_euler("xyz", [np.pi - 1e-3, 0.0, 0.0]).as_matrix()
    Y, Z = np.zeros((3, 3)), np.empty((3, 3))
    Y[0] = [np.pi - 1e-3, np.pi + 1e-3, np.pi + 2e-3]
    predicted(C, Y, Z)
    np.testing.assert_allclose(Z[0] - Z[0, 0], -(Y[0] - Y[0, 0]), atol=1e-12)


@pytest.mark.nojit
@pytest.mark.parametrize("size", [0.0, 1e-4, 0.3])
def test_misalignment_keeps_pace_with_both_attitudes(size):
    """C_true = exp([phi x]) C_ins before and after, the INS led astray by a drift of its gyros."""
    rng = np.random.default_rng(5)
    C = attitudes(4)[0][0]
    eps, rate, tau = 0.01 * rng.standard_normal(3), rng.standard_normal(3), 0.01
    mean = np.concatenate([size * rng.standard_normal(3), eps, np.zeros(3)])
    turn = Rotation.from_rotvec(mean[:3])
    after = C @ Rotation.from_rotvec(tau * (rate + eps)).as_matrix()
    true = turn.as_matrix() @ C @ Rotation.from_rotvec(tau * rate).as_matrix()
    expected = Rotation.from_matrix(true @ after.T).as_rotvec()
    Phi = np.eye(9)
    found = misalign(C, after, tau, mean, Phi)
    # the mean of both ends stands for the interval: second order in its turn of 0.01 rad
    np.testing.assert_allclose(found - mean[:3], expected - mean[:3], atol=2e-6 * tau)
    for j in range(3):
        d = np.zeros(9)
        d[3 + j] = 1e-4
        room = np.eye(9)
        more, less = (misalign(C, after, tau, mean + s * d, room) for s in (1.0, -1.0))
        np.testing.assert_allclose(Phi[:3, 3 + j], (more - less) / 2e-4, atol=1e-4 * tau)


@pytest.mark.nojit
def test_running_free_and_turning():
    rng = np.random.default_rng(2)
    C, alpha = attitudes(6)[0][0], 0.1 * rng.standard_normal((6, 3))
    expected = [Rotation.from_matrix(C)]
    for a in alpha:
        expected.append(expected[-1] * Rotation.from_rotvec(a))
    found = run_free(C, alpha, 2)
    for k in range(4):
        np.testing.assert_allclose(found[k], expected[2 * k].as_matrix(), atol=1e-14)
    phi = 0.5 * rng.standard_normal((4, 3))
    np.testing.assert_allclose(turn_between(turned_by(phi, found), found), phi, atol=1e-14)
    np.testing.assert_allclose(
        turned_by(phi, found), Rotation.from_rotvec(phi).as_matrix() @ found, atol=1e-14
    )
    z = difference(found, turned_by(phi, found))
    np.testing.assert_allclose(z, [h(C, p) for C, p in zip(found, phi, strict=True)], atol=1e-14)


@pytest.mark.nojit
def test_bad_input():
    good = np.eye(3)
    for C, alpha, every in (
        (np.eye(2), np.zeros((4, 3)), 1), (good, np.zeros((4, 2)), 1), (good, np.zeros((4, 3)), 3),
        (good, np.zeros((4, 3)), 0), (good, np.zeros((0, 3)), 1),
    ):  # fmt: skip
        with pytest.raises(ValueError, match="expected"):
            run_free(C, alpha, every)
    with pytest.raises(ValueError, match="phi, C_b_i"):
        turned_by(np.zeros((2, 3)), good[None])
    assert math.isclose(wrapped(np.array([3.0 * np.pi / 2.0]))[0], -np.pi / 2.0)
