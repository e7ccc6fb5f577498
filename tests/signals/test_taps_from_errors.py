"""Taps in bulk: against the correlator in closed form, the law of the sinc, and statistics."""

import numpy as np
import pytest

from signals.codes import GPS_L1CA
from signals.correlator_model import ModelCorrelator
from signals.noise import normals, stream_key
from signals.taps_from_errors import taps_from_errors

CHIPS = GPS_L1CA.chips(17)[None]
OFFSETS = np.array([-0.5, -0.25, 0.0, 0.25, 0.5])
QUADRATURE = 3e-7  # of `error_integral`, of the amplitude


@pytest.mark.parametrize("delay_chips", [0.0, 0.31, -0.74, 511.4, -1022.6, 3000.2])
@pytest.mark.parametrize("freq_hz", [0.0, 21.0, -130.0])
def test_means_are_those_of_the_model_correlator(truth, command, delay_chips, freq_hz):
    cycles = 0.13
    state = truth(chips=delay_chips, cycles=cycles, cn0_dbhz=41.0, duration_s=0.04)
    nco = command([0.0, 0.031], dump_chips=10230)
    nco.carrier_freq_hz[:] -= freq_hz
    model = ModelCorrelator(state, CHIPS, np.array([17]), OFFSETS, 1, noise=False)(nco)
    middle = 0.5 * (model.t_start_s + model.t_end_s)
    found = taps_from_errors(
        delay_chips, cycles + freq_hz * middle, freq_hz, 41.0,
        model.t_end_s - model.t_start_s, CHIPS, OFFSETS,
    )  # fmt: skip
    assert found.shape == model.iq.shape == (3, 5)
    amplitude = np.sqrt(2.0 * 10.0**4.1 * 0.01)
    np.testing.assert_allclose(found, model.iq, atol=QUADRATURE * amplitude)


@pytest.mark.nojit
def test_sinc_and_phase_of_a_tap():
    """sqrt(2 C/N0 T) sinc(f T) exp(j 2 pi phi), Kaplan & Hegarty, 3rd ed., ch. 8."""
    freq = np.array([0.0, 1e-7, 0.02, 33.0, 100.0, -250.0])
    phase = np.array([[0.0], [0.2], [-7.3]])
    found = taps_from_errors(0.0, phase, freq, 40.0, 0.01, CHIPS, [0.0])[..., 0]
    expected = np.sqrt(2.0 * 1e4 * 0.01) * np.sinc(freq * 0.01) * np.exp(2j * np.pi * phase)
    np.testing.assert_allclose(found, expected, atol=1e-13)


def test_noise_is_unit_white_and_correlated_as_the_code():
    n = 400_000
    iq = taps_from_errors(np.zeros(n), 0.0, 0.0, -100.0, 0.001, CHIPS, OFFSETS, seed=5)
    lag = np.abs(OFFSETS[:, None] - OFFSETS)
    code = CHIPS[0].astype(int)
    covariance = 1.0 - lag * (1.0 - code @ np.roll(code, 1) / 1023.0)
    # a product of two unit normals has variance 1 + r^2 <= 2
    tolerance = 4.5 * np.sqrt(2.0 / n)
    np.testing.assert_allclose((iq.real.T @ iq.real) / n, covariance, atol=tolerance)
    np.testing.assert_allclose((iq.imag.T @ iq.imag) / n, covariance, atol=tolerance)
    np.testing.assert_allclose((iq.real.T @ iq.imag) / n, 0.0, atol=tolerance)
    np.testing.assert_allclose(np.mean(iq, axis=0), 0.0, atol=4.5 / np.sqrt(n) + 1e-4)
    kurtosis = np.mean(iq.real[:, 0] ** 4)
    assert kurtosis == pytest.approx(3.0, abs=4.5 * np.sqrt(96.0 / n))


@pytest.mark.nojit
def test_noise_is_keyed_by_stream_channel_and_number_alone():
    number = np.array([0, 5, 255, 256, 257, 2**40])
    options = {"seed": 3, "stream": "study", "channel": 9}
    together = taps_from_errors(
        np.linspace(-1, 1, 6), 0.1, 3.0, 40.0, 0.001, CHIPS, [0.0, 0.5], number=number, **options
    )
    for k, x in enumerate(np.linspace(-1, 1, 6)):
        alone = taps_from_errors(
            x, 0.1, 3.0, 40.0, 0.001, CHIPS, [0.0, 0.5], number=number[k], **options
        )
        np.testing.assert_array_equal(alone, together[k])
    for change in ({"seed": 4}, {"stream": "other"}, {"channel": 8}):
        other = taps_from_errors(
            0.0, 0.0, 0.0, 0.0, 1e-9, CHIPS, [0.0], number=number, **(options | change)
        )
        assert np.abs(other[:, 0] - together[:, 0]).min() > 1e-6
    # the prompt's noise is the keyed pair itself
    draw = np.empty(2)
    normals(*stream_key(3, "study"), 5, 0, 0, 9 << 16, draw)
    noise = taps_from_errors(0.0, 0.0, 0.0, -300.0, 0.001, CHIPS, [0.0], number=5, **options)
    np.testing.assert_allclose([noise[0].real, noise[0].imag], draw, atol=1e-12)


def test_bad_input_is_refused():
    good = {"delay_chips": 0.0, "phase_cycles": 0.0, "freq_hz": 0.0, "cn0_dbhz": 40.0,
            "duration_s": 0.001, "chips": CHIPS, "offset_chips": [0.0]}  # fmt: skip
    for change, text in (
        ({"delay_chips": [0.0, np.nan]}, "delay_chips contains nan"),
        (
            {"delay_chips": 1e300},
            r"delay_chips contains 1e\+300: expected numbers of at most 1e\+09",
        ),
        ({"freq_hz": -1e200}, "freq_hz contains -1e"),
        ({"duration_s": 0.0}, "duration_s contains 0.0: expected positive numbers"),
        ({"duration_s": 1e308}, r"duration_s contains 1e\+308"),
        ({"cn0_dbhz": 3100.0}, "cn0_dbhz contains 3100.0: expected up to 300 dB-Hz"),
        ({"cn0_dbhz": np.nan}, "cn0_dbhz contains nan"),
        ({"chips": np.zeros_like(CHIPS)}, "replica 0 has no power"),
        ({"chips": np.repeat(CHIPS, 2, axis=0)}, "chips of 2 signals: expected one"),
        ({"channel": 70_000}, "channel: expected whole numbers from 0 to 65535"),
        ({"number": [-1]}, "number: expected whole numbers"),
        ({"offset_chips": [np.inf]}, "offset_chips is"),
        ({"out": np.empty(2, complex)}, "out: expected complex128 of shape"),
        ({"out": np.empty((2, 1), complex)[::2][0]}, None),
    ):
        if text is None:  # a view is as good as an array
            assert taps_from_errors(**(good | change)) is change["out"]
            continue
        with pytest.raises(ValueError, match=text):
            taps_from_errors(**(good | change))


def test_nothing_in_nothing_out() -> None:
    for seed in (None, 1):
        taps = taps_from_errors(
            np.zeros((0, 5)), 0.0, 0.0, 45.0, 0.001, CHIPS, [-0.5, 0.0], seed=seed
        )
        assert taps.shape == (0, 5, 2)
    assert taps_from_errors([0.0, 0.1], 0.0, 0.0, 45.0, 0.001, CHIPS, []).shape == (2, 0)


def test_a_signal_far_below_the_noise_is_nothing() -> None:
    """-1e4 dB-Hz: the amplitude is below the smallest double."""
    assert not taps_from_errors(0.0, 0.0, 0.0, -1e4, 0.001, CHIPS, [0.0]).any()
