"""IF samples against a float64 evaluation of their definition, sample by sample."""

from pathlib import Path

import numpy as np
import pytest

from signals.codes import GPS_L1CA
from signals.constants import CA_CHIP_RATE_HZ, GPS_L1_HZ
from signals.front_end import SyntheticIf
from signals.propagation import SignalState
from signals.recording import Recording

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


def by_definition(state: SignalState, code: np.ndarray, n: np.ndarray, if_hz: float) -> np.ndarray:
    """Equation (1) of the module without noise, sigma = 1, in float64."""
    t = n / FS
    # sample 20000 k of a 5 ms piece is the first of the next one
    p = np.minimum(n // 20_000, len(state.t_s) - 2)
    dt = t - state.t_s[p]
    z = np.zeros(n.size, complex)
    for i in range(len(code)):
        x = np.sum(state.code_phase_chips[i, p] * dt[:, None] ** np.arange(4), axis=1)
        phi = np.sum(state.carrier_phase_cycles[i, p] * dt[:, None] ** np.arange(4), axis=1)
        phi = phi % 1.0 + if_hz * t
        amplitude = np.sqrt(2 * 10 ** (state.cn0_dbhz[i, p] / 10) / FS) * state.valid[i, p]
        data = state.symbols[i, np.floor(x / 20_460).astype(int) - state.first_symbol]
        chip = code[i, np.floor(x).astype(int) % 1023]
        z += amplitude * data * chip * np.exp(2j * np.pi * phi)
    return z


def as_complex(samples: np.ndarray) -> np.ndarray:
    return samples[:, 0].astype(float) + 1j * samples[:, 1]


@pytest.mark.parametrize("if_hz", [0.0, 1_234_567.0])
def test_samples_follow_their_definition(if_hz):
    state = truth([-4321.0, 17.0, 3500.0])
    source = SyntheticIf(state, chips(3), FS, 1, if_hz=if_hz, sample_format="float32", noise=False)
    n = np.arange(80_000)
    z, expected = as_complex(source.samples(0, 80_000)), by_definition(state, chips(3), n, if_hz)
    error = np.abs(z - expected)
    amplitude = np.sqrt(2 * 10**4.5 / FS)
    # a chip edge may fall within rounding of a sample: at most one in 10^5, the rest to 1e-5 of
    # one satellite's amplitude (the carrier's phase to 1e-5 rad)
    edge = error > 0.5 * amplitude
    assert edge.sum() <= 1
    assert error[~edge].max() < 1e-5 * amplitude
    assert np.linalg.norm(error[~edge]) < 1e-6 * np.linalg.norm(expected)


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


def test_no_stair_of_frequency_at_a_10_g_jump():
    """Frequency held over a cell of 256 us would err by 525 (256e-6)^2 / 2 = 1.7e-5 cycles, and
    its chord by an eighth of 525 (256e-6)^2, 4e-6; the module claims 6e-7 and float32."""
    state = truth([1000.0])._replace(symbols=np.ones((1, 4), np.int8))
    ones = np.ones((1, 1023), np.int8)
    source = SyntheticIf(state, ones, FS, 1, sample_format="float32", noise=False)
    z = as_complex(source.samples(0, 80_000))
    t = np.arange(80_000) / FS
    phase = state.carrier_phase_cycles[0, 0, 0] + 1000.0 * t
    phase += 0.5 * 525.0 * np.maximum(t - 0.010, 0.0) ** 2
    error = np.angle(z * np.exp(-2j * np.pi * (phase % 1.0))) / (2 * np.pi)
    assert np.abs(error).max() < 6e-7 + 1e-7


def test_symbols_change_at_the_sample():
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
    for sample_format in ("int8", "float32"):
        source = SyntheticIf(silent, chips(1), FS, 5, sample_format=sample_format)
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


def test_invalid_pieces_are_silent():
    state = truth([100.0, -100.0])
    valid = state.valid.copy()
    valid[1, 1:3] = False
    state = state._replace(valid=valid, cn0_dbhz=state.cn0_dbhz + [[0.0], [3.0]])
    z = SyntheticIf(state, chips(2), FS, 1, sample_format="float32", noise=False)
    expected = by_definition(state, chips(2), np.arange(80_000), 0.0)
    np.testing.assert_allclose(as_complex(z.samples(0, 80_000)), expected, atol=1e-5)


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
    with pytest.raises(ValueError, match="chips are"):
        SyntheticIf(state, chips(2), FS, 1)
    with pytest.raises(ValueError, match="symbols 1 to 5 do not cover the truth: expected 0 to"):
        SyntheticIf(state._replace(first_symbol=1), chips(1), FS, 1)
    with pytest.raises(ValueError, match="seed"):
        SyntheticIf(state, chips(1), FS, -1)
