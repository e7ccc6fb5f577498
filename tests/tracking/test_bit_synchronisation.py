"""Bit edges from prompts whose bits are known."""

from __future__ import annotations

import numpy as np
import pytest

from ultratight.statistics import wilson
from ultratight.tracking.bit_synchronisation import bit_edge


def prompts(
    rng: np.random.Generator, first: int, n: int, cn0_dbhz: float, hz: float = 0.0
) -> np.ndarray:
    """Prompts of 1 ms with random bits, the first whole one at ``first``; unit noise per part."""
    bit = (np.arange(n) - first) // 20 + 1
    signs = rng.choice([-1.0, 1.0], bit.max() + 1)[bit]
    turns = hz * 1e-3 * np.arange(n) + rng.uniform()
    z = np.sqrt(2.0 * 10 ** (cn0_dbhz / 10) * 1e-3) * signs * np.exp(2j * np.pi * turns)
    return z + rng.standard_normal(n) + 1j * rng.standard_normal(n)


@pytest.mark.parametrize("first", [0, 1, 7, 19])
def test_the_edge_is_found_whatever_the_doppler(first: int) -> None:
    rng = np.random.default_rng(first)
    for hz in (0.0, -13.7, 210.0):
        edge = bit_edge(prompts(rng, first, 400, 40.0, hz), 1e-3, 20)
        assert edge.first == first
        assert edge.probability > 0.999


@pytest.mark.parametrize("cn0_dbhz", [27.0, 28.0])
def test_the_probability_is_how_often_it_is_right(cn0_dbhz: float) -> None:
    """Right in as many of 400 trials as the probabilities add up to, within 99.9 %."""
    rng = np.random.default_rng(8)
    told, right = 0.0, 0
    for _ in range(400):
        first = int(rng.integers(20))
        edge = bit_edge(prompts(rng, first, 200, cn0_dbhz), 1e-3, 20)
        told, right = told + edge.probability, right + (edge.first == first)
    share = wilson(right, 400, 0.999)
    assert 0.3 < share.value < 0.99  # hard enough to be wrong, easy enough to be right
    assert share.low < told / 400 < share.high


def test_without_a_change_of_sign_nothing_is_known() -> None:
    rng = np.random.default_rng(2)
    z = 8.0 + rng.standard_normal(200) + 1j * rng.standard_normal(200)
    assert bit_edge(z, 1e-3, 20).probability < 0.1


def test_too_few_prompts() -> None:
    with pytest.raises(ValueError, match="prompts: 39 given, expected at least 40, two bits"):
        bit_edge(np.ones(39, complex), 1e-3, 20)
