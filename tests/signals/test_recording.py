"""Recordings: formats, conventions, scale, files that cannot be used, and the real sky."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from signals.codes import GPS_L1CA
from signals.correlator import SampleCorrelator
from signals.nco import Nco
from signals.recording import Recording
from signals.sample_formats import FORMATS, encode

IQ = Path(__file__).parents[3] / "shared" / "data" / "iq"
FS = 4.0e6


def values(name: str, n: int, seed: int = 0) -> np.ndarray:
    """Random samples that a format can hold: (n, 2) or (n,)."""
    form, rng = FORMATS[name], np.random.default_rng(seed)
    shape = (n,) if form.real else (n, 2)
    if form.packing:
        return rng.choice(form.packing.levels, shape)
    return np.rint(24 * rng.standard_normal(shape)).astype(form.value_dtype)


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_gives_its_samples_for_any_range(tmp_path: Path, name: str) -> None:
    x = values(name, 1001 if not FORMATS[name].packed else 1008)
    path = tmp_path / "if.bin"
    path.write_bytes(encode(x, FORMATS[name]).tobytes())
    recording = Recording(path, FS, 0.0, 1.0, sample_format=name, first_sample=7)
    assert len(recording) == len(x)
    expected = x if x.ndim == 2 else np.stack([x, np.zeros_like(x)], axis=1)
    for a, b in [(0, len(x)), (0, 0), (1, 2), (3, 8), (501, 502), (998, 1000), (5, 1001)]:
        given = recording.samples(7 + a, 7 + b)
        assert given.dtype == recording.dtype
        np.testing.assert_array_equal(given, expected[a:b])
    with pytest.raises(ValueError, match=r"if.bin has 7 to"):
        recording.samples(6, 8)


@pytest.mark.parametrize("name", ["ci8", "ci16", "cf32", "cu8", "ci2p"])
def test_order_and_sign_of_q_are_put_right(tmp_path: Path, name: str) -> None:
    """Written as (Q, I), as (I, -Q), and as the two together: z, read back with the same flags."""
    z = values(name, 1000)
    for swap in (False, True):
        for conjugate in (False, True):
            written = z * np.array([1, -1], np.int8) if conjugate else z
            written = written[:, ::-1] if swap else written
            path = tmp_path / f"{swap}{conjugate}.bin"
            path.write_bytes(encode(np.ascontiguousarray(written).astype(z.dtype), FORMATS[name]))
            recording = Recording(
                path, FS, 0.0, 1.0, sample_format=name, swap_iq=swap, conjugate=conjugate
            )
            np.testing.assert_array_equal(recording.samples(10, 990), z[10:990])


def test_the_least_int8_is_clipped_when_conjugated() -> None:
    x = np.array([[-128, -128], [127, 127]], np.int8)
    given = Recording(x, FS, 0.0, 1.0, conjugate=True).samples(0, 2)
    assert given.tolist() == [[-128, 127], [127, -127]]
    assert x.tolist() == [[-128, -128], [127, 127]]


def test_samples_are_mapped_not_read(tmp_path: Path) -> None:
    """A file of 40 GB that occupies nothing: opened, measured and read at its end."""
    path = tmp_path / "large.bin"
    with path.open("wb") as file:
        file.truncate(40_000_000_000)
        file.seek(-4, 2)
        file.write(bytes([1, 2, 3, 4]))
    recording = Recording(path, FS, 0.0)
    assert recording.end_sample == 20_000_000_000
    assert recording.samples(19_999_999_998, 20_000_000_000).tolist() == [[1, 2], [3, 4]]
    assert recording.sigma > 0.0  # its last block is part of what is measured


# -- sigma and the scale of taps -----------------------------------------------------------------


@pytest.mark.parametrize("name", ["ci8", "ri8", "cf32", "ri16"])
def test_sigma_is_measured_about_the_mean(name: str) -> None:
    """Gaussian noise of 24 per value with an offset: 24 for I and Q, 24 / sqrt(2) for real.

    2^20 samples at most: the standard deviation of a measured sigma is sigma / sqrt(2 n).
    """
    rng = np.random.default_rng(3)
    real = FORMATS[name].real
    n = 1_500_000
    x = 24.0 * rng.standard_normal(n if real else (n, 2)) + 5.0
    if FORMATS[name].dtype.kind == "i":
        x = np.rint(x)
    recording = Recording(x.astype(FORMATS[name].dtype), FS, 1e6 if real else 0.0)
    expected = 24.0 / np.sqrt(2.0) if real else 24.0
    assert recording.sigma == pytest.approx(expected, rel=4.0 / np.sqrt(2.0 * 2**20))


def tone(real: bool, cn0_dbhz: float, if_hz: float, seconds: float, seed: int) -> np.ndarray:
    """One satellite, code phase 0 at sample 0, no Doppler, in white noise of sigma 20."""
    rng = np.random.default_rng(seed)
    n = np.arange(round(seconds * FS))
    chips = GPS_L1CA.chips(5)[np.floor(n / FS * 1.023e6).astype(int) % 1023]
    phase = 2.0 * np.pi * if_hz * n / FS
    # complex: 2 sigma^2 = N0 fs, amplitude^2 = C; real: sigma^2 = N0 fs / 2, amplitude^2 / 2 = C
    amplitude = 20.0 * np.sqrt(2.0 * 10 ** (cn0_dbhz / 10) / FS) * (np.sqrt(2.0) if real else 1.0)
    if real:
        return amplitude * chips * np.cos(phase) + 20.0 * rng.standard_normal(n.size)
    z = amplitude * chips * np.exp(1j * phase)
    return np.stack([z.real, z.imag], axis=1) + 20.0 * rng.standard_normal((n.size, 2))


@pytest.mark.parametrize(("real", "if_hz"), [(False, 0.0), (False, -1.2e5), (True, 1.1e6)])
def test_taps_have_the_same_scale_for_real_and_complex_samples(real: bool, if_hz: float) -> None:
    """Mean sqrt(2 C/N0 T) and unit variance per component (Kaplan & Hegarty, 3rd ed., ch. 8)."""
    cn0, seconds = 45.0, 4.0
    x = tone(real, cn0, if_hz, seconds, 4)
    recording = Recording(np.clip(np.rint(x), -127, 127).astype(np.int8), FS, if_hz)
    correlator = SampleCorrelator(recording, GPS_L1CA.chips(5)[None], np.zeros(1))
    one = np.ones((1, 1))
    taps = correlator(
        Nco(
            np.array([0.0, seconds]),
            0.0 * one,
            1.023e6 * one,
            0.0 * one,
            0.0 * one,
            0.0 * one,
            np.array([1023]),
            np.array([True]),
        )
    )
    iq = taps.iq[:, 0]
    n = iq.size
    assert n >= 3999
    expected = np.sqrt(2.0 * 10 ** (cn0 / 10) * 1e-3)
    assert iq.real.mean() == pytest.approx(expected, abs=4.0 / np.sqrt(n) + 0.01 * expected)
    assert iq.imag.mean() == pytest.approx(0.0, abs=4.0 / np.sqrt(n))
    for part in (iq.real, iq.imag):
        assert part.var() == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / n) + 0.01)


# -- what cannot be used ------------------------------------------------------------------------

BAD = {
    "missing": (None, "ci8", "no such file, expected interleaved I, Q samples of ci8, 16 bits"),
    "empty": (b"", "ci16", "empty, expected interleaved I, Q samples of ci16, 32 bits"),
    "truncated": (bytes(11), "cf32", "sample that begins at byte 8 of 11 is not whole"),
    "truncated real": (bytes(3), "ri16", "sample that begins at byte 2 of 3 is not whole"),
    "all equal": (bytes(100), "ci8", "samples are all equal"),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_file_that_cannot_be_used_is_named(tmp_path: Path, kind: str) -> None:
    content, name, expected = BAD[kind]
    path = tmp_path / "bad.bin"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=expected) as caught:
        Recording(path, FS, 0.0, sample_format=name)
    assert "bad.bin" in str(caught.value) or kind == "all equal"


def test_a_stated_length_is_checked(tmp_path: Path) -> None:
    path = tmp_path / "if.bin"
    path.write_bytes(bytes(range(10)))
    kept = Recording(path, FS, 0.0, sample_format="ci2p", n_samples=19)
    assert kept.end_sample == 19
    with pytest.raises(ValueError, match=r"10 bytes, expected 11 .*; truncated at byte 10"):
        Recording(path, FS, 0.0, sample_format="ci2p", n_samples=21)
    with pytest.raises(ValueError, match=r"10 bytes, expected 8 .*; data follow at byte 8"):
        Recording(path, FS, 0.0, sample_format="ci8", n_samples=4)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"sample_rate_hz": 0.0}, "sample_rate_hz is 0"),
        ({"sample_rate_hz": float("nan")}, "sample_rate_hz is nan"),
        ({"if_hz": 2.1e6}, "if_hz is 2100000"),
        ({"if_hz": float("inf")}, "if_hz is inf"),
        ({"sigma": -1.0}, "sigma is -1"),
        ({"sigma": 1e300}, r"sigma is 1e\+300"),
        ({"first_sample": -5}, "first_sample is -5"),
    ],
)
def test_numbers_that_mean_nothing(change: dict[str, float], expected: str) -> None:
    known = {"sample_rate_hz": FS, "if_hz": 0.0, "sigma": 1.0} | change
    with pytest.raises(ValueError, match=expected):
        Recording(np.ones((4, 2), np.int8), **known)


def test_arrays_that_are_no_samples() -> None:
    for array in (np.zeros((4, 2), complex), np.zeros((4, 3), np.int8), np.zeros((4, 2))):
        with pytest.raises(ValueError, match=rf"samples are {array.dtype} \(4, .\): expected"):
            Recording(array, FS, 0.0, 1.0)


def test_real_samples_have_no_q() -> None:
    with pytest.raises(ValueError, match="real samples have no Q"):
        Recording(np.ones(4, np.int8), FS, 1e6, 1.0, conjugate=True)


# -- the real sky --------------------------------------------------------------------------------

SKY = {
    "L1_20211202_084700_4MHz_IQ.bin": (
        {"sample_rate_hz": 4e6, "if_hz": 0.0, "sample_format": "ci8", "conjugate": True},
        [(26, 650.0, 0.89978), (31, -204.0, 0.28972), (29, -2215.0, 0.41320)],
    ),
    "L1_20211125_004000_12MHz_I.bin": (
        {"sample_rate_hz": 12e6, "if_hz": 3e6, "sample_format": "ri8"},
        [(13, -241.0, 0.50033), (15, 1746.0, 0.77640), (20, -1349.0, 0.68097)],
    ),
    "codc_bladerf_l1_5MHz_ishort.dat": (
        {"sample_rate_hz": 5e6, "if_hz": 0.0, "sample_format": "ci16"},
        [(27, -861.0, 0.61195), (4, -1808.0, 0.65096)],
    ),
}  # fmt: skip
"""File: how it is read; PRN, Doppler [Hz], time to the next code start [ms] (data README)"""


def strongest(recording: Recording, prn: int, doppler_hz: float, n_ms: int = 60) -> tuple:
    """(time to the next code start [ms], peak over median) of incoherently added milliseconds."""
    fs = recording.sample_rate_hz
    n = round(fs * 1e-3)
    iq = recording.samples(0, n * n_ms).astype(float)
    t = np.arange(n * n_ms) / fs
    z = (iq[:, 0] + 1j * iq[:, 1]) * np.exp(-2j * np.pi * (recording.if_hz + doppler_hz) * t)
    rate = 1.023e6 * (1.0 + doppler_hz / 1575.42e6)
    code = GPS_L1CA.chips(prn)[np.floor(rate * t).astype(int) % 1023]
    spectra = np.fft.fft(z.reshape(n_ms, n)) * np.conj(np.fft.fft(code.reshape(n_ms, n)))
    power = (np.abs(np.fft.ifft(spectra)) ** 2).sum(axis=0)
    return power.argmax() / fs * 1e3, power.max() / np.median(power)


@pytest.mark.skipif(not IQ.exists(), reason="needs the reference data folder beside the repository")
@pytest.mark.parametrize("name", SKY)
def test_satellites_of_the_real_sky_are_where_they_were_found(name: str) -> None:
    """At the sign of Doppler that the data README gives, and not at the other.

    Within half a chip and a sample: 0.5 us + 0.25 us at most.
    """
    how, satellites = SKY[name]
    recording = Recording(IQ / name, **how)
    for prn, doppler_hz, expected_ms in satellites:
        at_ms, over_median = strongest(recording, prn, doppler_hz)
        assert at_ms == pytest.approx(expected_ms, abs=0.75e-3)
        assert over_median > 10.0
    if not recording.format.real:
        prn, doppler_hz, _ = satellites[0]
        right = strongest(recording, prn, doppler_hz)[1]
        how = how | {"conjugate": not how.get("conjugate", False)}
        assert strongest(Recording(IQ / name, **how), prn, doppler_hz)[1] < 0.15 * right
        # swapped and conjugated: turned by a quarter, the same sense
        turned = Recording(IQ / name, **(how | {"swap_iq": True}))
        assert strongest(turned, prn, doppler_hz)[1] == pytest.approx(right, rel=1e-6)


@pytest.mark.parametrize("name", ["cf32", "rf32", "cf32_be"])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_is_named_by_its_sample(
    tmp_path: Path, name: str, wrong: float
) -> None:
    """Far from what sigma is measured of, in a file that is read in pieces."""
    x = np.zeros((3_000_000,) if name[0] == "r" else (3_000_000, 2), np.float32)
    x[::2] = 1.0
    x[2_345_678, ...] = wrong
    path = tmp_path / "if.bin"
    path.write_bytes(encode(x, FORMATS[name]).tobytes())
    recording = Recording(path, FS, 1e6 if name[0] == "r" else 0.0, 1.0, sample_format=name)
    assert np.isfinite(recording.samples(0, 2_345_678)).all()
    with pytest.raises(ValueError, match=r"if.bin: sample 2345678 is not finite"):
        recording.samples(2_345_000, 2_346_000)
