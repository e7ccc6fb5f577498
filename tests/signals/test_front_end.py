"""IF samples against a float64 evaluation of their definition, sample by sample."""

import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from signals import front_end
from signals.codes import GPS_L1CA
from signals.constants import CA_CHIP_RATE_HZ, GPS_L1_HZ
from signals.cpu import available
from signals.front_end import SyntheticIf
from signals.propagation import SignalState
from signals.recording import Recording
from signals.replica import replicas

FS = 4.0e6  # 4000 samples per 1023 chips: the awkward, commensurate case
CN0 = 45.0


def truth(
    doppler_hz: list[float], jump_hz_per_s: float = 525.0, n_piece: int = 4, seed: int = 1
) -> SignalState:
    """Constant Doppler, then from the middle on a Doppler rate (525 Hz/s at L1 is 10 g)."""
    rng = np.random.default_rng(seed)
    n, step_s = len(doppler_hz), 0.005
    t_s = step_s * np.arange(n_piece + 1)
    carrier, code = np.zeros((n, n_piece, 4)), np.zeros((n, n_piece, 4))
    phase, rate = rng.uniform(-1e8, 1e8, n), np.array(doppler_hz, float)
    start_chips, start_cycles = rng.uniform(0, 20_460, n), phase
    for p in range(n_piece):
        ramp = jump_hz_per_s if p >= n_piece // 2 else 0.0
        carrier[:, p] = np.stack([phase, rate, np.full(n, ramp / 2), np.zeros(n)], axis=1)
        phase = phase + rate * step_s + 0.5 * ramp * step_s**2
        rate = rate + ramp * step_s
    code[:] = carrier * CA_CHIP_RATE_HZ / GPS_L1_HZ
    code[..., 0] = start_chips[:, None] + CA_CHIP_RATE_HZ * t_s[:-1]
    code[..., 0] += (carrier[..., 0] - start_cycles[:, None]) * CA_CHIP_RATE_HZ / GPS_L1_HZ
    code[..., 1] += CA_CHIP_RATE_HZ
    symbols = rng.choice(np.array([-1, 1], np.int8), (n, 4))
    cn0 = np.full((n, n_piece), CN0)
    return SignalState(t_s, code, carrier, cn0, np.ones((n, n_piece), bool), symbols, 0)


def chips(n: int) -> np.ndarray:
    return np.stack([GPS_L1CA.chips(prn) for prn in range(1, n + 1)])


@pytest.fixture(params=available())
def path(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each path that this machine has, for sources made in the test."""
    monkeypatch.setattr(front_end, "cpu_path", lambda: request.param)
    return str(request.param)


def by_definition(
    state: SignalState,
    code: list[np.ndarray] | np.ndarray,
    n: np.ndarray,
    if_hz: float,
    per_chip: tuple[int, ...] | None = None,
    symbol_chips: tuple[int, ...] | None = None,
) -> np.ndarray:
    """Equation (1) of the module without noise, sigma = 1, in float64."""
    t = n / FS
    # sample 20000 k of a 5 ms piece is the first of the next one
    p = np.minimum(n // 20_000, len(state.t_s) - 2)
    dt = t - state.t_s[p]
    z = np.zeros(n.size, complex)
    for i, row in enumerate(code):
        per, symbol = 1 if per_chip is None else per_chip[i], 20_460
        if symbol_chips is not None:
            symbol = symbol_chips[i]
        x = np.sum(state.code_phase_chips[i, p] * dt[:, None] ** np.arange(4), axis=1)
        phi = np.sum(state.carrier_phase_cycles[i, p] * dt[:, None] ** np.arange(4), axis=1)
        phi = phi % 1.0 + if_hz * t
        amplitude = np.sqrt(2 * 10 ** (state.cn0_dbhz[i, p] / 10) / FS) * state.valid[i, p]
        data = state.symbols[i, np.floor(x / symbol).astype(int) - state.first_symbol]
        chip = row[np.floor(x * per).astype(int) % len(row)]
        z += amplitude * data * chip * np.exp(2j * np.pi * phi)
    return z


def assert_defined(
    z: np.ndarray, expected: np.ndarray, worst: float = 1e-5, rms: float = 1e-6
) -> None:
    """A chip edge may fall within rounding of a sample: at most one in 10^5; the rest to ``worst``
    of one satellite's amplitude: for three at 10 g 3 x 2 pi x 2.7e-7 rad, and float32."""
    amplitude = np.sqrt(2 * 10 ** (CN0 / 10) / FS)
    error = np.abs(z - expected)
    edge = error > 0.5 * amplitude
    assert edge.sum() <= 1
    assert error[~edge].max() < worst * amplitude
    assert np.linalg.norm(error[~edge]) < rms * np.linalg.norm(expected)


def as_complex(samples: np.ndarray) -> np.ndarray:
    return samples[:, 0].astype(float) + 1j * samples[:, 1]


@pytest.mark.parametrize("if_hz", [0.0, 1_234_567.0])
def test_samples_follow_their_definition(if_hz, path):
    state = truth([-4321.0, 17.0, 3500.0])
    source = SyntheticIf(state, chips(3), FS, 1, if_hz=if_hz, sample_format="float32", noise=False)
    z, expected = (
        as_complex(source.samples(0, 80_000)),
        by_definition(state, chips(3), np.arange(80_000), if_hz),
    )
    assert_defined(z, expected)


def test_the_worst_frequency_of_the_leapfrog(path):
    """A quarter cycle per vector of 16 (8) samples is a double root of the recurrence: errors grow
    with the square of the steps, to 16^2 / 2 x 2^-24 = 8e-6 rad at the end of a sub-block."""
    state = truth([-4321.0], jump_hz_per_s=0.0)
    for lanes in (16, 8):
        if_hz = 4321.0 + FS / (4 * lanes)
        source = SyntheticIf(
            state, chips(1), FS, 1, if_hz=if_hz, sample_format="float32", noise=False
        )
        expected = by_definition(state, chips(1), np.arange(80_000), if_hz)
        assert_defined(as_complex(source.samples(0, 80_000)), expected, rms=5e-6)


def test_any_modulation_period_and_symbol(path):
    """Sub-chips, real values and symbol lengths of each channel; one period that is very short."""
    state = truth([-2000.0, 1500.0, 300.0])
    rng = np.random.default_rng(5)
    state = state._replace(symbols=rng.choice(np.array([-1, 1], np.int8), (3, 45)))
    boc = np.repeat(GPS_L1CA.chips(3), 2) * np.tile([1.0, -1.0], 1023)
    rows, per_chip, symbol = (
        [boc, rng.normal(size=10_230), np.array([1.0, -0.5, 2.0])],
        (2, 1, 3),
        (
            1023,
            20_460,
            5115,
        ),
    )
    source = SyntheticIf(
        state,
        replicas(rows, per_chip),
        FS,
        1,
        sample_format="float32",
        noise=False,
        symbol_chips=np.array(symbol),
    )
    expected = by_definition(state, rows, np.arange(80_000), 0.0, per_chip, symbol)
    error = np.abs(as_complex(source.samples(0, 80_000)) - expected)
    edge = error > 0.01 * np.sqrt(2 * 10**4.5 / FS)
    assert edge.sum() <= 2
    assert np.linalg.norm(error[~edge]) < 1e-6 * np.linalg.norm(expected)


@pytest.mark.parametrize("real", [False, True])
@pytest.mark.parametrize("sample_format", ["int8", "int16", "float32", "bits2"])
@pytest.mark.parametrize("path", [p for p in available() if p != "portable"], indirect=True)
def test_every_path_has_the_same_noise(sample_format, real, path):
    """Noise alone to the bit, rounding included; the silent satellite makes no difference."""
    state = truth([0.0])
    state = state._replace(valid=np.zeros_like(state.valid))
    arguments = {"sample_format": sample_format, "real": real, "if_hz": 1e6}
    x = SyntheticIf(state, chips(1), FS, 5, **arguments).samples(1000, 9000)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(front_end, "cpu_path", lambda: "portable")
        expected = SyntheticIf(state, chips(1), FS, 5, **arguments).samples(1000, 9000)
    assert x.shape == ((8000,) if real else (8000, 2))
    assert np.abs(x.astype(float)).max() > 0.0
    np.testing.assert_array_equal(x, expected)


def test_c_n0_of_a_real_sampler(path):
    """Matched correlation over T: mean^2 / variance = 2 C/N0 T of x against its own waveform, and
    the same of complex samples (Kaplan & Hegarty ch. 8); T = 1 ms, 45 dB-Hz."""
    state = truth([700.0], jump_hz_per_s=0.0, n_piece=400)
    state = state._replace(symbols=np.ones((1, 110), np.int8))
    n = 2000 * 4000
    for real in (False, True):
        source = SyntheticIf(state, chips(1), FS, 1, if_hz=1.1e6, real=real)
        silent = SyntheticIf(
            state, chips(1), FS, 1, if_hz=1.1e6, real=real, noise=False, sample_format="float32"
        )
        x, w = source.samples(0, n).astype(float), silent.samples(0, n).astype(float)
        y = (x * w).reshape(2000, -1).sum(axis=1)
        ratio = y.mean() ** 2 / y.var()
        # variance of ratio: that of mean^2 4 / (N snr) and of var 2 / N, relative
        expected = 2 * 10**4.5 * 1e-3
        assert abs(ratio / expected - 1) < 4 * np.sqrt(4 / (2000 * expected) + 2 / 2000)
        noise = x - source.sigma * (math.sqrt(2) if real else 1) * w
        rms = source.sigma * (math.sqrt(2) if real else 1)
        assert abs(noise.std() / rms - 1) < 4 / np.sqrt(2 * noise.size)


def test_a_real_sampler_has_its_carrier_at_if_hz(path):
    state = truth([700.0], jump_hz_per_s=0.0)
    arguments = {"if_hz": 1.1e6, "sample_format": "float32", "noise": False}
    x = SyntheticIf(state, chips(1), FS, 1, real=True, **arguments).samples(0, 80_000)
    z = by_definition(state, chips(1), np.arange(80_000), 1.1e6)
    # equation (2): sqrt(2) of the real part of (1)
    np.testing.assert_allclose(x, math.sqrt(2) * z.real, atol=1e-6)


@pytest.mark.parametrize(
    ("form", "step", "levels", "efficiency"),
    [
        ("bits1", 9.0, 2, 0.636620),
        ("bits2", 0.9957, 4, 0.881154),
        ("bits4", 0.3352, 16, 0.988457),
    ],
)
def test_few_levels(path, form, step, levels, efficiency):
    """Odd levels between thresholds at 0 and every step; for weak signals in Gaussian noise the
    power kept is E[x q]^2 / E[q^2] (theory/quantization_loss.csv: efficiency and best step of 2, 4
    and 16 levels; Max 1960)."""
    state = truth([0.0])
    silent = state._replace(valid=np.zeros_like(state.valid))
    source = SyntheticIf(silent, chips(1), FS, 5, sample_format=form)
    q = source.samples(0, 80_000)
    x = SyntheticIf(silent, chips(1), FS, 5, sample_format="float32").samples(0, 80_000)
    edge = np.abs(x / step - np.rint(x / step)) < 2e-6
    expected = 2 * np.clip(np.floor(x / step), -levels / 2, levels / 2 - 1) + 1
    np.testing.assert_array_equal(q[~edge], expected[~edge])
    x, q = x.ravel().astype(float), q.ravel().astype(float)
    kept = np.mean(x * q) ** 2 / np.mean(q * q) / np.mean(x * x)
    assert kept == pytest.approx(efficiency, abs=4 * 0.33 / np.sqrt(x.size))
    assert q.std() == pytest.approx(source.sigma, rel=4 / np.sqrt(2 * x.size))


@pytest.mark.nojit
def test_a_few_samples():
    """Small enough for plain Python; the border between two cells is among them."""
    state = truth([-4321.0])
    arguments = {"if_hz": 1e5, "noise": False}
    fine = SyntheticIf(state, chips(1), FS, 1, sample_format="float32", **arguments)
    expected = by_definition(state, chips(1), np.arange(1000, 1050), 1e5)
    np.testing.assert_allclose(as_complex(fine.samples(1000, 1050)), expected, atol=1e-5)
    coarse = SyntheticIf(state, chips(1), FS, 1, **arguments)
    np.testing.assert_allclose(as_complex(coarse.samples(1000, 1050)), 24 * expected, atol=0.71)


@pytest.mark.parametrize("if_hz", [0.0, 1_234_567.0])
def test_no_stair_of_frequency_at_a_10_g_jump(if_hz, path):
    """Frequency held over a block of 1 ms would err by 525 (1e-3)^2 / 2 = 2.6e-4 cycles; the chord
    over a sub-block of 256 samples errs by an eighth of 525 (64e-6)^2, 2.7e-7, and float32."""
    state = truth([1000.0])._replace(symbols=np.ones((1, 4), np.int8))
    ones = np.ones((1, 1023), np.int8)
    source = SyntheticIf(state, ones, FS, 1, if_hz=if_hz, sample_format="float32", noise=False)
    z = as_complex(source.samples(0, 80_000))
    t = np.arange(80_000) / FS
    phase = state.carrier_phase_cycles[0, 0, 0] + 1000.0 * t
    phase += if_hz * t
    phase += 0.5 * 525.0 * np.maximum(t - 0.010, 0.0) ** 2
    error = np.angle(z * np.exp(-2j * np.pi * (phase % 1.0))) / (2 * np.pi)
    assert np.abs(error).max() < 2.7e-7 + 1.5e-7


def test_symbols_change_at_the_sample(path):
    state = truth([0.0], jump_hz_per_s=0.0)
    state.code_phase_chips[0, :, 0] = 20_460 - 5115.25 + CA_CHIP_RATE_HZ * state.t_s[:-1]
    state = state._replace(symbols=np.array([[1, -1]], np.int8))
    source = SyntheticIf(state, np.ones((1, 1023), np.int8), FS, 1, sample_format="float32",
                         noise=False)  # fmt: skip
    z = as_complex(source.samples(0, 80_000))
    sign = np.sign((z * np.conj(z[0])).real)
    first = int(np.ceil(5115.25 / CA_CHIP_RATE_HZ * FS))
    np.testing.assert_array_equal(sign, np.where(np.arange(80_000) < first, 1, -1))


def test_same_bits_for_any_block_and_threads():
    state = truth([-900.0, 2500.0])
    whole = SyntheticIf(state, chips(2), FS, 5).samples(0, 80_000)
    cuts = [0, 1, 1023, 1024, 1025, 20_000, 47_111, 80_000]
    blocks = list(zip(cuts[:-1], cuts[1:], strict=True))
    for a, b in blocks:  # each as the first that is asked for
        alone = SyntheticIf(state, chips(2), FS, 5).samples(a, b)
        np.testing.assert_array_equal(alone, whole[a:b])
    source = SyntheticIf(state, chips(2), FS, 5)
    again = [(500, 1100), (47_000, 70_000), (10, 20), (69_000, 69_100), (79_000, 80_000)]
    # one after the other, backwards, across what is kept
    for a, b in blocks + blocks[::-1] + again:
        block = source.samples(a, b)
        np.testing.assert_array_equal(block, whole[a:b])
        block[:] = 0  # the caller's own
    threads = SyntheticIf(state, chips(2), FS, 5, workers=3)
    np.testing.assert_array_equal(threads.samples(333, 70_001), whole[333:70_001])
    other = SyntheticIf(state, chips(2), FS, 6).samples(0, 80_000)
    assert np.mean(other == whole) < 0.05


def test_noise_has_sigma_after_rounding():
    state = truth([0.0])
    silent = state._replace(valid=np.zeros_like(state.valid))
    for sample_format, sigma in (
        ("int8", None),
        ("int8", 1.0),
        ("int8", 32.0),
        ("int16", None),
        ("float32", None),
        ("float32", 0.25),
    ):
        source = SyntheticIf(silent, chips(1), FS, 5, sample_format=sample_format, sigma=sigma)
        assert source.sigma == (
            sigma or {"int8": 24.0, "int16": 1000.0, "float32": 1.0}[sample_format]
        )
        x = source.samples(0, 80_000).astype(float) / source.sigma
        assert abs(x.var() - 1.0) < 4 * np.sqrt(2 / x.size)
        assert np.abs(x.mean(0)).max() < 4 / np.sqrt(80_000)
    coarse = SyntheticIf(state, chips(1), FS, 5).samples(0, 80_000).astype(float)
    fine = SyntheticIf(state, chips(1), FS, 5, sample_format="float32").samples(0, 80_000)
    # same stream: int8 is the float32 signal times 24, rounded (noise smaller by 1 / (24 * 576))
    np.testing.assert_allclose(coarse, 24.0 * fine, atol=0.5 + 24 * 6 / (24 * 576))


def test_strong_signals_clip_at_127():
    state = truth([0.0, 0.0])
    loud = state._replace(cn0_dbhz=np.full_like(state.cn0_dbhz, 85.0))
    x = SyntheticIf(loud, chips(2), FS, 5).samples(0, 80_000)
    assert x.max() == 127
    assert x.min() == -127


def test_pieces_may_end_at_any_sample(path):
    """Where a piece ends inside a vector of samples its neighbour's samples are left alone."""
    state = truth([100.0, -100.0], jump_hz_per_s=0.0)
    t_s = np.array([0.0, 1003.3e-6, 1004.1e-6, 5e-3])

    def pieces(c: np.ndarray) -> np.ndarray:
        line = np.zeros((2, 3, 4))
        line[..., 0], line[..., 1] = c[:, :1, 0] + c[:, :1, 1] * t_s[:-1], c[:, :1, 1]
        return line

    state = state._replace(
        t_s=t_s,
        cn0_dbhz=np.array([[45.0, 50.0, 43.0], [45.0, 45.0, 45.0]]),
        valid=np.array([[True, True, True], [True, False, True]]),
        code_phase_chips=pieces(state.code_phase_chips),
        carrier_phase_cycles=pieces(state.carrier_phase_cycles),
    )
    source = SyntheticIf(state, chips(2), FS, 1, sample_format="float32", noise=False)
    z = as_complex(source.samples(0, 20_000))
    n = np.arange(20_000)
    p = np.searchsorted(np.ceil(t_s * FS), n, side="right") - 1
    expected = np.zeros(n.size, complex)
    for i in range(2):
        c, phi = state.code_phase_chips[i, p], state.carrier_phase_cycles[i, p]
        dt = n / FS - t_s[p]
        x = c[:, 0] + c[:, 1] * dt
        a = np.sqrt(2 * 10 ** (state.cn0_dbhz[i, p] / 10) / FS) * state.valid[i, p]
        d = state.symbols[i, np.floor(x / 20_460).astype(int)]
        chip = chips(2)[i, np.floor(x).astype(int) % 1023]
        expected += a * d * chip * np.exp(2j * np.pi * (phi[:, 0] % 1 + phi[:, 1] * dt))
    np.testing.assert_allclose(z, expected, atol=1e-6)


def test_invalid_pieces_are_silent(path):
    state = truth([100.0, -100.0])
    valid = state.valid.copy()
    valid[1, 1:3] = False
    state = state._replace(valid=valid, cn0_dbhz=state.cn0_dbhz + [[0.0], [3.0]])
    z = SyntheticIf(state, chips(2), FS, 1, sample_format="float32", noise=False)
    expected = by_definition(state, chips(2), np.arange(80_000), 0.0)
    np.testing.assert_allclose(as_complex(z.samples(0, 80_000)), expected, atol=1e-5)


def test_streams_without_growing():
    """Two seconds at 4 Msps are 16 MB as int8; what is held at a time stays below 0.5 MB."""
    state = truth([50.0], n_piece=400)
    state = state._replace(symbols=np.ones((1, 110), np.int8))
    source = SyntheticIf(state, chips(1), FS, 9)
    whole = SyntheticIf(state, chips(1), FS, 9).samples(0, 8_000_000)
    tracemalloc.start()
    n = 0
    for block in source.stream(50_000):
        assert np.array_equal(block, whole[n : n + len(block)])
        n += len(block)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert n == 8_000_000
    assert peak < 500_000


def test_a_real_recording_has_the_scale_of_complex_samples(tmp_path: Path):
    state = truth([50.0])
    for sample_format in ("int8", "int16", "bits2", "float32"):
        source = SyntheticIf(
            state, chips(1), FS, 9, if_hz=1e6, real=True, sample_format=sample_format
        )
        x = source.samples(0, 70_000)
        for file in (None, tmp_path / f"{sample_format}.bin"):
            recording = source.record(70_000, file)
            assert recording.format.real
            assert recording.sigma == source.sigma
            samples = recording.samples(0, 70_000)
            np.testing.assert_array_equal(samples[:, 0], x)
            assert not samples[:, 1].any()
        assert source.sigma == pytest.approx(x.std() / math.sqrt(2), rel=0.02)


def test_record_into_memory_and_file(tmp_path: Path):
    source = SyntheticIf(truth([50.0]), chips(1), FS, 9, if_hz=2e5)
    expected = source.samples(0, 60_001)
    seen: list[tuple[int, int]] = []
    for path in (None, tmp_path / "if.bin"):
        recording = source.record(60_001, path, lambda done, n: seen.append((done, n)))
        np.testing.assert_array_equal(recording.samples(0, 60_001), expected)
        np.testing.assert_array_equal(recording.samples(5, 11), expected[5:11])
        assert (recording.sample_rate_hz, recording.if_hz, recording.sigma) == (FS, 2e5, 24.0)
        assert seen[-1] == (60_001, 60_001)
    assert (tmp_path / "if.bin").stat().st_size == 2 * 60_001
    again = Recording(tmp_path / "if.bin", FS, 2e5, 24.0, first_sample=100)
    np.testing.assert_array_equal(again.samples(100, 103), expected[:3])


@pytest.mark.parametrize(("n0", "n1"), [(-1, 5), (79_990, 80_001), (10, 9)])
def test_samples_outside_the_truth_are_refused(n0, n1):
    source = SyntheticIf(truth([0.0]), chips(1), FS, 1)
    with pytest.raises(ValueError, match=f"samples {n0} to {n1} asked for"):
        source.samples(n0, n1)
    with pytest.raises(ValueError, match=f"samples {n0} to {n1} asked for"):
        source.record().samples(n0, n1)


def test_bad_parameters_are_refused():
    state = truth([0.0])
    with pytest.raises(ValueError, match="sample_format"):
        SyntheticIf(state, chips(1), FS, 1, sample_format="int4")
    with pytest.raises(ValueError, match="sample_rate_hz"):
        SyntheticIf(state, chips(1), 1.0e6, 1)
    with pytest.raises(ValueError, match="sub-chip rate 6138"):
        SyntheticIf(state, replicas([np.ones(6 * 1023)], 6), FS, 1)
    with pytest.raises(ValueError, match="chips are"):
        SyntheticIf(state, chips(2), FS, 1)
    with pytest.raises(ValueError, match="chips has 2 rows: expected 1"):
        SyntheticIf(state, replicas(list(chips(2))), FS, 1)
    for arguments, what in (
        ({"if_hz": 2.1e6}, "if_hz is 2100000.0: expected at most half"),
        ({"real": True}, "if_hz is 0.0: expected above 0"),
        ({"real": True, "if_hz": 2e6}, "if_hz is 2000000.0: expected above 0"),
        ({"sigma": 41.0}, "sigma is 41.0: expected 1 to 40 of int8"),
        ({"sigma": 0.5, "sample_format": "int16"}, "expected 1 to 8000 of int16"),
        ({"sigma": 0.0, "sample_format": "float32"}, "sigma is 0.0"),
        ({"sigma": 1.0, "sample_format": "bits2"}, "sigma is 1.0: expected none"),
        ({"workers": 0}, "workers is 0"),
        ({"symbol_chips": 0}, "symbol_chips is 0"),
    ):
        with pytest.raises(ValueError, match=what):
            SyntheticIf(state, chips(1), FS, 1, **arguments)
    with pytest.raises(ValueError, match="symbols 1 to 5 do not cover the truth: expected 0 to"):
        SyntheticIf(state._replace(first_symbol=1), chips(1), FS, 1)
    with pytest.raises(ValueError, match="seed"):
        SyntheticIf(state, chips(1), FS, -1)
