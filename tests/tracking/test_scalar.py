"""The scalar closure on taps in closed form: life of a channel, command, positions, settings."""

import numpy as np
import pytest
from scalar_bench import (
    CALM,
    FAST,
    LOOP,
    NO_IMU,
    NODE_S,
    bench,
    delay_jitter_chips,
    loss_reasons,
    thermal_cycles,
)

from signals.constants import C_MPS, GPS_L1_HZ
from signals.propagation import pseudorange
from ultratight import scenario
from ultratight.ins.imu import Increments
from ultratight.simulation import fly, new_closure
from ultratight.tracking.channel_state import LOCKED, PULL_IN
from ultratight.tracking.loop_filters import phase_loop
from ultratight.tracking.positioning import least_squares
from ultratight.tracking.scalar import Scalar, ScalarSettings
from ultratight.world import World


def test_pull_in_from_what_the_receiver_knows():
    rng = np.random.default_rng(7)
    b = bench(FAST, 10, 2.5, 35.0)
    v = b.receiver.knows.v_eb_e + 1.5 * rng.standard_normal(3)
    r = b.receiver.knows.r_eb_e + 15.0 * rng.standard_normal(3)
    b = bench(FAST, 10, 2.5, 35.0, v_eb_e=v, r_eb_e=r, clock_rate_mps=1.5, clock_m=30.0)
    carrier, code = b.run(2.4)
    assert (b.receiver.loops.phase == LOCKED).all()
    assert loss_reasons(b.receiver) == []
    # five sigma of carrier; code has decayed by exp(-4 Bn t)
    assert np.abs(carrier[-200:]).max() < 5.0 * thermal_cycles(18.0, 0.005, 35.0)
    assert np.abs(code[-1]).max() < 5.0 * delay_jitter_chips([1], 1.0, 0.005, 35.0, 0.25)[0]
    order = [kind for _, i, kind, _ in b.receiver.events if i == 3]
    assert order == ["frequency lock", "phase lock"]


@pytest.mark.parametrize("offset_hz", [-300.0, 200.0])
def test_the_frequency_loop_pulls_in_from_far(offset_hz):
    b = bench(FAST, 6, 4.0, 45.0, clock_rate_mps=-offset_hz * C_MPS / GPS_L1_HZ)
    b.run(3.9)
    true_hz = b.state.carrier_phase_cycles[:, -20, 1]
    assert (b.receiver.loops.phase == LOCKED).all()
    np.testing.assert_allclose(b.receiver.doppler_hz, true_hz, atol=2.0)


def test_second_order_loops_lock_too():
    b = bench(ScalarSettings(0.005, 18.0, pll_order=2, dll_order=2), 10, 3.0, 40.0)
    b.run(2.0)
    carrier, _ = b.run(2.9)
    assert (b.receiver.loops.phase == LOCKED).all()
    assert carrier.std() == pytest.approx(thermal_cycles(18.0, 0.005, 40.0), rel=0.15)


@pytest.mark.parametrize("cn0", [30.0, 45.0])
def test_cn0_is_estimated(cn0):
    # a low pass of 1 s: each channel is known to 0.24 dB at 30 dB-Hz (narrow-wide power ratio of
    # 20 x 50 prompts), the mean of 16 to 0.06 dB; code and phase jitter take up to 0.2 dB
    b = bench(FAST, 16, 8.0, cn0, cn0_dbhz=np.full(16, cn0 - 3.0))
    b.run(7.9)
    assert b.receiver.cn0_dbhz.mean() == pytest.approx(cn0, abs=0.4)


def test_an_outage_is_a_loss_of_lock_and_ends_in_lock():
    level = np.full(round(9.0 / NODE_S) + 1, 40.0)
    level[round(3.0 / NODE_S) : round(5.0 / NODE_S)] = 0.0
    b = bench(FAST, 6, 9.0, level)
    b.run(8.9)
    lost = b.receiver.first_lost_s
    assert ((lost > 3.0) & (lost < 4.0)).all()
    assert any("phase lock indicator" in reason for reason in loss_reasons(b.receiver))
    assert (b.receiver.loops.phase == LOCKED).all()


def test_a_false_frequency_lock_is_noticed():
    # at 1 / (2 T) = 25 Hz a Costas loop of 20 ms turns by half a cycle per update and sees nothing
    b = bench(ScalarSettings(0.02, 5.0), 6, 7.0, 45.0)
    b.run(3.0)
    assert (b.receiver.loops.phase == LOCKED).all()
    b.receiver.loops.carrier_memory[:, 1] += 25.0
    b.run(6.9)
    assert any("frequency lock indicator" in reason for reason in loss_reasons(b.receiver))
    assert (b.receiver.loops.phase == LOCKED).all()


def test_missing_dumps_spoil_their_bit_only():
    b = bench(FAST, 6, 2.0, 45.0)
    s = b.receiver
    for k in range(1900):
        taps = b.correlator(s.steer((k + 1) * 0.001, NO_IMU))
        if k % 100 == 57:
            taps = type(taps)(*(column[1:] for column in taps))
        s.step(taps)
    assert loss_reasons(s) == []
    assert (s.loops.phase == LOCKED).all()


# -- command --------------------------------------------------------------------------------------


def test_the_command_is_continuous_and_uses_earlier_increments_only():
    world = World(scenario.load("jump-1", ['receiver.closure="scalar-ins"']), 1)
    imu = world.imu[0]
    given = Increments(imu.t_s[1:3], imu.alpha_ib_b[1:2], imu.nu_ib_b[1:2])
    shaken = given._replace(nu_ib_b=given.nu_ib_b + 5.0)
    commands = []
    for increments in (given, shaken):
        receiver = new_closure(world.scenario, world.knows)
        for k in range(4):
            before = receiver.steer((k + 1) * 0.001, NO_IMU)
        during = receiver.steer(0.005, increments)
        commands.append((before, during, receiver.steer(0.006, NO_IMU)))
    (_, first, second), (_, shaken_first, shaken_second) = commands
    for a, b in zip(first, shaken_first, strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.abs(second.carrier_freq_hz - shaken_second.carrier_freq_hz).max() > 1.0
    for before, during, after in commands:
        for old, new in ((before, during), (during, after)):
            dt = old.t_s[1] - old.t_s[0]
            end = old.carrier_phase_cycles + dt * (
                old.carrier_freq_hz + 0.5 * dt * old.carrier_rate_hz_per_s
            )
            np.testing.assert_allclose(new.carrier_phase_cycles, end, rtol=0.0, atol=1e-7)
            end = old.code_phase_chips + dt * old.chip_rate_hz
            np.testing.assert_allclose(new.code_phase_chips, end, rtol=0.0, atol=1e-9)


# -- positions ------------------------------------------------------------------------------------


def test_least_squares_finds_where_the_pseudoranges_came_from():
    world = World(scenario.load("uniform", CALM), 1)
    truth = np.array([*world.knows.r_eb_e, 321.0, *world.knows.v_eb_e, -12.0])
    tow_s = world.scenario.start_tow_s + 3.0
    seen = [pseudorange(row, tow_s, truth[:3], truth[4:7], 321.0, -12.0) for row in world.elements]
    rho, rate = np.array([s[0] for s in seen]), np.array([s[1] for s in seen])
    use = np.ones(rho.size, dtype=bool)
    found = truth + np.array([3e4, -2e4, 1e4, 5e3, 100.0, -50.0, 30.0, 9.0])
    assert least_squares(world.elements, tow_s, rho, rate, use, found)
    np.testing.assert_allclose(found[:4], truth[:4], atol=1e-5)
    np.testing.assert_allclose(found[4:], truth[4:], atol=1e-6)
    use[3:] = False
    assert not least_squares(world.elements, tow_s, rho, rate, use, found)


def test_position_and_velocity_of_a_flight():
    world = World(scenario.load("uniform", ['receiver.closure="scalar"', *LOOP]), 3)
    receiver = new_closure(world.scenario, world.knows)
    history = fly(receiver, world.correlator(), world.imu[0], 6.0)
    assert np.isnan(history.rows["r_eb_e"][0]).all()  # no lock yet
    settled = history.t_s > 3.0
    r, v = world.antenna(history.t_s[settled])
    # DLL 1 Hz at 35 dB-Hz: 2.6 m per satellite, times a PDOP of 2 (10 satellites)
    assert np.linalg.norm(history.rows["r_eb_e"][settled] - r, axis=1).max() < 4.0 * 2.6 * 2.0
    assert np.linalg.norm(history.rows["v_eb_e"][settled] - v, axis=1).max() < 0.5
    assert np.abs(history.rows["clock_rate"][settled] - world.clock.drift_mps[0]).max() < 2.0
    snapshot = receiver.snapshot()
    assert {a.shape for a in snapshot.values()} == {world.prn.shape}


# -- settings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"integration_s": 0.003}, "integration_s is 0.003"),
        ({"integration_s": 0.0205}, "integration_s is 0.0205"),
        ({"bandwidth_hz": -1.0}, "bandwidth_hz is -1.0"),
        ({"dll_bandwidth_hz": 0.0}, "bandwidth_hz is 0.0"),
        ({"fll_bandwidth_hz": np.nan}, "fll_bandwidth_hz is nan"),
        ({"pll_order": 1}, "pll_order is 1"),
        ({"dll_order": 3}, "dll_order is 3"),
        ({"fll_order": 2, "pll_order": 2}, "fll_order is 2"),
        ({"loop": "pid"}, "loop is 'pid'"),
        ({"carrier_loop": "dll"}, "carrier_loop is 'dll'"),
        ({"carrier_loop": "fll", "fll_bandwidth_hz": 0.0}, "fll_bandwidth_hz is 0.0"),
        ({"code_discriminator": "early"}, "code_discriminator is 'early'"),
        ({"carrier_discriminator": "sin"}, "carrier_discriminator is 'sin'"),
        ({"cn0_estimator": "mm"}, "cn0_estimator is 'mm'"),
        ({"assisted_integration_s": 0.003}, "assisted_integration_s is 0.003"),
        ({"aiding_latency_s": -0.1}, "aiding_latency_s is -0.1"),
    ],
)
def test_settings_that_mean_nothing(change, message):
    world = World(scenario.load("uniform", CALM), 1)
    with pytest.raises(ValueError, match=message):
        Scalar(world.knows, ScalarSettings(**change), 0.25, NODE_S, aided=False)


def test_the_scenario_s_keys_reach_the_loops():
    keys = {
        "integration_s": 0.01,
        "bandwidth_hz": 7.0,
        "fll_bandwidth_hz": 3.0,
        "dll_bandwidth_hz": 0.5,
        "pll_order": 2,
        "dll_order": 2,
    }
    changes = {"receiver.closure": "scalar"} | {f"receiver.{k}": v for k, v in keys.items()}
    world = World(scenario.load("uniform", changes), 1)
    receiver = new_closure(world.scenario, world.knows)
    assert receiver.settings == ScalarSettings(**keys)
    assert receiver.design.block == 10
    np.testing.assert_array_equal(receiver.design.pll, phase_loop(2, 7.0, 0.01, 0.0005)[1])
    np.testing.assert_array_equal(receiver.design.dll, phase_loop(2, 0.5, 0.01, 0.0005)[1])


def test_a_bench_starts_in_pull_in():
    b = bench(FAST, 4, 0.1, 40.0)
    assert (b.receiver.loops.phase == PULL_IN).all()
    assert np.isnan(b.receiver.pvt()[0]).all()
