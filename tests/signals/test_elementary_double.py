"""log, cos and sin in double precision, against those of the C library."""

import numpy as np
import pytest

from signals.compiled import kernel
from signals.elementary_double import cos_sin, log, normal_pair

pytestmark = pytest.mark.nojit


@kernel
def _each(x, logarithm, cosine, sine):
    for k in range(x.size):
        logarithm[k] = log(x[k])
        cosine[k], sine[k] = cos_sin(x[k])


@kernel(fastmath={"reassoc", "contract", "arcp", "nsz"})
def _turn(x, cosine, sine):
    for k in range(x.size):
        cosine[k], sine[k] = cos_sin(x[k])


def test_errors_are_those_of_rounding():
    rng = np.random.default_rng(3)
    x = np.concatenate([rng.uniform(0.0, 1.0, 300), 2.0 ** rng.uniform(-300, 300, 300),
                        [0.5, 1.0, 2.0, np.sqrt(0.5), 2.0**-33, 1.0 - 2.0**-33]])  # fmt: skip
    found = np.empty((3, x.size))
    _each(x, *found)
    np.testing.assert_allclose(found[0], np.log(x), rtol=4.5e-16, atol=0)
    part = np.remainder(x, 1.0)
    np.testing.assert_allclose(found[1], np.cos(2 * np.pi * part), atol=1.2e-15)
    np.testing.assert_allclose(found[2], np.sin(2 * np.pi * part), atol=1.2e-15)


def test_quarters_are_exact_and_sums_may_be_reordered():
    x = np.concatenate([np.arange(-8, 9) / 4.0, np.random.default_rng(1).uniform(-40, 40, 300)])
    cosine, sine = np.empty(x.size), np.empty(x.size)
    _turn(x, cosine, sine)
    np.testing.assert_array_equal(cosine[:17:4], 1.0)
    np.testing.assert_array_equal(sine[:17:2], 0.0)
    np.testing.assert_array_equal(sine[1:17:4], 1.0)
    part = np.remainder(x, 1.0)
    np.testing.assert_allclose(cosine, np.cos(2 * np.pi * part), atol=1.2e-15)
    np.testing.assert_allclose(sine, np.sin(2 * np.pi * part), atol=1.2e-15)


@pytest.mark.parametrize("word", [0, 1, 2**31, 2**32 - 1])
@pytest.mark.parametrize(
    "turn", [0, 2**29 - 1, 2**29, 2**30, 3 * 2**29, 2**31, 3 * 2**30, 2**32 - 1]
)
def test_normal_pair_is_box_and_muller(word, turn):
    radius = np.sqrt(-2.0 * np.log((word + 0.5) / 2.0**32))
    angle = 2.0 * np.pi * turn / 2.0**32
    found = normal_pair(np.uint64(word), np.uint64(turn))
    np.testing.assert_allclose(found, [radius * np.cos(angle), radius * np.sin(angle)], atol=1e-14)
