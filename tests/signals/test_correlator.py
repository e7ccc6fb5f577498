"""Sample-level taps against a float64 evaluation of their definition, signs and statistics."""

import itertools

import numpy as np
import pytest

from signals.codes import GPS_L1CA
from signals.constants import C_MPS, CA_CHIP_RATE_HZ, GPS_L1_HZ
from signals.correlator import SampleCorrelator
from signals.front_end import SyntheticIf
from signals.lanes_correlator import SPAN
from signals.nco import Nco, Taps
from signals.recording import Recording

FS = 4.0e6  # 4000 samples per 1023 chips: the awkward, commensurate case
IF_HZ = 123_456.7
OFFSETS = np.array([-0.5, 0.0, 0.5])


def chips(n: int) -> np.ndarray:
    return np.stack([GPS_L1CA.chips(prn) for prn in range(1, n + 1)])


def noise(n: int, dtype: type = np.int8, if_hz: float = IF_HZ) -> Recording:
    x = 24.0 * np.random.default_rng(3).standard_normal((n, 2))
    return Recording(np.clip(np.rint(x), -127, 127).astype(dtype), FS, if_hz, 24.0)


def split(nco: Nco, first: int, end: int) -> Nco:
    """Pieces first ... end - 1 of a command."""
    return Nco(nco.t_s[first : end + 1], *(x[first:end] for x in nco[1:6]), *nco[6:])


def merge(parts: list[Taps]) -> Taps:
    """Rows of several calls in order of channel, then of time."""
    rows = Taps(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    order = np.lexsort((rows.t_start_s, rows.channel))
    return Taps(*(column[order] for column in rows))


def by_definition(source: Recording, nco: Nco, code: np.ndarray, offsets: np.ndarray) -> list:
    """Whole integrations (channel, index, first, end, iq) of equation (1), all in float64."""
    edge = np.ceil(nco.t_s * FS - 1e-5).astype(int)
    n = np.arange(edge[0], edge[-1])
    p = np.searchsorted(edge, n, side="right") - 1
    t = n / FS
    dt = t - nco.t_s[p]
    samples = source.samples(n[0], n[-1] + 1).astype(float)
    z = (samples[:, 0] + 1j * samples[:, 1]) / source.sigma
    rows = []
    for i in range(len(code)):
        x = nco.code_phase_chips[p, i] + nco.chip_rate_hz[p, i] * dt
        phase = nco.carrier_phase_cycles[p, i] + nco.carrier_freq_hz[p, i] * dt
        phase = phase % 1.0 + 0.5 * nco.carrier_rate_hz_per_s[p, i] * dt**2 + source.if_hz * t
        wiped = z * np.exp(-2j * np.pi * phase)
        k = np.floor(x / nco.dump_chips[i] + 1e-9).astype(int)
        for index in range(k[0] + 1, k[-1]):
            m = np.flatnonzero(k == index)
            replica = np.floor(x[m] - offsets[:, None]).astype(int) % code.shape[1]
            iq = (code[i, replica] * wiped[m]).sum(axis=1) / np.sqrt(m.size)
            rows.append((i, index, n[m[0]], n[m[-1]] + 1, iq))
    return rows


@pytest.mark.parametrize(
    ("dtype", "rate", "tolerance"),
    # 525 Hz/s: 2 pi rate (SPAN / fs) (STRIDE / fs) / 12 rms, see test_exact
    [(np.int8, 0.0, 2e-6), (np.float32, 525.0, 1.1e-5)],
)
def test_taps_follow_their_definition(command, dtype, rate, tolerance):
    source = noise(80_000, dtype)
    t_s = np.array([0.0, 0.00333, 0.0051, 0.0149, 0.02])
    nco = command(
        t_s, [300.3, 20_000.7, 5e8 + 0.1], [-1.2e8 + 0.3, 77.7, 0.2], [-4321.0, 12.0, 3456.7], rate,
        [1023, 2046, 1023],
    )  # fmt: skip
    offsets = np.array([-1.0, -0.5, 0.0, 0.3, 0.5, 40.0, -1500.25])
    taps = SampleCorrelator(source, chips(3), offsets)(nco)
    expected = by_definition(source, nco, chips(3), offsets)
    assert len(expected) == 19 + 9 + 19
    # a dump that ends with the command is not over before a sample has shown it
    assert [(r[0], r[1]) for r in expected] == list(zip(taps.channel, taps.number, strict=True))
    np.testing.assert_array_equal(taps.t_start_s, [r[2] / FS for r in expected])
    np.testing.assert_array_equal(taps.t_end_s, [r[3] / FS for r in expected])
    iq = np.array([r[4] for r in expected])
    error = np.abs(taps.iq - iq)
    # a chip edge within rounding of a sample changes one term of 4000: count it, do not hide it
    edge = error > 1e-4
    assert edge.sum() <= 1
    assert np.linalg.norm(error[~edge]) < tolerance * np.linalg.norm(iq)


@pytest.mark.nojit
def test_a_few_short_integrations(command):
    """Small enough for plain Python; 100 chips are 391 samples."""
    source = noise(1500, if_hz=0.0)
    nco = command([0.0, 0.0002, 0.000375], 30.3, 0.0, -4321.0, 0.0, 100)
    taps = SampleCorrelator(source, chips(1), OFFSETS)(nco)
    expected = by_definition(source, nco, chips(1), OFFSETS)
    assert taps.number.tolist() == [1, 2, 3] == [r[1] for r in expected]
    np.testing.assert_allclose(taps.iq, [r[4] for r in expected], atol=1e-5)


def test_phases_at_both_ends_are_the_commands(command):
    nco = command(np.arange(5) * 5e-3, 300.3, 1e6, -4321.0, 525.0)
    taps = SampleCorrelator(noise(80_000), chips(1), OFFSETS)(nco)
    for t, code, carrier in (
        (taps.t_start_s, taps.code_start_chips, taps.carrier_start_cycles),
        (taps.t_end_s, taps.code_end_chips, taps.carrier_end_cycles),
    ):
        p = np.searchsorted(nco.t_s, t, side="right") - 1
        dt = t - nco.t_s[p]
        expected = nco.code_phase_chips[p, 0] + nco.chip_rate_hz[p, 0] * dt
        np.testing.assert_allclose(code, expected, rtol=0, atol=1e-9)
        expected = 1e6 + (-4321.0 + 0.5 * 525.0 * t) * t
        np.testing.assert_allclose(carrier, expected, rtol=0, atol=1e-8)
    # the first sample at or past a multiple: less than one sample of 0.2558 chips beyond it
    past = taps.code_start_chips - 1023 * taps.number
    assert np.all((past >= 0) & (past < 0.2558))
    np.testing.assert_array_equal(taps.t_start_s[1:], taps.t_end_s[:-1])


def test_commensurate_rates_give_exactly_4000_samples(command):
    """4 MHz and no Doppler: every bound is a tie between a sample and a code period."""
    nco = command(np.arange(5) * 5e-3)
    taps = SampleCorrelator(noise(80_000), chips(1), OFFSETS)(nco)
    np.testing.assert_array_equal(taps.number, np.arange(19))
    np.testing.assert_array_equal(np.rint(taps.t_start_s * FS), 4000 * np.arange(19))
    np.testing.assert_array_equal(np.rint((taps.t_end_s - taps.t_start_s) * FS), 4000)


@pytest.fixture(scope="module")
def received(truth):
    """Samples without noise of one satellite at 45 dB-Hz, 30 Hz Doppler, no data."""
    state = truth(2000.25, 0.0, 30.0, duration_s=0.05)
    return SyntheticIf(state, chips(1), FS, 1, if_hz=IF_HZ, sample_format="float32", noise=False)


def test_amplitude_is_root_2_cn0_t(received, command):
    nco = command([0.0, 0.05], 2000.25, 0.0, 30.0)
    taps = SampleCorrelator(received, chips(1), OFFSETS)(nco)
    expected = np.sqrt(2 * 10**4.5 * 1e-3)
    np.testing.assert_allclose(taps.iq[:, 1], expected, rtol=1e-4)  # +- half a sample of 4000
    # half a chip off: R(0.5) of the code, sampled at four points per chip
    half = expected * 0.5 * (1 + GPS_L1CA.autocorrelation(1)[1])
    for tap in (0, 2):
        np.testing.assert_allclose(taps.iq[:, tap].mean(), half, rtol=0.02)
    np.testing.assert_array_equal(taps.noise_var, 1.0)


def test_late_grows_when_the_satellite_is_farther(truth, command):
    """10 m farther than the replica: code phase received is 10 m / 293 m behind, Late > Early.

    (L - E) / P = 2 shift (1 - R(1)), from samples that fall between an edge of the code and its
    replica: 512 edges x 0.034 chips x 3.9 samples per chip = 68 for each of E and L, a count with
    a scatter of 9 % of the difference; hence twelve codes and 4 x 9 % / sqrt(12).
    """
    ahead = 10.0 / C_MPS * CA_CHIP_RATE_HZ
    ratio = []
    for prn in range(1, 13):
        code, start = GPS_L1CA.chips(prn)[None], 71.37 * prn
        source = SyntheticIf(
            truth(start, duration_s=0.005), code, FS, 1, sample_format="float32", noise=False
        )
        nco = command([0.0, 0.005], start + ahead)
        early, prompt, late = np.abs(SampleCorrelator(source, code, OFFSETS)(nco).iq[0])
        ratio.append((late - early) / prompt / (1 - GPS_L1CA.autocorrelation(prn)[1]))
    assert np.mean(ratio) == pytest.approx(2 * ahead / (1 - ahead), rel=0.1)


def test_prompt_turns_clockwise_when_receding_faster(received, command):
    """1 m/s faster away than the command: arg(P2 conj P1) = -2 pi dv T / lambda."""
    extra_hz = 1.0 * GPS_L1_HZ / C_MPS  # the command's Doppler is too high by this
    taps = SampleCorrelator(received, chips(1), OFFSETS)(
        command([0.0, 0.05], 2000.25, 0.0, 30.0 + extra_hz)
    )
    turn = np.angle(taps.iq[1:, 1] * np.conj(taps.iq[:-1, 1]))
    np.testing.assert_allclose(turn, -2 * np.pi * 1.0 * 1e-3 * GPS_L1_HZ / C_MPS, rtol=2e-3)


def test_phase_of_the_prompt_is_true_minus_replica(received, command):
    nco = command([0.0, 0.05], 2000.25, -0.1, 30.0)
    taps = SampleCorrelator(received, chips(1), OFFSETS)(nco)
    np.testing.assert_allclose(np.angle(taps.iq[:, 1]), 2 * np.pi * 0.1, atol=1e-5)


@pytest.mark.parametrize("error_hz", [12.5, 25.0, 40.0])
def test_frequency_loss_is_sinc(received, command, error_hz):
    """20 ms at 12.5 Hz (0.91 dB), 25 Hz (3.92 dB), 40 Hz (12.6 dB): Kaplan & Hegarty ch. 8."""
    nco = command([0.0, 0.05], 2000.25, 0.0, 30.0 - error_hz, dump_chips=20_460)
    taps = SampleCorrelator(received, chips(1), OFFSETS)(nco)
    assert len(taps.number) == 1
    expected = np.sqrt(2 * 10**4.5 * 0.02) * np.sinc(error_hz * 0.02)
    assert abs(taps.iq[0, 1]) == pytest.approx(expected, rel=2e-3)


def test_cn0_and_noise_of_a_whole_front_end(truth, command):
    state = truth([2000.25, 700.0], 0.0, [30.0, -1500.0], cn0_dbhz=[45.0, -100.0], duration_s=0.8)
    source = SyntheticIf(state, chips(2), FS, 4, if_hz=IF_HZ)
    nco = command([0.0, 0.8], [2000.25, 700.0], 0.0, [30.0, -1500.0])
    taps = SampleCorrelator(source, chips(2), OFFSETS)(nco)
    x = taps.iq[taps.channel == 0, 1]
    n = x.size
    assert n == 799  # multiples 2046 to 2000.25 + 818400 chips
    assert abs(x.mean() - np.sqrt(2 * 10**4.5 * 1e-3)) < 4 * np.sqrt(2 / n)
    assert abs(x.var() / 2 - 1) < 4 / np.sqrt(n)
    # the other channel hears noise and the first satellite's cross-correlation, 2/3 of a chip of
    # its power: 2 C T * 2 / (3 Rc N0), signals_and_theory: spectral separation -61.86 dB/Hz
    y = taps.iq[taps.channel == 1]
    expected = 1 + 10**4.5 * 2 / (3 * CA_CHIP_RATE_HZ)
    assert np.all(abs(np.mean(np.abs(y) ** 2, axis=0) / 2 / expected - 1) < 4 / np.sqrt(n) + 0.03)
    # R(0.5) and R(1) between taps
    cov = (y.conj().T @ y).real / (2 * n)
    assert abs(cov[0, 1] - 0.5) < 4 / np.sqrt(n) + 0.03
    assert abs(cov[0, 2]) < 4 / np.sqrt(n) + 0.03


def test_sums_stay_open_between_calls(command):
    """Pieces in one call or in many, at any call border: the same bits."""
    source = noise(80_000)
    nco = command(np.arange(9) * 2.5e-3, [300.3, 1e4], 0.0, [-2000.0, 40.0], 525.0, [1023, 5115])
    whole = SampleCorrelator(source, chips(2), OFFSETS)(nco)
    parts = SampleCorrelator(source, chips(2), OFFSETS)
    rows = merge([parts(split(nco, a, b)) for a, b in itertools.pairwise([0, 1, 4, 8])])
    for column, expected in zip(rows, whole, strict=True):
        np.testing.assert_array_equal(column, expected)


class Chopped:
    """A source that copies, in float32."""

    def __init__(self, source: Recording) -> None:
        self.sample_rate_hz, self.if_hz, self.sigma = FS, source.if_hz, source.sigma
        self.source = source

    def samples(self, n0: int, n1: int) -> np.ndarray:
        return self.source.samples(n0, n1).astype(np.float32)


def test_bits_do_not_depend_on_source_block_or_threads(command, monkeypatch):
    source = noise(80_000)
    nco = command([0.0, 0.02], [300.3, 1e4, 7.0], 0.0, [-2000.0, 40.0, 1.0])
    whole = SampleCorrelator(source, chips(3), OFFSETS)(nco)
    threads = SampleCorrelator(source, chips(3), OFFSETS, workers=2)(nco)
    monkeypatch.setattr("signals.correlator._BLOCK", 3 * SPAN)
    blocks = SampleCorrelator(Chopped(source), chips(3), OFFSETS)(nco)
    for other in (threads, blocks):
        for column, expected in zip(other, whole, strict=True):
            np.testing.assert_array_equal(column, expected)


def test_first_partial_integration_is_dropped(command):
    source = noise(80_000)
    part = SampleCorrelator(source, chips(1), OFFSETS)(command([0.0, 0.005], 1023 * 7 + 0.3))
    assert part.number.tolist() == [8, 9, 10, 11]
    # within a sample (0.2558 chips) of the multiple the integration is whole
    whole = SampleCorrelator(source, chips(1), OFFSETS)(command([0.0, 0.005], 1023 * 7 + 0.2))
    assert whole.number.tolist() == [7, 8, 9, 10]  # 11 ends at 4.9998 ms: with the sample at 5 ms
    assert whole.t_start_s[0] == 0.0


def test_a_small_step_back_never_repeats_an_integration(command):
    nco = command(np.arange(9) * 2.5e-3, 1023 - 2.5 * 1023 + 2.0)
    for step in (-3.0, 3.0):
        moved = nco.code_phase_chips.copy()
        moved[1:] += step
        taps = SampleCorrelator(noise(80_000), chips(1), OFFSETS)(
            nco._replace(code_phase_chips=moved)
        )
        # at the border the index had just changed (2 chips ago): -3 chips lead back before it
        np.testing.assert_array_equal(np.diff(taps.number), 1)
        np.testing.assert_array_equal(taps.t_start_s[1:], taps.t_end_s[:-1])
        length = np.rint((taps.t_end_s - taps.t_start_s) * FS)
        assert sorted(length - 4000)[0 if step > 0 else -1] == pytest.approx(
            -step / 1023 * 4000, abs=1.0
        )


def test_a_large_step_starts_again(command):
    nco = command(np.arange(9) * 2.5e-3, 100.0)
    for step in (-5000.5, 5000.5):
        moved = nco.code_phase_chips.copy()
        moved[3:] += step
        taps = SampleCorrelator(noise(80_000), chips(1), OFFSETS)(
            nco._replace(code_phase_chips=moved)
        )
        samples = np.rint((taps.t_end_s - taps.t_start_s) * FS)
        np.testing.assert_allclose(samples, 4000, atol=1)  # whole ones only
        assert not np.any((taps.t_start_s < 7.5e-3) & (taps.t_end_s > 7.5e-3))


def test_change_of_dump_length_drops_the_open_sum(command):
    nco = command(np.arange(9) * 2.5e-3, 100.0)
    correlate = SampleCorrelator(noise(80_000), chips(1), OFFSETS)
    first = correlate(split(nco, 0, 4))
    assert first.number.tolist() == list(range(1, 10))
    second = correlate(split(nco, 4, 8)._replace(dump_chips=np.array([2046])))
    assert second.number.tolist() == [6, 7, 8, 9]  # chips 12276 to 20460 of 20560
    assert second.t_start_s[0] == pytest.approx((6 * 2046 - 100) / CA_CHIP_RATE_HZ, abs=1 / FS)


def test_invalid_channels_and_gaps_drop_the_open_sum(command):
    nco = command(np.arange(9) * 2.5e-3, [100.0, 100.0])
    correlate = SampleCorrelator(noise(80_000), chips(2), OFFSETS)
    off = np.array([True, False])
    correlate(split(nco, 0, 2))
    broken = split(nco, 2, 4)._replace(valid=off)
    broken.carrier_freq_hz[:, 1] = np.nan  # not looked at
    middle = correlate(broken)
    assert set(middle.channel) == {0}
    last = correlate(split(nco, 4, 6))
    assert last.number[last.channel == 0].tolist() == [10, 11, 12, 13, 14]
    assert last.number[last.channel == 1].tolist() == [11, 12, 13, 14]
    gap = correlate(split(nco, 7, 8))  # 17.5 ms: chip 18002.5, integration 17 is under way
    assert gap.number[gap.channel == 0].tolist() == [18, 19]


def test_a_command_may_be_of_any_arrays(command):
    """Other types and layouts, and fewer pieces than before: the same bits as a plain command."""
    source = noise(80_000)
    nco = command(np.arange(9) * 2.5e-3, [300.0, 1e4], 0.0, [-2000.0, 40.0], 0.0, [1023, 5115])
    fresh, used = (SampleCorrelator(source, chips(2), OFFSETS) for _ in range(2))
    used(nco)
    for part in (split(nco, 0, 1), split(nco, 1, 8)):
        expected = fresh(part)
        strange = Nco(
            part.t_s.tolist(),
            np.asfortranarray(part.code_phase_chips),
            part.chip_rate_hz.tolist(),
            np.repeat(part.carrier_phase_cycles, 2, axis=1)[:, ::2],
            part.carrier_freq_hz.astype(np.int64),
            part.carrier_rate_hz_per_s.astype(np.float32),
            part.dump_chips.astype(np.int32),
            part.valid.astype(np.int8),
        )
        for column, same in zip(used(strange), expected, strict=True):
            np.testing.assert_array_equal(column, same)


def test_results_belong_to_the_caller(command):
    """Room is used again by the next call, rows that were returned are not."""
    nco = command(np.arange(9) * 2.5e-3, [300.0, 1e4])
    correlate = SampleCorrelator(noise(80_000), chips(2), OFFSETS)
    first = correlate(split(nco, 0, 4))
    kept = Taps(*(column.copy() for column in first))
    correlate(split(nco, 4, 8))
    for column, same in zip(first, kept, strict=True):
        np.testing.assert_array_equal(column, same)


def test_a_source_that_fails_leaves_nothing_behind(command):
    """Refused within the second of three blocks: the next command starts as on a new correlator."""
    source = noise(400_000)
    nco = command([0.0, 0.1], [300.0, 1e4])
    expected = SampleCorrelator(source, chips(2), OFFSETS)(nco)
    short = Recording(source.samples(0, 200_000), FS, IF_HZ, 24.0)
    correlate = SampleCorrelator(short, chips(2), OFFSETS)
    for _ in range(3):
        with pytest.raises(ValueError, match="the recording has 0 to 200000"):
            correlate(nco)
    correlate._source = source
    for column, same in zip(correlate(nco), expected, strict=True):
        np.testing.assert_array_equal(column, same)


def test_bad_commands_are_refused(command):
    source = noise(40_000)
    good = command([0.0, 0.005, 0.01])
    correlate = SampleCorrelator(source, chips(1), OFFSETS)
    for field, value, message in (
        ("chip_rate_hz", np.full((2, 1), -1.0), "chip_rate_hz is .*expected > 0"),
        (
            "chip_rate_hz",
            np.full((2, 1), 5e6),
            "chip_rate_hz is .*at most the sampling rate, 4000000.0",
        ),
        ("carrier_freq_hz", np.full((2, 1), np.nan), "carrier_freq_hz of a valid channel"),
        ("carrier_freq_hz", np.zeros((1, 1)), r"carrier_freq_hz is \(1, 1\): expected \(2, 1\)"),
        ("dump_chips", np.array([0]), "dump_chips is .*at least one chip"),
        ("valid", np.ones(2, bool), r"expected \(1,\) each"),
        ("t_s", np.array([0.0, 0.005, 0.004]), "expected two or more, rising"),
        ("t_s", np.array([0.0, 0.005, 0.0101]), "the recording has 0 to 40000"),
    ):
        with pytest.raises(ValueError, match=message):
            correlate(good._replace(**{field: value}))
    with pytest.raises(ValueError, match="chips are"):
        SampleCorrelator(source, np.ones(1023, np.int8), OFFSETS)
    with pytest.raises(ValueError, match="offset_chips"):
        SampleCorrelator(source, chips(1), np.array([np.nan]))


@pytest.mark.parametrize("phase", [1e19, -1e19, 1e300])
def test_a_phase_without_a_fraction_in_float64_is_refused(phase: float) -> None:
    one = np.ones((1, 1))
    nco = Nco(
        np.array([0.0, 1e-3]), phase * one, CA_CHIP_RATE_HZ * one, one, one, one,
        np.array([1023]), np.array([True]),
    )  # fmt: skip
    correlator = SampleCorrelator(noise(4000), chips(1), OFFSETS)
    with pytest.raises(ValueError, match=r"code_phase_chips of a valid channel is -?1e"):
        correlator(nco)
