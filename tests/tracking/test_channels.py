"""Public facts of the channels, against the signals' documents and their codes."""

import numpy as np
import pytest

from signals.codes import (
    BEIDOU_B1CP,
    GALILEO_E5AQ,
    GPS_L1CA,
    GPS_L1CD,
    GPS_L1CP,
    GPS_L2CL,
    GPS_L5I,
    GPS_L5Q,
)
from signals.constants import C_MPS
from ultratight.tracking.channels import channels

ROWS = [GPS_L1CA, GPS_L5I, GPS_L5Q, GPS_L1CD, GPS_L1CP, GPS_L2CL, GALILEO_E5AQ, BEIDOU_B1CP]
TOW = 475_220.0


@pytest.fixture(scope="module")
def facts():
    return channels(ROWS, [7] * len(ROWS), TOW)


def test_integrations_are_half_of_a_symbol_or_ten_milliseconds(facts):
    ms = 1e3 * facts.half_s
    np.testing.assert_allclose(ms, [10, 5, 10, 5, 10, 10, 10, 10], rtol=1e-12)
    assert facts.pilot.tolist() == [False, False, True, False, True, True, True, True]
    np.testing.assert_allclose(facts.wavelength_m * facts.carrier_hz, C_MPS)


def test_correlation_is_the_codes_own_at_its_steps(facts):
    for i, row in enumerate(ROWS):
        n = row.per_chip
        np.testing.assert_array_equal(
            facts.correlation[i, : n + 1], row.autocorrelation(7)[: n + 1]
        )
        assert (facts.correlation[i, n:] == facts.correlation[i, n]).all()


def test_overlays_stand_at_the_time_of_the_week(facts):
    # IS-GPS-800 3.2.2.1.2: the overlay of 18 s begins with the week; symbol 0 is the one under way
    chip = round(TOW / 0.01) % 1800
    expected = np.roll(GPS_L1CP.secondary_chips(7), -chip)
    np.testing.assert_array_equal(facts.pilot_symbols(4, np.arange(1800)), expected)
    assert facts.pilot_symbols(4, np.array([-1]))[0] == GPS_L1CP.secondary_chips(7)[chip - 1]
    # BeiDou's week begins 14 s after that of GPS
    chip = round((TOW - 14.0) / 0.01) % 1800
    expected = np.roll(BEIDOU_B1CP.secondary_chips(7), -chip)
    np.testing.assert_array_equal(facts.pilot_symbols(7, np.arange(1800)), expected)
    # NH20 and CS100 are in the replica
    for i in (2, 5, 6):
        assert (facts.pilot_symbols(i, np.arange(-5, 5)) == 1).all()
