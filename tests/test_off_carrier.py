"""Lock judged by the truth: how far each NCO is off the true carrier, and since when."""

from __future__ import annotations

import numpy as np

from ultratight import load, run
from ultratight.metrics import off_carrier_s


def test_ten_rows_in_a_row() -> None:
    """25 Hz for 0.2 s in rows of 20 ms; shorter, or with a gap, is no loss; no number is one."""
    t = 0.02 * np.arange(1, 101)
    error = np.zeros((100, 5))
    error[30:39, 0] = 40.0  # nine rows
    error[30:40, 1] = -26.0  # ten
    error[30:50, 2], error[39, 2] = 26.0, 24.0  # ten after the gap
    error[95:, 3] = np.nan  # ends too early
    error[60:, 4] = np.nan
    found = off_carrier_s(t, error)
    np.testing.assert_allclose(found, [np.nan, t[30], t[40], np.nan, t[60]])
    assert np.isnan(off_carrier_s(t[:5], error[:5])).all()


def test_a_clock_that_runs_off_takes_its_carrier_with_it() -> None:
    """10 m/s are 52.6 Hz; the filter follows the other nine satellites, NCO of G09 with them."""
    fault = {"t0_s": 0.4, "prns": [9], "pseudorange_rate_mps": 10.0}
    keys = {"receiver.filter": "kf-gate", "channel.disturbance": [fault], "duration_s": 1.0}
    off = run(load("static", keys), 1, whole=False).summary["off_carrier_s"]
    assert off.pop("G09:L1CA") in (0.4, 0.42)
    assert set(off.values()) == {None}
