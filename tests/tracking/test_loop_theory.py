"""Closed forms of loops against published tables, integrals done by hand, and plain draws."""

import math

import numpy as np
import pytest

from signals.clock import Oscillator
from signals.codes import GPS_L1CA
from signals.constants import C_MPS, GPS_L1_HZ
from signals.modulation import bpsk
from ultratight.tracking import loop_theory as theory
from ultratight.tracking import noisy_phase as noisy

pytestmark = pytest.mark.nojit
CHIP_M, WAVELENGTH_M = C_MPS / 1.023e6, C_MPS / GPS_L1_HZ
BPSK1 = bpsk(1)


@pytest.mark.parametrize(
    ("t_s", "expected"),
    [(0.02, (16.6, 19.7, 22.2, 23.8, 24.6)), (0.001, (21.3, 23.6, 25.5, 26.6, 27.1))],
)
def test_phase_loop_thresholds_of_the_table(t_s, expected):
    # 15 deg, thermal noise alone, Bn 2, 5, 10, 15, 18 Hz (Kaplan & Hegarty's formula, tabulated)
    found = [theory.pll_threshold_dbhz(bn, t_s) for bn in (2.0, 5.0, 10.0, 15.0, 18.0)]
    assert found == pytest.approx(expected, abs=0.06)


@pytest.mark.parametrize(
    ("bn", "expected"), [(2.0, (22.7, 19.7, 17.4)), (10.0, (26.6, 24.1, 22.7))]
)
def test_frequency_loop_thresholds_of_the_table(bn, expected):
    found = [theory.fll_threshold_dbhz(bn, t) for t in (0.001, 0.005, 0.02)]
    assert found == pytest.approx(expected, abs=0.06)


def test_code_jitter_of_the_table():
    # 30 dB-Hz, Bn 1 Hz, T 20 ms, D = 0.1, 20.46 MHz: 1.66, 1.70, bound 1.46, piecewise 1.82 m; the
    # first two hold B&K's factor (1 - Bn T / 2) besides
    of = theory.flank(BPSK1, 0.05, 1.023e6, 20.46e6)
    analogue = math.sqrt(1.0 - 0.5 * 0.02)
    for kind, metres in (("coherent", 1.66), ("power", 1.70)):
        found = theory.dll_jitter_chips(kind, of, 1.0, 0.02, 30.0) * analogue * CHIP_M
        assert found == pytest.approx(metres, abs=0.006)
    bound = theory.dll_bound_chips(BPSK1, 1.023e6, 20.46e6, 1.0, 30.0) * CHIP_M
    assert bound == pytest.approx(1.46, abs=0.006)
    fit = theory.dll_jitter_piecewise_chips(0.05, 20.0, 1.0, 0.02, 30.0) * CHIP_M
    assert fit == pytest.approx(1.82, abs=0.006)


@pytest.mark.parametrize("spacing", [0.05, 0.25, 0.5])
def test_code_variance_of_a_triangle(spacing):
    # D / (4 T C/N0) [1 + 1 / (T C/N0)] and [1 + 2 / ((2 - D) T C/N0)] in wide bands
    of, D, t_cn0 = theory.flank(BPSK1, spacing, 1.023e6), 2.0 * spacing, 0.02 * 10.0**2.7
    squaring = {"coherent": 0.0, "dot-product": 1.0, "power": 2.0 / (2.0 - D)}
    for kind, part in squaring.items():
        expected = D / (4.0 * t_cn0) * (1.0 + part / t_cn0)
        assert theory.code_variance(kind, of, 0.02, 27.0) == pytest.approx(expected, rel=1e-6)


def test_the_fit_meets_the_integrals_at_its_ends():
    # wide: D >= pi chip rate / band is the triangle's form; narrow: the width is 1 / band
    wide = theory.dll_jitter_piecewise_chips(0.5, 1000.0, 1.0, 0.02, 35.0)
    of = theory.flank(BPSK1, 0.5, 1.023e6)
    assert wide == pytest.approx(theory.dll_jitter_chips("power", of, 1.0, 0.02, 35.0))
    narrow = theory.dll_jitter_piecewise_chips(0.01, 2.0, 1.0, 1.0, 60.0)
    assert narrow == pytest.approx(math.sqrt(0.5e-6 * 0.5), rel=1e-4)


def test_a_code_has_its_own_flank():
    # PRN 1: R(1) = -1/1023 or 63/1023 by the Gold code's three levels
    of = theory.flank_of_code(GPS_L1CA, 1, 0.25)
    side = GPS_L1CA.autocorrelation(1)[1]
    assert round(1023.0 * side) in (-1, 63, -65)
    assert of == pytest.approx((2.0 * (1.0 - side), 0.75 + 0.25 * side, 0.5 + 0.5 * side, 1.0))


def test_mean_time_to_slip_of_the_table():
    for db, seconds in ((0.0, 7.91), (2.0, 23.5), (4.0, 136.6)):
        found = theory.mean_time_to_slip_s(10.0 ** (0.1 * db), 1.0)
        assert found == pytest.approx(seconds, rel=2e-3)


def test_dynamic_stress_of_the_table():
    # third order at 18 Hz: 1.536 deg per g/s; 100 g/s on the best loop with Bn T <= 0.2: 31.2, 31.5
    metres = theory.steady_error(3, 18.0 / 0.7845, 9.80665)
    assert metres / WAVELENGTH_M * 360.0 == pytest.approx(1.536, abs=2e-3)
    for t_s, expected in ((0.005, 31.2), (0.001, 31.5)):
        best = min(
            theory.pll_threshold_dbhz(
                bn, t_s, stress_cycles=980.665 * (0.7845 / bn) ** 3 / WAVELENGTH_M
            )
            for bn in np.arange(20.0, min(60.0, 0.2 / t_s) + 1.0, 2.0)
        )
        assert best == pytest.approx(expected, abs=0.06)
    assert theory.pll_threshold_dbhz(18.0, 0.005, stress_cycles=0.126) == math.inf


@pytest.mark.parametrize(
    ("order", "derivative", "peak"),
    [
        (1, 1, 1.0),
        (2, 1, 0.4559),  # of exp(-0.7071 t) sin(0.7071 t) sqrt 2 / sqrt(1.0002), at t = 1.11
        (2, 2, 1.0433),  # these three by scipy.signal on a grid of 5 ms
        (3, 2, 0.4850),
        (3, 3, 1.4730),
    ],
)
def test_largest_error_after_a_step(order, derivative, peak):
    assert theory.peak_factor(order, derivative) == pytest.approx(peak, abs=2e-4)
    assert theory.peak_factor(order, order + 1) == math.inf


def test_jitter_that_an_oscillator_causes():
    # white frequency noise h0 in an analogue loop of order 2: f_L^2 h0 / (4 sqrt 2 w), by
    # int |s / (s^2 + a s + b)|^2 ds / (2 pi j) = 1 / (2 a); the digital one at w T = 0.004
    white = Oscillator("white", h0=1e-21)
    found = theory.oscillator_jitter_cycles(white, 2, 20.0, 2e-4)
    assert found == pytest.approx(GPS_L1_HZ * math.sqrt(1e-21 / (4.0 * 1.414 * 20.0)), rel=0.01)
    # random walk h-2: f_L^2 h-2 (2 pi)^2 int |1 / (s^2 + ...)|^2 / 2 = / (2 a b): pi^2 / (a b)
    walk = Oscillator("walk", h_minus2=2e-20)
    found = theory.oscillator_jitter_cycles(walk, 2, 20.0, 2e-4)
    expected = GPS_L1_HZ * math.sqrt(2e-20 * math.pi**2 / (1.414 * 20.0**3))
    assert found == pytest.approx(expected, rel=0.01)


def test_jitter_of_the_doppler():
    # order 3, analogue: int |(1.1 w^2 s^2 + w^3 s) / (s^3 + 2.4 w s^2 + 1.1 w^2 s + w^3)|^2
    # = (1.331 + 1) / (2 (2.64 - 1)) w^3 by the table of such integrals
    w, bn = 22.9, 18.0
    expected = 0.02 * math.sqrt(2.331 / 3.28 * w**3 / (2.0 * bn))
    assert theory.doppler_jitter_hz(3, w, 1e-4, bn, 0.02) == pytest.approx(expected, rel=0.01)


# -- noise in discriminators and indicators -------------------------------------------------------


def draws(a2, n=200_000):
    rng = np.random.default_rng(3)
    return math.sqrt(a2) + rng.standard_normal(n) + 1j * rng.standard_normal(n)


@pytest.mark.parametrize("a2", [1.0, 4.0, 12.0])
def test_moments_of_the_angle(a2):
    angle = np.angle(draws(a2))
    for k in (1, 2, 4):
        found = noisy.phase_moment(k, a2)
        assert found == pytest.approx(np.cos(k * angle).mean(), abs=4.0 / math.sqrt(400_000))


@pytest.mark.parametrize("phase", [0.05, 0.15, -0.22])
def test_mean_of_discriminators_in_noise(phase):
    z = draws(4.0) * np.exp(2j * np.pi * phase)
    cycles = np.angle(z) / (2.0 * np.pi)
    expected = {
        "atan2": cycles.mean(),
        "atan": (cycles - 0.5 * np.round(2.0 * cycles)).mean(),
        "decision-directed": (z.imag * np.sign(z.real)).mean() / (4.0 * np.pi),
        "product": (z.imag * z.real).mean() / (8.0 * np.pi),
    }
    for kind, value in expected.items():
        # none of them has a standard deviation of more than 0.25 cycles
        assert noisy.mean_phase_error(kind, np.array(phase), 4.0) == pytest.approx(
            value, abs=4.0 * 0.25 / math.sqrt(200_000)
        )


def test_indicators_in_noise():
    cn0 = 21.0
    bit = draws(0.04 * 10.0**2.1)
    phase = (bit.real**2 - bit.imag**2) / np.abs(bit) ** 2
    half = [draws(0.02 * 10.0**2.1), draws(0.02 * 10.0**2.1)[::-1]]
    power = 0.5 * (np.abs(half[0]) ** 2 + np.abs(half[1]) ** 2)
    frequency = (half[0] * half[1].conj()).real / power
    for found, values in (
        (noisy.phase_indicator(cn0, 0.02), phase),
        (noisy.frequency_indicator(cn0, 0.01), frequency),
    ):
        assert found.mean == pytest.approx(values.mean(), abs=4.0 / math.sqrt(200_000))
        assert found.sigma == pytest.approx(values.std(), rel=0.02)
    # jitter of 0.05 cycles: cos 2 phi is exp(-2 (2 pi 0.05)^2)
    high = noisy.phase_indicator(70.0, 0.02, 0.05)
    assert high.mean == pytest.approx(math.exp(-2.0 * (0.1 * math.pi) ** 2), rel=1e-3)


def test_indicator_threshold_by_hand():
    # mean 1, sigma 1 / A: a low pass of gain 2/3 halves the variance... of sigma by sqrt(1/2); one
    # look and a loss of 15.87 % are one sigma: 1 - 1 / (A sqrt 2) = 0.5 at A^2 = 2
    found = noisy.indicator_threshold_dbhz(
        lambda cn0: noisy.Indicator(1.0, 1.0 / math.sqrt(theory.ratio_hz(cn0))),
        0.5, 2.0 / 3.0, 1.0, 0.15866,
    )  # fmt: skip
    assert found == pytest.approx(10.0 * math.log10(2.0), abs=2e-3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: theory.flank(BPSK1, 0.0, 1e6), "spacing_chips is 0.0"),
        (
            lambda: theory.code_variance("early", theory.Flank(2.0, 0.5, 0.5), 0.02, 30.0),
            "discriminator is 'early'",
        ),
        (lambda: noisy.mean_phase_error("sine", np.zeros(1), 4.0), "kind is 'sine'"),
    ],
)
def test_calls_that_mean_nothing(call, message):
    with pytest.raises(ValueError, match=message):
        call()
