"""Samples and closed form give the same taps for every kind of modulation.

The samples are made here, from the definition (waveform of the delayed code times carrier), and by
`SyntheticIf`.
Sampling moves each step of signal and replica by a uniform part of a sample: with n steps of
height h_k in each, in N samples, the mean of the product is off by
sqrt(2 sum h_k^2 / 12) / N of the amplitude (see `test_correlators_agree`).
"""

from pathlib import Path

import numpy as np
import pytest

from signals.codes import GPS_L1CD, GPS_L1CP, GPS_L2CM, GPS_L5Q, Signal, galileo_e1
from signals.correlator import SampleCorrelator
from signals.correlator_model import ModelCorrelator
from signals.front_end import SyntheticIf
from signals.nco import Nco
from signals.propagation import SignalState
from signals.recording import Recording
from signals.replica import replicas

CODES = Path(__file__).parents[3] / "shared" / "data" / "codes" / "galileo_e1_memory_codes.csv"
IF_HZ = 20e3
LENGTH_S = 0.0305
OFFSETS = np.array([-0.21, 0.0, 0.21])


def straight(row: Signal, chips: float, cycles: float, doppler_hz: float) -> tuple:
    """Code and carrier at t = 0 and their rates."""
    return chips, row.chip_rate_hz * (1 + doppler_hz / row.carrier_hz), cycles, doppler_hz


def sampled(row: Signal, prn: int, fs: float, signs: np.ndarray, line: tuple) -> Recording:
    """Noise-free samples of C/N0 = fs / 2, so that the amplitude is the noise's sigma."""
    t = np.arange(round(LENGTH_S * fs)) / fs
    code, wave = line[0] + line[1] * t, row.subchips(prn)
    symbol = signs[np.floor(code / row.symbol_chips).astype(int)]
    value = wave[np.floor(code * row.per_chip).astype(np.int64) % wave.size] * symbol
    z = value * np.exp(2j * np.pi * (IF_HZ * t + line[2] + line[3] * t))
    return Recording(np.stack([z.real, z.imag], 1).astype(np.float32), fs, IF_HZ, 1.0)


def synthetic(row: Signal, prn: int, fs: float, signs: np.ndarray, line: tuple) -> SyntheticIf:
    """The same from the front end."""
    return SyntheticIf(
        truth(row, fs, signs, line), replicas([row.subchips(prn)], row.per_chip), fs, 1,
        if_hz=IF_HZ, sample_format="float32", noise=False, symbol_chips=row.symbol_chips,
    )  # fmt: skip


def truth(row: Signal, fs: float, signs: np.ndarray, line: tuple) -> SignalState:
    t = np.arange(8) * 5e-3
    code, carrier = np.zeros((1, 7, 4)), np.zeros((1, 7, 4))
    code[0, :, 0], code[0, :, 1] = line[0] + line[1] * t[:-1], line[1]
    carrier[0, :, 0], carrier[0, :, 1] = line[2] + line[3] * t[:-1], line[3]
    cn0 = np.full((1, 7), 10 * np.log10(fs / 2))
    return SignalState(t, code, carrier, cn0, np.ones((1, 7), bool), signs[None], 0)


def steps(row: Signal, prn: int) -> float:
    """Sum of the squared heights of the steps of one second of the waveform."""
    wave = row.subchips(prn).astype(float)
    return float((np.diff(wave) ** 2).sum() / wave.size * row.per_chip * row.chip_rate_hz)


CASES = [
    pytest.param(GPS_L1CD, 14.3e6, 5115, id="BOC(1,1)"),
    pytest.param(GPS_L1CP, 24.7e6, 10_230, id="TMBOC"),
    pytest.param(GPS_L5Q, 24.7e6, 102_300, id="L5 Q with NH20"),
    pytest.param(GPS_L2CM, 5.3e6, 5115, id="L2 CM, alternate chips"),
    pytest.param(
        "E1C", 24.7e6, 8184, id="CBOC with CS25",
        marks=pytest.mark.skipif(
            not CODES.exists(), reason="needs the reference data folder beside the repository"
        ),
    ),
]  # fmt: skip


@pytest.mark.parametrize("source", [sampled, synthetic])
@pytest.mark.parametrize(("row", "fs", "dump_chips"), CASES)
def test_mean_and_bounds(row, fs, dump_chips, source):
    if row == "E1C":
        row = galileo_e1(CODES)[1]
    rng = np.random.default_rng(5)
    sigma = np.sqrt(2 * steps(row, 7) / 12 / fs)  # times sqrt(1 / N) below
    for _ in range(4):
        start, doppler = rng.uniform(0, row.symbol_chips), rng.uniform(-3000, 3000)
        signs = rng.choice(np.array([-1, 1], np.int8), 12)
        line = straight(
            row, start + rng.uniform(-0.3, 0.3), rng.uniform(0, 1), doppler + rng.uniform(-20, 20)
        )
        command = straight(row, start, 0.0, doppler)
        nco = Nco(
            np.array([0.0, 0.03]),
            *(np.full((1, 1), x) for x in command),
            np.zeros((1, 1)),
            np.array([dump_chips]),
            np.array([True]),
        )
        waveforms = replicas([row.subchips(7)], row.per_chip)
        samples = SampleCorrelator(source(row, 7, fs, signs, line), waveforms, OFFSETS)(nco)
        model = ModelCorrelator(
            truth(row, fs, signs, line), waveforms, np.array([7]), OFFSETS, 1, noise=False,
            symbol_chips=row.symbol_chips, period_chips=dump_chips, sample_rate_hz=fs,
        )(nco)  # fmt: skip
        assert len(samples.number) >= 1
        np.testing.assert_array_equal(samples.number, model.number)
        np.testing.assert_allclose(samples.t_start_s, model.t_start_s, rtol=0, atol=1e-9)
        np.testing.assert_allclose(samples.t_end_s, model.t_end_s, rtol=0, atol=1e-9)
        n = (model.t_end_s - model.t_start_s) * fs
        deviation = (samples.iq - model.iq) / np.sqrt(n)[:, None]
        # parts of a code period: the products of chips are not their mean over it
        parts = 2.0 * np.sqrt(2.0 / dump_chips) if dump_chips % row.length_chips else 0.0
        assert np.abs(deviation).max() < 5 * np.hypot(sigma / np.sqrt(n.min()), parts)
    assert np.abs(model.iq[:, 1]).min() > 0.1 * np.sqrt(n.min())


@pytest.mark.parametrize("make", [sampled, synthetic])
def test_a_replica_of_another_waveform_disagrees(make):
    """The test can fail: BOC(1,1) in place of TMBOC loses the BOC(6,1) chips, 4 of 33."""
    line = straight(GPS_L1CP, 3.0123456, 0.0, 0.0)  # no sample on an edge: 24700 / 1023 per chip
    signs = np.ones(12, np.int8)
    nco = Nco(
        np.array([0.0, 0.03]), *(np.full((1, 1), x) for x in line), np.zeros((1, 1)),
        np.array([10_230]), np.array([True]),
    )  # fmt: skip
    found = []
    for modulation in (GPS_L1CP.modulation, GPS_L1CD.modulation):
        waveforms = replicas([modulation.modulate(GPS_L1CP.chips(7))], modulation.per_chip)
        source = make(GPS_L1CP, 7, 24.7e6, signs, line)
        taps = SampleCorrelator(source, waveforms, np.zeros(1))(nco)
        found.append(taps.iq[0, 0].real / np.sqrt(0.01 * 24.7e6))
    assert found[0] == pytest.approx(1.0, abs=1e-6)
    assert found[1] == pytest.approx(29 / 33, abs=5e-3)
