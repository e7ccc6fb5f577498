"""Lock judged by the truth: how far each NCO is off the true carrier, and since when."""

from __future__ import annotations

import numpy as np

from ultratight import load, run
from ultratight.metrics import off_carrier_s, off_signal_s


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


def test_back_on_the_signal_is_after_the_last_loss() -> None:
    """Half a chip counts as 25 Hz does; what is too short to be a loss ends no return."""
    t = 0.02 * np.arange(1, 101)
    hz, chips = np.zeros((100, 6)), np.zeros((100, 6))
    hz[20:30, 0], chips[30:45, 0], hz[60:69, 0] = 40.0, -0.6, 40.0  # a loss; too short
    hz[20:40, 1], chips[70:80, 1] = 40.0, 0.51  # two losses
    chips[50:, 2] = 0.51  # to the end
    chips[:, 3], hz[95:, 3] = 0.49, 40.0  # too short to tell
    hz[80:, 4] = np.nan
    chips[:10, 5] = np.nan  # from the start
    first, back = off_signal_s(t, hz, chips)
    np.testing.assert_allclose(first, [t[20], t[20], t[50], np.nan, t[80], t[0]])
    np.testing.assert_allclose(back, [t[45], t[80], np.nan, t[0], np.nan, t[10]])


def test_half_a_chip_off_the_code_is_off_the_signal() -> None:
    """A satellite 200 m (0.68 chip) farther for a while, 100 m (0.34) are not enough; no replica's
    frequency moves, and those of the other nine satellites stay where they are."""
    for m, lost in ((200.0, True), (-200.0, True), (100.0, False)):
        fault = {"t0_s": 0.4, "t1_s": 0.8, "prns": [9], "pseudorange_m": m}
        keys = {"receiver.filter": "kf-gate", "channel.disturbance": [fault], "duration_s": 1.2}
        told = run(load("static", keys), 1, whole=False).summary
        for field, of_g09, others in (
            ("off_signal_s", (0.4, 0.42) if lost else (None,), None),
            ("on_signal_s", (0.8, 0.82) if lost else (0.02,), 0.02),
            ("off_carrier_s", (None,), None),
        ):
            assert told[field].pop("G09:L1CA") in of_g09
            assert set(told[field].values()) == {others}


def test_a_clock_that_runs_off_takes_its_carrier_with_it() -> None:
    """10 m/s are 52.6 Hz; the filter follows the other nine satellites, NCO of G09 with them."""
    fault = {"t0_s": 0.4, "prns": [9], "pseudorange_rate_mps": 10.0}
    keys = {"receiver.filter": "kf-gate", "channel.disturbance": [fault], "duration_s": 1.0}
    off = run(load("static", keys), 1, whole=False).summary["off_carrier_s"]
    assert off.pop("G09:L1CA") in (0.4, 0.42)
    assert set(off.values()) == {None}
