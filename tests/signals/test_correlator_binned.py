"""The binned engine against the definition in float64: error, edges, bounds, refusals."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from signals import correlator_binned as engine
from signals import cpu
from signals.codes import GPS_L1CA
from signals.correlator import SampleCorrelator
from signals.recording import Recording
from signals.replica import Replicas, replicas

ROOT = Path(__file__).parents[2]
THREE, FIVE = np.array([-0.5, 0.0, 0.5]), np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
ODD = np.array([0.3, -0.13, 0.0, 0.21])
MANY = np.linspace(-1.0, 1.0, 21)


def waveforms(per_chip: int = 1) -> Replicas:
    """Two channels: chips, or BOC(1,1)."""
    shape = {1: np.ones(1), 2: np.array([1.0, -1.0])}[per_chip]
    rows = [np.repeat(GPS_L1CA.chips(prn), per_chip) * np.tile(shape, 1023) for prn in (3, 17)]
    return replicas(rows, per_chip)


def recording(n: int, fs: float, if_hz: float = 0.0, sigma: float = 24.0) -> Recording:
    x = sigma * np.random.default_rng(3).standard_normal((n, 2))
    return Recording(np.clip(np.rint(x), -128, 127).astype(np.int8), fs, if_hz, sigma)


CASES = [
    # fs, offsets, doppler, rate, if, entries per chip, sigma, dump
    (25.0e6, THREE, -4321.0, 0.0, 0.0, 1, 24.0, 1023),
    (25.0e6, FIVE, 10_000.0, 525.0, 0.0, 1, 1.0, 5115),
    (25.0e6, MANY, -10_000.0, -1300.0, 0.0, 1, 24.0, 1023),
    (20.0e6, ODD, 4500.0, 0.0, 25_000.0, 1, 200.0, 1023),
    (20.0e6, THREE, 10_000.0, 0.0, -30_000.0, 2, 24.0, 1023),
    (20.0e6, np.array([0.1]), 2500.0, 0.0, 0.0, 1, 24.0, 1023),
    (20.0e6, np.array([-1500.25, 0.0, 40.0]), 0.3, 0.0, 0.0, 1, 24.0, 2046),
    (50.0e6, THREE, 4500.0, 0.0, 0.0, 1, 24.0, 1023),
    (5.0e6, THREE, 3000.0, 525.0, 0.0, 1, 24.0, 1023),
    (20.0e6, THREE, 2500.0, 0.0, 0.0, 1, 24.0, 50),
]


@pytest.mark.parametrize("case", CASES, ids=lambda c: f"{c[0] / 1e6:g}M-{len(c[1])}taps-{c[5]}")
def test_error_is_what_the_series_leaves_out(command: Any, definition: Any, case: Any) -> None:
    """(w u)^2 / 2 less its mean, u uniform in the widest bin: sqrt(1 / 180) (w L)^2 / 2 rms.

    Float32 adds 1e-5; the parabola of a rate, taken by its mean over a part, pi rate (SPAN / fs)^2
    / 4 / sqrt(45 / 4) rms.
    """
    fs, offsets, doppler, rate, if_hz, per_chip, sigma, dump = case
    source, table = recording(int(0.0111 * fs), fs, if_hz, sigma), waveforms(per_chip)
    nco = command([0.0, 0.00377, 0.011], [-0.3017, 1022.9123], [0.7, -1e8], doppler, rate, dump)
    taps = SampleCorrelator(source, table, offsets, method="binned")(nco)
    assert len(taps.number) >= 2 * (11_000 // dump - 1) > 0
    expected = definition(source, nco, table, offsets, taps)
    off = np.abs(taps.iq - expected)
    # a sample on an edge to 1e-9 of a chip may fall on either side: of the size of a sample
    n = np.rint((taps.t_end_s - taps.t_start_s) * fs)[:, None]
    edge = off > 0.3 / np.sqrt(n)
    assert edge.sum() <= 1
    found = np.linalg.norm(off[~edge]) / np.linalg.norm(expected[~edge])
    cuts = engine.cut_up(np.rint(offsets * per_chip % 1.0 * 2**32).astype(np.int64))
    widest = np.diff(cuts, append=cuts[0] + 2**32).max() / 2**32
    turn = 2.0 * np.pi * (abs(doppler + if_hz)) * widest / (1.023e6 * per_chip)
    bound = turn**2 / 2.0 / np.sqrt(180.0)
    bow = np.pi * abs(rate) * (engine.SPAN / fs) ** 2 / 4.0 / np.sqrt(45.0 / 4.0)
    assert found < 1.3 * np.hypot(bound, bow) + 1e-5
    assert found < 1e-3


def test_gain_is_one(command: Any, definition: Any) -> None:
    """x / sin x: at 30 kHz a bin of half a chip would be 4e-4 too strong."""
    fs, code = 20.0e6, GPS_L1CA.chips(7)
    n = np.arange(60_000)
    nco = command([0.0, 0.003], 5.21234, 0.1, 30_000.0)
    x = 5.21234 + nco.chip_rate_hz[0, 0] * n / fs
    z = 90 * code[np.floor(x).astype(int) % 1023] * np.exp(2j * np.pi * (30_000.0 * n / fs + 0.1))
    samples = np.rint(np.stack([z.real, z.imag], axis=1)).astype(np.int8)
    source, table = Recording(samples, fs, 0.0, 24.0), replicas([code])
    taps = SampleCorrelator(source, table, THREE, method="binned")(nco)
    gain = taps.iq / definition(source, nco, table, THREE, taps)
    assert np.abs(gain[:, 1] - 1.0).max() < 2e-5


@pytest.mark.parametrize("value", [(-128, -128), (127, -128)])
def test_sums_that_turn_over(command: Any, definition: Any, value: tuple[int, int]) -> None:
    """Extremes throughout, bins of 29 samples: 16 bits hold a bin, no prefix sum."""
    fs, table = 59.0e6, waveforms()
    source = Recording(np.tile(np.array(value, np.int8), (130_000, 1)), fs, 0.0, 24.0)
    nco = command([0.0, 0.0022], [5.21234, 7.1], 0.1, [0.0, 977.0])
    taps = SampleCorrelator(source, table, THREE, method="binned")(nco)
    expected = definition(source, nco, table, THREE, taps)
    assert np.abs(taps.iq - expected).max() < 2e-5 * np.abs(expected).max()


def test_same_bits_for_any_call_block_and_thread(command: Any, monkeypatch: Any) -> None:
    source, table = recording(210_000, 20.0e6), waveforms()
    nco = command(np.arange(9) * 1.25e-3, [300.3, 1e4], 0.0, [-2000.0, 40.0], 525.0, [1023, 2046])
    whole = SampleCorrelator(source, table, ODD, method="binned")(nco)
    assert whole.number.size > 10
    threads = SampleCorrelator(source, table, ODD, method="binned", workers=2)(nco)
    monkeypatch.setattr("signals.correlator._BLOCK", engine.SPAN)
    blocks = SampleCorrelator(source, table, ODD, method="binned")(nco)
    parts = SampleCorrelator(source, table, ODD, method="binned")
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


_ELSEWHERE = """
import sys
import numpy as np
from signals.correlator import SampleCorrelator
from signals.nco import Nco
from signals.recording import Recording
from signals.codes import GPS_L1CA
x = np.random.default_rng(5).integers(-128, 128, (50_003, 2)).astype(np.int8)
rate = 1.023e6 * np.ones((1, 1))
nco = Nco(np.array([0.0, 0.0025]), 3.21 * rate / rate, rate, 0.2 * rate / rate,
          4321.0 * rate / rate, 500.0 * rate / rate, np.array([500]), np.ones(1, bool))
taps = SampleCorrelator(Recording(x, 20.0e6, 0.0, 74.0), GPS_L1CA.chips(7)[None],
                        np.linspace(-0.5, 0.5, 5), method="binned")(nco)
np.save(sys.argv[1], taps.iq)
"""


def test_paths_agree(tmp_path: Path) -> None:
    """Every path of this CPU: float32 sums in another order."""
    iq = []
    for path in cpu.available():
        env = os.environ | {"PYTHONPATH": str(ROOT), cpu.VARIABLE: path}
        name = tmp_path / f"{path}.npy"
        subprocess.run([sys.executable, "-c", _ELSEWHERE, str(name)], env=env, check=True)
        iq.append(np.load(name))
    assert iq[0].shape == (4, 5)
    for other in iq[1:]:
        assert np.linalg.norm(other - iq[0]) < 3e-6 * np.linalg.norm(iq[0])


def test_cuts() -> None:
    """At every fraction of a delay, and no more than half an entry apart."""
    half = 1 << 31
    np.testing.assert_array_equal(engine.cut_up(np.array([0, half, half])), [0, half])
    np.testing.assert_array_equal(engine.cut_up(np.array([5])), [5, half + 5])
    far = engine.cut_up(np.array([half - 1, half + 9]))
    assert {half - 1, half + 9} <= set(far.tolist())
    assert np.diff(far, append=far[0] + 2 * half).max() <= half


@pytest.mark.nojit
def test_a_few_samples_in_plain_python(command: Any, definition: Any) -> None:
    source, table = recording(1500, 8.0e6), replicas([GPS_L1CA.chips(3)])
    nco = command([0.0, 0.0001, 0.0001875], 30.3, 0.0, -4321.0, 0.0, 40)
    taps = SampleCorrelator(source, table, THREE, method="binned")(nco)
    assert taps.number.tolist() == [1, 2, 3, 4]
    expected = definition(source, nco, table, THREE, taps)
    assert np.abs(taps.iq - expected).max() < 1e-4 * np.abs(expected).max()


def test_refusals(command: Any) -> None:
    table, nco = waveforms(), command([0.0, 0.001], [0.0, 0.0])

    def correlate(fs: float, if_hz: float, offsets: np.ndarray, dtype: type = np.int8) -> None:
        source = Recording(np.zeros((70_000, 2), dtype), fs, if_hz, 1.0)
        SampleCorrelator(source, table, offsets, method="binned")(nco)

    correlate(20.0e6, 0.0, THREE)
    with pytest.raises(ValueError, match="samples are not int8: expected int8"):
        correlate(20.0e6, 0.0, THREE, np.float32)
    with pytest.raises(ValueError, match=r"3.91 samples per chip: expected 4 to 60 .*these taps"):
        correlate(4.0e6, 0.0, THREE)
    with pytest.raises(ValueError, match=r"62.56 samples per chip: expected 4 to 60"):
        correlate(64.0e6, 0.0, THREE)
    with pytest.raises(ValueError, match=r"9.775 samples per chip: expected 20 to"):
        correlate(10.0e6, 0.0, MANY)
    message = "turns by 0.0025 cycles per sample: expected at most 0.001889"
    with pytest.raises(ValueError, match=message):
        correlate(20.0e6, 50_000.0, THREE)
