"""Noise: published bits, normal moments and tails, and bits that do not depend on blocking."""

import numpy as np
import pytest
from scipy import stats

from signals.cpu import available
from signals.elementary import TURN, cos_sin, fixed, log, sine_of_turns, wrap
from signals.noise import (
    CELL,
    _box_muller,
    complex_gaussian,
    generator,
    normals,
    philox,
    stream_key,
)
from signals.vectors import Body, Portable, body

PATHS = available()

# Random123 1.14, tests/kat_vectors, philox4x32 10 rounds: counter, key -> words
KNOWN = [
    ((0,) * 4, (0,) * 2, (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((2**32 - 1,) * 4, (2**32 - 1,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]


def gaussian(key: np.ndarray, n0: int, n: int, on: Body | None = None) -> np.ndarray:
    out = np.empty((n, 2), np.float32)
    complex_gaussian(Portable() if on is None else on, key, n0, out)
    return out


@pytest.mark.nojit
@pytest.mark.parametrize(("counter", "key", "words"), KNOWN)
def test_philox_gives_the_published_words(counter, key, words):
    assert tuple(int(w) for w in philox(*counter, *key)) == words


def test_elementary_functions_against_float64():
    phase = np.random.default_rng(1).integers(-(2**40), 2**40, 20_000)
    angle = 2 * np.pi * (phase / TURN % 1.0)
    out = np.array([cos_sin(wrap(int(p))) for p in phase])
    np.testing.assert_allclose(out[:, 0], np.cos(angle), atol=2e-7)
    np.testing.assert_allclose(out[:, 1], np.sin(angle), atol=2e-7)
    u = np.concatenate([np.geomspace(2.0**-33, 1.0, 20_000), [0.9999999]]).astype(np.float32)
    np.testing.assert_allclose([log(x) for x in u], np.log(u.astype(float)), rtol=3e-7, atol=1e-12)
    turns = np.random.default_rng(2).uniform(-20.0, 20.0, 5_000)
    sine = [sine_of_turns(t) for t in turns]
    np.testing.assert_allclose(sine, np.sin(2 * np.pi * turns), atol=1e-9)
    assert [fixed(t) for t in turns[:50]] == [round(t * 2**32) for t in turns[:50]]


@pytest.mark.nojit
@pytest.mark.parametrize(("n0", "n"), [(0, 7), (3, 5), (CELL - 2, 5), (5 * 2**40 + 511, 3)])
def test_any_block_has_the_same_bits(n0, n):
    key = stream_key(7, "thermal")
    whole = gaussian(key, n0 - min(n0, 3), n + 6)[min(n0, 3) :][:n]
    np.testing.assert_array_equal(gaussian(key, n0, n), whole)
    one_by_one = np.concatenate([gaussian(key, n0 + m, 1) for m in range(n)])
    np.testing.assert_array_equal(one_by_one, whole)


def test_samples_follow_box_muller_of_their_own_words():
    """Sample j of a cell is words 0, 1 of counter 512 cell + j, sample j + 512 words 2, 3."""
    key = stream_key(3, "x")
    cell = 2**33 // 512 + 5  # the counter needs its second word
    out = gaussian(key, cell * CELL, CELL)
    for j in (0, 1, 17, 511):
        index = 512 * cell + j
        w = [int(v) for v in philox(index % 2**32, index >> 32, 0, 0, key[0], key[1])]
        for sample, (a, b) in ((j, w[:2]), (j + 512, w[2:])):
            z = np.sqrt(-2 * np.log((a + 0.5) / 2**32)) * np.exp(2j * np.pi * b / 2**32)
            np.testing.assert_allclose(out[sample], [z.real, z.imag], rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize("path", PATHS)
def test_every_path_has_the_same_bits(path):
    """The plain twin is the definition; cells from the first to a counter of more than 32 bits."""
    key = stream_key(23, "thermal")
    for n0 in (0, 700 * CELL, 2**33 - 2 * CELL, 5 * 2**40):
        expected = gaussian(key, n0, 4 * CELL).view(np.uint32)
        np.testing.assert_array_equal(
            gaussian(key, n0, 4 * CELL, body(path)).view(np.uint32), expected
        )


def test_tails_are_met_beyond_6_sigma():
    """P(|z| > r) = exp(-r^2 / 2) of a complex normal: Rayleigh."""
    key, n = stream_key(2, "thermal"), 2**20
    levels, found = np.array([4.5, 5.0, 5.5, 6.0]), np.zeros(4)
    for block in range(100):
        z2 = (gaussian(key, block * n, n, body(PATHS[0])) ** 2).sum(axis=1)
        found += [np.count_nonzero(z2 > r**2) for r in levels]
    expected = 100 * n * np.exp(-(levels**2) / 2)
    assert np.all(np.abs(found - expected) < 4 * np.sqrt(expected))
    assert found[-1] >= 1


def test_moments_tails_and_distribution():
    n = 4_000_000
    x = gaussian(stream_key(11, "thermal"), 12_345, n, body(PATHS[0])).astype(float)
    assert np.all(np.abs(x.mean(0)) < 4 / np.sqrt(n))
    assert np.all(np.abs(x.var(0) - 1) < 4 * np.sqrt(2 / n))
    assert abs(np.mean(x[:, 0] * x[:, 1])) < 4 / np.sqrt(n)
    assert np.all(np.abs((x**4).mean(0) - 3) < 4 * np.sqrt(96 / n))
    assert np.all(np.abs((x**3).mean(0)) < 4 * np.sqrt(15 / n))
    for lag in (1, 2, 511, 512, 513, 1024):  # partners of one counter are 512 apart
        assert np.all(np.abs((x[:-lag] * x[lag:]).mean(0)) < 4 / np.sqrt(n - lag))
        assert abs(np.mean(x[:-lag, 0] * x[lag:, 1])) < 4 / np.sqrt(n - lag)
        r2 = (x**2).sum(1) - 2.0  # variance 4
        assert abs(np.mean(r2[:-lag] * r2[lag:])) < 4 * 4 / np.sqrt(n - lag)
    for level in (3.0, 4.0, 4.8):
        expected = 2 * n * 2 * stats.norm.sf(level)
        assert abs(np.sum(np.abs(x) > level) - expected) < 4 * np.sqrt(expected)
    assert stats.kstest(x[:200_000, 0], "norm").pvalue > 1e-3
    assert stats.kstest(x[:200_000, 1], "norm").pvalue > 1e-3


@pytest.mark.nojit
def test_tails_reach_beyond_a_24_bit_uniform():
    """u = (word + 1/2) / 2^32: the word 0 gives sqrt(-2 ln 2^-33) = 6.7637; 24 bits end at 5.9."""
    words = np.array([0, 1, 255, 2**31, 2**32 - 1], np.uint64)
    one = np.float32(1.0)
    radius = np.array([_box_muller(w, np.uint64(0), one)[0] for w in words])
    expected = np.sqrt(-2 * np.log((words.astype(float) + 0.5) / 2**32))
    np.testing.assert_allclose(radius, expected, rtol=1e-6, atol=4e-4)  # log of 1 - 2^-24 steps
    assert radius[0] == pytest.approx(6.7637, abs=1e-4)


def test_streams_are_independent_and_reproducible():
    n = 200_000
    names = [(1, "thermal"), (2, "thermal"), (1, "clock")]
    x = [gaussian(stream_key(*name), 0, n).ravel().astype(float) for name in names]
    for a in range(3):
        for b in range(a):
            assert abs(np.mean(x[a] * x[b])) < 4 / np.sqrt(2 * n)
    np.testing.assert_array_equal(x[0], gaussian(stream_key(1, "thermal"), 0, n).ravel())
    assert generator(1, "imu").normal() == generator(1, "imu").normal()
    assert len({generator(s, m).normal() for s in (1, 2) for m in ("imu", "clock")}) == 4


@pytest.mark.parametrize("seed", [-1, 1.5, True, "1"])
def test_seed_must_be_a_count(seed):
    with pytest.raises(ValueError, match="seed"):
        stream_key(seed, "thermal")


@pytest.mark.nojit
def test_normals_are_keyed_and_normal():
    key = stream_key(4, "taps")
    few = np.empty(3)
    normals(key[0], key[1], 1, 2, 3, 0, few)
    many = np.empty(2003)
    normals(key[0], key[1], 1, 2, 3, 0, many)
    np.testing.assert_array_equal(few, many[:3])
    later = np.empty(5)
    normals(key[0], key[1], 1, 2, 3, 2, later)
    np.testing.assert_array_equal(later, many[8:13])
    assert stats.kstest(many, "norm").pvalue > 1e-3
    for other in ((0, 2, 3), (1, 0, 3), (1, 2, 0)):
        x = np.empty(2003)
        normals(key[0], key[1], *other, 0, x)
        assert abs(np.mean(x * many)) < 4 / np.sqrt(2003)
