"""Local-level mechanisation: laws, an independent run in ECEF, the error model by differences."""

import numpy as np
import pytest

from ultratight.ins import earth, strapdown
from ultratight.ins.attitude import rotation_from_vector
from ultratight.ins.imu import Increments
from ultratight.ins.local_level import (
    N_ERRORS,
    Navigation,
    advance,
    correct,
    follow,
    radii,
    rotation_from_attitude,
)

DT = 0.005
LAT, LON = np.radians(34.27), np.radians(108.95)


def turning(seconds=20.0):
    """Climb, bank and turn at once."""
    t = np.arange(round(seconds / DT) + 1) * DT
    attitude = np.stack([0.1 * np.sin(0.3 * t), 0.2 * np.sin(0.2 * t), 0.05 * t], axis=1)
    return follow(DT, attitude, 60.0 + 2.0 * t, (LAT, LON, 380.0))


def state_of(path, k=0):
    return Navigation(
        rotation_from_attitude(*path.attitude[k]), path.v[k].copy(), path.p[k].copy(), np.zeros(3),
        np.zeros(3),
    )  # fmt: skip


def test_error_free_increments_leave_no_error():
    path = turning()
    state = state_of(path)
    for k in range(0, len(path.alpha), 200):
        advance(state, path.alpha[k : k + 200], path.nu[k : k + 200], DT, (0.0, 0.0), 20)
    np.testing.assert_allclose(state.v, path.v[-1], atol=1e-11)
    RM, RN = radii(LAT, 380.0)
    assert np.all(np.abs(state.p - path.p[-1]) * [RM, RN * np.cos(LAT), 1.0] < 1e-7)
    np.testing.assert_allclose(state.C, rotation_from_attitude(*path.attitude[-1]), atol=1e-13)


def test_the_ecef_mechanisation_agrees():
    """Another frame, gravity model and integrator: 20 s, to the models' difference of gravity.

    Normal gravity (Somigliana, cubic in height) against J2 differs by up to 1.2e-4 m/s2
    (`earth.gravity_at`): 0.5 * 1.2e-4 * 20^2 = 0.024 m and 2.4e-3 m/s; the integrators' share is
    below.
    """
    path = turning()
    enu = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # its own inverse: north-east-down
    frd = enu
    n_e = [earth.rotation_e_from_n(*path.p[k, :2]) for k in (0, -1)]
    start = strapdown.NavState(
        0.0, earth.ecef_from_geodetic(*path.p[0]), n_e[0] @ enu @ path.v[0],
        n_e[0] @ enu @ rotation_from_attitude(*path.attitude[0]) @ frd,
    )  # fmt: skip
    t = np.arange(len(path.alpha) + 1) * DT
    end = strapdown.propagate(start, Increments(t, path.alpha @ frd, path.nu @ frd))
    assert np.linalg.norm(end.r_eb_e - earth.ecef_from_geodetic(*path.p[-1])) < 0.03
    v = enu @ n_e[1].T @ end.v_eb_e
    np.testing.assert_allclose(v, path.v[-1], atol=4e-3)
    C = enu @ n_e[1].T @ end.C_b_e @ frd
    np.testing.assert_allclose(C, rotation_from_attitude(*path.attitude[-1]), atol=2e-7)


def test_transition_is_the_mechanisation_by_differences():
    """One second of the nonlinear equations from each of 15 small errors, both signs."""
    path = turning(2.0)
    alpha, nu = path.alpha[:200], path.nu[:200]
    true = state_of(path)
    Phi, _ = advance(true, alpha, nu, DT, (0.0, 0.0), 20)
    size = np.array([1e-5] * 3 + [1e-2] * 3 + [1e-6, 1e-6, 10.0] + [1e-6] * 3 + [1e-3] * 3)
    found = np.empty((N_ERRORS, N_ERRORS))
    for j in range(N_ERRORS):
        ends = []
        for sign in (1.0, -1.0):
            x = np.zeros(N_ERRORS)
            x[j] = sign * size[j]
            state = state_of(path)
            correct(state, -np.concatenate([x[:9], np.zeros(6)]))
            # measured = true + bias
            advance(state, alpha + x[9:12] * DT, nu + x[12:15] * DT, DT, (0.0, 0.0), 20)
            turn = state.C @ true.C.T
            phi = -0.5 * np.array(
                [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
            )
            ends.append(np.concatenate([phi, state.v - true.v, state.p - true.p, x[9:]]))
        found[:, j] = (ends[0] - ends[1]) / (2.0 * size[j])
    scale = np.sqrt(np.array([1e-4, 1e-1, 1e-6, 1e-5, 1e-2]))[[0] * 3 + [1] * 3 + [2] * 3
                                                              + [3] * 3 + [4] * 3]  # fmt: skip
    scaled = scale / scale[:, None]
    scaled[8] = scaled[8] / 1e3  # metres
    miss = np.abs(found - Phi) * scaled
    assert miss.max() < 2e-3 * (np.abs(Phi) * scaled).max()
    # every block on its own scale; those below rounding of the differences are left to the above
    for rows, columns, rel in (
        ((0, 3), (0, 3), 1e-6), ((3, 6), (0, 3), 1e-3), ((3, 6), (3, 6), 1e-6),
        ((6, 9), (3, 6), 1e-5), ((0, 3), (9, 12), 1e-3), ((3, 6), (12, 15), 1e-3),
    ):  # fmt: skip
        a, b = found[slice(*rows), slice(*columns)], Phi[slice(*rows), slice(*columns)]
        assert np.abs(a - b).max() < rel * np.abs(b).max(), (rows, columns)


def test_noise_of_a_second_is_that_of_its_parts():
    """Q over a step is Phi Q Phi' + Q, and its diagonal begins as density times time."""
    path = turning(2.0)
    state, other = state_of(path), state_of(path)
    whole = advance(state, path.alpha[:40], path.nu[:40], DT, (1e-10, 1e-6), 20)
    one = advance(other, path.alpha[:20], path.nu[:20], DT, (1e-10, 1e-6), 20)
    two = advance(other, path.alpha[20:40], path.nu[20:40], DT, (1e-10, 1e-6), 20)
    np.testing.assert_allclose(whole[0], two[0] @ one[0], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(whole[1], two[0] @ one[1] @ two[0].T + two[1], rtol=1e-7, atol=1e-22)
    np.testing.assert_allclose(np.diag(one[1])[:6], [1e-11] * 3 + [1e-7] * 3, rtol=1e-14)
    assert np.array_equal(whole[1], whole[1].T)


def test_corrections_take_errors_out():
    path = turning(1.0)
    state = state_of(path)
    x = np.array([1e-3, -2e-3, 3e-3, 1.0, 2.0, 3.0, 1e-6, 2e-6, 3.0, 1e-6, 0, 0, 0, 1e-3, 0])
    state.C[:] = rotation_from_vector(-x[:3]) @ state.C
    state.v[:], state.p[:] = state.v + x[3:6], state.p + x[6:9]
    correct(state, x)
    np.testing.assert_allclose(state.C, rotation_from_attitude(*path.attitude[0]), atol=1e-14)
    np.testing.assert_allclose(state.v, path.v[0], atol=1e-12)
    np.testing.assert_array_equal(state.accel_bias, x[12:])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"dt_s": 0.0}, "dt_s, attitude"), ({"speed_mps": [1.0, np.nan]}, "expected finite"),
        ({"attitude": np.zeros((3, 3))}, "attitude, speed"),
        ({"p0": (np.radians(89.9), 0.0, 0.0)}, "latitudes of"),
    ],
)  # fmt: skip
def test_refusals(change, said):
    good = {"dt_s": DT, "attitude": np.zeros((2, 3)), "speed_mps": [1.0, 1.0], "p0": (0, 0, 0)}
    with pytest.raises(ValueError, match=said):
        follow(**(good | change))
    path = turning(1.0)
    with pytest.raises(ValueError, match="per_step: 7"):
        advance(state_of(path), path.alpha, path.nu, DT, (0.0, 0.0), 7)
