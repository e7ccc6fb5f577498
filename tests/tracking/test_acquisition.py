"""Acquisition of samples whose truth is known: what is found, where, how surely, and how often not.

Expected values are the truth of the generator (`signals.front_end`, held to its definition by its
own tests), sums by definition, and distributions.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from signals.codes import GPS_L1CA, signal
from signals.front_end import SyntheticIf
from signals.propagation import SignalState
from signals.recording import Recording
from signals.replica import replicas
from signals.signal_row import Signal
from ultratight.statistics import wilson
from ultratight.tracking import acquisition, code_search
from ultratight.tracking.acquisition import Search, acquire, threshold
from ultratight.tracking.excision import HALF
from ultratight.tracking.fine_acquisition import Fine, code_sense

SKY = {3: (-3210.0, 812.25, 46.0), 11: (47.0, 100.5, 43.0), 22: (4890.0, 511.9, 40.0)}
"""PRN: Doppler [Hz], code phase at sample 0 [chips], C/N0 [dB-Hz]"""


def sampled(
    sky: dict[int, tuple[float, float, float]],
    rate_hz: float,
    seconds: float,
    row: Signal = GPS_L1CA,
    seed: int = 1,
    **how: Any,
) -> Recording:
    """Samples of satellites at constant Doppler, with random data bits."""
    n = math.ceil(seconds / 0.005)
    t = 0.005 * np.arange(n + 1)
    rng = np.random.default_rng(seed)
    doppler, phase, cn0 = (np.array(column)[:, None] for column in zip(*sky.values(), strict=True))
    carrier, code = np.zeros((2, len(sky), n, 4))
    carrier[..., 0], carrier[..., 1] = doppler * t[:-1] + rng.uniform(size=(len(sky), 1)), doppler
    chip_rate = row.chip_rate_hz * (1.0 + doppler / row.carrier_hz)
    code[..., 0], code[..., 1] = phase + chip_rate * t[:-1], chip_rate
    n_symbol = math.ceil(row.chip_rate_hz * 1.001 * n * 0.005 / row.symbol_chips) + 2
    n_symbol += math.ceil(row.length_chips / row.symbol_chips)
    state = SignalState(
        t, code, carrier, np.broadcast_to(cn0, (len(sky), n)), np.ones((len(sky), n), bool),
        rng.choice(np.array([-1, 1], np.int8), (len(sky), n_symbol)), 0,
    )  # fmt: skip
    table = replicas([row.subchips(prn) for prn in sky], row.per_chip)
    source = SyntheticIf(state, table, rate_hz, seed, symbol_chips=row.symbol_chips, **how)
    return source.record(round(seconds * rate_hz))


def noise(rate_hz: float, n: int, seed: int) -> np.ndarray:
    """White noise (n, 2) float32."""
    return np.random.default_rng(seed).standard_normal((n, 2)).astype(np.float32)


def wave(turn: float, n: int) -> np.ndarray:
    """A continuous wave (n, 2) float32 of amplitude 1, ``turn`` cycles a sample."""
    turns = 2.0 * np.pi * turn * np.arange(n)
    return np.stack([np.cos(turns), np.sin(turns)], axis=1).astype(np.float32)


def chips_apart(a: float, b: float, length: int = 1023) -> float:
    """a - b, the shorter way round."""
    return (a - b + length / 2) % length - length / 2


SAMPLERS = {
    "4 MHz int8 IQ": (4e6, {}),
    "12 MHz real at 3 MHz": (12e6, {"real": True, "if_hz": 3e6}),
    "5 MHz int16 IQ": (5e6, {"sample_format": "int16"}),
    "no whole samples per period, 1.25 MHz off": (6.1377e6, {"if_hz": 1.2501e6}),
    "2 bits": (4e6, {"sample_format": "bits2"}),
    "4 bits": (4e6, {"sample_format": "bits4"}),
    "1 bit": (4e6, {"sample_format": "bits1"}),
    "1 bit, real": (6e6, {"sample_format": "bits1", "real": True, "if_hz": 1.6e6}),
}


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_what_is_sent_is_found_and_nothing_else(sampler: str) -> None:
    """Doppler, code phase and C/N0 of 0.1 s; 5 sigma at 40 dB-Hz and the figures of the docstring.

    Doppler: Cramer-Rao bound sqrt(12 / 2 C/N0 T) / (2 pi T) = 0.1 Hz, with T = 0.1 s, is beaten
    by the squaring loss (1 + 1 / (2 C/N0 T_c)) and the grid; 1 Hz is ten times that.  Code:
    early-late of 1 ms at half a chip, sqrt(D / (4 C/N0 T) (1 + ...)) = 0.018 chips.
    """
    rate_hz, how = SAMPLERS[sampler]
    rows = acquire(sampled(SKY, rate_hz, 0.11, **how))
    assert [row.prn for row in rows] == list(range(1, 33))
    assert [row.prn for row in rows if row.found] == list(SKY)
    for row in rows:
        if row.found:
            doppler, code_phase, cn0 = SKY[row.prn]
            assert row.doppler_hz == pytest.approx(doppler, abs=1.0)
            assert chips_apart(row.code_phase_chips, code_phase) == pytest.approx(0.0, abs=0.09)
            # theory/quantization_loss.csv, clipping by neighbours included
            lost = {"1": 1.96, "2": 0.55}.get(sampler[0], 0.0) if "bit" in sampler else 0.0
            assert row.cn0_dbhz == pytest.approx(cn0 - lost, abs=1.0)
            assert row.sample_index == 0


ONE_SIDE = {2: (-838.0, 10.3, 45.0), 6: (-1275.0, 200.6, 45.0), 19: (-5057.0, 700.9, 45.0)}


@pytest.mark.parametrize(
    ("rate_hz", "said", "sense", "offset_hz"),
    [
        (1.3e6, {}, 1.0, 0.0),
        (4e6, {}, 1.0, 0.0),
        (1.3e6, {"if_hz": 3000.0}, 1.0, -3000.0),
        (4e6, {"if_hz": -6000.0}, 1.0, 6000.0),
        (1.3e6, {"conjugate": True}, -1.0, 0.0),
    ],
)
def test_codes_say_what_is_wrong_with_carriers(
    rate_hz: float, said: dict[str, Any], sense: float, offset_hz: float
) -> None:
    """Sense and offset as the description was falsified, within 4.5 of the sigmas that are given.

    At 1.3 MHz half a sample is 0.4 chips: code phases belong to whole samples.
    """
    sent = sampled(ONE_SIDE, rate_hz, 1.0)
    source = Recording(sent.samples(0, sent.end_sample), rate_hz, **({"if_hz": 0.0} | said))
    rows = [row for row in acquire(source, search=Search(doppler_hz=12e3)) if row.found]
    assert [row.prn for row in rows] == list(ONE_SIDE)
    at = Fine(*(np.array([getattr(row, name) for row in rows]) for name in Fine._fields))
    found = code_sense(source, GPS_L1CA, list(ONE_SIDE), at, 0, source.end_sample)
    assert found.sense_sigma < 0.03
    assert found.sense == pytest.approx(sense, abs=4.5 * found.sense_sigma)
    wrong = acquisition.misfit(source, GPS_L1CA, rows)
    assert wrong.inverted == (sense < 0.0)
    if sense > 0.0:
        assert found.offset_sigma_hz < 60.0
        assert found.offset_hz == pytest.approx(offset_hz, abs=4.5 * found.offset_sigma_hz)
        assert wrong.offset_hz == (found.offset_hz if offset_hz else 0.0)


def test_nothing_is_said_of_what_cannot_be_told() -> None:
    """A satellite alone has no sense, only an offset; 20 ms have neither."""
    sent = sampled({7: (2000.0, 50.0, 45.0)}, 2.5e6, 0.5)
    source = Recording(sent.samples(0, sent.end_sample), 2.5e6, 4000.0)
    rows = acquire(source, prns=[7])
    wrong = acquisition.misfit(source, GPS_L1CA, rows)
    assert wrong == (False, pytest.approx(-4000.0, abs=500.0))
    short = Recording(sent.samples(0, 50_000), 2.5e6, 4000.0)
    assert acquisition.misfit(short, GPS_L1CA, rows) == (False, 0.0)


@pytest.mark.parametrize(
    ("agree", "of", "said"),
    [(3, 3, 0), (4, 4, 4), (4, 9, 0), (5, 9, 5), (5, 20, 0), (6, 20, 6), (0, 0, 0), (1, 1, 0)],
)
def test_a_doppler_modulo_500_hz_is_shared_by_more_than_chance(
    agree: int, of: int, said: int
) -> None:
    """N C(N - 1, n - 1) 0.008^(n - 1), to first order, on the two sides of 1e-4.

    1.9e-4, 2.0e-6; 2.6e-4, 2.6e-6; 3.2e-4, 7.6e-6.  The others stand 20 Hz apart, and agreeing
    Dopplers lie about 0, where the remainder wraps.
    """
    doppler = [500.0 * (-1) ** k * k + 0.6 * k - 1.0 for k in range(agree)]
    doppler += [40.0 + 1020.0 * k for k in range(of - agree)]
    rows = [
        acquisition.Acquisition(1 + k, 0.0, d, 30.0, 2.0, 1.0, 0) for k, d in enumerate(doppler)
    ]
    absent = [acquisition.Acquisition(40 + k, 0.0, 0.0, 30.0, 0.5, 1.0, 0) for k in range(9)]
    assert acquisition.alike(GPS_L1CA, [*rows, *absent]) == said


def test_a_later_sample_has_a_later_code_phase() -> None:
    recording = sampled(SKY, 4e6, 0.06)
    n0 = 123_457
    for row in acquire(recording, prns=list(SKY), first_sample=n0):
        doppler, code_phase, _ = SKY[row.prn]
        expected = code_phase + 1.023e6 * (1.0 + doppler / 1575.42e6) * n0 / 4e6
        assert (row.found, row.sample_index) == (True, n0)
        assert chips_apart(row.code_phase_chips, expected) == pytest.approx(0.0, abs=0.15)


def test_a_satellite_does_not_depend_on_those_searched_with_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One by one, in another order, and a few PRNs at a time where room is scarce: same bits."""
    recording = sampled(SKY, 4e6, 0.02)
    together = {row.prn: row for row in acquire(recording)}
    assert acquire(recording, prns=[22, 5]) == [together[22], together[5]]
    monkeypatch.setattr(code_search, "_ROOM", 3 * 21 * 2048)
    assert acquire(recording) == list(together.values())


def test_the_code_follows_the_carrier_over_a_long_sum() -> None:
    """0.4 s at 4.5 kHz: the code gains 1.17 chips, which would halve the peak.

    On the grid in delay and Doppler: 1 + 0.903 C/N0 T, as the lines taken have 90.3 % of the power
    (the module's losses); a change of sign in every 40th block takes some 2 % more.
    """
    on_grid = 1023.0 * (1.0 - 1448 / 2048)
    recording = sampled({7: (4500.0, on_grid, 42.0)}, 2.5e6, 0.401)
    (row,) = acquire(recording, prns=[7], search=Search(noncoherent=400))
    one = 10**4.2 * 1e-3
    assert row.peak - 1.0 == pytest.approx(0.885 * one, rel=0.05)
    assert chips_apart(row.code_phase_chips, on_grid) == pytest.approx(0.0, abs=0.06)


def test_longer_coherent_sums_find_what_is_weaker() -> None:
    """30 dB-Hz in 0.1 s: hidden to 10 x 1 ms, plain in 10 x 10 ms (10 log 10 - squaring loss)."""
    recording = sampled({9: (1234.5, 700.0, 31.0)}, 2.5e6, 0.13)
    short, long = (
        acquire(recording, prns=[9], search=search)[0]
        for search in (Search(1500.0), Search(1500.0, coherent_s=0.01))
    )
    assert not short.found
    assert long.found
    assert long.doppler_hz == pytest.approx(1234.5, abs=10.0)
    assert chips_apart(long.code_phase_chips, 700.0) == pytest.approx(0.0, abs=0.5)


# -- the energies --------------------------------------------------------------------------------


def energy_by_definition(x: np.ndarray, g: code_search.Grid, prn: int, d: int, k: int) -> float:
    """Equations (1) to (3) of the module, in float64, as sums over samples and lines."""
    c = code_search.lines(g.signal, prn, g.n_delay)
    m = np.fft.fftfreq(g.n_delay, 1.0 / g.n_delay)
    total = 0.0
    for b in range(g.n_block):
        n = np.arange(g.n_sample)
        t, t_b = n / g.sample_rate_hz, (g.block_at(b) - g.first_sample) / g.sample_rate_hz
        s = t_b + (t_b + 0.5 * g.block_s) * g.doppler_hz[d] / g.signal.carrier_hz
        turns = np.outer(t, m) / g.period_s - m * (k / g.n_delay - s / g.period_s)
        code = np.exp(2j * np.pi * turns) @ c  # one line of the lowest pair alone: not quite real
        block = x[g.block_at(b) :][: g.n_sample]
        wiped = block * np.exp(-2j * np.pi * (g.if_hz + g.doppler_hz[d]) * t)
        total += abs(np.vdot(code, wiped)) ** 2 / np.vdot(c, c).real
    return float(total)


@pytest.mark.nojit
def test_energies_are_their_definition() -> None:
    """Two blocks, an intermediate frequency, float32 sums: to 1e-4 of the mean energy."""
    rate_hz, n = 1.5e6, 1500
    pairs = noise(rate_hz, 2 * n, 3)
    recording = Recording(pairs, rate_hz, 1.0e5)
    search = Search(noncoherent=2, doppler_hz=1000.0, delays_per_chip=1.0)
    g = search.grid(recording, GPS_L1CA, 0)
    ((prns, energy),) = code_search.energies(recording, g, [5, 17])
    assert energy.shape == (2, 5, 1024)
    # each block about the mean of itself and what the excision takes beside it
    means = [pairs[: n + HALF].mean(axis=0), pairs[n - HALF :].mean(axis=0)]
    centred = pairs.astype(float) - np.repeat(means, n, axis=0)
    x = centred[:, 0] + 1j * centred[:, 1]
    for i, d, k in ((0, 0, 0), (1, 3, 500), (1, 4, 1023)):
        expected = energy_by_definition(x, g, prns[i], d, k)
        assert energy[i, d, k] == pytest.approx(expected, abs=1e-4 * float(energy.mean()))


@pytest.mark.parametrize("label", ["L1CA", "L1CD", "L2CM"])
def test_lines_are_the_code(label: str) -> None:
    """Parseval, and the code's values where its Fourier series is summed over many lines."""
    row = signal(label)
    values = row.modulation.modulate(row.chips(4)).astype(float)
    c = code_search.lines(row, 4, 64 * values.size)
    # 1 / (pi^2 32) of a rectangle's power is beyond 32 times its first zero
    assert np.vdot(c, c).real == pytest.approx(np.mean(values**2), rel=2.0 / (np.pi**2 * 32))
    middles = np.fft.ifft(c, norm="forward").real[32::64]
    np.testing.assert_allclose(middles, values, atol=0.03)


# -- how surely ----------------------------------------------------------------------------------


def test_the_threshold_is_that_of_the_chi_square() -> None:
    """B sums of |z|^2 are chi-square of 2 B degrees; for one block -log(1 - (1 - p)^(1/n))."""
    assert threshold(1000, 1, 0.01) == pytest.approx(-math.log(1.0 - 0.99 ** (1 / 1000)), rel=1e-9)
    for blocks in (1, 10, 300):
        tail = stats.chi2(2 * blocks).sf(2 * blocks * threshold(43_008, blocks, 1e-3))
        assert tail == pytest.approx(1e-3 / 43_008, rel=1e-3)


def false_alarms(recording: Recording, search: Search, blocks: int, prns: range) -> tuple[int, int]:
    """How many PRNs that are not there are found, and of how many."""
    step = len(recording) // blocks
    found = [
        row.found
        for b in range(blocks)
        for row in acquire(recording, prns=prns, search=search, first_sample=b * step)
    ]
    return sum(found), len(found)


@pytest.mark.parametrize("kind", ["white", "coloured", "continuous wave"])
def test_false_alarms_are_as_rare_as_stated(kind: str) -> None:
    """In noise of any colour, and beside a wave 23 dB above all of it.

    Cells are not independent, which leaves 0.75 to 1 of the rate.
    """
    rate_hz, n_block = 2.5e6, 2
    pairs = noise(rate_hz, n_block * 25_000, 5)
    if kind == "coloured":  # 12 dB over the band
        z = stats.norm.rvs(size=(2, len(pairs)), random_state=6)
        from scipy.signal import lfilter

        pairs = np.ascontiguousarray(lfilter([1.0], [1.0, -0.6], z).T, np.float32)
    if kind == "continuous wave":
        pairs += 20.0 * wave(317_123.0 / rate_hz, len(pairs))
    recording = Recording(pairs, rate_hz, 0.0)
    k, n = false_alarms(recording, Search(false_alarm=0.1), n_block, range(1, 211))
    rate = wilson(k, n, 0.9999)
    assert rate.low < 0.1
    assert rate.high > 0.06


def test_a_strong_satellite_is_found_once() -> None:
    """60 dB-Hz beside 40: all other codes correlate with it, 21 to 24 dB below, over the threshold.

    Without taking it away nearly every PRN would be "found".
    """
    sky = {3: (-3210.0, 812.25, 62.0), 11: (47.0, 100.5, 41.0)}
    recording = sampled(sky, 4e6, 0.05)
    rows = acquire(recording)
    assert [row.prn for row in rows if row.found] == list(sky)
    loud = [row for row in rows if row.prn == 11]
    assert loud[0].doppler_hz == pytest.approx(47.0, abs=2.0)
    g = Search().grid(recording, GPS_L1CA, 0)
    naive = acquisition._peaks(recording, g, range(1, 33))
    assert sum(p.peak > rows[0].threshold for p in naive) > 25


def test_satellites_beside_a_continuous_wave_are_found() -> None:
    """Twice the noise of all 4 MHz in one line, 40 dB above a satellite: its bins are blanked."""
    clean = sampled(SKY, 4e6, 0.03, sample_format="float32")
    pairs = clean.samples(0, 120_000) + 2.0 * wave(0.0871, 120_000)
    rows = acquire(Recording(pairs, 4e6, 0.0))
    assert [row.prn for row in rows if row.found] == list(SKY)
    before = {row.prn: row.peak for row in acquire(clean)}
    for row in rows:
        if row.found:
            assert row.peak == pytest.approx(before[row.prn], rel=0.2)


# -- other signals -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("label", "rate_hz", "coherent_s"), [("L5Q", 25e6, 0.001), ("L1CD", 5e6, 0.01)]
)
def test_other_signals(label: str, rate_hz: float, coherent_s: float) -> None:
    """A BPSK(10) with a secondary code and a BOC(1,1) of 10 ms."""
    row = signal(label)
    sky = {4: (-1530.0, 0.42 * row.length_chips, 45.0)}
    recording = sampled(sky, rate_hz, 0.055, row)
    search = Search(noncoherent=5, doppler_hz=2000.0, coherent_s=coherent_s)
    found = acquire(recording, row, range(3, 6), search)
    assert [f.found for f in found] == [False, True, False]
    assert found[1].doppler_hz == pytest.approx(-1530.0, abs=3.0)
    away = chips_apart(found[1].code_phase_chips, 0.42 * row.length_chips, row.length_chips)
    assert away == pytest.approx(0.0, abs=0.06)
    assert found[1].cn0_dbhz == pytest.approx(45.0, abs=1.5)


# -- what cannot be searched ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"noncoherent": 0}, "noncoherent is 0: expected 1 to"),
        ({"false_alarm": 0.0}, "false_alarm is 0.0: expected more than 0, below 1"),
        ({"doppler_hz": -1.0}, "doppler_hz is -1: expected 0 to"),
        ({"coherent_s": 0.0015}, "coherent_s is 0.0015: expected a multiple of the code period"),
        ({"coherent_s": math.nan}, "coherent_s is nan: expected a multiple"),
        ({"doppler_step_hz": 600.0}, "doppler_step_hz is 600: expected 10 to 500"),
        ({"delays_per_chip": 0.5}, "delays_per_chip is 0.5: expected 1 to 100"),
    ],
)
def test_searches_that_make_no_sense(change: dict[str, float], expected: str) -> None:
    recording = Recording(noise(4e6, 50_000, 1), 4e6, 0.0)
    with pytest.raises(ValueError, match=expected):
        acquire(recording, search=Search(**change))


def test_samples_that_cannot_be_searched() -> None:
    pairs = noise(4e6, 50_000, 1)
    with pytest.raises(ValueError, match="samples 0 to 39999, expected 0 to 40000, as 10 x 1 ms"):
        acquire(Recording(pairs[:39_999], 4e6, 0.0))
    with pytest.raises(ValueError, match="prn 333: GPS L1 C/A has codes for PRN 1-210"):
        acquire(Recording(pairs, 4e6, 0.0), prns=[1, 333])
    with pytest.raises(ValueError, match=r"1e\+06: expected more than the chip rate of GPS L1 C/A"):
        acquire(Recording(pairs, 1e6, 0.0))
    with pytest.raises(ValueError, match=r"at if_hz 0: expected a band .* half .*; it holds 45%"):
        acquire(Recording(pairs[:, 0].copy(), 4e6, 0.0))
    pairs[33_333, 1] = np.nan
    with pytest.raises(ValueError, match="sample 33333 is not finite, expected numbers"):
        acquire(Recording(pairs, 4e6, 0.0, 1.0))
