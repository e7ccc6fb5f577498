"""Jitter of the scalar loops: phase, frequency and code, classical and Kalman, against theory."""

import numpy as np
import pytest
from scalar_bench import (
    NODE_S,
    bench,
    delay_jitter_chips,
    loss_reasons,
    thermal_cycles,
    true_phase,
)
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from signals import clock
from signals.constants import GPS_L1_HZ
from ultratight.tracking.channel_state import LOCKED
from ultratight.tracking.loop_filters import phase_loop
from ultratight.tracking.scalar import ScalarSettings


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
        b.step(k)
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
        b.step(k)
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
        b.step(k)
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
