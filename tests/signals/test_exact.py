"""The exact engine on every path of this CPU, against the definition in numpy's float64."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from signals import cpu
from signals.codes import GPS_L1CA
from signals.constants import CA_CHIP_RATE_HZ, GPS_L1_HZ
from signals.correlator import SampleCorrelator
from signals.lanes_correlator import SPAN, STRIDE
from signals.nco import Nco
from signals.recording import Recording
from signals.replica import Replicas, replicas

ROOT = Path(__file__).parents[2]
THREE, FIVE = np.array([-0.5, 0.0, 0.5]), np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
MANY = np.linspace(-1.03, 0.97, 21)


def waveforms(per_chip: int) -> Replicas:
    """Two channels: chips, BOC(1,1), or the four-valued CBOC of Galileo E1 (OS SIS ICD 2.3.3)."""
    shape = {
        1: np.ones(1),
        2: np.array([1.0, -1.0]),
        12: np.sqrt(10 / 11) * np.repeat([1.0, -1.0], 6) + np.sqrt(1 / 11) * np.tile([1, -1], 6),
    }[per_chip]
    rows = [np.repeat(GPS_L1CA.chips(prn), per_chip) * np.tile(shape, 1023) for prn in (3, 17)]
    return replicas(rows, per_chip)


def command(t_s: Any, doppler_hz: float, rate_hz_per_s: float, dump_chips: int) -> Nco:
    """Two channels from chips -0.3 and 1022.9 on, at one piece's phases and rates each."""
    t_s, ones = np.asarray(t_s, float), np.ones((len(t_s) - 1, 2))
    begin = t_s[:-1, None]
    rate = CA_CHIP_RATE_HZ * (1 + doppler_hz / GPS_L1_HZ)
    return Nco(
        t_s,
        np.array([-0.3, 1022.9]) + rate * begin,
        rate * ones,
        np.array([0.7, -1e8]) + begin * (doppler_hz + 0.5 * rate_hz_per_s * begin),
        doppler_hz + rate_hz_per_s * begin * ones,
        rate_hz_per_s * ones,
        np.full(2, dump_chips),
        np.ones(2, bool),
    )


def reference(
    z: np.ndarray, fs: float, if_hz: float, nco: Nco, table: Replicas, offset_chips: np.ndarray,
    channel: int, first: int, end: int,
) -> np.ndarray:  # fmt: skip
    """Sum over samples first ... end - 1: every index and every phase its own, in float64."""
    n = np.arange(first, end)
    p = np.searchsorted(np.ceil(nco.t_s * fs - 1e-5), n, side="right") - 1
    dt = n / fs - nco.t_s[p]
    x = nco.code_phase_chips[p, channel] + nco.chip_rate_hz[p, channel] * dt
    cycles = nco.carrier_phase_cycles[p, channel] % 1.0 + nco.carrier_freq_hz[p, channel] * dt
    cycles += 0.5 * nco.carrier_rate_hz_per_s[p, channel] * dt**2 + if_hz * n / fs
    wiped = z[n] * np.exp(-2j * np.pi * cycles)
    period = table.table[table.first[channel] :][: table.length[channel]].astype(float)
    index = np.floor((x - offset_chips[:, None]) * table.per_chip[channel]).astype(int)
    return period[index % period.size] @ wiped


CASES = [
    # fs, offsets, doppler, rate, type, if, sub-chips, dump
    (4.0e6, THREE, -4321.0, 0.0, np.int8, 0.0, 1, 20_460),
    (4.0e6, FIVE, 3456.7, 0.0, np.float32, 1.0e6, 1, 1023),
    (4.0e6, MANY, 4500.0, 0.0, np.int8, -0.3e6, 1, 5115),
    (4.0e6, THREE, 1000.0, 1300.0, np.int8, 0.0, 1, 20_460),
    (4.0e6, THREE, 1000.0, -525.0, np.float32, 0.0, 1, 1023),
    (25.0e6, THREE, 4321.0, 0.0, np.int8, 0.0, 1, 1023),
    (25.0e6, FIVE, -123.4, 0.0, np.float32, 4.0e6, 2, 20_460),
    (25.0e6, THREE, 2222.2, 0.0, np.int8, 0.0, 12, 5115),
    (2.6e6, np.array([-0.1, 0.1]), -2000.0, 0.0, np.int8, 0.0, 1, 2046),
    (2.6e6, THREE, 777.7, 0.0, np.int8, 0.0, 2, 1023),
    (CA_CHIP_RATE_HZ * (1 + 1e-4), THREE, -4000.0, 0.0, np.int8, 0.0, 1, 1023),
    (1.5e6, np.array([0.0]), 100.0, 0.0, np.float32, 0.0, 2, 1023),
    (4.0e6, np.array([-0.05, 0.0, 0.05, 7.0]), 10.0, 0.0, np.int8, 0.0, 12, 1023),
    (4.0e6, THREE, 2500.0, 0.0, np.int8, 0.0, 1, 50),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case[0] / 1e6:.3f}-{case[6]}")
def test_sums_follow_their_definition(case: Any) -> None:
    """Float32 rounding only, save for a sample in 10^6 that lies on the edge of a chip.

    Under a frequency rate the frequency of a stride is off by up to half of what it moves in a
    cell: over uniform places in cell and stride 2 pi rate (SPAN / fs) (STRIDE / fs) / 12 rms.
    """
    fs, offset_chips, doppler_hz, rate, dtype, if_hz, per_chip, dump = case
    table = waveforms(per_chip)
    t_s = [0.0, 0.00777, 0.0205] if dump > 50 else [0.0, 0.0011]
    n = int(t_s[-1] * fs)
    samples = 24.0 * np.random.default_rng(3).standard_normal((n + 9, 2))
    samples = np.clip(np.rint(samples), -127, 127).astype(dtype)
    nco = command(t_s, doppler_hz, rate, dump)
    taps = SampleCorrelator(Recording(samples, fs, if_hz, 24.0), table, offset_chips)(nco)
    z = (samples[:, 0].astype(float) + 1j * samples[:, 1]) / 24.0
    span = np.rint(np.stack([taps.t_start_s, taps.t_end_s], axis=1) * fs).astype(int)
    assert len(span) >= 2 * ((t_s[-1] - t_s[0]) * CA_CHIP_RATE_HZ // dump - 1)
    expected = np.array(
        [
            reference(z, fs, if_hz, nco, table, offset_chips, channel, *ab) / np.sqrt(ab[1] - ab[0])
            for channel, ab in zip(taps.channel, span, strict=True)
        ]
    )
    error = np.abs(taps.iq - expected)
    # one wrong sample is of the size of the noise of one
    edge = error > 0.1 / np.sqrt((span[:, 1] - span[:, 0])[:, None])
    assert edge.sum() <= 1 + 1e-6 * 2 * n * offset_chips.size
    relative = np.linalg.norm(error[~edge]) / np.linalg.norm(expected[~edge])
    drift = 2 * np.pi * abs(rate) * (SPAN / fs) * (STRIDE / fs) / 12
    assert drift < 5e-5
    assert relative < 2e-6 + 1.2 * drift


def test_a_frequency_rate_does_not_bias_the_sum() -> None:
    """1.3 kHz/s over 20 ms: the prompt of the signal itself is sqrt(N), real, to 2e-6."""
    fs, code = 4.0e6, GPS_L1CA.chips(3)
    nco = command([0.0, 0.0205], 1000.0, 1300.0, 20_460)
    n = np.arange(int(0.0205 * fs))
    t = n / fs
    x = nco.code_phase_chips[0, 0] + nco.chip_rate_hz[0, 0] * t
    cycles = 0.7 + (1000.0 + 650.0 * t) * t
    z = code[np.floor(x).astype(int) % 1023] * np.exp(2j * np.pi * cycles)
    source = Recording(np.stack([z.real, z.imag], 1).astype(np.float32), fs, 0.0, 1.0)
    taps = SampleCorrelator(source, waveforms(1), np.array([0.0]))(nco)
    count = np.rint((taps.t_end_s[0] - taps.t_start_s[0]) * fs)
    assert taps.channel[0] == 0
    assert abs(taps.iq[0, 0] / np.sqrt(count) - 1) < 2e-6


def test_scaled_waveforms_scale_the_sums() -> None:
    """A table is any real number: twice the table, twice the sum, to the bit."""
    source = Recording(np.random.default_rng(1).normal(size=(9000, 2)).astype("f4"), 4e6, 0.0, 1.0)
    one = waveforms(12)
    two = one._replace(table=2.0 * one.table)
    nco = command([0.0, 0.002], -321.0, 0.0, 1023)
    a, b = (SampleCorrelator(source, table, THREE)(nco).iq for table in (one, two))
    np.testing.assert_array_equal(2.0 * a, b)


@pytest.mark.parametrize("path", [name for name in cpu.available() if name != cpu.path()])
def test_the_other_paths_follow_it_too(path: str) -> None:
    chosen = "sums_follow or bias"
    done = subprocess.run(
        [sys.executable, "-m", "pytest", __file__, "-k", chosen, "-p", "no:cacheprovider"],
        cwd=ROOT, capture_output=True, text=True, check=False,
        env=os.environ | {cpu.VARIABLE: path, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
