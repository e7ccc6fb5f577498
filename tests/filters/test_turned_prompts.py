"""Half-bit prompts that turn while they are integrated: against sums over many instants."""

import numpy as np
import pytest

from ultratight.filters.gaussian import Gaussian, Measurement
from ultratight.filters.turned_prompts import (
    KINK_RAD,
    are_half_bits,
    freed_of_kink,
    radians_per_metre,
    searched,
    stepped,
)

N, NB, T, NOW = 24, 7, 0.02, 0.3
K = 2.0 * np.pi / 0.1903
A2 = 63.0
"""Squared amplitude of a half bit's prompt at 35 dB-Hz"""


def halves(y):
    """I1 Q1 I2 Q2 S of phase and rate, for small rates."""
    phase = K * (y[..., 1:2] + 0.5 * np.array([-0.5 * T, 0.5 * T]) * y[..., 2:3])
    c, s = np.cos(phase), np.sin(phase)
    return np.stack([c[..., 0], s[..., 0], c[..., 1], s[..., 1], -y[..., 0] / 150.0], axis=-1)


def halves_jacobian(y):
    z, J = halves(y), np.zeros((len(y), 5, 3))
    J[:, 4, 0] = -1.0 / 150.0
    for h, back in enumerate((-0.25 * T, 0.25 * T)):
        J[:, 2 * h, 1], J[:, 2 * h + 1, 1] = -K * z[:, 2 * h + 1], K * z[:, 2 * h]
        J[:, 2 * h : 2 * h + 2, 2] = back * J[:, 2 * h : 2 * h + 2, 1]
    return z, J


def seen_by(make, phase_of, rng=None):
    """Bits whose phase [rad] is phase_of(t) (nb, instants); the last ends at NOW, T long each."""
    u = np.random.default_rng(1).standard_normal((NB, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    middle = NOW - np.linspace(0.5 * T, 1.4 * T, NB)
    A = np.zeros((NB, 3, N))
    A[:, 2, 3:6], A[:, 2, 16] = -u, 1.0
    A[:, 1] = A[:, 2] * (middle - NOW)[:, None]
    A[np.arange(NB), 1, 17 + np.arange(NB)] = 1.0
    t = middle[:, None] + T * ((np.arange(20_000) + 0.5) / 20_000 - 0.5)
    prompt = np.exp(1j * phase_of(t)).reshape(NB, 2, -1).mean(axis=2)
    if rng is not None:
        prompt = prompt + (rng.standard_normal((NB, 2, 2)) @ [1.0, 1j]) / np.sqrt(A2)
    z = np.zeros((NB, 5))
    z[:, 0:4:2], z[:, 1:4:2] = prompt.real, prompt.imag
    R = np.tile(np.diag([1.0 / A2] * 4 + [0.01]), (NB, 1, 1))
    span = np.column_stack([middle, np.full(NB, 0.5 * T)])
    m = Measurement(z, A, R, halves, halves_jacobian, np.arange(NB), span)
    return m, make.prediction(N, NB, t_s=NOW, T=T, layout_=make.layout(N))


def stepping(d, late_s):
    return lambda t: K * d * np.maximum(t - (NOW - T + late_s), 0.0)


@pytest.mark.parametrize("late_s", [0.0, 0.007, -0.01])
def test_prompts_of_a_step_of_any_size(make, late_s):
    m, prediction = seen_by(make, stepping(18.0, late_s))
    model = stepped(m, prediction, late_s)
    x = np.zeros(N)
    x[16] = 18.0
    x[17:] = 18.0 * (T - late_s)  # the state is that at the end of the epoch
    found = model.h((model.A @ x)[:, None, :])[:, 0]
    np.testing.assert_allclose(found[:, :4], m.z[:, :4], atol=1e-4)
    assert np.hypot(m.z[:, 2], m.z[:, 3]).min() < 0.5  # far from a prompt of full size
    np.testing.assert_allclose(radians_per_metre(m), K)


def test_slope_of_the_stepped_model(make):
    m, prediction = seen_by(make, stepping(0.0, 0.0))
    model = stepped(m, prediction, 0.004)
    y = np.random.default_rng(2).standard_normal((NB, 4)) * [10.0, 0.02, 0.5, 9.0]
    z, J = model.h_jacobian(y)
    np.testing.assert_allclose(z, model.h(y[:, None, :])[:, 0], atol=1e-14)
    for j, step in enumerate((1e-3, 1e-6, 1e-5, 1e-5)):
        e = np.eye(4)[j] * step
        slope = (model.h((y + e)[:, None]) - model.h((y - e)[:, None]))[:, 0] / (2.0 * step)
        np.testing.assert_allclose(J[..., j], slope, atol=1e-5)


@pytest.mark.parametrize(
    ("d", "late_s"),
    [(0.0, 0.0), (3.0, 0.0), (-9.0, 0.0), (18.0, 0.0), (-18.0, 0.0), (-9.0, 0.01), (12.0, 0.01)],
)
def test_search_finds_instant_and_size(make, d, late_s):
    """Four s.d. of the Cramer-Rao bound; an instant without clear difference is not looked for."""
    m, prediction = seen_by(make, stepping(d, late_s), np.random.default_rng(4))
    cov = np.zeros((N, N))
    cov[16, 16] = 9.0
    late, size = searched(Gaussian(np.zeros(N), cov), m, prediction, since_before=False)
    _, J = stepped(m, prediction, late_s).h_jacobian(np.full((NB, 1), d) * [0.0, 0.0, 0.0, 1.0])
    bound = 1.0 / np.sqrt(A2 * (J[:, :4, 3] ** 2).sum() + 1.0 / 9.0)
    pull = abs(d) * bound**2 / 9.0  # of the prior
    assert bound < 1.0
    assert size == pytest.approx(d, abs=4.0 * bound + pull + 0.2)
    assert late == pytest.approx(late_s if abs(d) > 5.0 else 0.0, abs=0.0026)


@pytest.mark.parametrize("stepped_s", [-np.inf, -0.012])
def test_a_feedback_leaves_prompts_as_if_nothing_had_happened(make, stepped_s):
    """NCO behind by 9 m/s until the epoch began, since the step: amplitude and phase restored.

    The reference is corrected along a straight line; its mean is taken out of each half.
    """
    d, start = 9.0, NOW - T
    fed = np.zeros(N)
    fed[16], fed[17:] = d, d * min(T, -stepped_s)

    def error(t, since):
        return np.where(t < start, K * (fed[17] + d * np.maximum(t - start, since)), 0.0)

    def phase(t):
        known = error(t, -np.inf).reshape(NB, 2, -1).mean(axis=2)
        return error(t, stepped_s) - np.repeat(known, t.shape[1] // 2, axis=1)

    m, prediction = seen_by(make, phase)
    power = m.z[:, 0] ** 2 + m.z[:, 1] ** 2
    assert power.min() < 0.64
    freed = freed_of_kink(m, prediction, fed, stepped_s)
    np.testing.assert_allclose(freed.z[:, 0:4:2], 1.0, atol=5e-3)
    np.testing.assert_allclose(freed.z[:, 1:4:2], 0.0, atol=5e-3)
    np.testing.assert_allclose(freed.R[:, 0, 0], m.R[:, 0, 0] / power, rtol=1e-2)
    small = fed * (0.5 * KINK_RAD / (K * fed[17]))
    assert freed_of_kink(m, prediction, small, stepped_s) is m


def test_which_measurements_are_half_bits(make):
    m, _ = seen_by(make, stepping(0.0, 0.0))
    assert are_half_bits(m)
    assert not are_half_bits(m._replace(z=m.z[:, :3]))
    assert not are_half_bits(m._replace(span=None))
    assert not are_half_bits(m._replace(z=m.z[:0]))
