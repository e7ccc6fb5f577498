"""Rotations: group laws, and scipy's Rotation and expm as independent oracles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm, polar
from scipy.spatial.transform import Rotation

from ultratight.ins.attitude import (
    euler_from_rotation,
    orthonormalise,
    rotation_from_euler,
    rotation_from_vector,
    skew,
    turn_left,
    turn_right,
    vector_from_rotation,
)

pytestmark = pytest.mark.nojit

ANGLE = st.floats(-3.1, 3.1)
VECTOR = st.tuples(*[st.floats(-1.7, 1.7)] * 3).map(np.array)


@given(VECTOR, VECTOR)
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-15)


@given(VECTOR)
def test_rotation_from_vector_is_the_exponential(phi):
    np.testing.assert_allclose(rotation_from_vector(phi), expm(skew(phi)), atol=4e-15)


@pytest.mark.parametrize("length", [0.0, 1e-12, 1e-6, 0.00999, 0.01001, 1.0, 3.14159, np.pi])
def test_vector_round_trip_at_every_length(length):
    phi = length * np.array([2.0, -1.0, 2.0]) / 3.0
    C = rotation_from_vector(phi)
    np.testing.assert_allclose(C @ C.T, np.eye(3), atol=1e-15)
    back = vector_from_rotation(C)
    # at pi the axis has no sign
    np.testing.assert_allclose(back * np.sign(back @ phi or 1.0), phi, rtol=1e-14, atol=1e-15)


@given(VECTOR)
def test_vector_round_trip(phi):
    np.testing.assert_allclose(vector_from_rotation(rotation_from_vector(phi)), phi, atol=1e-13)


@given(ANGLE, st.floats(-1.55, 1.55), ANGLE)
def test_euler_round_trip_and_oracle(roll, pitch, yaw):
    C = rotation_from_euler(roll, pitch, yaw)
    np.testing.assert_allclose(
        C, Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), atol=1e-15
    )
    np.testing.assert_allclose(euler_from_rotation(C), [roll, pitch, yaw], atol=1e-13)


def test_euler_signs():
    """A positive yaw turns the nose east, pitch lifts it, roll lowers the right wing."""
    np.testing.assert_allclose(
        rotation_from_euler(0, 0, np.pi / 2) @ [1, 0, 0], [0, 1, 0], atol=1e-16
    )
    np.testing.assert_allclose(
        rotation_from_euler(0, 0.1, 0) @ [1, 0, 0], [np.cos(0.1), 0, -np.sin(0.1)]
    )
    np.testing.assert_allclose(
        rotation_from_euler(0.1, 0, 0) @ [0, 1, 0], [0, np.cos(0.1), np.sin(0.1)]
    )


@given(VECTOR, st.integers(0, 2**32 - 1))
def test_orthonormalise_is_the_polar_factor(phi, seed):
    C = rotation_from_vector(phi) + 0.05 * np.random.default_rng(seed).standard_normal((3, 3))
    np.testing.assert_allclose(orthonormalise(C), polar(C)[0], atol=4e-15)


@given(VECTOR, VECTOR)
def test_turns_in_place_are_products_with_the_exponential(phi, psi):
    C = expm(skew(psi))
    left, right = C.copy(), C.copy()
    turn_left(*phi, left)
    turn_right(right, *phi)
    np.testing.assert_allclose(left, expm(skew(phi)) @ C, atol=6e-15)
    np.testing.assert_allclose(right, C @ expm(skew(phi)), atol=6e-15)
