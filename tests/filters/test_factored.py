"""Both factors of P in single precision: what they keep that P itself does not."""

import numpy as np
import pytest

from ultratight.filters.factored import FORMS

ONE = np.float32
PHI = np.array([[1.0, 0.02], [0.0, 1.0]])
Q = 1e-8 * 0.02 * np.array([[0.02**2 / 3, 0.02 / 2], [0.02 / 2, 1.0]])
H, R, START = np.array([[1.0, 0.0]]), 1e-6, np.diag([1e6, 1e4])
"""Position observed to 1 mm, a rate driven by 1e-4"""


def collinear():
    """P, H and r of two nearly collinear, very exact measurements, in single precision.

    Grewal & Andrews, 3rd ed., example 6.2: delta^2 is below the rounding of 1, delta is not.
    """
    delta = 2e-4
    return np.eye(3, dtype=ONE), np.array([[1, 1, 1], [1, 1, 1 + delta]], ONE), ONE(delta**2)


@pytest.mark.nojit
@pytest.mark.parametrize("name", FORMS)
def test_single_precision_stays_definite(make, name):
    """The truth is rational."""
    form, (P, rows, r) = FORMS[name], collinear()
    expected = make.exact_posterior(P, rows, [r, r])
    factor, mean = P.copy(), np.zeros(3, ONE)
    form.condition(mean, factor, np.zeros(2, ONE), rows, np.full((2, 1, 1), r, ONE))
    assert factor.dtype == ONE
    found = form.cov(factor.astype(float))
    least = np.linalg.eigvalsh(expected)[0]
    assert np.linalg.eigvalsh(found)[0] == pytest.approx(least, rel=0.05)
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


@pytest.mark.nojit
def test_neither_the_short_form_nor_joseph_s_does(make):
    """The short one is indefinite, Joseph's is definite and wrong by half."""
    P, rows, r = collinear()
    K = np.linalg.solve(S := rows @ P @ rows.T + r * np.eye(2, dtype=ONE), rows @ P).T
    assert S.dtype == K.dtype == ONE
    short = P - K @ S @ K.T
    assert np.linalg.eigvalsh(short.astype(float))[0] < 0.0
    left = np.eye(3, dtype=ONE) - K @ rows
    joseph = left @ P @ left.T + r * K @ K.T
    expected = make.exact_posterior(P, rows, [r, r])
    assert abs(joseph - expected).max() > 0.5 * abs(expected).max()


@pytest.mark.parametrize("name", FORMS)
def test_single_precision_over_a_thousand_epochs(name):
    """Single against double, relative."""
    form, found = FORMS[name], []
    for kind in (np.float64, ONE):
        factor, mean = form.first(START).astype(kind), np.zeros(2, kind)
        noise = np.full((1, 1, 1), R, kind)
        for _ in range(1000):
            factor = form.predict(factor, PHI, Q)
            assert factor.dtype == kind
            form.condition(mean, factor, np.zeros(1, kind), H.astype(kind), noise)
            assert np.all(np.diag(factor) >= 0.0)
        found.append(form.cov(factor.astype(float)))
    np.testing.assert_allclose(found[1], found[0], rtol=2e-3)


@pytest.mark.nojit
def test_the_plain_form_has_nothing_left_by_then():
    """A variance of 0, and no gain for ever."""
    P, (phi, q, h) = START.astype(ONE), (x.astype(ONE) for x in (PHI, Q, H))
    worst = np.inf
    for _ in range(1000):
        P = phi @ P @ phi.T + q
        K = P @ h.T / (h @ P @ h.T + ONE(R))
        P = P - K @ h @ P
        worst = min(worst, np.linalg.eigvalsh(P.astype(float)).min())
    assert worst <= 0.0
