"""The command follows the INS, causally; what is known of the difference is bookkept exactly."""

import numpy as np
import pytest
from scipy.integrate import quad

from signals.arcs import arcs
from signals.constants import C_MPS, GPS_L1_HZ
from ultratight.ins.imu import Increments
from ultratight.scenario import load
from ultratight.tracking.steering import (
    feed_back,
    mean_known,
    predict,
    start,
    steer_epoch,
)
from ultratight.world import World

WAVELENGTH_M = C_MPS / GPS_L1_HZ
START_S = 19.99  # the jump of 100 m/s2 falls into the epoch that follows
N_PIECE = 4


@pytest.fixture(scope="module")
def world():
    changes = ['imu.grade="perfect"', "imu.accel_scale_factor_ppm=[0,0,0]", "imu.lag_s=0.0",
               'clock.model="ideal"', "duration_s=21.0", "profile=[{t0_s=20.0,t1_s=21.0,"
               "accel0_mps2=100.0,accel1_mps2=100.0}]"]  # fmt: skip
    return World(load("jump-1", changes), seed=3)


def perfect_state(world, t_s):
    """A Steering that holds the truth at receiver time t_s."""
    s, _ = start(world.knows, 0.005)
    motion = world.trajectory.at(world.true_time(np.array([t_s])))
    s.r_eb_e[:], s.v_eb_e[:], s.C_b_e[:] = motion.r_eb_e[0], motion.v_eb_e[0], motion.C_b_e[0]
    node = round(t_s / 0.005)
    s.clock[:] = world.clock.clock_m[node], world.clock.clock_rate_mps[node]
    imu = world.imu[0]
    s.last_alpha[:], s.last_nu[:] = imu.alpha_ib_b[node], imu.nu_ib_b[node]
    predict(s, sky(world), t_s)
    return s


def sky(world):
    tow = world.scenario.start_tow_s
    return arcs(world.elements, tow, tow + 60.0)


def increments(world, t_s, n=N_PIECE):
    """The n IMU intervals that begin at t_s."""
    k = round(t_s / 0.005) + 1  # one interval lies before the start
    imu = world.imu[0]
    return Increments(imu.t_s[k : k + n + 1], imu.alpha_ib_b[k : k + n], imu.nu_ib_b[k : k + n])


def command(world, s, imu):
    out = np.empty((5, imu.t_s.size - 1, world.prn.size))
    steer_epoch(s.buffer, sky(world), imu.t_s, imu.alpha_ib_b, imu.nu_ib_b, out)
    return out


def true_phase(world, t_s, what):
    """Carrier [cycles] or code [chips] of the truth at one time, all channels."""
    state = world.signal
    p = min(int(t_s / 0.005 + 1e-9), state.valid.shape[1] - 1)
    c = getattr(state, what)[:, p]
    dt = t_s - state.t_s[p]
    return c[:, 0] + dt * (c[:, 1] + dt * (c[:, 2] + dt * c[:, 3]))


def nco_phase(imu, out, piece, dt):
    return out[2][piece] + out[3][piece] * dt + 0.5 * out[4][piece] * dt**2


def known_phase(s, piece, dt):
    c = s.known_carrier[(int(s.newest[0]) + 1 - N_PIECE + piece) % s.known_t_s.shape[0]]
    return c[:, 0] + dt * (c[:, 1] + dt * (c[:, 2] + dt * c[:, 3]))


def test_command_plus_known_difference_is_the_truth_through_the_jump(world):
    """Perfect INS: NCO phase + known difference = true phase, to the rounding of 2e7 m."""
    s = perfect_state(world, START_S)
    imu = increments(world, START_S)
    out = command(world, s, imu)
    for piece in range(N_PIECE):
        for dt in (0.0, 0.0013, 0.0049):
            t = imu.t_s[piece] + dt
            error = nco_phase(imu, out, piece, dt) + known_phase(s, piece, dt)
            error -= true_phase(world, t, "carrier_phase_cycles")
            assert np.abs(error).max() < 2e-5
    # the piece that begins with the jump cannot know it: 100 m/s2 for 5 ms along each line of sight
    along = s.u @ (world.trajectory.at(np.array([20.5])).a_eb_e[0])
    expected = 0.5 * along * 0.005**2 / WAVELENGTH_M
    piece = round((20.0 - START_S) / 0.005)
    np.testing.assert_allclose(known_phase(s, piece, 0.005), expected, atol=3e-4)


def test_code_command_is_the_true_code_phase(world):
    s = perfect_state(world, START_S)
    imu = increments(world, START_S)
    out = command(world, s, imu)
    for piece in range(N_PIECE):
        error = out[0][piece] - true_phase(world, imu.t_s[piece], "code_phase_chips")
        assert np.abs(error).max() < 1e-7


@pytest.mark.parametrize("changed", range(N_PIECE))
def test_a_piece_uses_only_increments_that_ended_before_it_began(world, changed):
    imu = increments(world, START_S)
    before = command(world, perfect_state(world, START_S), imu)
    nu = imu.nu_ib_b.copy()
    nu[changed] += [0.3, -0.2, 0.1]
    after = command(world, perfect_state(world, START_S), imu._replace(nu_ib_b=nu))
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a[: changed + 1], b[: changed + 1])
    if changed + 1 < N_PIECE:
        assert np.abs(before[3][changed + 1] - after[3][changed + 1]).max() > 0.1  # Hz


def test_feedback_moves_the_nco_phase_by_the_phase_correction_alone(world):
    s = perfect_state(world, START_S)
    imu = increments(world, START_S)
    command(world, s, imu)
    t = imu.t_s[-1]
    before = s.phase_offset - s.rho / WAVELENGTH_M
    phase_m = np.linspace(-0.02, 0.02, world.prn.size)
    x = np.zeros(17)
    x[:3], x[3:6], x[15], x[16] = [3.0, -2.0, 1.0], [0.3, 0.1, -0.2], 5.0, 0.4
    feed_back(s.buffer, sky(world), x, phase_m, t)
    after = s.phase_offset - s.rho / WAVELENGTH_M
    np.testing.assert_allclose(after - before, -phase_m / WAVELENGTH_M, atol=1e-6)


def test_after_feedback_of_the_true_error_the_past_is_that_of_the_truth(world):
    """An INS that starts 0.4 m/s and 4 m off: corrected at the end, its memory is right again."""
    s = perfect_state(world, START_S)
    x = np.zeros(17)
    x[:3], x[3:6], x[15], x[16] = [3.0, -2.0, 1.0], [0.3, 0.1, -0.2], 5.0, 0.4
    s.r_eb_e[:] -= x[:3] - 0.02 * x[3:6]
    s.v_eb_e[:] -= x[3:6]
    s.clock[0] -= x[15] - 0.02 * x[16]
    s.clock[1] -= x[16]
    predict(s, sky(world), START_S)
    imu = increments(world, START_S)
    out = command(world, s, imu)
    t = imu.t_s[-1]
    phase_at_end = s.phase_offset - s.rho / WAVELENGTH_M
    error_cycles = true_phase(world, t, "carrier_phase_cycles") - phase_at_end
    feed_back(s.buffer, sky(world), x, -error_cycles * WAVELENGTH_M, t)
    for piece in range(N_PIECE):
        for dt in (0.0, 0.0025, 0.005):
            rest = nco_phase(imu, out, piece, dt) + known_phase(s, piece, dt)
            rest -= true_phase(world, imu.t_s[piece] + dt, "carrier_phase_cycles")
            assert np.abs(rest).max() < 2e-4  # the Sagnac and geometry terms of 0.4 m/s x 20 ms


def test_a_known_scale_factor_and_bias_are_undone(world):
    """An IMU that reports (1 + s) f + b, and an INS that was told s and b: that of the truth."""
    scale, bias = np.array([3e-3, -1e-3, 2e-3]), np.array([0.01, 0.02, -0.03])
    imu = increments(world, START_S)
    flown = []
    for known in (0.0, 1.0):
        s = perfect_state(world, START_S)
        dt = 0.005 * (1.0 - s.clock[1] / C_MPS)
        x = np.zeros(20)
        x[9:12], x[17:] = known * bias, known * scale
        feed_back(s.buffer, sky(world), x, np.zeros(world.prn.size), START_S)
        nu = imu.nu_ib_b * (1.0 + known * scale) + known * bias * dt
        command(world, s, imu._replace(nu_ib_b=nu))
        flown.append((s.v_eb_e.copy(), s.mean_force[0].copy()))
    for with_errors, without in zip(flown[1], flown[0], strict=True):
        np.testing.assert_allclose(with_errors, without, rtol=0.0, atol=1e-10)


def test_mean_known_is_the_integral_over_the_pieces():
    """Against adaptive quadrature of the piecewise cubic."""
    rng = np.random.default_rng(5)
    t = np.array([[0.0, 0.005], [0.005, 0.010], [0.010, 0.015]])
    cubic = rng.standard_normal((3, 4)) * [1.0, 1e2, 1e4, 1e6]

    def value(x):
        k = min(int(x / 0.005), 2)
        return np.polyval(cubic[k, ::-1], x - t[k, 0])

    a, b = 0.0031, 0.0127
    expected = quad(value, a, b, points=[0.005, 0.010], epsabs=1e-12)[0] / (b - a)
    assert mean_known(t, cubic, a, b) == pytest.approx(expected, rel=1e-9)
