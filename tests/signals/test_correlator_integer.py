"""The integer engine against the definition in float64: error, bias, bounds, refusals."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from signals import correlator_integer as engine
from signals.codes import GPS_L1CA
from signals.correlator import SampleCorrelator
from signals.lanes_integer import MOST, SPAN, STRIDE
from signals.recording import Recording
from signals.replica import Replicas, replicas

THREE, FIVE = np.array([-0.5, 0.0, 0.5]), np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
ODD = np.array([0.3, -0.13, 0.0, 0.21])
MANY = np.linspace(-1.03, 0.97, 21)
WIDE = np.array([-1500.25, -0.5, 0.0, 0.5, 6.0, 40.0])


def waveforms(per_chip: int = 1) -> Replicas:
    """Two channels: chips, or BOC(1,1), or the four-valued CBOC of E1 (OS SIS ICD 2.3.3)."""
    shape = {
        1: np.ones(1),
        2: np.array([1.0, -1.0]),
        12: np.sqrt(10 / 11) * np.repeat([1.0, -1.0], 6) + np.sqrt(1 / 11) * np.tile([1, -1], 6),
    }[per_chip]
    rows = [np.repeat(GPS_L1CA.chips(prn), per_chip) * np.tile(shape, 1023) for prn in (3, 17)]
    return replicas(rows, per_chip)


def recording(n: int, fs: float, if_hz: float = 0.0, sigma: float = 24.0) -> Recording:
    x = sigma * np.random.default_rng(3).standard_normal((n, 2))
    if sigma < 3.0:  # two bits: -3, -1, 1, 3
        x = np.where(np.abs(x) < sigma, 1, 3) * np.where(x < 0, -1, 1)
    return Recording(np.clip(np.rint(x), -128, 127).astype(np.int8), fs, if_hz, sigma)


def error(taps: Any, expected: np.ndarray) -> float:
    return float(np.linalg.norm(taps.iq - expected) / np.linalg.norm(expected))


def errors(table: Replicas, n: int) -> tuple[float, float]:
    """Least and largest error of noise-like sums of n samples, from what is rounded.

    Carrier: I and Q to whole numbers.  Frequency: within 2^-18 cycles per sample over a stride.
    Chip edges: two roundings to 2^-16 entries move one by a third of that in the mean; a sample
    that lies there meets the next entry.  So few do that their number, of mean m, may be
    m + 4 sqrt(m) + 4.
    """
    carrier = 2.0 / 12.0 / engine.AMPLITUDE**2
    frequency = (2.0 * np.pi * STRIDE * 2.0**-18) ** 2 / 12.0 / 3.0
    rows = [table.table[a : a + n + 1] for a, n in zip(table.first, table.length, strict=True)]
    step = np.mean([np.mean(np.diff(row) ** 2) / np.mean(row**2) for row in rows])
    moved = n * 2.0**-16 / 3.0
    edges = step * (moved + 4.0 * np.sqrt(moved) + 4.0) / n
    return 0.7 * float(np.sqrt(carrier)), 1.1 * float(np.sqrt(carrier + frequency + edges))


CASES = [
    # fs, offsets, doppler, rate, if, entries per chip, sigma, dump
    (4.0e6, THREE, -4321.0, 0.0, 0.0, 1, 24.0, 1023),
    (4.0e6, FIVE, 10_000.0, 525.0, 0.0, 1, 24.0, 20_460),
    (4.0e6, ODD, -10_000.0, -525.0, 1.234567e6, 1, 1.0, 1023),
    (4.0e6, MANY, 4500.0, 0.0, -0.3e6, 1, 200.0, 5115),
    (4.0e6, WIDE, 1000.0, 1300.0, 0.0, 1, 24.0, 1023),
    (25.0e6, THREE, 10_000.0, 0.0, 0.0, 1, 24.0, 1023),
    (25.0e6, FIVE, -123.4, 0.0, 4.0e6, 2, 24.0, 5115),
    (25.0e6, ODD, 2222.2, 0.0, 0.0, 12, 2.0, 1023),
    (2.6e6, THREE, 777.7, 0.0, 0.0, 2, 24.0, 1023),
    (1.1e6, FIVE, 777.7, 0.0, 0.0, 1, 24.0, 1023),  # beyond the window: the plain twin
    (4.0e6, THREE, 2500.0, 0.0, 0.0, 1, 24.0, 50),
    (4.0e6, np.array([0.0]), 2500.0, 0.0, 0.0, 1, 24.0, 1023),
]


@pytest.mark.parametrize("case", CASES, ids=lambda c: f"{c[0] / 1e6:g}M-{len(c[1])}taps-{c[5]}")
def test_error_is_what_is_rounded(command: Any, definition: Any, case: Any) -> None:
    fs, offsets, doppler, rate, if_hz, per_chip, sigma, dump = case
    source, table = recording(int(0.021 * fs), fs, if_hz, sigma), waveforms(per_chip)
    t_s = [0.0, 0.00777, 0.0205 if dump < 20_000 else 0.021]
    nco = command(t_s, [-0.3, 1022.9], [0.7, -1e8], doppler, rate, dump)
    taps = SampleCorrelator(source, table, offsets, method="integer")(nco)
    assert len(taps.number) >= 2 * (20_900 // dump - 1) > 0 or dump == 20_460
    found = error(taps, definition(source, nco, table, offsets, taps))
    n = round(np.sum(taps.t_end_s - taps.t_start_s) * fs)
    least, largest = errors(table, n)
    assert least < found < largest
    assert found < 0.012


def test_no_bias(command: Any, definition: Any) -> None:
    """Gain and early minus late of 60 satellites of any Doppler: right in the mean, to 4 sigma.

    One of them may be off by what a part of a stride, or an edge, makes of its own carrier.
    """
    fs, code, rng = 4.0e6, GPS_L1CA.chips(7), np.random.default_rng(4)
    n, table = np.arange(12_000), replicas([code])
    gain, slope = [], []
    for doppler, chips, cycles in zip(
        rng.uniform(-5e3, 5e3, 60), rng.uniform(0, 1023, 60), rng.uniform(0, 1, 60), strict=True
    ):
        nco = command([0.0, 0.003], chips, cycles, doppler)
        x = chips + nco.chip_rate_hz[0, 0] * n / fs
        z = (
            90
            * code[np.floor(x).astype(int) % 1023]
            * np.exp(2j * np.pi * (doppler * n / fs + cycles))
        )
        samples = np.rint(np.stack([z.real, z.imag], axis=1)).astype(np.int8)
        source = Recording(samples, fs, 0.0, 24.0)
        taps = SampleCorrelator(source, table, THREE, method="integer")(nco)
        expected = definition(source, nco, table, THREE, taps)
        gain += list(taps.iq[:, 1] / expected[:, 1])
        slope += list(((taps.iq - expected)[:, 0] - (taps.iq - expected)[:, 2]) / expected[:, 1])
    for off in (np.array(gain) - 1.0, np.array(slope)):
        assert np.abs(off).max() < 1e-3
        for part in (off.real, off.imag):
            assert abs(part.mean()) < 4.0 * part.std() / np.sqrt(off.size) < 1e-4


@pytest.mark.parametrize("low", [-128, -127])
@pytest.mark.parametrize("if_hz", [0.43e6, -0.43e6])
def test_no_sample_saturates(command: Any, definition: Any, low: int, if_hz: float) -> None:
    """Every sample at an extreme, its signs the carrier's and the code's: the largest sums."""
    fs, code = 4.0e6, GPS_L1CA.chips(7)
    table = replicas([code])
    nco = command([0.0, 0.005], 5.21234, 0.1, 977.0)
    n = np.arange(20_000)
    chip = code[np.floor(5.21234 + nco.chip_rate_hz[0, 0] * n / fs).astype(int) % 1023]
    z = chip * np.exp(2j * np.pi * (if_hz / fs * n + 977.0 * n / fs + 0.1))
    samples = np.where(np.stack([z.real, z.imag], axis=1) >= 0, 127, low).astype(np.int8)
    source = Recording(samples, fs, if_hz, 1.0)
    taps = SampleCorrelator(source, table, THREE, method="integer")(nco)
    expected = definition(source, nco, table, THREE, taps)
    assert np.abs(expected[:, 1]).min() > 0.9 * 127 * np.sqrt(2 * 4000)
    # rounding of 4000 samples, at random, is 1e-4; a saturated sum would lose 5 % at 45 degrees
    assert np.abs(taps.iq - expected).max() < 1e-3 * np.abs(expected).max()


def test_the_bound_of_the_words_is_reached_by_no_table() -> None:
    """255 max(c + s) <= 255 * 128 < 2^15 for every frequency (1)."""
    table, bias = np.zeros((1, 2, 2 * STRIDE), np.int8), np.zeros((1, 2, STRIDE), np.int16)
    most = 0
    for number in range(-(1 << 16), 1 << 16, 509):
        gain = engine.tabulate(number * 2.0**-17, 0, table, bias)
        assert gain == pytest.approx(engine.AMPLITUDE, rel=0.006)  # 90 where nothing turns
        pairs = table.astype(int).reshape(2, STRIDE, 2)
        high = np.maximum(pairs, 0).sum(axis=2).max()
        low = np.minimum(pairs, 0).sum(axis=2).min()
        most = max(most, high, -low)
        np.testing.assert_array_equal(bias[0], 128 * pairs.sum(axis=2))
    assert 120 < most <= 128


def test_same_bits_for_any_call_block_and_thread(command: Any, monkeypatch: Any) -> None:
    fs = 4.0e6
    source, table = recording(84_000, fs), waveforms()
    nco = command(np.arange(9) * 2.5e-3, [300.3, 1e4], 0.0, [-2000.0, 40.0], 525.0, [1023, 5115])
    whole = SampleCorrelator(source, table, ODD, method="integer")(nco)
    threads = SampleCorrelator(source, table, ODD, method="integer", workers=2)(nco)
    monkeypatch.setattr("signals.correlator._BLOCK", SPAN)
    blocks = SampleCorrelator(source, table, ODD, method="integer")(nco)
    parts = SampleCorrelator(source, table, ODD, method="integer")
    rows = [
        parts(
            nco._replace(
                t_s=nco.t_s[a : b + 1], **{f: getattr(nco, f)[a:b] for f in nco._fields[1:6]}
            )
        )
        for a, b in itertools.pairwise([0, 1, 4, 8])
    ]
    order = np.argsort(np.concatenate([r.channel for r in rows]), kind="stable")
    calls = [np.concatenate(column)[order] for column in zip(*rows, strict=True)]
    for other in (threads, blocks, calls):
        for column, expected in zip(other, whole, strict=True):
            np.testing.assert_array_equal(column, expected)


@pytest.mark.skipif(not engine.IN_VECTORS, reason="needs AVX-512 VNNI")
def test_vectors_are_their_twin(command: Any, monkeypatch: Any) -> None:
    """The same integers; float32 sums of them differ from float64 ones."""
    fs = 4.0e6
    source, table = recording(30_000, fs), waveforms()
    nco = command([0.0, 0.007], [300.3, 1e4], 0.0, [-2000.0, 4e3], 525.0, [1023, 2046])
    iq = []
    for most in (1 << 33, 0):  # a step beyond it goes to the twin
        correlate = SampleCorrelator(source, table, MANY, method="integer")
        correlate._engines[0].own[0].most[:] = most
        iq.append(correlate(nco).iq)
    assert np.linalg.norm(iq[0] - iq[1]) < 1e-6 * np.linalg.norm(iq[0])
    assert np.any(iq[0] != iq[1])


def test_clusters_share_windows() -> None:
    """Five taps on half chips: one window, two comparisons; far taps have their own."""

    def of(offsets: list[float]) -> list[list[list[int]]]:
        late = max(offsets)
        return engine.clusters(np.array([[round((late - d) * 2**32) for d in offsets]]))

    assert of([-1.0, -0.5, 0.0, 0.5, 1.0]) == [[[4, 2, 0], [3, 1]]]
    assert of([-0.1, 0.0, 0.1]) == [[[2], [1], [0]]]
    assert of([0.0, 40.0, 0.5]) == [[[1]], [[2], [0]]]
    assert [sum(map(len, c)) for c in of(np.arange(0, 2, 0.1).tolist())] == [MOST, MOST, MOST, 2]


@pytest.mark.nojit
def test_a_few_samples_in_plain_python(command: Any, definition: Any) -> None:
    source, table = recording(1500, 4.0e6), replicas([GPS_L1CA.chips(3)])
    nco = command([0.0, 0.000375], 30.3, 0.0, -4321.0, 0.0, 100)
    taps = SampleCorrelator(source, table, THREE, method="integer")(nco)
    assert taps.number.tolist() == [1, 2, 3]
    assert error(taps, definition(source, nco, table, THREE, taps)) < 0.01


def test_refusals(command: Any) -> None:
    floats = Recording(np.zeros((20_000, 2), np.float32), 4.0e6, 0.0, 1.0)
    nco = command([0.0, 0.005], [0.0, 0.0])
    unknown: Any = "fast"
    with pytest.raises(
        ValueError, match='samples are not int8: expected int8 for method "integer"'
    ):
        SampleCorrelator(floats, waveforms(), THREE, method="integer")(nco)
    with pytest.raises(ValueError, match="method is 'fast': expected one of exact, integer"):
        SampleCorrelator(floats, waveforms(), THREE, method=unknown)
