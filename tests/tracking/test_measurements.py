"""Models D and C against the closed-form correlator, finite differences and noise statistics."""

import numpy as np
import pytest
from scipy.stats import ncx2

from signals.codes import GPS_L1CA
from signals.constants import C_MPS, CA_CHIP_RATE_HZ, GPS_L1_HZ, OMEGA_EARTH
from signals.correlator_model import ModelCorrelator
from signals.nco import Nco
from signals.propagation import SignalState
from ultratight.tracking.channels import channels
from ultratight.tracking.code_model import HALF, OFFSET, code_rows
from ultratight.tracking.code_model import SPACING as SPACING_COLUMN
from ultratight.tracking.half_bits import Bits, HalfBits
from ultratight.tracking.measurements import AMPLITUDE2_FLOOR, Amplitudes, is_back, measure
from ultratight.tracking.steering import new_steering
from ultratight.tracking.tap_model import TapModel

PRN, SPACING, CN0_DBHZ, HALF_S = 17, 0.25, 35.0, 0.01
LAG1 = float(GPS_L1CA.autocorrelation(PRN)[1])
WAVELENGTH_M = C_MPS / GPS_L1_HZ
FACTS = channels([GPS_L1CA], [PRN], 0.0)
CODE = (code_rows(FACTS), FACTS.pilot)
A2 = 2.0 * 10 ** (CN0_DBHZ / 10.0) * HALF_S
T_S = 0.02
LEVEL = new_steering(1, 0.005)
"""The satellite ahead along x, no force, no lever arm"""
LEVEL.u[0] = [1.0, 0.0, 0.0]


def differential(bits, spacing=SPACING, clock_sf=0.0, steering=LEVEL, t_s=T_S):
    """Model D of one channel."""
    memory = Amplitudes(np.array([A2]), np.zeros(1, complex))
    return measure(bits, steering, t_s, 17, 17, *CODE, spacing, clock_sf, memory)


def coherent(bits, spacing=SPACING, clock_sf=0.0, steering=LEVEL, t_s=T_S, phase_start=17):
    """Model C of one channel, all data bits +1."""
    memory = Amplitudes(np.array([A2]), np.zeros(1, complex))
    data = np.ones((1, 10_000), np.int8)
    n = phase_start + 1
    return measure(bits, steering, t_s, n, phase_start, *CODE, spacing, clock_sf, memory, data)


def taps(dr, dv, p=0.0, n_bit=1, noise=False, seed=1, spacing=SPACING):
    """Half-bit taps of a satellite dr farther and receding dv faster than the replica.

    dr and the carrier-phase error p [m] hold in the middle of the first bit; the replica runs at
    the nominal rates, so that the errors are the truth's.
    """
    t = np.arange(0.0, 0.02 * n_bit + 0.0051, 0.005)  # the last dump must end inside
    error = dr + dv * (t[:-1] - 0.01)
    phase = p + dv * (t[:-1] - 0.01)
    code, carrier = np.zeros((1, t.size - 1, 4)), np.zeros((1, t.size - 1, 4))
    code[0, :, 0] = CA_CHIP_RATE_HZ * (t[:-1] - error / C_MPS)
    code[0, :, 1] = CA_CHIP_RATE_HZ * (1.0 - dv / C_MPS)
    carrier[0, :, 0] = -phase * GPS_L1_HZ / C_MPS
    carrier[0, :, 1] = -dv * GPS_L1_HZ / C_MPS
    n = t.size - 1
    state = SignalState(
        t, code, carrier, np.full((1, n), CN0_DBHZ), np.ones((1, n), bool),
        np.ones((1, n_bit + 4), np.int8), -2,
    )  # fmt: skip
    nco = Nco(
        t, (CA_CHIP_RATE_HZ * t[:-1])[:, None], np.full((n, 1), CA_CHIP_RATE_HZ),
        np.zeros((n, 1)), np.zeros((n, 1)), np.zeros((n, 1)), np.array([10_230]), np.array([True]),
    )  # fmt: skip
    correlator = ModelCorrelator(
        state, GPS_L1CA.chips(PRN)[None], np.array([PRN]), np.array([-spacing, 0.0, spacing]),
        seed, noise=noise,
    )  # fmt: skip
    return correlator(nco)


def bits(found):
    """Pair them, with a memory that knows of no difference."""
    steering = new_steering(1, 0.005)
    return HalfBits(FACTS, 3).pair(found, steering)


def measured(dr, dv, p=0.0):
    paired = bits(taps(dr, dv, p))
    assert paired.number.tolist() == [0]
    return differential(paired), coherent(paired)


@pytest.mark.parametrize(
    ("dr", "dv", "p"),
    [(0.0, 0.0, 0.0), (10.0, 1.0, 0.01), (-25.0, -4.0, -0.05), (60.0, 7.0, 0.08), (3.0, -9.0, 0.0)],
)
def test_models_predict_the_taps_of_the_correlator(dr, dv, p):
    """h at the true error = z without noise.

    What h leaves out: the code error moves by dv x 20 ms during the bit (3e-4 chips at 9 m/s).
    """
    d, c = measured(dr, dv, p)
    tolerance = 2e-4 + 2e-3 * abs(dv) / 9.0
    np.testing.assert_allclose(d.z[0], d.h(np.array([[[dr, dv]]]))[0, 0], atol=tolerance)
    np.testing.assert_allclose(c.z[0], c.h(np.array([[[dr, p, dv]]]))[0, 0], atol=tolerance)


def test_signs_farther_is_late_receding_is_clockwise():
    """Issue facts: 10 m farther -> L > E; 1 m/s receding -> arg(P2 conj P1) = -0.33 rad."""
    d, c = measured(10.0, 1.0, 0.01)
    turn = np.angle(d.z[0, 0] + 1j * d.z[0, 1])
    assert turn == pytest.approx(2.0 * np.pi * HALF_S / WAVELENGTH_M, rel=1e-3)
    assert d.z[0, 2] > 0.0
    assert c.z[0, 1] > 0.0
    behind, _ = measured(-10.0, 1.0)
    assert behind.z[0, 2] < 0.0


@pytest.mark.parametrize("d", [2, 3])
def test_jacobians_are_finite_differences_with_the_prompt_peak_held(d):
    """Away from kinks, with lag1 = 1 (flat prompt) in the I and Q rows, where R(d) is held."""
    params = code_rows(FACTS)
    params[0, [OFFSET, HALF, SPACING_COLUMN]] = 2.0, HALF_S, SPACING
    model = TapModel(params)
    y = np.array([[5.0, 3.0]]) if d == 2 else np.array([[5.0, 0.03, 3.0]])
    z, J = model.jacobian(y)
    np.testing.assert_array_equal(z, model(y[:, None])[:, 0])
    for k in range(1, d):
        step = np.zeros(d)
        step[k] = 1e-5
        slope = (model((y + step)[:, None]) - model((y - step)[:, None]))[0, 0] / 2e-5
        np.testing.assert_allclose(J[0, :, k], slope, rtol=1e-6, atol=1e-8)
    # range: the rows of I and Q hold R(d); S is early-late times the prompt that is held
    assert J[0, 0, 0] == 0.0
    assert J[0, 1, 0] == 0.0
    chip = C_MPS / CA_CHIP_RATE_HZ
    delay = 7.0 / chip
    loss = np.sinc(3.0 / WAVELENGTH_M * HALF_S) ** 2
    expected = loss * (1.0 - delay * (1.0 - LAG1)) * 2.0 * (1.0 - LAG1) / chip
    assert J[0, 2, 0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("spacing", [0.1, 0.25, 0.5, 1.0])
def test_noise_of_the_measurements_is_that_of_R(spacing):
    """Variance of z over 4000 bits against R, at spacings where a slip in one shows in another."""
    n = 4000
    paired = bits(taps(0.0, 0.0, n_bit=n, noise=True, spacing=spacing))
    assert paired.channel.size >= n - 2
    for found in (differential(paired, spacing), coherent(paired, spacing)):
        # 4 standard errors of a variance; S is a product of two noises with more kurtosis: 6
        ratio = found.z.var(axis=0) / np.diag(found.R[0])
        np.testing.assert_allclose(ratio, 1.0, atol=6.0 * np.sqrt(2.0 / n))


def test_oscillator_noise_enters_the_differential_phase():
    """White frequency noise turns one half against the other: (2 pi / lambda)^2 S_f 2 T_h / 3."""
    paired = bits(taps(0.0, 0.0))
    quiet = differential(paired).R[0, 1, 1]
    noisy = differential(paired, clock_sf=4.5e-5).R[0, 1, 1]
    rng = np.random.default_rng(2)
    steps = rng.standard_normal((20_000, 200)) * np.sqrt(4.5e-5 * 1e-4)
    path = np.cumsum(steps, axis=1)
    turn = 2.0 * np.pi / WAVELENGTH_M * (path[:, 100:].mean(axis=1) - path[:, :100].mean(axis=1))
    assert noisy - quiet == pytest.approx(turn.var(), rel=4.0 * np.sqrt(2.0 / 20_000) + 0.005)


@pytest.mark.parametrize("n_scale", [0, 3])
def test_projection_is_the_derivative_of_range_and_rate_at_the_middle_of_the_bit(n_scale):
    """A against a finite difference of range(t_mid), with the state carried back to t_mid."""
    rng = np.random.default_rng(7)
    C = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    force_b, arm_b = np.array([98.0, 1.0, -9.0]), np.array([0.5, -0.3, 0.2])
    u = np.array([0.6, -0.64, 0.48])
    u /= np.linalg.norm(u)
    t, t_mid = 3.0, 2.984
    paired = Bits(
        np.array([0]), np.array([0]), np.array([[t_mid, HALF_S, 0.0]]), np.ones((1, 2, 3), complex)
    )
    turn_b = np.array([0.3, -0.8, 0.5])  # rad/s against inertial space
    s = new_steering(1, 0.005)
    s.C_b_e[:], s.lever_arm_b[:], s.mean_force[0], s.u[0] = C, arm_b, force_b, u
    s.last_alpha[:] = turn_b * 0.005
    arm_rate = np.cross(C @ turn_b - [0.0, 0.0, OMEGA_EARTH], C @ arm_b)
    A = coherent(paired, steering=s, t_s=t, phase_start=17 + n_scale).A[0]
    back = t_mid - t

    def errors(x):
        """(range, phase, rate) at t_mid of an error state x at t; constant acceleration error."""
        psi = x[6:9]
        accel = np.cross(psi, C @ force_b) - C @ x[9:12]
        accel -= C @ (x[17 : 17 + n_scale] * force_b[:n_scale]) if n_scale else 0.0
        velocity = x[3:6] + np.cross(psi, arm_rate)
        rate = -u @ (velocity + back * accel) + x[16]
        moved = -u @ (back * velocity + 0.5 * back**2 * accel) + back * x[16]
        level = -u @ (x[:3] + np.cross(psi, C @ arm_b)) + x[15]
        return np.array([level + moved, x[-1] + moved, rate])

    for k in range(18 + n_scale):
        x = np.zeros(18 + n_scale)
        x[k] = 1.0
        np.testing.assert_allclose(A[:, k], errors(x), atol=1e-12, err_msg=str(k))


@pytest.mark.parametrize("lag", [0.0101, 0.015, 0.02, 0.025, 0.0299])
def test_a_bit_is_short_of_its_share_of_the_clock_step(lag):
    """Mean of the clock over the bit against A x, noise instant by noise instant.

    x is made of the same noise: cb and p of all S_f up to t - h and all S_g up to t, the step as
    `clock_step_into` defines it.  What remains of S_f is the mean over the bit against a straight
    line, at most S_f T / 12 as at both ends and in the middle (mean of a Brownian bridge); of S_g
    what came in the last h, S_g h^3 / 3 and a fifth for the mean over the bit.  Without the share
    of the step a bit that ended before t - h keeps S_f (lag - h - h / 3).
    """
    T, h, t, sf, sg = 0.02, HALF_S, 1.0, 4.5e-5, 0.0355
    paired = Bits(
        np.array([0]), np.array([0]), np.array([[t - lag, h, 0.0]]), np.ones((1, 2, 3), complex)
    )
    memory, data = Amplitudes(np.array([A2]), np.zeros(1, complex)), np.ones((1, 100), np.int8)
    found = measure(paired, LEVEL, t, 19, 17, *CODE, SPACING, sf, memory, data, 0, h, T)
    row = found.A[0, 1]
    assert found.A[0, 0, 18] == row[18]  # the code sees the same clock
    du = 1e-6
    u = np.arange(-0.045, 0.0, du) + 0.5 * du  # noise at t + u
    within = np.clip((-lag + h - u) / (2.0 * h), 0.0, 1.0)  # share of the bit after it
    fresh = (u >= -T - h) & (u < -h)
    seen = row[17] * (u < -h) + row[18] * fresh
    rest_f = sf * np.sum((within - seen) ** 2) * du
    mean_after = np.clip(-lag + h - u, 0.0, 2.0 * h)  # (s - u)+ averaged over the bit
    ramp = np.where(u < -lag - h, -lag - u, mean_after**2 / (4.0 * h))
    step = -(u + T + h) * (u >= -T)
    rest_g = sg * np.sum((ramp - (row[17] * -u + row[16] + row[18] * step)) ** 2) * du
    assert rest_f <= 1.001 * sf * T / 12.0
    assert rest_g <= 1.201 * sg * h**3 / 3.0
    if lag >= 2.0 * h:
        without = sf * np.sum((within - row[17] * (u < -h)) ** 2) * du
        assert without == pytest.approx(sf * (lag - h - h / 3.0), rel=1e-3)


def test_a_half_that_lost_its_partner_is_dropped():
    found = taps(0.0, 0.0, n_bit=3)
    keep = np.ones(found.channel.size, bool)
    keep[1] = False  # second half of bit 0
    pruned = type(found)(*(a[keep] for a in found))
    assert bits(pruned).number.tolist() == [1, 2]


def test_model_c_without_the_data_bit_is_refused():
    paired = bits(taps(0.0, 0.0))
    memory = Amplitudes(np.array([A2]), np.zeros(1, complex))
    rest = (*CODE, SPACING, 0.0, memory)
    with pytest.raises(ValueError, match="data_bits: none for bit 0 of channel 0"):
        measure(paired, LEVEL, T_S, 18, 17, *rest)
    with pytest.raises(ValueError, match="data_bits: none for bit 0 of channel 0"):
        measure(paired, LEVEL, T_S, 18, 17, *rest, np.ones((1, 5), np.int8), 1)


def test_amplitude_follows_the_power_of_the_prompts():
    """Two halves of power a: A^2 goes 2 % of the way to a - 2 (the noise of I and Q)."""
    iq = np.zeros((1, 2, 3), complex)
    iq[0, :, 1] = [3.0 + 4.0j, 5.0j]
    paired = Bits(np.array([0]), np.array([0]), np.array([[0.01, HALF_S, 0.0]]), iq)
    memory = Amplitudes(np.array([100.0]), np.zeros(1, complex))
    data = -np.ones((1, 1), np.int8)
    measure(paired, LEVEL, T_S, 17, 17, *CODE, SPACING, 0.0, memory, data)
    assert memory.amplitude2[0] == pytest.approx(100.0 + 0.02 * (25.0 - 2.0 - 100.0))
    assert memory.prompt[0] == -(3.0 + 9.0j)


def test_a_signal_that_is_back_is_measured_in_its_own_scale_at_once():
    """From the floor, as after an outage: the in-phase number of 35 dB-Hz is 1, not A^2 / 0.5."""
    memory = Amplitudes(np.array([AMPLITUDE2_FLOOR]), np.zeros(1, complex))
    found = measure(bits(taps(0.0, 0.0)), LEVEL, T_S, 17, 17, *CODE, SPACING, 0.0, memory)
    assert found.z[0, 0] == pytest.approx(1.0, abs=0.05)
    assert memory.amplitude2[0] == pytest.approx(A2, rel=0.05)


@pytest.mark.parametrize("a2", [0.5, 2.0, 20.0, 200.0, 2000.0])
def test_noise_passes_for_a_return_less_than_once_in_ten_million_symbols(a2):
    """Twice the power plus 4 is chi-square with 4 degrees of freedom, noncentrality 2 A^2."""
    powers = a2 + np.linspace(0.0, 10.0 * np.sqrt(2.0 * a2 + 2.0) + 60.0, 20_001)
    limit = powers[int(np.argmax([is_back(p, a2) for p in powers]))]
    assert ncx2.sf(2.0 * limit + 4.0, 4, 2.0 * a2) < 1e-7
    assert limit < a2 + 8.0 * np.sqrt(2.0 * a2 + 2.0) + 14.0
