"""Discriminators on taps without noise, from each code's own correlation."""

import cmath
import math

import numpy as np
import pytest

from signals.codes import GPS_L1CA
from ultratight.tracking.discriminators import (
    costas_phase,
    delay_slope,
    dot_product_delay,
    frequency,
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
