"""Discriminators on taps without noise, from each code's own correlation."""

import cmath
import functools
import math

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from signals.codes import GPS_L1CA, GPS_L1CD, GPS_L5I
from signals.correlations import correlations
from signals.replica import replicas
from ultratight.tracking.discriminators import (
    ATAN,
    ATAN2,
    CODE_DISCRIMINATORS,
    FREQUENCY_DISCRIMINATORS,
    PHASE_DISCRIMINATORS,
    Peak,
    check_peak,
    costas_phase,
    delay_error,
    delay_slope,
    dot_product_delay,
    frequency,
    frequency_error,
    phase_error,
    signal_peak,
)

pytestmark = pytest.mark.nojit
IDEAL = np.array([1.0, 0.0, 0.0])


def brute_force_correlation(prn, lag_chips, oversampling=200):
    """R at a lag by multiplying two rectangular-chip waveforms, sample by sample."""
    chips = np.repeat(GPS_L1CA.chips(prn).astype(float), oversampling)
    shift = round(lag_chips * oversampling)
    return float(chips @ np.roll(chips, shift)) / chips.size


@pytest.mark.parametrize("prn", [1, 7, 8, 17])
@pytest.mark.parametrize("spacing", [0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0])
@pytest.mark.parametrize("error", [0.02, -0.03])
def test_delay_has_unit_slope_at_any_spacing(prn, spacing, error):
    turn, amplitude = cmath.exp(0.3j), 11.0
    early, prompt, late = (
        amplitude * turn * brute_force_correlation(prn, error + offset)
        for offset in (-spacing, 0.0, spacing)
    )
    slope = delay_slope(GPS_L1CA.autocorrelation(prn), spacing)
    measured = dot_product_delay(early, prompt, late, amplitude**2, slope)
    # the prompt itself has fallen to R(error); that is the discriminator's curvature, not its slope
    assert measured / brute_force_correlation(prn, error) == pytest.approx(error, rel=1e-9)


def test_slope_of_an_ideal_code():
    # R(s - e) - R(s + e) = 2 e on the flanks of a triangle; e where the late one stands at its foot
    assert delay_slope(IDEAL, 0.3) == 2.0
    assert delay_slope(IDEAL, 1.0) == 1.0


@pytest.mark.parametrize("spacing", [0.0, -0.1, 1.01, math.nan])
def test_spacings_that_mean_nothing(spacing):
    with pytest.raises(ValueError, match="spacing_chips is"):
        delay_slope(IDEAL, spacing)


@pytest.mark.parametrize("bit", [1.0, -1.0])
@pytest.mark.parametrize("cycles", [-0.24, -0.1, 0.0, 1e-3, 0.2])
def test_phase_is_in_cycles_and_blind_to_the_bit(bit, cycles):
    prompt = bit * 7.0 * cmath.exp(2j * math.pi * cycles)
    assert costas_phase(prompt) == pytest.approx(cycles, abs=1e-15)


def test_phase_half_a_cycle_away_is_the_same():
    assert costas_phase(cmath.exp(2j * math.pi * 0.3)) == pytest.approx(-0.2)
    assert costas_phase(0j) == 0.0


@pytest.mark.parametrize("lag_s", [0.001, 0.01])
@pytest.mark.parametrize("share", [-0.45, -0.01, 0.0, 0.02, 0.4])
def test_frequency_is_in_hz_up_to_half_the_rate(lag_s, share):
    hz = share / lag_s
    prompts = [3.0 * cmath.exp(2j * math.pi * (0.17 + hz * lag_s * k)) for k in range(4)]
    products = sum(b * a.conjugate() for a, b in zip(prompts, prompts[1:], strict=False))
    assert frequency(products, lag_s) == pytest.approx(hz, abs=1e-9)


def test_variance_of_the_dot_product():
    # D / (4 (1 - R(1)) T C/N0) (1 + 1 / (T C/N0)), D = 2 s: from the covariance R(d_i - d_k) of the
    # taps' noise; the ideal code's formula is that of Betz & Kolodziejski for wide bands
    prn, spacing, t_cn0, n = 8, 0.25, 12.0, 200_000
    correlation = GPS_L1CA.autocorrelation(prn)
    lag = np.array([-spacing, 0.0, spacing])
    shape = np.interp(np.abs(lag[:, None] - lag), [0.0, 1.0], correlation[:2])
    rng = np.random.default_rng(5)
    noise = np.linalg.cholesky(shape) @ (
        rng.standard_normal((3, n)) + 1j * rng.standard_normal((3, n))
    )
    early, prompt, late = math.sqrt(2.0 * t_cn0) * shape[1][:, None] + noise
    slope = delay_slope(correlation, spacing)
    error = [
        dot_product_delay(*taps, 2.0 * t_cn0, slope)
        for taps in zip(early, prompt, late, strict=True)
    ]
    theory = 2.0 * spacing / (4.0 * (1.0 - correlation[1]) * t_cn0) * (1.0 + 1.0 / t_cn0)
    # the variance of a nearly normal sample is known to sqrt(2 / n); its tails add half as much
    assert np.var(error) == pytest.approx(theory, rel=4.0 * 1.5 * math.sqrt(2.0 / n))
    assert abs(np.mean(error)) < 4.0 * math.sqrt(theory / n)


# -- rows of the tables ---------------------------------------------------------------------------

FINER = {"L1CA": 128, "L1CD": 64, "L5I": 16}
"""Steps that resolve 24 MHz in the correlators' tables: 1/128 chip is (2 pi f h)^4 / 384 = 3e-5"""


@functools.cache
def received_correlation(signal, prn, bandwidth_hz):
    """R(d) as the closed-form correlator has it, near the peak, between its steps by splines."""
    waveform = replicas([signal.subchips(prn)], signal.per_chip)
    finer = FINER[signal.label]
    own = correlations(waveform, np.array([signal.chip_rate_hz]), bandwidth_hz, finer)
    steps = int(own.per_chip[0])
    right = own.table[: 2 * steps + 1]
    lag = np.arange(-2 * steps, 2 * steps + 1) / steps
    return CubicSpline(lag, np.concatenate([right[:0:-1], right]))


@pytest.mark.parametrize("kind", CODE_DISCRIMINATORS)
@pytest.mark.parametrize(
    ("signal", "prn", "bandwidth_hz", "spacings"),
    [
        (GPS_L1CA, 7, 2.046e6, (0.1, 0.25, 0.5)),
        (GPS_L1CA, 7, 8.0e6, (0.05, 0.25, 0.5, 0.8)),
        (GPS_L1CA, 18, 24.0e6, (0.05, 0.1, 0.5)),
        (GPS_L1CD, 3, 4.092e6, (0.05, 0.125, 0.25)),
        (GPS_L1CD, 3, 24.0e6, (0.05, 0.125, 0.4)),
        (GPS_L5I, 5, 20.46e6, (0.1, 0.5, 0.8)),
    ],
)
def test_unit_slope_behind_a_filter(kind, signal, prn, bandwidth_hz, spacings):
    r, e = received_correlation(signal, prn, bandwidth_hz), 2e-4
    for spacing in spacings:
        peak = signal_peak(signal, prn, spacing, bandwidth_hz)
        assert_unit_slope(kind, r, peak, spacing, e, 2e-3)


@pytest.mark.parametrize("kind", CODE_DISCRIMINATORS)
@pytest.mark.parametrize(
    ("signal", "prn", "spacings"),
    [
        (GPS_L1CA, 7, (0.05, 0.25, 0.5, 0.9)),
        (GPS_L1CD, 3, (0.05, 0.2, 0.4, 0.7)),
        (GPS_L5I, 5, (0.1, 0.5)),
    ],
)
def test_unit_slope_of_wide_bands(kind, signal, prn, spacings):
    values = signal.autocorrelation(prn)[: 2 * signal.per_chip + 1]
    lag = np.arange(values.size) / signal.per_chip
    for spacing in spacings:
        peak = signal_peak(signal, prn, spacing)
        assert_unit_slope(kind, lambda d: np.interp(abs(d), lag, values), peak, spacing, 1e-7, 1e-6)


def assert_unit_slope(kind, r, peak, spacing, error, tolerance):
    amplitude, turn = 9.0, -1.0 if kind == "coherent" else cmath.exp(0.4j)
    found = []
    for e in (error, -error):
        taps = [complex(amplitude * turn * r(e + d)) for d in (-spacing, 0.0, spacing)]
        found.append(delay_error(CODE_DISCRIMINATORS[kind], *taps, amplitude**2, *peak))
    assert (found[0] - found[1]) / (2.0 * error) == pytest.approx(1.0, abs=tolerance)
    assert abs(found[0] + found[1]) < 1e-9


def test_peaks_by_closed_form():
    # BOC(1,1) of independent chips: R = 1 - 3 d up to d = 1/2, here but for the code's side lobes
    peak = signal_peak(GPS_L1CD, 3, 0.2)
    assert peak.slope == pytest.approx(6.0, rel=0.02)
    assert peak.level == pytest.approx(0.4, abs=0.01)
    # between a half and a whole chip the slope is that of a side peak, backwards
    assert signal_peak(GPS_L1CD, 3, 0.7).slope == pytest.approx(-2.0, rel=0.04)
    # a filter wide enough is none
    wide = signal_peak(GPS_L1CA, 7, 0.25, 4e9)
    near = signal_peak(GPS_L1CA, 7, 0.25)
    assert wide.level == pytest.approx(near.level, abs=1e-4)
    assert wide.slope == pytest.approx(near.slope, rel=1e-3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: signal_peak(GPS_L1CA, 7, 1.5), "spacing_chips is 1.5"),
        (lambda: signal_peak(GPS_L1CA, 7, 1.5, 2e6), "spacing_chips is 1.5"),
        (lambda: signal_peak(GPS_L1CA, 7, 0.5, 0.0), "bandwidth_hz is 0.0"),
        (lambda: signal_peak(GPS_L1CA, 7, 0.5, math.nan), "bandwidth_hz is nan"),
        (lambda: check_peak("early", Peak(2.0, 0.5)), "code_discriminator is 'early'"),
        (lambda: check_peak("power", Peak(6.0, 0.0)), "the correlation is 0 there"),
        (lambda: check_peak("coherent", Peak(0.0, 0.5)), "grows by 0 per chip"),
    ],
)
def test_peaks_that_mean_nothing(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_no_level_is_asked_of_those_that_need_none():
    check_peak("coherent", Peak(6.0, 0.0))
    check_peak("dot-product", Peak(6.0, 0.0))


@pytest.mark.parametrize("kind", ["coherent", "power", "envelope"])
@pytest.mark.parametrize("spacing", [0.1, 0.5])
def test_variance_of_the_others(kind, spacing):
    # D = 2 s, ideal code: coherent D / (4 T C/N0), power that times 1 + 2 / ((2 - D) T C/N0), in
    # wide bands (Betz & Kolodziejski); envelopes as coherent where C/N0 is high
    t_cn0, n = (12.0, 20_000) if kind == "power" else (1000.0, 20_000)
    lag = np.array([-spacing, 0.0, spacing])
    shape = np.maximum(1.0 - np.abs(lag[:, None] - lag), 0.0)
    rng = np.random.default_rng(6)
    noise = np.linalg.cholesky(shape + 1e-12 * np.eye(3)) @ (
        rng.standard_normal((3, n)) + 1j * rng.standard_normal((3, n))
    )
    taps = math.sqrt(2.0 * t_cn0) * shape[1][:, None] + noise
    peak, number = Peak(2.0, 1.0 - spacing), CODE_DISCRIMINATORS[kind]
    error = [delay_error(number, *z, 2.0 * t_cn0, *peak) for z in taps.T]
    D = 2.0 * spacing
    theory = D / (4.0 * t_cn0)
    if kind == "power":
        theory *= 1.0 + 2.0 / ((2.0 - D) * t_cn0)
    assert np.var(error) == pytest.approx(theory, rel=4.0 * 1.5 * math.sqrt(2.0 / n))
    assert abs(np.mean(error)) < 4.0 * math.sqrt(theory / n)


@pytest.mark.parametrize("kind", PHASE_DISCRIMINATORS)
def test_unit_slope_of_phase(kind):
    amplitude, e = 11.0, 1e-4
    for bit in (1.0,) if kind == "atan2" else (1.0, -1.0):
        found = [
            phase_error(
                PHASE_DISCRIMINATORS[kind],
                bit * amplitude * cmath.exp(2j * math.pi * cycles),
                amplitude**2,
            )
            for cycles in (e, -e)
        ]
        assert (found[0] - found[1]) / (2.0 * e) == pytest.approx(1.0, abs=1e-6)


def test_phase_discriminators_far_from_zero():
    # sin(2 pi x) / 2 pi and sin(4 pi x) / 4 pi; atan2 sees half a cycle, atan does not
    prompt = 5.0 * cmath.exp(2j * math.pi * 0.2)
    sine = math.sin(0.4 * math.pi) / (2.0 * math.pi)
    assert phase_error(PHASE_DISCRIMINATORS["decision-directed"], prompt, 25.0) == pytest.approx(
        sine
    )
    product = math.sin(0.8 * math.pi) / (4.0 * math.pi)
    assert phase_error(PHASE_DISCRIMINATORS["product"], prompt, 25.0) == pytest.approx(product)
    assert phase_error(ATAN2, -prompt, 25.0) == pytest.approx(-0.3)
    assert phase_error(ATAN, -prompt, 25.0) == pytest.approx(0.2)


@pytest.mark.parametrize("lag_s", [0.001, 0.01])
@pytest.mark.parametrize("kind", FREQUENCY_DISCRIMINATORS)
def test_unit_slope_of_frequency(kind, lag_s):
    for share in (1e-4, -2e-4):
        product = 81.0 * cmath.exp(2j * math.pi * share)
        found = frequency_error(FREQUENCY_DISCRIMINATORS[kind], product, lag_s, 81.0)
        assert found == pytest.approx(share / lag_s, rel=1e-6)


def test_frequency_discriminators_far_from_zero():
    # a turn of 0.3 cycles: atan2 knows it, the sine does not, its sign with that of the dot turns
    product = 4.0 * cmath.exp(0.6j * math.pi)
    found = {
        kind: frequency_error(number, product, 1.0, 4.0)
        for kind, number in FREQUENCY_DISCRIMINATORS.items()
    }
    sine = math.sin(0.6 * math.pi) / (2.0 * math.pi)
    assert found == pytest.approx({"atan2": 0.3, "cross": sine, "decision-directed": -sine})
