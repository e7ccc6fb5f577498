"""Vibration: derivatives of each other, the power and the band asked for, what an IMU feels."""

import numpy as np
import pytest

from signals.constants import STANDARD_GRAVITY
from ultratight.ins.trajectory import Trajectory
from ultratight.ins.vibration import Vibrating, Vibration

START = (np.radians(39.9), np.radians(116.4), 8000.0)
CALM = Trajectory.from_profile(START, 0.7, 200.0)
SHAKE = Vibration(2.0, 22.0, 0.7, 5.0, 50.0)
SHAKEN = Vibrating(CALM, [SHAKE])


def moved(t, part):
    return (getattr(SHAKEN.at(t), part) - getattr(CALM.at(t), part)) @ CALM.C_n_e


def test_velocity_and_acceleration_are_the_derivatives() -> None:
    """Five-point formula at h = 0.2 ms, through the rise and the fall too.

    Its error is h^4 f5 / 30, 1e-9 of f' at 50 Hz; where the rise begins or ends, a third of h times
    the jump of a', 60 / 0.25^3 of a millimetre: 1e-4 m/s2 at most.  Positions of 6.4e6 m round to
    1e-9 m, which h divides: 1e-5 m/s.
    """
    t, h = np.concatenate([np.linspace(1.99, 2.4, 211), np.linspace(21.6, 22.01, 211)]), 2e-4
    for whole, slope, atol in (("r_eb_e", "v_eb_e", 2e-5), ("v_eb_e", "a_eb_e", 1e-4)):
        near = [moved(t + k * h, whole) for k in (-2, -1, 1, 2)]
        found = (near[0] - 8 * near[1] + 8 * near[2] - near[3]) / (12 * h)
        np.testing.assert_allclose(found, moved(t, slope), rtol=1e-6, atol=atol)
        assert np.abs(moved(t, slope)).max() > 0.01
    for part in ("r_eb_e", "v_eb_e", "a_eb_e"):
        np.testing.assert_array_equal(moved(np.array([0.0, 2.0, 22.0, 30.0]), part), 0.0)
    np.testing.assert_array_equal(SHAKEN.at(t).C_b_e, CALM.at(t).C_b_e)


def test_power_and_band() -> None:
    """0.7 g r.m.s. per axis, nothing outside 5-50 Hz.  Beats of the 16 lines, 2.8 Hz apart, leave
    the mean square of 19 s uncertain by a few per cent."""
    t = np.arange(2.5, 21.5, 0.001)
    a = moved(t, "a_eb_e")
    np.testing.assert_allclose(np.sqrt((a**2).mean(axis=0)), 0.7 * STANDARD_GRAVITY, rtol=0.06)
    window = np.hanning(t.size)[:, None]
    power = np.abs(np.fft.rfft(a * window, axis=0)) ** 2
    f = np.fft.rfftfreq(t.size, 0.001)
    outside = (f < 4.5) | (f > 50.5)
    assert power[outside].sum() < 1e-4 * power.sum()
    correlation = np.corrcoef(a.T)
    assert np.abs(correlation[np.triu_indices(3, 1)]).max() < 0.6  # phases of its own per axis


def test_imu_feels_what_the_antenna_does() -> None:
    """Body axes fixed to the Earth: the increments less the calm ones sum to the velocity."""
    t = np.arange(1.9, 22.2, 0.005)
    nu = SHAKEN.increments(t)[1] - CALM.increments(t)[1]
    velocity = np.cumsum(nu, axis=0) @ CALM.at(0.0).C_b_e.T
    shaken = SHAKEN.at(t[1:]).v_eb_e - CALM.at(t[1:]).v_eb_e
    # gravity at the displaced place and the Coriolis force: 1e-4 m/s2 in all
    np.testing.assert_allclose(velocity, shaken, atol=2e-4)
    assert np.abs(shaken).max() > 0.1


@pytest.mark.parametrize(
    "numbers", [(2.0, 2.4, 1.0, 5.0, 50.0), (0.0, 5.0, -1.0, 5.0, 50.0), (0.0, 5.0, 1.0, 50.0, 5.0),
                (0.0, 5.0, np.nan, 5.0, 50.0)],
)  # fmt: skip
def test_what_means_nothing_is_refused(numbers) -> None:
    with pytest.raises(ValueError, match=r"expected|finite"):
        Vibration(*numbers)
