"""Lines in samples: gone, and the rest as it was."""

from __future__ import annotations

import numpy as np
import pytest

from ultratight.tracking.excision import HALF, excised

N = 20_000


def noise(seed: int) -> np.ndarray:
    parts = np.random.default_rng(seed).standard_normal((2, N))
    return (parts[0] + 1j * parts[1]).astype(np.complex64)


def test_noise_is_given_back_as_it_is() -> None:
    z = noise(1)
    assert excised(z) is z


@pytest.mark.parametrize("amplitude", [1.0, 30.0, 300.0])
def test_a_line_is_gone_and_little_else(amplitude: float) -> None:
    """Five bins of 1024 and as many side lobes as stand out: below 4 % of the noise.

    In the middle; at both ends half a spectrum fades out.
    """
    z = noise(2)
    line = amplitude * np.exp(2j * np.pi * 0.123_456 * np.arange(N)).astype(np.complex64)
    middle = slice(2 * HALF, N - 2 * HALF)
    left = excised(z + line)[middle]
    lost = np.mean(np.abs(left - z[middle]) ** 2) / 2.0
    assert lost < 0.04
    at_line = np.vdot(line[middle], left) / amplitude / len(left)
    assert abs(at_line) < 4.0 * np.sqrt(2.0 / len(left))
