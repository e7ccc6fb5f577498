"""Half-bit prompts kept apart: against the whole bit, against slopes, and against the taps."""

import numpy as np
import pytest

from ultratight.filters.gaussian import Gaussian, Measurement, update
from ultratight.filters.rules import get_rule
from ultratight.tracking.code_model import CHIP, HALF, LAG1, SPACING, STEPS, TABLE, WAVELENGTH
from ultratight.tracking.half_bit_phases import HalfBitPhases, kept_apart
from ultratight.tracking.half_bits import Bits
from ultratight.tracking.tap_model import TapModel

T_H = 0.01


@pytest.fixture(name="params")
def _params():
    row = np.zeros((2, TABLE + 2))
    row[:, CHIP], row[:, HALF], row[:, SPACING] = 293.05, T_H, 0.25
    row[:, STEPS], row[:, LAG1], row[:, WAVELENGTH] = 1.0, -1.0 / 1023.0, [0.1903, 0.2548]
    row[:, TABLE:] = [1.0, -1.0 / 1023.0]
    return row


def points(seed, nb=2, p=6):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((nb, p, 3)) * [20.0, 0.05, 3.0]


@pytest.mark.nojit
def test_halves_together_are_the_whole_bit(params):
    """sinc(2 x) = sinc(x) cos(x): the mean of both halves is h of model C, S is the same."""
    y = points(1)
    apart, whole = HalfBitPhases(params)(y), TapModel(params)(y)
    np.testing.assert_allclose(0.5 * (apart[..., 0] + apart[..., 2]), whole[..., 0], atol=1e-14)
    np.testing.assert_allclose(0.5 * (apart[..., 1] + apart[..., 3]), whole[..., 1], atol=1e-14)
    np.testing.assert_allclose(apart[..., 4], whole[..., 2], atol=1e-14)


@pytest.mark.nojit
def test_against_the_mean_of_a_turning_phase(params):
    """By brute force: the mean of exp(-j phase(t)) over each half, phase linear in time."""
    y = points(2)
    y[..., 0] = 0.0
    found = HalfBitPhases(params)(y)
    for b in range(2):
        k = 2.0 * np.pi / params[b, WAVELENGTH]
        for half, (a, e) in enumerate(((-T_H, 0.0), (0.0, T_H))):
            t = np.linspace(a, e, 2001)[:, None]
            turn = np.exp(-1j * k * (y[b, :, 1] + t * y[b, :, 2]))
            mean = np.trapezoid(turn, t, axis=0) / T_H
            np.testing.assert_allclose(found[b, :, 2 * half], mean.real, atol=2e-6)
            np.testing.assert_allclose(found[b, :, 2 * half + 1], -mean.imag, atol=2e-6)


@pytest.mark.nojit
def test_jacobian_against_differences(params):
    """But for the prompt's own slope in range, which is left out on purpose."""
    model, y, step = HalfBitPhases(params), points(3)[:, 0], 1e-6
    z, J = model.jacobian(y)
    np.testing.assert_allclose(z, model(y[:, None])[:, 0])
    for j in (1, 2):
        d = np.zeros(3)
        d[j] = step
        slope = (model((y + d)[:, None]) - model((y - d)[:, None]))[:, 0] / (2.0 * step)
        np.testing.assert_allclose(J[:, :, j], slope, atol=1e-7)
    assert not J[:, :4, 0].any()


@pytest.mark.nojit
def test_prompts_with_their_data_and_noise(params):
    """P_h = A (I_h - j Q_h) times the data bit; a pilot's bit is 1."""
    a2, expected = np.array([60.0, 90.0]), HalfBitPhases(params)(points(4, p=1))[:, 0]
    data = np.array([-1.0, 1.0])
    iq = np.zeros((2, 2, 3), complex)
    iq[:, 0, 1] = (data * np.sqrt(a2)) * (expected[:, 0] - 1j * expected[:, 1])
    iq[:, 1, 1] = (data * np.sqrt(a2)) * (expected[:, 2] - 1j * expected[:, 3])
    bits = Bits(np.array([0, 1]), np.array([7, 9]), np.zeros((2, 3)), iq)
    R = np.zeros((2, 3, 3))
    R[:, 0, 0] = R[:, 1, 1] = 0.5 / a2
    R[:, 2, 2] = 0.02
    model = TapModel(params)
    whole = Measurement(np.full((2, 3), 0.3), np.zeros((2, 3, 25)), R, model, model.jacobian,
                        bits.channel)  # fmt: skip
    sent = np.zeros((2, 5), dtype=np.int8)
    sent[0, 2] = -1  # bit 7 of channel 0 from bit 5 on; channel 1 is a pilot
    found = kept_apart(whole, bits, np.array([False, True]), sent, 5)
    np.testing.assert_allclose(found.z[:, :4], expected[:, :4], atol=1e-14)
    np.testing.assert_allclose(found.z[:, 4], 0.3)
    np.testing.assert_allclose(found.R[:, 0, 0], 1.0 / a2)
    np.testing.assert_allclose(found.R[1], np.diag([1 / 90.0] * 4 + [0.02]))
    with pytest.raises(TypeError, match="h is function, expected a TapModel"):
        kept_apart(whole._replace(h=lambda y: y), bits, np.ones(2, bool), None, 0)


@pytest.mark.parametrize("rule", ["linearised", "gh3", "gh7", "unscented-projected"])
def test_compiled_update_is_that_of_the_plain_function(params, rule):
    """The same h without its compiled update goes through `Rule.linearise`: the same figures."""
    rng = np.random.default_rng(5)
    model, n = HalfBitPhases(params), 5
    A = rng.standard_normal((2, 3, n)) * np.array([20.0, 0.02, 1.0])[:, None]
    root = rng.standard_normal((n, n))
    prior = Gaussian(0.1 * rng.standard_normal(n), root @ root.T / n)
    R = np.tile(np.diag([0.02, 0.02, 0.02, 0.02, 0.1]), (2, 1, 1))
    seen = Measurement(
        model(points(6, p=1))[:, 0], A, R, model, model.jacobian, np.arange(2)
    )  # fmt: skip
    plain = seen._replace(h=lambda y: model(y))
    for passes in (1, 3):
        found = update(prior, seen, get_rule(rule), passes)
        expected = update(prior, plain, get_rule(rule), passes)
        for name in ("mean", "cov", "innovation", "nis", "H", "noise"):
            np.testing.assert_allclose(
                getattr(found, name), getattr(expected, name), rtol=1e-10, atol=1e-12
            )
