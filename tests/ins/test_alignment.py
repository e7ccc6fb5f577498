"""Attitude at the start: the truth is that of a trajectory, the IMU's data its exact increments."""

from __future__ import annotations

import numpy as np
import pytest

from ultratight.ins.alignment import SLIP_SIGMA, align
from ultratight.ins.attitude import vector_from_rotation
from ultratight.ins.imu import Increments
from ultratight.ins.trajectory import Segment, Trajectory

PLACE = float(np.radians(39.9)), float(np.radians(116.4)), 500.0
T = np.arange(21) * 0.1 + 1.0


def moving(
    speed: float, *segments: Segment, place: tuple[float, float, float] = PLACE
) -> tuple[Trajectory, Increments]:
    """Three seconds of a drive towards 70 deg, and what an IMU of 200 Hz reports."""
    way = Trajectory.from_profile(place, np.radians(70.0), speed, segments)
    t = np.arange(601) * 0.005
    return way, Increments(t, *way.increments(t))


def off(C: np.ndarray, way: Trajectory) -> np.ndarray:
    """Rotation vector between an attitude and the true one at the last velocity (3,), ECEF."""
    return vector_from_rotation(way.at(T[-1]).C_b_e @ C.T)


@pytest.mark.parametrize(
    "segments",
    [(), (Segment(0.0, 9.0, 4.0, 4.0, 0.2, 0.2),), (Segment(1.5, 9.0, -6.0, 3.0, 0.0, 0.4),)],
    ids=["straight", "curve", "braking into a curve"],
)
def test_attitude_of_a_body_that_moves(segments: tuple[Segment, ...]) -> None:
    """Exact but for the Earth's turn, 0.15 mrad in the window, and velocities taken linear."""
    way, imu = moving(20.0, *segments)
    m = way.at(T)
    found = align(imu, T, m.r_eb_e[-1], m.v_eb_e, 0.01)
    assert np.linalg.norm(off(found.C_b_e, way)) < 3e-4
    # the course is believed to a degree; a force that turns says more than it
    assert found.sigma.max() < 1.1 * SLIP_SIGMA
    assert (found.sigma.max() < 0.5 * SLIP_SIGMA) == bool(segments)


@pytest.mark.parametrize("bias_sigma", [0.0, 0.02])
def test_sigma_is_what_noise_and_bias_do(bias_sigma: float) -> None:
    """100 draws: velocity noise of 5 cm/s, accelerometers of 2 mg, a slip of a degree.

    On the equator, where the axes of ECEF are up, east and north: heading and both tilts.
    """
    way, imu = moving(25.0, place=(0.0, 0.0, 500.0))
    m = way.at(T)
    rng = np.random.default_rng(5)
    normalised = []
    for _ in range(100):
        v = m.v_eb_e + 0.05 * rng.standard_normal((len(T), 3))
        bias = bias_sigma * rng.standard_normal(3) * 0.005
        slip = SLIP_SIGMA * rng.standard_normal(2)
        # the body turned under its course, and with it what it feels
        turned = np.array([[1, -slip[0], slip[1]], [slip[0], 1, 0], [-slip[1], 0, 1]])
        felt = imu._replace(nu_ib_b=imu.nu_ib_b @ turned + bias, alpha_ib_b=imu.alpha_ib_b @ turned)
        found = align(felt, T, m.r_eb_e[-1], v, 0.05, bias_sigma)
        true = way.at(T[-1]).C_b_e @ turned
        normalised.append(vector_from_rotation(true @ found.C_b_e.T) / found.sigma)
    rms = np.sqrt(np.mean(np.square(normalised), axis=0))
    np.testing.assert_allclose(rms, 1.0, atol=4.0 / np.sqrt(200.0))


def test_a_slow_body_has_no_heading_but_is_level() -> None:
    way, imu = moving(0.05)
    m = way.at(T)
    found = align(imu, T, m.r_eb_e[-1], m.v_eb_e, 0.02)
    assert found.sigma.max() > np.radians(10.0)
    up = -way.C_n_e[:, 2]
    assert off(found.C_b_e, way) @ up == pytest.approx(
        np.linalg.norm(off(found.C_b_e, way)), abs=2e-3
    )


def test_what_cannot_be_levelled_by() -> None:
    way, imu = moving(20.0)
    m = way.at(T)
    r, v = m.r_eb_e[-1], m.v_eb_e
    with pytest.raises(ValueError, match="4 velocities to level by, expected 5 at least"):
        align(imu, T[-4:], r, v[-4:], 0.02)
    with pytest.raises(ValueError, match=r"from 0.000 to 3.000 s: expected 1.500 to 3.500 s"):
        align(imu, T + 0.5, r, v, 0.02)
    milli = imu._replace(nu_ib_b=1.2 * imu.nu_ib_b)
    with pytest.raises(ValueError, match=r"force is 11.7. m/s2, the GNSS velocities ask for 9.7"):
        align(milli, T, r, v, 0.02)
    falling = v + np.outer(T - T[0], 9.8 * way.C_n_e[:, 2])
    with pytest.raises(ValueError, match="nothing to level by"):
        align(imu, T, r, falling, 0.02)
