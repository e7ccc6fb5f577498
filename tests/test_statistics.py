"""Intervals against published numbers, scipy, and what they promise: coverage."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ultratight.statistics import bootstrap, paired_difference, wilson


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    [
        # R. G. Newcombe, Statist. Med. 17 (1998) 857-872, Table I, method 3
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_gives_newcombes_table(k: int, n: int, low: float, high: float) -> None:
    found = wilson(k, n)
    assert found.value == k / n
    assert found.low == pytest.approx(low, abs=5.1e-5)
    assert found.high == pytest.approx(high, abs=5.1e-5)


def test_wilson_is_scipys_at_any_count_and_level() -> None:
    for n in (1, 7, 50):
        for k in range(n + 1):
            for level in (0.5, 0.95, 0.999):
                theirs = stats.binomtest(k, n).proportion_ci(level, method="wilson")
                ours = wilson(k, n, level)
                assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


def test_wilson_of_nothing_knows_nothing() -> None:
    nothing = wilson(0, 0)
    assert np.isnan(nothing.value)
    assert nothing[1:] == (0.0, 1.0, 0)


@pytest.mark.parametrize("given", [(-1, 5), (6, 5), (0, -1)])
def test_wilson_refuses_what_is_no_count(given: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="expected 0 <= k <= n"):
        wilson(*given)


def test_bootstrap_of_the_mean_is_scipys_within_resampling_noise() -> None:
    """Two percentile bootstraps with streams of their own: quantiles of 20 000 resamples differ by
    some sqrt(2 p (1 - p) / 20 000) = 0.0016 in probability, 0.03 of the standard error at 2.5 %."""
    values = np.random.default_rng(4).gamma(2.0, 1.0, 60)
    theirs = stats.bootstrap(
        (values,), np.mean, n_resamples=20_000, method="percentile", rng=np.random.default_rng(1)
    )
    ours = bootstrap(values, "mean", resamples=20_000)
    assert ours.value == np.mean(values)
    tolerance = 0.12 * theirs.standard_error  # 4 sigma
    assert ours.low == pytest.approx(theirs.confidence_interval.low, abs=tolerance)
    assert ours.high == pytest.approx(theirs.confidence_interval.high, abs=tolerance)


def test_bootstrap_of_the_median_is_efrons() -> None:
    """Its exact law for odd n = 2 m - 1 (B. Efron, Ann. Statist. 7 (1979), section 3):
    P(median* <= x_(k)) = P(binomial(n, k/n) >= m)."""
    n, m = 19, 10
    values = np.sort(np.random.default_rng(5).standard_normal(n))
    below = np.array([stats.binom.sf(m - 1, n, k / n) for k in range(1, n + 1)])
    assert np.abs(below[:, None] - [0.025, 0.975]).min() > 4 * np.sqrt(0.025 * 0.975 / 40_000)
    found = bootstrap(values, resamples=40_000)
    assert found.value == values[m - 1]
    assert found.low == values[np.argmax(below >= 0.025)]
    assert found.high == values[np.argmax(below >= 0.975)]


def test_bootstrap_covers_the_mean_as_often_as_it_says() -> None:
    """600 samples of 40 normal numbers: the percentile interval of the mean is Student's without
    its factor, 2 Phi^-1(0.975) s sqrt(39/40) / sqrt(40), which covers in 93.9 % (t, 39)."""
    rng = np.random.default_rng(2)
    n, trials = 40, 600
    z = stats.norm.ppf(0.975) * np.sqrt((n - 1) / n)
    expected = 1.0 - 2.0 * stats.t.sf(z, n - 1)
    inside = 0
    for seed in range(trials):
        found = bootstrap(rng.standard_normal(n), "mean", resamples=1_000, seed=seed)
        inside += found.low <= 0.0 <= found.high
    # 4 sigma of the count
    assert abs(inside / trials - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / trials)


def test_bootstrap_repeats_and_leaves_holes_out() -> None:
    values = np.array([1.0, np.nan, 2.0, 4.0, np.inf, 3.0])
    found = bootstrap(values, "mean")
    assert found == bootstrap(values, "mean")
    many = np.random.default_rng(6).standard_normal(30)
    assert bootstrap(many, "mean") != bootstrap(many, "mean", seed=2)
    assert (found.value, found.n) == (2.5, 4)
    assert 1.0 <= found.low < 2.5 < found.high <= 4.0
    assert bootstrap([5.0, 5.0])[:3] == (5.0, 5.0, 5.0)
    assert bootstrap([np.nan]).n == 0


def test_pairs_cancel_what_they_share() -> None:
    """A difference of 0.1 under a common noise of 10: paired it is found, unpaired it is not."""
    rng = np.random.default_rng(3)
    common = 10.0 * rng.standard_normal(50)
    a, b = common + 0.1 + 0.02 * rng.standard_normal(50), common + 0.02 * rng.standard_normal(50)
    found = paired_difference(a, b, "mean")
    assert found.low < 0.1 < found.high
    assert found.high - found.low < 0.03
    alone = bootstrap(a, "mean"), bootstrap(b, "mean")
    assert alone[0].low < alone[1].high
    assert paired_difference([1.0, np.nan, 3.0], [0.0, 1.0, np.inf]).n == 1


@pytest.mark.parametrize(
    "call",
    [
        lambda: bootstrap([[1.0]]),
        lambda: bootstrap([1.0], "mode"),
        lambda: bootstrap([1.0], level=1.0),
        lambda: paired_difference([1.0, 2.0], [1.0]),
        lambda: wilson(1, 2, 0.0),
    ],
)
def test_bad_arguments_are_refused(call: object) -> None:
    assert callable(call)
    with pytest.raises(ValueError, match="expected"):
        call()
