"""Scalar loops by choice: discriminators, C/N0 estimators, divergence, Kalman loop, phases."""

import numpy as np
import pytest
from scalar_bench import (
    NODE_S,
    bench,
    loss_reasons,
    thermal_cycles,
)

from ultratight.tracking.channel_state import ASSISTED, LOCKED
from ultratight.tracking.loop_filters import phase_loop
from ultratight.tracking.scalar import ScalarSettings


@pytest.mark.parametrize("kind", ["decision-directed", "product"])
def test_other_phase_discriminators_hold_lock(kind):
    b = bench(ScalarSettings(0.005, 18.0, carrier_discriminator=kind), 10, 3.0, 42.0)
    b.run(2.0)
    carrier, _ = b.run(2.9)
    assert (b.receiver.loops.phase == LOCKED).all()
    assert carrier.std() == pytest.approx(thermal_cycles(18.0, 0.005, 42.0), rel=0.15)


@pytest.mark.parametrize("estimator", ["m2m4", "snv"])
def test_the_other_estimators_in_the_loop(estimator):
    # SNV takes phase jitter for noise: 2 + A^2 sigma^2 in place of 2, with A^2 = 2 C/N0 20 ms; 50
    # bits: 0.25 dB each, the mean of 16 channels to 0.06
    settings = ScalarSettings(0.02, 5.0, cn0_estimator=estimator)
    b = bench(settings, 16, 8.0, 42.0)
    b.run(7.9)
    expected, c = 42.0, 10.0**4.2
    if estimator == "snv":
        jitter = (2.0 * np.pi * thermal_cycles(5.0, 0.02, 42.0)) ** 2
        expected -= 10.0 * np.log10(1.0 + c * 0.02 * jitter)
        assert expected < 41.7
    assert b.receiver.cn0_dbhz.mean() == pytest.approx(expected, abs=0.25)


def test_divergence_is_seen_and_ends_lock_where_asked():
    told = {"divergence_mps": 3.0}
    b = bench(ScalarSettings(0.005, 18.0), 6, 13.0, 45.0, **told)
    limited = bench(ScalarSettings(0.005, 18.0, code_carrier_limit_mps=1.5), 6, 13.0, 45.0, **told)
    for each in (b, limited):
        each.run(12.9)
    assert loss_reasons(b.receiver) == []
    # a low pass of 4 s after 12 s has 95 % of it; the DLL's noise of 0.8 m moves it by 0.3 m/s
    assert np.abs(b.receiver.loops.divergence_mps - 0.95 * 3.0).max() < 1.0
    assert all("code and carrier diverge" in r for r in loss_reasons(limited.receiver))
    assert len(loss_reasons(limited.receiver)) == 6


def test_the_kalman_loop_pulls_in_and_comes_back():
    level = np.full(round(8.0 / NODE_S) + 1, 42.0)
    level[round(3.0 / NODE_S) : round(4.0 / NODE_S)] = 0.0
    b = bench(ScalarSettings(0.005, loop="kalman"), 6, 8.0, level, clock_rate_mps=2.0)
    b.run(2.9)
    assert (b.receiver.loops.phase == LOCKED).all()
    b.run(7.9)
    assert (b.receiver.first_lost_s > 3.0).all()
    assert (b.receiver.loops.phase == LOCKED).all()
    true_hz = b.state.carrier_phase_cycles[:, -20, 1]
    np.testing.assert_allclose(b.receiver.doppler_hz, true_hz, atol=1.0)


def test_each_phase_has_its_own_settings():
    settings = ScalarSettings(
        0.02, 5.0, dll_bandwidth_hz=0.5, pull_in_bandwidth_hz=8.0, pull_in_dll_bandwidth_hz=4.0,
        assisted_integration_s=0.005, assisted_bandwidth_hz=15.0, assisted_dll_bandwidth_hz=2.0,
    )  # fmt: skip
    b = bench(settings, 4, 3.0, 45.0)
    d = b.receiver.design
    assert (d.block_assisted, d.block) == (5, 20)
    np.testing.assert_array_equal(d.pll_assisted, phase_loop(3, 15.0, 0.005, 0.0005)[1])
    np.testing.assert_array_equal(d.dll_assisted, phase_loop(1, 2.0, 0.005, 0.0005)[1])
    np.testing.assert_array_equal(d.dll_pull_in, phase_loop(1, 4.0, 0.001, 0.0005)[1])
    np.testing.assert_array_equal(d.dll, phase_loop(1, 0.5, 0.02, 0.0005)[1])
    seen = set()
    for k in range(2900):
        b.step(k)
        seen |= {
            (int(p), int(n))
            for p, n in zip(b.receiver.loops.phase, b.receiver.loops.n_in_block, strict=True)
        }
    assert max(n for p, n in seen if p == ASSISTED) == 5
    assert max(n for p, n in seen if p == LOCKED) == 20
