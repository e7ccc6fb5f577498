"""Steps of C/N0 and faults of satellites in a scenario: the truth has them, the receiver not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from signals.constants import C_MPS, GPS_L1_HZ
from ultratight import load, run
from ultratight.scenario import Scenario
from ultratight.world import World

STEP = {"t0_s": 1.0, "t1_s": 2.0, "cn0_change_db": -15.0, "prns": [6, 9]}
FAULT = {"t0_s": 1.2, "prns": [9], "pseudorange_m": 100.0, "pseudorange_rate_mps": 2.0}


def flown(*disturbances: dict[str, Any], **change: Any) -> Scenario:
    keys = {"duration_s": 3.0, "channel.disturbance": list(disturbances)}
    return load("static", keys | change)


def test_the_truth_of_a_run_has_them() -> None:
    """C/N0, fault, pseudorange and Doppler of the satellites named; the others keep theirs."""
    before, after = run(flown(), 3), run(flown(STEP, FAULT), 3)
    t, names = after.t_s, after["channel"].tolist()
    six, nine = names.index("G06:L1CA"), names.index("G09:L1CA")
    weak = (t >= 1.0 - 1e-9) & (t < 2.0 - 1e-9)
    for i in range(len(names)):
        expected = np.where(weak & (i in (six, nine)), 20.0, 35.0)
        np.testing.assert_allclose(after["cn0_true"][:, i], expected)
    fault = np.where(t >= 1.2 - 1e-9, 100.0 + 2.0 * (t - 1.2), 0.0)
    np.testing.assert_allclose(after["pseudorange_fault"][:, nine], fault, atol=1e-9)
    assert not np.delete(after["pseudorange_fault"], nine, axis=1).any()
    more = after["pseudorange_true"] - before["pseudorange_true"]
    np.testing.assert_allclose(more[:, nine], fault, atol=1e-7)
    turn = (after["doppler_true"] - before["doppler_true"])[:, nine]
    np.testing.assert_allclose(
        turn, np.where(fault > 0.0, -2.0 * GPS_L1_HZ / C_MPS, 0.0), atol=1e-6
    )
    assert after.variables["cn0_true"].units == "dB-Hz"
    assert after.variables["pseudorange_fault"].units == "m"


def test_the_receiver_is_not_told() -> None:
    """What it knows is the same, and so are all bits until the first disturbance."""
    plain, hit = World(flown(), 5), World(flown(STEP, FAULT), 5)
    for name, value in vars(plain.knows).items():
        told = getattr(hit.knows, name)
        parts = zip(value, told, strict=True) if isinstance(value, tuple) else [(value, told)]
        assert all(np.array_equal(a, b) for a, b in parts), name
    before, after = run(flown(), 5), run(flown(STEP, FAULT), 5)
    early = before.t_s < 1.0
    for name in ("r_eb_e", "v_eb_e", "clock_m", "cn0"):
        assert np.array_equal(before[name][early], after[name][early])
        assert not np.array_equal(before[name], after[name])


def test_the_receiver_finds_the_loss_of_power() -> None:
    """A^2 follows with 1 s: after 5 s 0.7 % of the step is left.  Mean over ten channels, 4 sigma.

    The estimate averages 100 bits of A^2 = 2 (20 dB-Hz, 10 ms): its relative variance is at most
    (4 A^2 + 4) / A^4 / 100, 0.75 dB (1 sigma) per channel.
    """
    whole = {"t0_s": 1.0, "t1_s": 6.0, "cn0_change_db": -15.0}
    r = run(flown(whole, duration_s=7.0), 2)
    at = int(np.argmin(np.abs(r.t_s - 5.98)))
    n = r["cn0"].shape[1]
    found = 10 * np.log10(np.mean(10 ** (r["cn0"][at] / 10)))
    assert found == pytest.approx(20.0, abs=4 * 0.75 / np.sqrt(n) + 10 * np.log10(1 + 0.007 * 30))
    assert r["cn0"][early_row(r, 1.0)].mean() == pytest.approx(35.0, abs=0.5)


def early_row(r: Any, t_s: float) -> int:
    return int(np.searchsorted(r.t_s, t_s - 1e-6)) - 1


def test_taps_of_both_correlators_are_off_by_the_same() -> None:
    """Closed loop, 45 dB-Hz: powers of the faulty satellite's taps, from samples and closed form.

    Means over 18 dumps agree to 4 sigma of their own spread.  100 m are 0.341 chip: the prompt
    keeps (1 - 0.341)^2 of its power, within what ten satellites let the code follow in 0.2 s: 3 m
    (5 % of the power), and the noise of the mean (1 %).
    """
    fault = FAULT | {"t0_s": 1.0, "pseudorange_rate_mps": 0.0}
    change: dict[str, Any] = {"cn0_dbhz": 45.0, "duration_s": 1.22, "receiver.filter": "kf"}
    powers = []
    for kind in ("model", "samples"):
        r = run(flown(fault, **change, **{"correlator.kind": kind}), 4)
        nine = r["channel"].tolist().index("G09:L1CA")
        mine = (r["dump_channel"] == nine) & (r["dump_start"] > 1.02)
        power = r["tap_i"][mine] ** 2 + r["tap_q"][mine] ** 2 - 2.0  # of the noise
        powers.append((power.mean(axis=0), power.std(axis=0) / np.sqrt(mine.sum())))
    (a, sigma_a), (b, sigma_b) = powers
    assert np.all(np.abs(a - b) < 4.0 * np.hypot(sigma_a, sigma_b))
    for early, prompt, late in (a, b):
        assert late > prompt > early  # the signal comes later than the replica expects
        assert prompt / (2.0 * 10**4.5 * 0.01) == pytest.approx((1 - 0.341) ** 2, rel=0.06)


def test_forgetting_without_a_robust_gain_survives_a_fault() -> None:
    """R held at every outlier, whose gain is not reduced, loses all ten channels by one's fault.

    Held at the first alone, R of that channel opens, and the position is better than the KF's.
    """
    fault = {"t0_s": 5.0, "t1_s": 10.0, "prns": [6], "pseudorange_m": 100.0}
    keys = {"duration_s": 10.0, "channel.disturbance": [fault]}
    runs = [
        run(load("uniform", keys | {"receiver.filter": name}), 1)
        for name in ("kf", "kf-residual-forgetting")
    ]
    lost = [sum(t is not None for t in r.summary["lost_lock_s"].values()) for r in runs]
    kf, forgetting = (r.summary["position_rms_end_m"] for r in runs)
    assert lost == [1, 1]
    assert forgetting < 0.5 * kf


def test_a_sector_blocks_those_that_stand_in_it() -> None:
    """Against the elevations and azimuths that the run itself reports, through north as well."""
    walls = [
        {"t0_s": 0.0, "t1_s": 0.5, "elevation_deg": [-90.0, 30.0], "cn0_change_db": -45.0},
        {"t0_s": 0.5, "t1_s": 1.0, "azimuth_deg": [300.0, 60.0], "cn0_change_db": -45.0},
        {"t0_s": 1.0, "elevation_deg": [10.0, 60.0], "azimuth_deg": [60.0, 300.0], "prns": [4, 9],
         "cn0_change_db": -45.0},
    ]  # fmt: skip
    r = run(flown(*walls, duration_s=1.5), 1)
    el, az = r["elevation"][0], r["azimuth"][0] % 360.0
    named = np.isin(r["channel"], ["G04:L1CA", "G09:L1CA"])
    blocked = r["cn0_true"] < 0.0
    row = [int(np.searchsorted(r.t_s, t)) for t in (0.25, 0.75, 1.25)]
    assert np.array_equal(blocked[row[0]], el <= 30.0)
    assert np.array_equal(blocked[row[1]], (az >= 300.0) | (az <= 60.0))
    assert np.array_equal(blocked[row[2]], named)
    assert [int(blocked[k].sum()) for k in row] == [6, 3, 2]


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("elevation_deg", [60.0, 10.0], "the lower one first"),
        ("azimuth_deg", [10.0, 370.0], "360 or less"),
        ("azimuth_deg", [0.0, 360.0], "two directions"),
    ],
)
def test_sectors_without_an_inside_are_refused(key: str, value: list[float], expected: str) -> None:
    with pytest.raises(ValueError, match=rf"channel\.disturbance\[0\]\.{key}.*{expected}"):
        flown({"t0_s": 0.0, "cn0_change_db": -45.0, key: value})


@pytest.mark.parametrize("seed", [1, 2])
def test_signals_that_come_back_do_not_throw_the_filter_off(seed: int) -> None:
    """Four seconds without any: what returns is weighed by its own power, not by what had sunk.

    Before, the first symbols looked like errors of radians, and the fading filter lost all ten.
    """
    away = {"t0_s": 4.0, "t1_s": 8.0, "cn0_change_db": -45.0}
    keys = {"duration_s": 12.0, "cn0_dbhz": 40.0, "receiver.filter": "fiqkf-r"}
    flight = run(load("uniform", keys | {"profile": [], "channel.disturbance": [away]}), seed)
    assert flight.summary["converged"]
    assert set(flight.summary["off_carrier_s"].values()) == {None}
