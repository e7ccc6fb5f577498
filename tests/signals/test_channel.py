"""Disturbances of the path: the truth that they make, and what both correlators then see."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from signals.channel import Disturbance, disturbed, effects
from signals.code_start import nominal, symbol_span
from signals.codes import GPS_L1CA, GPS_L5Q
from signals.constants import C_MPS, CA_CHIP_RATE_HZ, GPS_L1_HZ
from signals.correlator import SampleCorrelator
from signals.correlator_model import ModelCorrelator
from signals.front_end import SyntheticIf
from signals.propagation import SignalState, signal_state
from signals.satellites import AF0, AF1, TOC, embedded

TOW = 475_220.0
PRN, ROWS = embedded().select(2149, TOW)
T = np.arange(201) * 5e-3
R0 = np.array([-2.178e6, 4.388e6, 4.074e6])  # 39.9 N 116.4 E, to a kilometre
V0 = np.array([-180.0, -80.0, 20.0])
ONE = np.arange(3) == 1


def antenna(rows: np.ndarray, signal: Any = GPS_L1CA) -> SignalState:
    n = len(rows)
    of = nominal([signal] * n)
    first, count = symbol_span(TOW, T, of=of)
    motion = R0 + T[:, None] * V0, np.repeat(V0[None], T.size, axis=0)
    clock = 300.0 + 30.0 * T, np.full(T.size, 30.0)
    symbols = np.ones((n, count), np.int8)
    return signal_state(rows, TOW, T, *motion, *clock, np.full(n, 35.0), symbols, first, of=of)


def fault(**change: Any) -> Disturbance:
    return Disturbance(**({"t0_s": 0.4, "t1_s": 0.7, "affected": ONE} | change))


@pytest.mark.parametrize("signal", [GPS_L1CA, GPS_L5Q], ids=["L1 C/A", "L5Q"])
def test_a_fault_is_what_the_satellites_own_clock_would_do(signal: Any) -> None:
    """The same fault as broadcast clock terms, late by delay / c, through orbits and light time.

    That clock is read when the signal leaves, so its ramp arrives a light time later: rate rho / c,
    to the 0.5 ms between rho / c and the light time.  The satellite's way during 100 m / c is 1 um.
    """
    step_m, rate_mps = 100.0, 40.0
    rows = ROWS[:3].copy()
    rows[1, AF0] -= (step_m + rate_mps * (rows[1, TOC] - TOW - 0.4)) / C_MPS
    rows[1, AF1] -= rate_mps / C_MPS
    clock, plain, of = antenna(rows, signal), antenna(ROWS[:3], signal), nominal([signal] * 3)
    found = disturbed(plain, [fault(delay_m=step_m, delay_rate_mps=rate_mps)], of)
    during = slice(80, 140)
    light_s = -plain.carrier_phase_cycles[1, during, 0] / of.carrier_hz[1]
    for name, hz in (
        ("code_phase_chips", of.chip_rate_hz),
        ("carrier_phase_cycles", of.carrier_hz),
    ):
        a, b = (getattr(x, name)[1, during] * C_MPS / hz[1] for x in (clock, found))
        np.testing.assert_allclose((a - b)[:, 0], rate_mps * light_s, atol=rate_mps * 1e-3)
        np.testing.assert_allclose((a - b)[:, 1], 0.0, atol=1e-3)
        assert rate_mps * light_s.min() > 2.5  # far above the tolerance


def test_nothing_else_is_touched() -> None:
    """Other channels, and what comes before and after, keep their bits; so do bends of the path."""
    of, plain = nominal([GPS_L1CA] * 3), antenna(ROWS[:3])
    found = disturbed(plain, [fault(delay_m=100.0, delay_rate_mps=1.0, cn0_change_db=-15.0)], of)
    before = np.r_[0:80, 140:200]
    for name in ("code_phase_chips", "carrier_phase_cycles", "cn0_dbhz"):
        a, b = getattr(plain, name), getattr(found, name)
        assert np.array_equal(a[~ONE], b[~ONE])
        assert np.array_equal(a[1, before], b[1, before])
    assert np.array_equal(found.cn0_dbhz[1, 80:140], np.full(60, 20.0))
    assert np.all(found.code_phase_chips[1, 80:140, :2] < plain.code_phase_chips[1, 80:140, :2])
    same = slice(2, 4)
    assert np.array_equal(plain.code_phase_chips[..., same], found.code_phase_chips[..., same])
    assert disturbed(plain, [], of) is plain
    assert plain.cn0_dbhz.min() == 35.0  # a given truth is not written over


def test_a_window_of_the_truth_is_disturbed_like_the_whole() -> None:
    """Files are made second by second."""
    of, plain = nominal([GPS_L1CA] * 3), antenna(ROWS[:3])
    changes = [fault(delay_rate_mps=7.0), fault(t0_s=0.5, t1_s=np.inf, cn0_change_db=-6.0)]
    whole = disturbed(plain, changes, of)
    part = slice(70, 160)
    cut = plain._replace(
        t_s=plain.t_s[70:161],
        **{name: getattr(plain, name)[:, part]
           for name in ("code_phase_chips", "carrier_phase_cycles", "cn0_dbhz", "valid")},
    )  # fmt: skip
    window = disturbed(cut, changes, of)
    for name in ("code_phase_chips", "carrier_phase_cycles", "cn0_dbhz"):
        assert np.array_equal(getattr(whole, name)[:, part], getattr(window, name))


def test_what_overlaps_adds_up_from_begin_to_end() -> None:
    """By hand: at the begin a step is there, at the end it is gone."""
    changes = [
        fault(delay_m=10.0, cn0_change_db=-3.0),
        fault(t0_s=0.5, t1_s=0.6, affected=np.ones(3, bool), delay_rate_mps=20.0),
        fault(t0_s=0.6, t1_s=np.inf, cn0_change_db=-4.0),
    ]
    found = effects(changes, np.array([0.399, 0.4, 0.5, 0.55, 0.6, 0.7, 9.0]), 3)
    assert found.delay_m[1] == pytest.approx([0.0, 10.0, 10.0, 11.0, 10.0, 0.0, 0.0])
    assert found.delay_m[0] == pytest.approx([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    assert found.cn0_change_db[1] == pytest.approx([0.0, -3.0, -3.0, -3.0, -7.0, -4.0, -4.0])
    assert found.delay_rate_mps[2] == pytest.approx([0.0, 0.0, 20.0, 20.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"delay_m": np.nan}, "expected finite numbers"),
        ({"t0_s": np.inf}, "expected finite numbers"),
        ({"t1_s": 0.4}, "t1_s: 0.4, expected more than t0_s = 0.4"),
        ({"t1_s": np.nan}, "t1_s: nan, expected more than t0_s"),
        ({"affected": np.ones(2, bool)}, "expected bool"),
        ({"affected": np.array([0, 1, 0])}, "expected bool"),
    ],
)
def test_nonsense_is_refused(change: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        effects([fault(**change)], T, 3)


# ---- correlators -----------------------------------------------------------------------------


def sent(truth_of: Any, delay_m: float, cn0_change_db: float) -> SignalState:
    """One satellite, 45 dB-Hz, that is disturbed from 0.05 s to 0.1 s of 0.15 s."""
    state = truth_of(chips=333.2, cycles=0.3, doppler_hz=900.0, duration_s=0.15)
    changes = [Disturbance(0.05, 0.1, np.ones(1, bool), cn0_change_db, delay_m)]
    return disturbed(state, changes, nominal([GPS_L1CA]))


@pytest.mark.parametrize(("delay_m", "cn0_change_db"), [(100.0, 0.0), (0.0, -15.0), (60.0, -6.0)])
def test_samples_and_closed_form_see_the_same(
    truth: Any, command: Any, delay_m: float, cn0_change_db: float
) -> None:
    """And what theory says: amplitudes R(delay + offset), phase -delay / wavelength.

    The tolerance is the effect of sampling, see `test_correlators_agree`: 4 sigma of 0.37 % at
    5 MHz; where the disturbance begins or ends inside an integration parts of code periods add
    self-noise, the root of 1 / (chips in the integration) at most.
    """
    prn, fs, offsets = 7, 5.0e6, np.array([-0.25, 0.0, 0.25])
    chips = np.array([GPS_L1CA.chips(prn)])
    state = sent(truth, delay_m, cn0_change_db)
    nco = command([0.0, 0.149], chips=333.2, cycles=0.3, doppler_hz=900.0, dump_chips=10230)
    source = SyntheticIf(state, chips, fs, 3, sample_format="float32", noise=False)
    sampled = SampleCorrelator(source, chips, offsets)(nco)
    model = ModelCorrelator(
        state, chips, np.array([prn]), offsets, 4, sample_rate_hz=fs, noise=False
    )(nco)
    sigma = 2.0 * np.sqrt(1024 / 12) / (fs * 1e-3)
    amplitude = np.sqrt(2.0 * 10**4.5 * 0.01)
    cut = [(a < t < b) for a, b in zip(model.t_start_s, model.t_end_s, strict=True)
           for t in (0.05, 0.1)]  # fmt: skip
    cut = np.array(cut).reshape(-1, 2).any(axis=1)
    assert cut.sum() == 2
    tolerance = amplitude * np.where(cut, 4 * np.hypot(sigma, 10230**-0.5), 4 * sigma)
    assert np.all(np.abs(sampled.iq - model.iq) < tolerance[:, None])
    during = ~cut & (model.t_start_s > 0.05) & (model.t_end_s < 0.1)
    assert during.sum() >= 3
    chip_m = C_MPS / CA_CHIP_RATE_HZ
    lag = np.abs(offsets - delay_m / chip_m)  # late replicas meet a late signal
    own = GPS_L1CA.autocorrelation(prn)
    size = amplitude * 10 ** (cn0_change_db / 20.0) * (1.0 - lag + lag * own[1])
    expected = size * np.exp(-2j * np.pi * delay_m * GPS_L1_HZ / C_MPS)
    np.testing.assert_allclose(model.iq[during], np.tile(expected, (during.sum(), 1)), rtol=1e-6)
    after = model.iq[(model.t_start_s > 0.1)]
    np.testing.assert_allclose(after[:, 1], amplitude, rtol=1e-6)


def test_same_samples_for_any_size_of_reading(truth: Any) -> None:
    """The bits of the IF do not depend on how they are asked for, across begin and end too."""
    chips = np.array([GPS_L1CA.chips(7)])
    state = sent(truth, 100.0, -15.0)
    whole = SyntheticIf(state, chips, 4.0e6, 3).samples(0, 600_000)
    for size in (7_777, 100_003):
        again = SyntheticIf(state, chips, 4.0e6, 3)
        parts = [again.samples(n, min(n + size, 600_000)) for n in range(0, 600_000, size)]
        assert np.array_equal(np.concatenate(parts), whole)
