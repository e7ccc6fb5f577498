"""Modulations against closed forms, tabulated losses and their own chips."""

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

from signals import modulation as m
from signals.codes import BEIDOU_B1CP, GPS_L1CA, GPS_L1CP, GPS_L2CM, GPS_L5Q

FC = 1.023e6
DATA = Path(__file__).parents[3] / "shared" / "data" / "theory" / "bandlimiting_loss.csv"
ALL = [
    m.bpsk(1), m.BOC11, m.BOC61, m.TMBOC, m.CBOC_PLUS, m.CBOC_MINUS, m.QMBOC, m.FIRST_HALF,
    m.SECOND_HALF,
]  # fmt: skip


def boc(f: np.ndarray, fs: float, fc: float) -> np.ndarray:
    """Sine-phased BOC with an even number of half periods in a chip (Betz 2001)."""
    return fc * (np.sin(np.pi * f / fc) * np.tan(np.pi * f / (2 * fs)) / (np.pi * f)) ** 2


def sinc2(f: np.ndarray, fc: float) -> np.ndarray:
    return np.sinc(f / fc) ** 2 / fc


def test_spectra_are_the_closed_forms():
    f = np.linspace(-15.1e6, 15.07e6, 1001)  # no pole of the tangent among them
    b11, b61 = boc(f, FC, FC), boc(f, 6 * FC, FC)
    near = {"rtol": 1e-9, "atol": 1e-20}
    np.testing.assert_allclose(m.bpsk(1).psd(f, FC), sinc2(f, FC), **near)
    np.testing.assert_allclose(m.bpsk(10).psd(f, 10 * FC), sinc2(f, 10 * FC), **near)
    np.testing.assert_allclose(m.BOC11.psd(f, FC), b11, **near)
    np.testing.assert_allclose(m.BOC61.psd(f, FC), b61, **near)
    np.testing.assert_allclose(m.TMBOC.psd(f, FC), 29 / 33 * b11 + 4 / 33 * b61, **near)
    # one sign of CBOC has a cross term, E1-B and E1-C together have none: MBOC(6,1,1/11)
    both = 0.5 * (m.CBOC_PLUS.psd(f, FC) + m.CBOC_MINUS.psd(f, FC))
    mboc = 10 / 11 * b11 + 1 / 11 * b61
    np.testing.assert_allclose(both, mboc, **near)
    assert np.abs(m.CBOC_PLUS.psd(f, FC) - mboc).max() > 0.05 * mboc.max()
    # L1C: 3/4 of the power in the pilot, 1/4 in the data: MBOC again (IS-GPS-800 3.3)
    np.testing.assert_allclose(0.75 * m.TMBOC.psd(f, FC) + 0.25 * b11, mboc, **near)
    # half a chip of 1 / 511.5 kHz: the spectrum of BPSK(1)
    np.testing.assert_allclose(m.FIRST_HALF.psd(f, FC / 2), sinc2(f, FC), **near)


@pytest.mark.parametrize("mod", ALL, ids=lambda x: x.name)
def test_spectrum_and_correlation_are_fourier_pairs_of_unit_power(mod):
    assert mod.correlation(np.array([0.0]))[0] == pytest.approx(1.0, abs=1e-12)
    # the tails fall as 1 / f^2: what lies beyond b is below 2 p^2 fc / (pi^2 b), p <= 12
    b = 3000 * FC
    rest = 2 * mod.per_chip**2 / (np.pi**2 * 3000)
    assert 1.0 - rest < mod.power_kept(FC, 2 * b) < 1.0
    # S is the transform of R, which is straight between its steps
    edges = np.arange(mod.per_chip + 1) / mod.per_chip
    for f in (0.0, 0.3e6, 1.1e6, 6.1e6, 7.4e6):

        def integrand(d: float, f: float = f) -> float:
            return 2 * mod.correlation(np.array([d]))[0] * np.cos(2 * np.pi * f * d / FC)

        parts = zip(edges[:-1], edges[1:], strict=True)
        integral = sum(quad(integrand, lo, hi, epsabs=1e-12)[0] for lo, hi in parts)
        assert mod.psd(np.array([f]), FC)[0] * FC == pytest.approx(integral, abs=1e-9)


def test_correlation_of_boc_has_its_known_peaks():
    # sine BOC(1,1): -1/2 at half a chip, zeros at 1/3 (Betz 2001)
    np.testing.assert_allclose(
        m.BOC11.correlation(np.array([0.0, 1 / 3, 0.5, -0.5, 0.75, 1.0, 3.0])),
        [1, 0, -0.5, -0.5, -0.25, 0, 0], atol=1e-12,
    )  # fmt: skip
    # BOC(6,1): falls from 1 to -11/12 in 1/12 chip
    np.testing.assert_allclose(m.BOC61.correlation(np.arange(3) / 12), [1, -11 / 12, 10 / 12])
    # L2 CM: a triangle half as wide as its chip
    np.testing.assert_allclose(m.FIRST_HALF.correlation(np.array([0.25, 0.5, 1.0])), [0.5, 0, 0])


@pytest.mark.skipif(
    not DATA.exists(), reason="needs the reference data folder beside the repository"
)
def test_losses_are_the_tabulated_ones():
    mboc = m.Modulation("MBOC", m.TMBOC.waveforms, (0,), 11)  # 1 chip in 11 BOC(6,1)
    mods = {
        "BPSK(1) GPS C/A": (m.bpsk(1), 1),
        "BPSK(2) BDS B1I": (m.bpsk(2), 2),
        "BPSK(10) L5/E5a": (m.bpsk(10), 10),
        "BOC(1,1)": (m.BOC11, 1),
        "MBOC(6,1,1/11) E1/L1C": (mboc, 1),
        "BOC(10,5)": (m.Modulation("BOC(10,5)", ((1, -1, 1, -1),)), 5),
        "BOC(15,2.5) E1A": (m.Modulation("BOC(15,2.5)", ((1, -1) * 6,)), 2.5),
    }
    with DATA.open() as file:
        rows = list(csv.DictReader(file))
    for r in rows:
        mod, n = mods[r["signal"]]
        band = float(r["double_sided_bandwidth_MHz"]) * 1e6
        assert mod.power_kept(n * FC, band) == pytest.approx(float(r["power_fraction"]), abs=1e-6)
        gabor = mod.gabor_bandwidth_hz(n * FC, band) / 1e6
        assert gabor == pytest.approx(float(r["rms_gabor_bandwidth_MHz"]), abs=1e-5)
    assert len(rows) == 7 * 9


@pytest.mark.parametrize("mod", [m.bpsk(1), m.BOC11, m.TMBOC, m.CBOC_MINUS], ids=lambda x: x.name)
def test_band_limited_correlation(mod):
    d = np.linspace(-1.5, 1.5, 301)
    narrow = mod.band_limited_correlation(d, FC, 4 * FC)
    assert narrow[150] == pytest.approx(mod.power_kept(FC, 4 * FC), abs=1e-12)
    np.testing.assert_allclose(narrow, narrow[::-1], atol=1e-12)
    # a filtered rectangle by the discrete transform of a long, finely sampled chip
    n, per = 2**14, 384
    pulse = np.zeros((len(mod.waveforms), n))
    steps = np.asarray(mod.waveforms).repeat(per // mod.per_chip, axis=1)
    pulse[:, :per] = steps
    f = np.fft.rfftfreq(n, 1 / (per * FC))
    keep = np.where(f < 2 * FC, 1.0, np.where(f == 2 * FC, 0.5, 0.0))
    power = (np.abs(np.fft.rfft(pulse)) ** 2 * keep).T @ mod.shares
    sampled = np.fft.irfft(power, n) / per
    lag = np.rint(d * per).astype(int)
    grid = mod.band_limited_correlation(lag / per, FC, 4 * FC)
    np.testing.assert_allclose(grid, sampled[lag], atol=2e-3)  # steps of 1/384 chip, f of 24 kHz
    # a wide filter changes nothing but the corners
    wide = mod.band_limited_correlation(d, FC, 400 * FC)
    np.testing.assert_allclose(wide, mod.correlation(d), atol=0.02)


@pytest.mark.parametrize("row", [GPS_L1CA, GPS_L1CP, GPS_L5Q, GPS_L2CM], ids=lambda r: r.label)
def test_spectrum_of_generated_codes_is_that_of_the_modulation(row):
    # mean periodogram over PRN, in bands of many lines: the code's lines scatter like noise
    fc, per = row.chip_rate_hz, row.per_chip
    length = row.length_chips * per
    power = np.zeros(length // 2 + 1)
    prns = range(1, 21)
    for prn in prns:
        values = row.modulation.modulate(row.chips(prn)).astype(float)
        power += np.abs(np.fft.rfft(values) / length) ** 2
    f = np.fft.rfftfreq(length, 1 / (per * fc))
    # a stair of values is its samples through a hold of one step
    power *= np.sinc(f / (per * fc)) ** 2 / len(prns)
    lines = 40
    n = len(f) // lines * lines
    band = power[1 : n + 1 - lines].reshape(-1, lines).sum(axis=1)
    step = fc / row.length_chips
    expected = (row.modulation.psd(f, fc) * step)[1 : n + 1 - lines].reshape(-1, lines).sum(axis=1)
    strong = expected > 0.05 * expected.max()
    # 800 lines with the spread of a power: 1 sigma is 1 / sqrt(800)
    ratio = band[strong] / expected[strong]
    assert abs(ratio.mean() - 1) < 5 / np.sqrt(800 * strong.sum())
    assert np.abs(ratio - 1).max() < 5 / np.sqrt(800)


@pytest.mark.parametrize("row", [GPS_L1CP, GPS_L2CM, BEIDOU_B1CP], ids=lambda r: r.label)
def test_codes_correlate_as_their_modulation(row):
    # within a chip of the peak, where other chips enter with -1 or so in a thousand each
    per = row.per_chip
    own = np.mean([row.autocorrelation(prn)[: per + 1] for prn in range(1, 31)], axis=0)
    ideal = row.modulation.correlation(np.arange(per + 1) / per)
    np.testing.assert_allclose(own, ideal, atol=5 / np.sqrt(30 * row.length_chips))


def test_time_multiplexed_chips_are_where_the_document_puts_them():
    # IS-GPS-800 3.3: chips 0, 4, 6, 29 of every 33
    values = GPS_L1CP.subchips(3).reshape(-1, 12) * GPS_L1CP.chips(3)[:, None]
    fast = (values[:, 1] == -1).reshape(-1, 33)
    assert (fast == np.isin(np.arange(33), [0, 4, 6, 29])).all()
    slow = values[~fast.ravel()]
    assert (slow == np.repeat([1, -1], 6)).all()
    assert (values[fast.ravel()] == np.tile([1, -1], 6)).all()


def test_what_a_replica_leaves_out_is_stated():
    assert 10 * np.log10(1 - m.QMBOC.left_out) == pytest.approx(-0.561, abs=5e-4)
    assert {x.name for x in ALL if x.left_out} == {m.QMBOC.name}


@pytest.mark.parametrize("bandwidth", [0.0, -1.0, np.nan, np.inf])
def test_a_bandwidth_must_be_positive(bandwidth):
    with pytest.raises(ValueError, match=r"bandwidth_hz is .*: expected more than 0 Hz"):
        m.BOC11.power_kept(FC, bandwidth)
