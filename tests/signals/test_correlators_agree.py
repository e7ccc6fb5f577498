"""Samples and closed form give the same taps: bounds, mean, covariance; and each sign, in both.

How far may they differ?  Sampling moves each change of sign in the product of signal and replica
by a uniform part of a sample.  Each of the two codes has about 512 changes in a period, of height
2; if independent, the mean over a period of n samples differs from the integral by a standard
deviation of 2 sqrt(1024 / 12) / n of the amplitude: 0.46 % at 4 MHz, 0.09 % at 20 MHz.  All
periods repeat it, unless the code drifts through the samples.  (At 4 x 1.023 MHz they are not
independent and not uniform: 21 % was seen.)
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from signals.code_start import symbol_span
from signals.codes import GPS_L1CA
from signals.constants import C_MPS, CA_CHIP_RATE_HZ, GPS_L1_HZ, WGS84_A
from signals.correlator import SampleCorrelator
from signals.correlator_model import ModelCorrelator
from signals.front_end import SyntheticIf
from signals.nco import Correlator, Nco
from signals.propagation import SignalState, elevation_azimuth, signal_state
from signals.satellites import embedded

OFFSETS = np.array([-0.25, 0.0, 0.25])
WAVELENGTH_M = C_MPS / GPS_L1_HZ
CHIP_M = C_MPS / CA_CHIP_RATE_HZ
Truth = Callable[..., SignalState]
Command = Callable[..., Nco]
Make = Callable[..., Correlator]


def sampling_sigma(fs: float) -> float:
    """Standard deviation of the effect of sampling, per unit of amplitude (see the module)."""
    return 2.0 * np.sqrt(1024 / 12) / (fs * 1e-3)


def from_samples(
    state: SignalState, prn: list[int], offset_chips: np.ndarray = OFFSETS, fs: float = 5.0e6,
    noise: bool = False, sample_format: Any = "float32",
) -> Correlator:  # fmt: skip
    chips = np.array([GPS_L1CA.chips(n) for n in prn])
    source = SyntheticIf(state, chips, fs, 3, if_hz=30e3, sample_format=sample_format, noise=noise)
    return SampleCorrelator(source, chips, offset_chips)


def closed_form(
    state: SignalState, prn: list[int], offset_chips: np.ndarray = OFFSETS, fs: float = 5.0e6,
    noise: bool = False,
) -> Correlator:  # fmt: skip
    chips = np.array([GPS_L1CA.chips(n) for n in prn])
    return ModelCorrelator(
        state, chips, np.array(prn), offset_chips, 4, sample_rate_hz=fs, noise=noise
    )


@pytest.fixture(params=[from_samples, closed_form], ids=["samples", "closed form"])
def make(request: pytest.FixtureRequest) -> Make:
    return request.param


# ---- agreement -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dump_chips", "fs"),
    [(1023, 4.0e6), (1023, 5.0e6), (1023, 20.0e6), (10230, 4.0e6), (10230, 4.3e6)],
)
@pytest.mark.parametrize("prn", [7, 8, 17])
def test_mean_and_bounds(
    truth: Truth, command: Command, prn: int, dump_chips: int, fs: float
) -> None:
    """Random errors: 0.4 chip, any phase, 60 Hz, 500 Hz/s, 30-45 dB-Hz; data, two pieces."""
    rng = np.random.default_rng(prn)
    deviations = []
    for _ in range(16):
        chips, doppler = rng.uniform(0, 20460), rng.uniform(-4000, 4000)
        cn0_dbhz = rng.uniform(30, 45)
        state = truth(
            chips=chips + rng.uniform(-0.4, 0.4),
            cycles=rng.uniform(0, 1),
            doppler_hz=doppler + rng.uniform(-60, 60),
            rate_hz_per_s=rng.uniform(-500, 500),
            cn0_dbhz=cn0_dbhz,
            duration_s=0.035,
            symbols=rng.choice(np.array([-1, 1], np.int8), (1, 6)),
        )
        nco = command([0.0, 13e-3, 0.033], chips=chips, doppler_hz=doppler, dump_chips=dump_chips)
        sampled = from_samples(state, [prn], fs=fs)(nco)
        model = closed_form(state, [prn], fs=fs)(nco)
        assert len(sampled.number) >= 0.033 * CA_CHIP_RATE_HZ // dump_chips - 1
        for name in set(sampled._fields) - {"iq"}:
            a, b = getattr(sampled, name), getattr(model, name)
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-7, err_msg=name)
        amplitude = np.sqrt(2 * 10 ** (cn0_dbhz / 10) * (model.t_end_s - model.t_start_s))
        turn = np.exp(-1j * np.angle(model.iq[:, 1]))  # so that an error of scale is real
        deviations.append(((sampled.iq - model.iq) * (turn / amplitude)[:, None])[:2])
    deviation = np.concatenate(deviations)
    sigma = sampling_sigma(fs)
    assert np.abs(deviation).max() < 4 * sigma
    # over the phases of the samples there is no bias; the two dumps of a case are not independent
    assert np.all(np.abs(deviation.mean(axis=0)) < 4 * sigma / np.sqrt(len(deviations)))


@pytest.mark.parametrize(
    ("prn", "fs", "sample_format"),
    [(7, 5.0e6, "float32"), (8, 4.0e6, "int8"), (17, 4.3e6, "float32")],
)
def test_mean_and_covariance_with_noise(
    truth: Truth, command: Command, prn: int, fs: float, sample_format: str
) -> None:
    """E, P, L with I and Q (6 x 6) over 4000 integrations of 1 ms under wandering errors."""
    n = 4000
    state = truth(chips=0.15, doppler_hz=1207.0, rate_hz_per_s=-3.0, cn0_dbhz=42.0, duration_s=4.01)
    nco = command([0.0, 1.7, 4.008], doppler_hz=1200.0, rate_hz_per_s=1.0)
    mean = closed_form(state, [prn], fs=fs)(nco).iq[:n]
    taps = [
        from_samples(state, [prn], fs=fs, noise=True, sample_format=sample_format)(nco).iq[:n],
        closed_form(state, [prn], fs=fs, noise=True)(nco).iq[:n],
    ]
    own = GPS_L1CA.autocorrelation(prn)
    lag = np.abs(np.subtract.outer(OFFSETS, OFFSETS))
    expected = np.kron(np.eye(2), (1 - lag) + lag * own[1])  # fiqkf.md section 2, own correlation
    bias = sampling_sigma(fs) * np.sqrt(2 * 10**4.2 * 1e-3) * np.array([1.0, 0.0])
    for iq, systematic in zip(taps, bias, strict=True):
        noise = np.hstack([(iq - mean).real, (iq - mean).imag])
        assert len(noise) == n
        assert np.all(np.abs(noise.mean(axis=0)) < 4 * np.hypot(1 / np.sqrt(n), systematic))
        covariance = noise.T @ noise / n
        assert np.all(np.abs(covariance - expected) < 4 * np.sqrt((1 + expected**2) / n))
        lagged = noise[1:].T @ noise[:-1] / n
        assert np.all(np.abs(lagged) < 4.5 / np.sqrt(n))  # 36 of them


def test_frequency_loss(make: Make, truth: Truth, command: Command) -> None:
    """20 log10 sinc(f T): 0.91 dB at f T = 0.25, 3.92 dB at 0.5 (Kaplan & Hegarty, ch. 8)."""
    loss_db = []
    for error_hz in (0.0, 12.5, 25.0):
        nco = command([0.0, 0.05], doppler_hz=800.0, dump_chips=20460)
        # the carrier is off, the code is not
        state = truth(doppler_hz=800.0, duration_s=0.05)
        state.carrier_phase_cycles[:, :, 0] += error_hz * state.t_s[:-1]
        state.carrier_phase_cycles[:, :, 1] += error_hz
        loss_db.append(20 * np.log10(np.abs(make(state, [7])(nco).iq[:2, 1])))
    loss_db = np.array(loss_db)
    expected_db = 10 * np.log10(2 * 10**4.5 * 0.02)
    np.testing.assert_allclose(loss_db[0], expected_db, atol=1e-3)
    np.testing.assert_allclose(loss_db[0] - loss_db[1], 0.912, atol=2e-3)
    np.testing.assert_allclose(loss_db[0] - loss_db[2], 3.922, atol=2e-3)


# ---- signs -----------------------------------------------------------------------------------


def test_farther_than_the_replica_makes_late_larger(
    make: Make, truth: Truth, command: Command
) -> None:
    distance_m = 10.0
    state = truth(chips=-distance_m / CHIP_M, cycles=-distance_m / WAVELENGTH_M, duration_s=0.05)
    taps = make(state, [7])(command([0.0, 0.05], dump_chips=20460))
    early, _, late = np.abs(taps.iq[0])
    assert late > early
    # two straight sides of R, one chip high and (1 - R1) steep
    slope = 1 - GPS_L1CA.autocorrelation(7)[1]
    expected = 2 * slope * distance_m / CHIP_M
    amplitude = np.sqrt(2 * 10**4.5 * 0.02)
    tolerance = 4 * np.sqrt(2) * sampling_sigma(5.0e6)
    np.testing.assert_allclose((late - early) / amplitude, expected, atol=tolerance)
    assert tolerance < expected / 2


def test_receding_faster_turns_the_prompt_clockwise(
    make: Make, truth: Truth, command: Command
) -> None:
    """1 m/s: arg(P2 conj P1) = -2 pi dv Th / lambda = -0.33 rad for Th = 10 ms."""
    speed_mps = 1.0
    state = truth(doppler_hz=2000.0 - speed_mps / WAVELENGTH_M, duration_s=0.05)
    nco = command([0.0, 0.05], doppler_hz=2000.0, dump_chips=10230)
    first, second = make(state, [7])(nco).iq[:2, 1]
    angle = np.angle(second * np.conj(first))
    assert angle == pytest.approx(-0.330, abs=5e-4)
    assert angle == pytest.approx(-2 * np.pi * speed_mps * 0.01 / WAVELENGTH_M, abs=5e-4)


def test_an_approaching_satellite_has_positive_doppler(make: Make, command: Command) -> None:
    """From orbits: the replica at -range rate / lambda finds the signal, its mirror does not."""
    week, tow_s = 2149, 475_220.0
    latitude, longitude = np.radians([39.9, 116.4])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude),
                   np.sin(latitude)])  # fmt: skip
    r_eb_e = WGS84_A * up
    prns, rows = embedded().select(week, tow_s)
    rates, risen = [], []
    for prn in prns:
        r, v, _, _ = embedded().at(week, tow_s, int(prn))
        u = (r - r_eb_e) / np.linalg.norm(r - r_eb_e)
        rates.append(u @ v)
        risen.append(float(elevation_azimuth(r_eb_e, u)[0]) > np.radians(10))
    rate_mps = np.array(rates)
    best = int(np.argmin(np.where(risen, rate_mps, np.inf)))
    assert rate_mps[best] < -400.0
    t_s = np.arange(5) * 5e-3
    first, n_symbol = symbol_span(tow_s, t_s)
    still = np.zeros((t_s.size, 3))
    state = signal_state(
        rows[best : best + 1], tow_s, t_s, still + r_eb_e, still, np.zeros(t_s.size),
        np.zeros(t_s.size), np.array([45.0]), np.ones((1, n_symbol), np.int8), first,
    )  # fmt: skip
    code = state.code_phase_chips[0, 0, 0]
    amplitude = np.sqrt(2 * 10**4.5 * 1e-3)
    for sign, low, high in ((-1, 0.98, 1.01), (+1, 0.0, 0.3)):
        nco = command([0.0, 0.01], chips=code, doppler_hz=sign * rate_mps[best] / WAVELENGTH_M)
        prompt = np.abs(make(state, [int(prns[best])])(nco).iq[:, 1])
        assert len(prompt) >= 8
        assert np.all((low * amplitude < prompt) & (prompt < high * amplitude))


def test_data_symbols_set_the_sign(make: Make, truth: Truth, command: Command) -> None:
    symbols = np.array([[1, -1, 1, 1, -1, -1, 1]], np.int8)
    state = truth(duration_s=0.1, symbols=symbols, first_symbol=-1)
    taps = make(state, [7])(command([0.0, 0.1], dump_chips=10230))
    expected = np.repeat(symbols[0, 1:], 2)[taps.number]
    assert taps.number.tolist() == list(range(9))
    amplitude = np.sqrt(2 * 10**4.5 * 0.01)
    np.testing.assert_allclose(taps.iq[:, 1], expected * amplitude, atol=2e-3 * amplitude)


def test_a_tap_at_positive_offset_is_a_delayed_replica(
    make: Make, truth: Truth, command: Command
) -> None:
    """The signal is 0.6 chip later than the replica: the tap at +0.6 is on top of it."""
    offsets = np.array([0.6, -0.6, 0.0])
    state = truth(chips=-0.6, duration_s=0.05)
    delayed, advanced, prompt = make(state, [17], offsets)(
        command([0.0, 0.05], dump_chips=20460)
    ).iq[0].real / np.sqrt(2 * 10**4.5 * 0.02)
    own = GPS_L1CA.autocorrelation(17)
    tolerance = 4 * sampling_sigma(5.0e6)
    assert delayed == pytest.approx(1.0, abs=2e-3)
    assert prompt == pytest.approx(0.4 + 0.6 * own[1], abs=tolerance)
    assert advanced == pytest.approx(0.8 * own[1] + 0.2 * own[2], abs=tolerance)
