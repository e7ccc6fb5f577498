"""Eight at a time, compiled and plain, against numpy."""

import numpy as np
import pytest

from signals.compiled import FAST_SUM, borrowing
from signals.eight import (
    WIDTH,
    fill,
    floor,
    greatest,
    least,
    load,
    load_part,
    padded,
    root,
    sin_cos,
    size,
    store,
    store_part,
    total,
)

pytestmark = pytest.mark.nojit


@borrowing
def _operate(a, b, out):
    x, y = load(a, 0), load(b, 0)
    store(out, 0, x + y)
    store(out, 8, x - y)
    store(out, 16, x * y)
    store(out, 24, x / y)
    store(out, 32, 2.0 * x - 1.0)
    store(out, 40, -floor(x))
    store(out, 48, least(x, y))
    store(out, 56, greatest(x, 0.5))
    store(out, 64, root(size(x)))
    x += y
    x *= fill(3.0)
    store(out, 72, 1.0 / x)


@borrowing
def _parts(a, i, n, out):
    store_part(out, 1, n, load_part(a, i, n))


@borrowing
def _sum(a):
    return total(load(a, 1))


@borrowing(fastmath=FAST_SUM)
def _dot(a, b):
    s = fill(0.0)
    for i in range(0, a.size, WIDTH):
        s += load(a, i) * load(b, i)
    return total(s)


@borrowing
def _tabulate(x, s, c):
    for i in range(0, x.size, WIDTH):
        sine, cosine = sin_cos(load(x, i))
        store(s, i, sine)
        store(c, i, cosine)


def test_operations_are_those_of_numpy():
    rng = np.random.default_rng(1)
    a, b = rng.standard_normal((2, WIDTH))
    out = np.empty((5, 16))  # any shape that is contiguous
    _operate(a, b, out)
    expected = [
        a + b, a - b, a * b, a / b, 2.0 * a - 1.0, -np.floor(a), np.minimum(a, b),
        np.maximum(a, 0.5), np.sqrt(np.abs(a)), 1.0 / ((a + b) * 3.0),
    ]  # fmt: skip
    np.testing.assert_array_equal(out.reshape(10, 8), expected)


def test_least_and_greatest_pass_nan_in_second_place_only():
    bad, good, out = np.full(WIDTH, np.nan), np.ones(WIDTH), np.empty(80)
    _operate(bad, good, out)
    np.testing.assert_array_equal(out[48:56], good)
    _operate(good, bad, out)
    assert np.isnan(out[48:56]).all()


def test_sum_is_in_one_order():
    a = np.random.default_rng(2).standard_normal(WIDTH + 2)
    x = a[1:9]
    four = x[:4] + x[4:]
    assert _sum(a) == (four[0] + four[2]) + (four[1] + four[3])
    a, b = np.random.default_rng(3).standard_normal((2, 24))
    assert _dot(a, b) == pytest.approx(a @ b, rel=1e-14)


@pytest.mark.parametrize("n", range(WIDTH + 1))
def test_parts_touch_nothing_else(n):
    a, out = np.arange(n + 3.0), np.full(WIDTH + 2, -1.0)
    _parts(a, 3, n, out)
    np.testing.assert_array_equal(out[1 : 1 + n], a[3:])
    assert out[0] == -1.0
    np.testing.assert_array_equal(out[1 + n :], -1.0)


def test_padded_is_a_multiple():
    assert [padded(n) for n in (0, 1, 8, 17, 25)] == [0, 8, 8, 24, 32]


def test_sine_and_cosine_are_those_of_the_library():
    """Some ulps of 1 and, without fused multiply-add, the product k pi rounded: 2^-53 |x|."""
    x = np.concatenate([np.linspace(-7.0, 7.0, 401), [1e-100, 1e-9, 0.5 * np.pi, np.pi, 1e4, -3e5]])
    x = np.append(x, np.zeros(-x.size % WIDTH))
    s, c = np.empty_like(x), np.empty_like(x)
    _tabulate(x, s, c)
    tolerance = 5e-16 + 2.0**-53 * np.abs(x)
    assert np.all(np.abs(s - np.sin(x)) < tolerance)
    assert np.all(np.abs(c - np.cos(x)) < tolerance)
    _tabulate(np.full(WIDTH, np.nan), s[:WIDTH], c[:WIDTH])
    assert np.isnan(s[:WIDTH]).all()
