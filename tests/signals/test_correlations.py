"""Autocorrelations of replicas, whole and filtered, against brute force and the modulation's."""

import numpy as np
import pytest

from signals.codes import GPS_L1CA, GPS_L1CP, GPS_L2CM, GPS_L5Q, Signal
from signals.correlations import Correlations, correlations, correlations_of
from signals.correlator_model import ModelCorrelator
from signals.replica import replicas


def own(row: Signal, prns: list[int], **options: object) -> Correlations:
    waveforms = replicas([row.modulation.modulate(row.chips(p)) for p in prns], row.per_chip)
    return correlations(waveforms, np.full(len(prns), row.chip_rate_hz), **options)


def channel(found: Correlations, i: int) -> np.ndarray:
    return found.table[found.first[i] : found.first[i] + found.period[i] + 1]


@pytest.mark.parametrize("row", [GPS_L1CA, GPS_L1CP, GPS_L2CM, GPS_L5Q], ids=lambda r: r.label)
def test_every_lag_is_the_sum_it_claims_to_be(row):
    found = own(row, [3, 9])
    assert found.per_chip.tolist() == [row.per_chip] * 2
    assert found.kept.tolist() == [1.0, 1.0]
    for i, prn in enumerate((3, 9)):
        values = row.modulation.modulate(row.chips(prn)).astype(float)
        table = channel(found, i)
        assert table.size == values.size + 1
        assert table[0] == table[-1] == 1.0
        for k in (1, 2, 7, 12, 501, values.size // 2, values.size - 1):
            assert table[k] == pytest.approx(values @ np.roll(values, k) / values.size, abs=2e-7)


def test_channels_of_several_signals_stand_side_by_side():
    rows = [GPS_L1CA.chips(5), GPS_L1CP.subchips(5), GPS_L5Q.subchips(5)]
    found = correlations_of(replicas(rows, [1, 12, 1]))
    assert found.period.tolist() == [1023, 122_760, 204_600]
    np.testing.assert_array_equal(channel(found, 0)[:-1], GPS_L1CA.autocorrelation(5))
    np.testing.assert_allclose(channel(found, 1)[:-1], GPS_L1CP.autocorrelation(5), atol=1e-12)
    np.testing.assert_allclose(channel(found, 2)[:-1], GPS_L5Q.autocorrelation(5), atol=1e-12)
    assert correlations_of(found) is found


@pytest.mark.parametrize(
    ("row", "bandwidth_hz", "finer"),
    [(GPS_L1CA, 4.092e6, 16), (GPS_L1CP, 24.552e6, 2), (GPS_L5Q, 20.46e6, 8)],
    ids=["L1CA", "L1CP", "L5Q"],
)
def test_a_filter_acts_as_on_the_spectrum_of_the_modulation(row, bandwidth_hz, finer):
    # codes are lines of random power about the modulation's spectrum: the mean over PRN approaches
    # its curve as 1 / sqrt(n length)
    prns = list(range(1, 21))
    found = own(row, prns, bandwidth_hz=bandwidth_hz, finer=finer)
    assert found.per_chip.tolist() == [row.per_chip * finer] * len(prns)
    n = int(found.per_chip[0])
    curves = np.array([channel(found, i)[: n + 1] * found.kept[i] for i in range(len(prns))])
    lag = np.arange(n + 1) / n
    expected = row.modulation.band_limited_correlation(lag, row.chip_rate_hz, bandwidth_hz)
    spread = 1.5 / np.sqrt(len(prns) * row.length_chips)
    np.testing.assert_allclose(curves.mean(axis=0), expected, atol=4 * spread)
    kept = row.modulation.power_kept(row.chip_rate_hz, bandwidth_hz)
    assert found.kept.mean() == pytest.approx(kept, abs=4 * spread)
    assert found.kept.max() < 1.0


def test_the_closed_form_uses_lags_of_parts_of_a_chip(truth, command):
    # constant error, a symbol each: sqrt(2 C/N0 T) R(e + d), R from 1/12 chip steps
    offsets = np.array([-0.5, -5 / 24, 0.0, 5 / 24, 0.5])
    own_table = GPS_L1CP.autocorrelation(7)
    waveforms = replicas([GPS_L1CP.subchips(7)], 12)
    state = truth(chips=0.03, duration_s=0.1, cn0_dbhz=40.0, symbols=np.ones((1, 20), np.int8))
    options = {"symbol_chips": 10_230, "noise": False}
    taps = ModelCorrelator(state, waveforms, np.array([7]), offsets, 1, **options)(
        command([0.0, 0.051], dump_chips=10_230)
    )
    assert len(taps.number) == 5
    lag = np.mod((0.03 + offsets) * 12, own_table.size)
    expected = np.interp(lag, np.arange(own_table.size + 1), np.append(own_table, 1.0))
    amplitude = np.sqrt(2 * 1e4 * (taps.t_end_s - taps.t_start_s))
    np.testing.assert_allclose(taps.iq / amplitude[:, None], np.tile(expected, (5, 1)), atol=1e-6)


def test_the_closed_form_crosses_kinks_of_parts_of_a_chip(truth, command):
    # a code error that runs through three kinks: the mean of R over the way, by brute force
    chips_per_s = 20.0
    state = truth(chips=-0.13, duration_s=0.05, cn0_dbhz=40.0)
    nco = command([0.0, 0.02], dump_chips=20_460)
    nco = nco._replace(chip_rate_hz=nco.chip_rate_hz - chips_per_s)
    waveforms = replicas([GPS_L1CP.subchips(7)], 12)
    offsets = np.array([-0.2, 0.0, 0.1])
    correlator = ModelCorrelator(
        state, waveforms, np.array([7]), offsets, 1, noise=False, period_chips=10_230
    )
    taps = correlator(nco._replace(t_s=np.array([0.0, 0.0201])))
    assert len(taps.number) == 1
    own_table = GPS_L1CP.autocorrelation(7)
    t = (np.arange(200_000) + 0.5) * (taps.t_end_s[0] - taps.t_start_s[0]) / 200_000
    for k, d in enumerate(offsets):
        lag = np.mod((-0.13 + chips_per_s * t + d) * 12, own_table.size)
        mean = np.interp(lag, np.arange(own_table.size + 1), np.append(own_table, 1.0)).mean()
        amplitude = np.sqrt(2 * 1e4 * (taps.t_end_s[0] - taps.t_start_s[0]))
        assert taps.iq[0, k] / amplitude == pytest.approx(mean, abs=1e-6)


def test_a_filtered_signal_loses_amplitude_and_its_noise_stays_one(truth, command):
    found = own(GPS_L1CA, [7], bandwidth_hz=2.046e6)
    kept, table = found.kept[0], channel(found, 0)
    # 0.9028 for random chips (bandlimiting_loss.csv); a code's own lines scatter about it
    assert kept == pytest.approx(0.9028, abs=3 / np.sqrt(1023))
    state = truth(duration_s=0.1, cn0_dbhz=40.0)
    late = np.interp(0.4 * 16, np.arange(table.size), table)
    mean = np.sqrt(2 * 1e4 * 1e-3 * kept) * np.array([1.0, late])
    nco = command([0.0, 0.0905], dump_chips=1023)
    quiet, noisy = (
        ModelCorrelator(state, found, np.array([7]), np.array([0.0, 0.4]), 1, noise=noise)(nco)
        for noise in (False, True)
    )
    np.testing.assert_allclose(quiet.iq, np.tile(mean, (90, 1)), rtol=0, atol=1e-5)
    noise = noisy.iq - mean
    sigma = 1 / np.sqrt(2 * 90)
    assert np.mean(np.abs(noise) ** 2, axis=0) / 2 == pytest.approx([1.0, 1.0], abs=4 * sigma)
    cross = np.mean(noise[:, 0] * noise[:, 1].conj()).real / 2
    assert cross == pytest.approx(late, abs=4 * sigma)
