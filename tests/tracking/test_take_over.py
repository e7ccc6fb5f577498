"""What a closure is told at its start: delays in clocks, lever arms, time that begins later."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from signals.atmosphere import ionosphere_delay_m, troposphere_delay_m
from signals.nco import Nco, Taps
from signals.propagation import elevation_azimuth, pseudorange
from ultratight.ins.earth import geodetic_from_ecef
from ultratight.ins.error_state import ProcessNoise
from ultratight.tracking.from_samples import Tracks
from ultratight.tracking.navigation import Navigation, navigate
from ultratight.tracking.take_over import Inertial, Later, estimates, knows_at

NOISE = ProcessNoise(1e-6, 1e-9, 1e-12, 1e-14, 0.01, 0.04)


@pytest.fixture(scope="module")
def nav(make_tracks: Callable[..., Tracks]) -> Navigation:
    """Until page 18 has come, at 475260, whose ionosphere the message then corrects."""
    return navigate(make_tracks(35.0, tow_s=475_250.0, prns=[2, 6, 12, 17, 19, 28]))


def test_the_delays_are_in_the_satellites_clocks(nav: Navigation) -> None:
    """Pseudoranges by the changed elements are those by the old ones and the models' delays.

    At the start, after one and after two minutes the parabola goes through them.  In between it
    misses the kink with which Klobuchar's cosine ends in the evening: 2 cm for one satellite.
    """
    position = estimates(nav)[-1][0]
    t_s = position.t_s + 0.004
    told = [
        knows_at(nav, position, t_s, 120.0, NOISE, atmosphere=a).elements for a in (True, False)
    ]
    knows = knows_at(nav, position, t_s, 120.0, NOISE, atmosphere=True)
    r, zero = knows.r_eb_e, np.zeros(3)
    lat, lon, h = geodetic_from_ecef(r)
    for after, within_m in ((0.0, 1e-3), (13.0, 0.03), (60.0, 1e-3), (120.0, 1e-3)):
        tow = knows.start_tow_s + after
        late, plain = (
            np.array([pseudorange(row, tow, r, zero, 0.0, 0.0) for row in rows]) for rows in told
        )
        elevation, azimuth = elevation_azimuth(r, plain[:, 2:])
        expected = troposphere_delay_m(lat, h, elevation)
        expected = expected + ionosphere_delay_m(
            lat, lon, azimuth, elevation, tow, nav.sky.iono_utc.alpha, nav.sky.iono_utc.beta
        )
        assert expected.max() > 4.0
        np.testing.assert_allclose(late[:, 0] - plain[:, 0], expected, atol=within_m)
        # centimetres a second in the rate, too
        np.testing.assert_allclose(late[:, 1], plain[:, 1], atol=0.05)


def test_the_state_is_that_of_the_position_filter(nav: Navigation) -> None:
    """4 ms later, and of an IMU 2 m before and 1 m below the antenna that turns with 0.5 rad/s."""
    position, estimate = estimates(nav)[-1]
    x = estimate.state
    C = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    own = Inertial(
        C, np.full(3, 0.01), 0.02, 1e-4, lever_b_m=np.array([-2.0, 0.0, -1.0]),
        omega_eb_b=np.array([0.0, 0.0, 0.5]),
    )  # fmt: skip
    knows = knows_at(nav, position, position.t_s + 0.004, 10.0, NOISE, inertial=own)
    assert knows.start_tow_s == pytest.approx(position.tow_s + 0.004, abs=1e-9)
    # C (-2, 0, -1) = (0, -2, -1); C (omega x lever) = C (0, -1, 0) = (1, 0, 0)
    np.testing.assert_allclose(knows.r_eb_e, x[:3] + 0.004 * x[4:7] - [0.0, -2.0, -1.0], atol=1e-6)
    np.testing.assert_allclose(knows.v_eb_e, x[4:7] - [1.0, 0.0, 0.0], atol=1e-9)
    assert knows.clock_m == pytest.approx(x[3] + 0.004 * x[7], abs=1e-9)
    sigma = np.sqrt(np.diag(estimate.cov))
    np.testing.assert_allclose(
        knows.sigma,
        [*sigma[:3], *sigma[4:7], *[0.01] * 3, *[0.02] * 3, *[1e-4] * 3, sigma[3], sigma[7]],
    )
    assert knows.data_bits is None
    assert len(knows.prn) == estimate.used.sum()


def test_a_correlator_whose_time_begins_later() -> None:
    """Commands are moved on, what comes back is moved back; nothing else changes."""
    seen = []

    class Echo:
        offset_chips = np.zeros(1)

        def __call__(self, nco: Nco) -> Taps:
            seen.append(nco)
            one = np.ones(1)
            number, t = np.zeros(1, np.int64), nco.t_s
            return Taps(number, number, t[:1], t[1:], one[:, None] + 0j, *[one] * 5)

    n = np.zeros((1, 1))
    command = Nco(np.array([0.5, 0.52]), n, n, n, n, n, np.ones(1, np.int64), np.ones(1, bool))
    taps = Later(Echo(), 21.6)(command)
    np.testing.assert_allclose(seen[0].t_s, [22.1, 22.12])
    np.testing.assert_allclose([taps.t_start_s[0], taps.t_end_s[0]], [0.5, 0.52])
    assert seen[0]._replace(t_s=command.t_s) == command
