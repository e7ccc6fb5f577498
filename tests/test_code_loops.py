"""Code loops of the loop study, on their own: what they follow, and how noisy they are."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

STUDIES = Path(__file__).parents[1] / "studies"


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(STUDIES)
    return import_module("common.code_loops")


def test_first_order_lags_behind_a_rate_and_not_behind_rest(bench: Any) -> None:
    """Steady error v / w (Kaplan & Hegarty, ch. 8) after e^(-w t) has died away."""
    loop = bench.CodeLoop(1, 2.0, 0.02, "power", 0.25)
    error = bench.run(loop, np.array([75.0, 75.0]), np.array([0.0, 0.02 * loop.w]), 3)
    at_1_s = round(1.0 / loop.integration_s)
    assert np.abs(error[at_1_s:, 0]).max() < 2e-3
    np.testing.assert_allclose(error[at_1_s:, 1], 0.02, atol=2e-3)


def test_second_order_follows_a_rate_and_lags_behind_an_acceleration(bench: Any) -> None:
    """Steady error a / w^2; the sign is that of a true delay that runs away."""
    loop = bench.CodeLoop(2, 2.0, 0.02, "coherent", 0.25)
    size = np.array([0.03, -0.03]) * loop.w**2
    error = bench.run(loop, np.full(2, 75.0), size, 3)
    np.testing.assert_allclose(error[-100:].mean(axis=0), [0.03, -0.03], rtol=0.01)


def test_jitter_is_the_square_root_of_bn_t(bench: Any) -> None:
    """2 Bn T times one output's variance, D / (4 T C/N0) (1 - lobe) for the coherent one.

    By hand at 45 dB-Hz: PRN 7's correlation falls by 1 - 0.0616 over the first chip.
    """
    loop = bench.CodeLoop(1, 5.0, 0.01, "coherent", 0.25)
    error = bench.run(loop, np.full(40, 45.0), np.zeros(40), 4)[100:]
    fall = 1.0 - 63.0 / 1023.0
    one = 2.0 * 0.5 * fall / (2.0 * 0.01 * 10**4.5 * (2.0 * fall) ** 2)
    assert error.std() == pytest.approx(np.sqrt(2.0 * 5.0 * 0.01 * one), rel=0.05)


def test_loss_is_told_from_noise(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve dB below the rule all are a chip off, four above it none; stress is one."""
    monkeypatch.setattr(bench, "LEVELS", (45.0,))
    monkeypatch.setattr(bench, "DURATION_S", 4.0)
    loop = bench.CodeLoop(2, 4.0, 0.02, "coherent", 0.1)
    flown = bench.fly_code_loop(loop, 4, 5)
    share = flown.lost.mean(axis=0)
    assert share[:3].min() == 1.0
    assert share[-4:].max() == 0.0
    np.testing.assert_allclose(flown.stress.mean(), 1.0, atol=0.02)
