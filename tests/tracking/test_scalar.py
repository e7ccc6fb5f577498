"""The scalar closure on taps in closed form: pull-in, jitter, loss of lock, positions."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from signals import clock
from signals.code_start import symbol_span
from signals.codes import GPS_L1CA
from signals.constants import C_MPS, GPS_L1_HZ
from signals.correlator_model import ModelCorrelator
from signals.noise import generator
from signals.propagation import SignalState, pseudorange, signal_state
from ultratight import scenario
from ultratight.ins.imu import Increments
from ultratight.simulation import fly, new_closure
from ultratight.tracking.channel_aiding import Delayed, learn_clock
from ultratight.tracking.channel_state import ASSISTED, CHIP_M, LOCKED, PULL_IN, WAVELENGTH_M
from ultratight.tracking.channels import channels
from ultratight.tracking.loop_filters import phase_loop
from ultratight.tracking.positioning import least_squares
from ultratight.tracking.scalar import Scalar, ScalarSettings
from ultratight.world import World

NO_IMU = Increments(np.zeros(1), np.zeros((0, 3)), np.zeros((0, 3)))
NODE_S = 0.005
CALM = [
    'clock.model="ideal"',
    "clock.bias_m=0.0",
    "clock.drift_mps=0.0",
]


@dataclasses.dataclass
class Bench:
    """Channels in uniform motion, each with its own code, bits and oscillator; no IMU."""

    receiver: Scalar
    correlator: ModelCorrelator
    state: SignalState

    def run(self, until_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Errors of the NCO (n_epoch, n_channel): carrier [cycles], less half cycles; code."""
        s, steps = self.receiver, []
        for k in range(round(s.t_s * 1000.0), round(until_s * 1000.0)):
            s.step(self.correlator(s.steer((k + 1) * 0.001, NO_IMU)))
            steps.append((s.t_s, s.loops.carrier_cycles.copy(), s.loops.code_chips.copy()))
        t, carrier, code = (np.array(a) for a in zip(*steps, strict=True))
        error = true_phase(self.state.t_s, self.state.carrier_phase_cycles, t) - carrier
        code_error = true_phase(self.state.t_s, self.state.code_phase_chips, t) - code
        return (error + 0.25) % 0.5 - 0.25, code_error


def true_phase(nodes, cubic, t):
    p = np.minimum((t / NODE_S + 1e-6).astype(int), nodes.size - 2)
    dt = t - nodes[p]
    c = cubic[:, p]
    return (((c[..., 3] * dt + c[..., 2]) * dt + c[..., 1]) * dt + c[..., 0]).T


def bench(
    settings, n, duration_s, level_dbhz, *,
    spacing=0.25, oscillator="ideal", seed=1, divergence_mps=0.0, **told,
) -> Bench:  # fmt: skip
    """n channels, PRN 1 ... n, on the lines of sight of the preset `uniform`.

    level_dbhz: C/N0, (n_node,) or a number.  told: changes to the receiver's perfect knowledge.
    divergence_mps: the code's range grows so much faster than the carrier's.
    """
    world = World(scenario.load("uniform", CALM), seed)
    t = np.arange(round(duration_s / NODE_S) + 1) * NODE_S
    r, v = world.antenna(t)
    prn = np.arange(1, n + 1)
    rows = world.elements[np.arange(n) % len(world.prn)]
    first, n_bit = symbol_span(world.scenario.start_tow_s, t)
    rng = generator(seed, "bench")
    bits = (1 - 2 * rng.integers(0, 2, (n, n_bit))).astype(np.int8)
    cn0 = np.broadcast_to(level_dbhz, (1, t.size))
    parts = []
    for i in range(n):
        ticks = clock.simulate(clock.OSCILLATORS[oscillator], t, rng)
        parts.append(
            signal_state(
                rows[i : i + 1], world.scenario.start_tow_s, t, r, v,
                ticks.clock_m, ticks.clock_rate_mps, cn0, bits[i : i + 1], first,
            )
        )  # fmt: skip
    joined = ("code_phase_chips", "carrier_phase_cycles", "cn0_dbhz", "valid", "symbols")
    state = parts[0]._replace(
        **{k: np.concatenate([getattr(part, k) for part in parts]) for k in joined}
    )
    state.code_phase_chips[:, :, 0] -= divergence_mps / CHIP_M * t[: state.t_s.size - 1]
    state.code_phase_chips[:, :, 1] -= divergence_mps / CHIP_M
    perfect = {
        "prn": prn, "channels": channels([GPS_L1CA] * len(prn), prn, world.scenario.start_tow_s),
        "elements": rows, "cn0_dbhz": state.cn0_dbhz[:, 0], "r_eb_e": r[0],
        "v_eb_e": v[0], "clock_m": 0.0, "clock_rate_mps": 0.0,
        "data_bits": bits, "first_bit": first,
    }  # fmt: skip
    knows = dataclasses.replace(world.knows, **(perfect | told))
    chips = np.stack([GPS_L1CA.chips(int(p)) for p in prn])
    offsets = np.array([-spacing, 0.0, spacing])
    return Bench(
        Scalar(knows, settings, spacing, NODE_S, aided=False),
        ModelCorrelator(state, chips, prn, offsets, seed),
        state,
    )


def loss_reasons(receiver):
    return [reason for _, _, kind, reason in receiver.events if kind == "loss of lock"]


# -- jitter ---------------------------------------------------------------------------------------


def thermal_cycles(bn_hz, t_s, cn0_dbhz):
    """Costas loop with squaring loss, Kaplan & Hegarty, 3rd ed., ch. 8."""
    c = 10.0 ** (cn0_dbhz / 10.0)
    return np.sqrt(bn_hz / c * (1.0 + 1.0 / (2.0 * t_s * c))) / (2.0 * np.pi)


def delay_jitter_chips(prn, bn_hz, t_s, cn0_dbhz, spacing):
    """Dot product, D = 2 spacing, with the slope 1 - R(1) of the code's own peak."""
    c = 10.0 ** (cn0_dbhz / 10.0)
    slope = np.array([1.0 - GPS_L1CA.autocorrelation(int(p))[1] for p in prn])
    return np.sqrt(bn_hz * spacing / (slope * c) * (1.0 + 1.0 / (t_s * c)))


@pytest.mark.slow
@pytest.mark.parametrize(("bn_hz", "t_s", "spacing"), [(18.0, 0.005, 0.25), (5.0, 0.02, 0.1)])
@pytest.mark.parametrize("cn0", [35.0, 45.0])
def test_jitter_is_that_of_theory(bn_hz, t_s, spacing, cn0):
    # independent samples are 1 / (2 Bn) apart: 10 s x 32 channels x 2 Bn >= 1280 for the DLL (2 Hz)
    # and 3200 for the PLL, known to 2 % and 1.3 %; Bn T <= 0.1
    settings = ScalarSettings(t_s, bn_hz, dll_bandwidth_hz=2.0)
    b = bench(settings, 32, 20.0, cn0, spacing=spacing)
    b.run(10.0)
    carrier, code = b.run(19.9)
    assert (b.receiver.loops.phase == LOCKED).all()
    assert loss_reasons(b.receiver) == []
    assert carrier.std() == pytest.approx(thermal_cycles(bn_hz, t_s, cn0), rel=0.1)
    normal = code / delay_jitter_chips(np.arange(1, 33), 2.0, t_s, cn0, spacing)
    assert normal.std() == pytest.approx(1.0, rel=0.1)
    assert abs(normal.mean()) < 4.0 / np.sqrt(1280.0)


def oscillator_cycles(oscillator, bn_hz, t_s):
    """r.m.s. phase error that the oscillator causes: integral of |1 - H|^2 S_phi over f.

    S_phi = (f_L1 / 2 pi f)^2 (h0 + h-2 / f^2) [cycles^2/Hz], one-sided; H is the loop written out
    by hand in z.
    """
    w, _ = phase_loop(3, bn_hz, t_s, 0.0005)
    f = np.geomspace(1e-3, 0.5 / t_s, 40_000)
    back = np.exp(-2j * np.pi * f * t_s)
    integral = 0.5 * t_s * (1.0 + back) / (1.0 - back)
    open_loop = integral * back * (2.4 * w + 1.1 * w**2 * integral + w**3 * integral**2)
    density = (GPS_L1_HZ / (2.0 * np.pi * f)) ** 2 * (oscillator.h0 + oscillator.h_minus2 / f**2)
    return np.sqrt(np.trapezoid(density / np.abs(1.0 + open_loop) ** 2, f))


@pytest.mark.slow
@pytest.mark.parametrize("cn0", [35.0, 45.0])
@pytest.mark.parametrize(("bn_hz", "t_s"), [(10.0, 0.01), (18.0, 0.005)])
def test_jitter_with_the_tcxo(cn0, bn_hz, t_s):
    b = bench(ScalarSettings(t_s, bn_hz), 32, 20.0, cn0, oscillator="tcxo")
    b.run(10.0)
    carrier, _ = b.run(19.9)
    assert loss_reasons(b.receiver) == []
    thermal = thermal_cycles(bn_hz, t_s, cn0)
    wander = oscillator_cycles(clock.OSCILLATORS["tcxo"], bn_hz, t_s)
    if cn0 == 45.0:
        assert wander > thermal  # here the oscillator is what is measured
    assert carrier.std() == pytest.approx(np.hypot(thermal, wander), rel=0.1)


# -- the jump -------------------------------------------------------------------------------------

JUMP_S, COSTAS_LIMIT_CYCLES = 20.0, 0.25
LOOP = ["receiver.integration_s=0.005", "receiver.bandwidth_hz=18.0"]


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


# -- life of a channel ----------------------------------------------------------------------------

FAST = ScalarSettings(0.005, 18.0)


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


# -- choices --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["atan2", "cross"])
@pytest.mark.parametrize("order", [1, 2])
def test_jitter_of_the_frequency_loop_alone(kind, order):
    # halves of a bit, T = 10 ms: 1 / (2 pi T) sqrt(4 Bn / (C/N0) (1 + 1 / (2 T C/N0))) with a new
    # pair every 2 T; 6 s x 32 channels x 2 Bn = 1920 independent samples, known to 1.6 %
    bn, t_s, c = 5.0, 0.01, 1e4
    settings = ScalarSettings(
        0.005,
        carrier_loop="fll",
        fll_bandwidth_hz=bn,
        fll_order=order,
        frequency_discriminator=kind,
    )
    b = bench(settings, 32, 10.0, 40.0)
    b.run(3.0)
    s, errors = b.receiver, []
    for k in range(3000, 9000):
        s.step(b.correlator(s.steer((k + 1) * 0.001, NO_IMU)))
        if k % 20 == 0:
            piece = round(s.t_s / NODE_S)
            errors.append(b.state.carrier_phase_cycles[:, piece, 1] - s.loops.loop_hz)
    theory = np.sqrt(4.0 * bn / c * (1.0 + 1.0 / (2.0 * t_s * c))) / (2.0 * np.pi * t_s)
    assert loss_reasons(s) == []
    assert np.std(errors) == pytest.approx(theory, rel=0.05)
    assert [kind for _, i, kind, _ in s.events if i == 3] == ["frequency lock"]


@pytest.mark.slow
def test_a_pure_loop_knows_whole_cycles():
    # without squaring loss; a Costas loop would rest half a cycle off in half of the channels
    b = bench(ScalarSettings(0.02, 10.0, carrier_discriminator="atan2"), 32, 10.0, 35.0)
    b.run(4.0)
    s, errors = b.receiver, []
    for k in range(4000, 9000):
        s.step(b.correlator(s.steer((k + 1) * 0.001, NO_IMU)))
        errors.append(
            true_phase(b.state.t_s, b.state.carrier_phase_cycles, np.array([s.t_s]))[0]
            - s.loops.carrier_cycles
        )
    carrier = (np.array(errors) + 0.5) % 1.0 - 0.5
    assert loss_reasons(s) == []
    assert carrier.std() == pytest.approx(np.sqrt(10.0 / 10.0**3.5) / (2.0 * np.pi), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["coherent", "power", "envelope"])
def test_code_jitter_of_each_discriminator(kind):
    # 45 dB-Hz, T = 20 ms: squaring losses are below 0.3 %; 8 s x 32 channels x 4 Hz = 1024: 2.2 %
    b = bench(
        ScalarSettings(0.02, 10.0, dll_bandwidth_hz=2.0, code_discriminator=kind), 32, 12.0, 45.0
    )
    b.run(3.5)
    _, code = b.run(11.5)
    normal = code / delay_jitter_chips(np.arange(1, 33), 2.0, 0.02, 45.0, 0.25)
    assert normal.std() == pytest.approx(1.0, rel=0.05)
    assert abs(normal.mean()) < 4.0 / np.sqrt(1024.0)


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


# -- Kalman loop ----------------------------------------------------------------------------------


def steady_kalman(receiver, t_s, cn0_dbhz):
    """Stationary r.m.s. errors of code [chips], phase, Doppler of a signal in uniform motion.

    The gain by scipy's Riccati equation, the error's covariance by its own recursion with that gain
    and without process noise, which the signal has none of.
    """
    q, k = receiver.design.kalman, 1.0 / 1540.0
    F = np.eye(4)
    F[1, 2:], F[2, 3] = (t_s, t_s**2 / 2.0), t_s
    F[0, 2:] = k * F[1, 2:]
    u = np.linspace(0.0, t_s, 4001)
    columns = (
        np.stack([np.full_like(u, k), np.ones_like(u), 0 * u, 0 * u], 1),
        np.stack([k * u**2 / 2.0, u**2 / 2.0, u, np.ones_like(u)], 1),
    )
    Q = q[1] * t_s * np.outer(columns[0][0], columns[0][0]) + q[3] * np.trapezoid(
        columns[1][:, :, None] * columns[1][:, None, :], u, axis=0
    )
    Q[0, 0] += q[0] * t_s
    H = np.array([[1.0, 0.0, -k * t_s / 2.0, k * t_s**2 / 6.0], [0.0, 1.0, -t_s / 2, t_s**2 / 6.0]])
    tc = t_s * 10.0 ** (cn0_dbhz / 10.0)
    R = np.diag(
        [0.25 / (2.0 * tc) * (1.0 + 1.0 / tc), (1 + 1 / (2 * tc)) / (2 * tc) / (2 * np.pi) ** 2]
    )
    P = solve_discrete_are(F.T, H.T, Q, R)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    A = (np.eye(4) - K @ H) @ F
    return np.sqrt(np.diag(solve_discrete_lyapunov(A, K @ R @ K.T)))


@pytest.mark.slow
@pytest.mark.parametrize("cn0", [35.0, 45.0])
def test_jitter_of_the_kalman_loop(cn0):
    t_s = 0.005
    settings = ScalarSettings(t_s, loop="kalman", divergence_m_sqrt_s=3.0)
    b = bench(settings, 32, 12.0, cn0)
    b.run(4.0)
    s, errors = b.receiver, []
    kalman = s.loops.kalman
    for k in range(4000, 11000):
        s.step(b.correlator(s.steer((k + 1) * 0.001, NO_IMU)))
        t = np.array([s.t_s])
        phase = true_phase(b.state.t_s, b.state.carrier_phase_cycles, t)[0]
        code = true_phase(b.state.t_s, b.state.code_phase_chips, t)[0]
        ahead = s.t_s - kalman.t_s
        fresh = np.where(ahead < 0.001, 0.0, np.nan)  # just updated: bits end at different times
        behind = (
            kalman.mean[:, :2]
            - kalman.nco
            + ahead[:, None] * np.outer(kalman.mean[:, 2], [1.0 / 1540.0, 1.0])
        )  # of the NCO, as the filter believes
        cycles = phase - s.loops.carrier_cycles - behind[:, 1]
        hz = b.state.carrier_phase_cycles[:, round(s.t_s / NODE_S), 1] - kalman.mean[:, 2]
        chips = code - s.loops.code_chips - behind[:, 0]
        errors.append([fresh + chips, fresh + (cycles + 0.25) % 0.5 - 0.25, fresh + hz])
    assert loss_reasons(s) == []
    found = np.sqrt(np.nanmean(np.square(errors), axis=(0, 2)))
    theory = steady_kalman(s, t_s, cn0)[:3]
    np.testing.assert_allclose(found[1:], theory[1:], rtol=0.05)
    assert found[0] == pytest.approx(theory[0], rel=0.1)


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


# -- phases and aiding ----------------------------------------------------------------------------


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
        b.receiver.step(b.correlator(b.receiver.steer((k + 1) * 0.001, NO_IMU)))
        seen |= {
            (int(p), int(n))
            for p, n in zip(b.receiver.loops.phase, b.receiver.loops.n_in_block, strict=True)
        }
    assert max(n for p, n in seen if p == ASSISTED) == 5
    assert max(n for p, n in seen if p == LOCKED) == 20


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
