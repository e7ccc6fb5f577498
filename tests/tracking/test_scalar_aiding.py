"""Scalar loops in a jump, unaided and aided by the INS; latency of the aid and its clock."""

import numpy as np
import pytest
from scalar_bench import (
    CALM,
    LOOP,
    NO_IMU,
    NODE_S,
    loss_reasons,
    thermal_cycles,
)

from ultratight import scenario
from ultratight.ins.imu import Increments
from ultratight.simulation import fly, new_closure
from ultratight.tracking.channel_aiding import Delayed, learn_clock
from ultratight.tracking.channel_state import LOCKED, PULL_IN, WAVELENGTH_M
from ultratight.tracking.loop_filters import phase_loop
from ultratight.tracking.scalar import Scalar, ScalarSettings
from ultratight.world import World

JUMP_S, COSTAS_LIMIT_CYCLES = 20.0, 0.25


def fly_jump(closure, *changes):
    changes = [f'receiver.closure="{closure}"', "cn0_dbhz=45.0", *changes]
    world = World(scenario.load("jump-1", changes), 1)
    receiver = new_closure(world.scenario, world.knows)
    history = fly(receiver, world.correlator(), world.imu[0], 22.0)
    return world, receiver, history


@pytest.mark.slow
def test_unaided_loops_hold_or_lose_the_jump_by_their_own_acceleration():
    world, receiver, _ = fly_jump("scalar", *LOOP, *CALM)
    rate = world.signal.carrier_phase_cycles[:, :, 1]
    k = round(JUMP_S / NODE_S)
    acceleration = np.abs(rate[:, k + 200] - rate[:, k - 1]) / (201 * NODE_S)  # Hz/s
    # the third-order loop's error after a step of acceleration has its peak at 0.485 a / w^2
    # (test_loop_filters) and the Costas discriminator ends at a quarter cycle
    w, _ = phase_loop(3, 18.0, 0.005, 0.0005)
    peak = 0.485 * acceleration / w**2
    margin = 3.0 * thermal_cycles(18.0, 0.005, 45.0)
    holds, loses = peak < COSTAS_LIMIT_CYCLES - margin, peak > COSTAS_LIMIT_CYCLES + margin
    assert holds.sum() >= 3
    assert loses.sum() >= 3
    assert (holds | loses).all()
    assert np.isnan(receiver.first_lost_s[holds]).all()
    assert (receiver.first_lost_s[loses] > JUMP_S).all()
    assert (receiver.first_lost_s[loses] < JUMP_S + 1.0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "loop", [LOOP, ["receiver.integration_s=0.01", "receiver.bandwidth_hz=10.0"]]
)
def test_aided_loops_hold_the_jump(loop):
    # what is left of 100 m/s2 is the scale factor's 0.3 m/s2 and the biases
    world, receiver, history = fly_jump("scalar-ins", *loop)
    assert loss_reasons(receiver) == []
    assert (history.rows["tracking_phase"][-1] == LOCKED).all()
    velocity = history.rows["v_eb_e"] - world.antenna(history.t_s)[1]
    assert np.sqrt((velocity[history.t_s > 5.0] ** 2).sum(axis=1).mean()) < 0.1


def test_a_latency_holds_increments_back_and_loses_none():
    line, got = Delayed(0.012), []
    t = np.arange(9) * 0.005
    for k in range(60):
        end = (k + 1) * 0.001
        n0, n1 = np.searchsorted(t[1:], [end - 0.001 + 1e-9, end + 1e-9])
        given = Increments(t[n0 : n1 + 1], np.full((n1 - n0, 3), n0 + 1.0), np.zeros((n1 - n0, 3)))
        out = line(given, end)
        assert out.t_s.size == out.alpha_ib_b.shape[0] + 1
        got += [
            (end, float(a[0]), float(stamp))
            for a, stamp in zip(out.alpha_ib_b, out.t_s[1:], strict=True)
        ]
    assert [number for _, number, _ in got] == list(range(1, 9))
    for end, number, stamp in got:
        assert stamp == pytest.approx(number * 0.005)
        assert end == pytest.approx(stamp + 0.012)


def test_a_late_aid_is_the_same_command_later():
    world = World(scenario.load("jump-1", ['receiver.closure="scalar-ins"']), 1)
    imu = world.imu[0]
    changed = []
    for latency in (0.0, 0.01):
        settings = ScalarSettings(0.005, aiding_latency_s=latency)
        frequencies = []
        for push in (0.0, 5.0):
            receiver = Scalar(world.knows, settings, 0.25, NODE_S, aided=True)
            run = []
            for k in range(20):
                given = NO_IMU._replace(t_s=np.array([k // 5 * 0.005]))
                if k % 5 == 4:
                    j = 1 + k // 5  # the first one ended at the start
                    nu = imu.nu_ib_b[j : j + 1] + (push if j == 1 else 0.0)
                    given = Increments(imu.t_s[j : j + 2], imu.alpha_ib_b[j : j + 1], nu)
                run.append(receiver.steer((k + 1) * 0.001, given).carrier_freq_hz[0])
            frequencies.append(run)
        differs = np.abs(np.array(frequencies[1]) - frequencies[0]).max(axis=1) > 1.0
        changed.append(int(np.argmax(differs)))
    # the increment that ends at 5 ms acts on the command from 5 ms on, or from 15 ms on
    assert changed == [5, 15]


def test_the_clock_takes_what_the_loops_have_in_common():
    world = World(scenario.load("uniform", ['receiver.closure="scalar-ins"', *CALM]), 1)
    receiver = Scalar(world.knows, ScalarSettings(0.005, aiding_clock="learnt"), 0.25, NODE_S, True)
    loops, before = receiver.loops, receiver.steering.clock[1]
    loops.phase[:-1] = LOCKED
    loops.loop_hz[:] = loops.carrier_memory[:, 1] = 4.0
    total = receiver.doppler_hz
    learn_clock(receiver.steering.buffer, 0.25, loops)
    assert receiver.steering.clock[1] - before == pytest.approx(-WAVELENGTH_M)
    np.testing.assert_allclose(receiver.doppler_hz[:-1], total[:-1], atol=1e-9)
    assert receiver.doppler_hz[-1] == pytest.approx(total[-1] + 1.0)  # not locked: a better aid
    loops.phase[3:] = PULL_IN
    learn_clock(receiver.steering.buffer, 0.25, loops)  # three are too few
    assert receiver.steering.clock[1] - before == pytest.approx(-WAVELENGTH_M)


@pytest.mark.slow
def test_the_clock_drift_is_learnt_in_flight():
    told = ["receiver.knows.velocity_sigma_mps=0.01", "receiver.knows.clock_rate_sigma_mps=5.0"]
    errors = []
    for kind in ("first", "learnt"):
        changes = ['receiver.closure="scalar-ins"', f'receiver.aiding_clock="{kind}"', *told, *LOOP]
        world = World(scenario.load("uniform", [*changes, "cn0_dbhz=45.0"]), 2)
        receiver = new_closure(world.scenario, world.knows)
        fly(receiver, world.correlator(), world.imu[0], 8.0)
        drift = world.clock.drift_mps[round(8.0 / NODE_S)]
        errors.append(abs(receiver.steering.clock[1] - drift))
    assert errors[0] > 1.0
    assert errors[1] < 0.2
