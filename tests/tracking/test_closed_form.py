"""Closed-form moments of model C against Gaussian theory, brute force and exact integrals."""

import math
from itertools import pairwise

import numpy as np
import pytest
from numpy.polynomial.hermite_e import hermegauss, hermeval
from scipy.stats import norm

from signals.codes import GPS_L1CA
from ultratight.filters.quadrature import gauss_hermite, gauss_rule
from ultratight.filters.rules import solve_slope
from ultratight.tracking.channels import channels
from ultratight.tracking.closed_form import INSTANT, ROOM, TIMES, WEIGHT, regress_closed
from ultratight.tracking.code_model import CHIP, HALF, OFFSET, SPACING, WAVELENGTH, code_rows
from ultratight.tracking.tap_model import TapModel

PARAMS = code_rows(channels([GPS_L1CA], [1], 0.0))
PARAMS[:, [HALF, SPACING, OFFSET]] = 0.01, 0.25, 2.0
MODEL = TapModel(PARAMS)
K = 2.0 * np.pi / PARAMS[0, WAVELENGTH]


def moments(mean, root):
    """Mean (3,), C = E[dz xi'] (3, 3), Omega (3, 3)."""
    zbar, G, Omega = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    regress_closed(mean, root, PARAMS[0], np.empty(ROOM), zbar, G, Omega)
    return zbar, G @ root, Omega


def by_points(mean, root, points, w):
    """The defining sums."""
    z = MODEL((mean + points @ root.T)[None])[0]
    zbar = w @ z
    dz = z - zbar
    C = (dz.T * w) @ points
    return zbar, C, (dz.T * w) @ dz - C @ C.T


def root_of(range_m, phase_rad, rate_mps, correlation=0.8):
    """Root of the covariance; range weakly, phase and rate strongly correlated."""
    sigma = np.array([range_m, phase_rad / K, rate_mps])
    rho = np.array([[1.0, 0.2, 0.1], [0.2, 1.0, correlation], [0.1, correlation, 1.0]])
    return np.linalg.cholesky(rho * np.outer(sigma, sigma))


@pytest.mark.nojit
@pytest.mark.parametrize("s", [1e-3, 0.3, 1.0, 2.5])
def test_phase_alone_has_the_moments_of_a_gaussian_angle(s):
    """E cos, var cos, var sin of N(0, s^2) and the slope by Stein's lemma, from any textbook."""
    at_peak = PARAMS[0, OFFSET]
    zbar, C, Omega = moments(np.array([-at_peak, 0.0, 0.0]), np.diag([0.0, s / K, 0.0]))
    e = np.exp(-0.5 * s * s)
    split = 0.0  # R(-spacing) - R(spacing): even
    np.testing.assert_allclose(zbar, [e, 0.0, split], atol=1e-14)
    np.testing.assert_allclose(C[:, 1], [0.0, s * e, 0.0], atol=1e-14)
    expected = [0.5 * (1.0 - e * e) ** 2, 0.5 * (1.0 - e**4) - (s * e) ** 2, 0.0]
    np.testing.assert_allclose(np.diag(Omega), expected, atol=1e-14)
    np.testing.assert_allclose(C[:, [0, 2]], 0.0, atol=1e-14)


@pytest.mark.parametrize(
    ("phase_rad", "rate_mps", "tolerance"),
    [(0.05, 0.05, 1e-12), (0.7, 0.5, 1e-9), (1.9, 1.0, 1e-7), (1.9, 3.0, 3e-5), (3.0, 0.5, 1e-9)],
)
def test_phase_and_rate_are_those_of_many_points(phase_rad, rate_mps, tolerance):
    """61 x 61 Gauss-Hermite points of another library in phase and rate; the range is known.

    The tolerance is the error of the Gauss rules in time, (k s T_h)^8 of the module's text; seven
    points per axis, which cost more, are off by 1e-4 at 0.7 rad and by 0.1 at 1.9 rad.
    """
    x, w = hermegauss(61)
    points = np.stack([np.zeros(61**2), np.repeat(x, 61), np.tile(x, 61)], axis=1)
    w = np.outer(w, w).ravel() / w.sum() ** 2
    mean = np.array([3.0, 0.3 / K, 0.4 * rate_mps])
    root = root_of(1.0, phase_rad, rate_mps)
    root[:, 0] = 0.0
    expected = by_points(mean, root, points, w)
    for found, true in zip(moments(mean, root), expected, strict=True):
        np.testing.assert_allclose(found, true, atol=tolerance)
    coarse = by_points(mean, root, *gauss_hermite(7, 3))
    if phase_rad > 1.0:
        worst = [max(np.abs(a - b).max() for a, b in zip(m, expected, strict=True))
                 for m in (moments(mean, root), coarse)]  # fmt: skip
        assert worst[0] < 1e-2 * worst[1]


def exact(mean, root, n=31):
    """Brute force: normal density on Gauss-Legendre points from kink to kink of the range.

    The kinks in reach: R(d) at 0, its early and late copies at one spacing.
    """
    chip = PARAMS[0, CHIP]
    ends = (np.array([-0.25, 0.0, 0.25]) * chip - PARAMS[0, OFFSET] - mean[0]) / root[0, 0]
    ends = np.unique(np.clip(np.append(ends, [-8.5, 8.5]), -8.5, 8.5))
    x, w = np.polynomial.legendre.leggauss(40)
    xi = np.concatenate([0.5 * (a + b) + 0.5 * (b - a) * x for a, b in pairwise(ends)])
    v = np.concatenate([0.5 * (b - a) * w for a, b in pairwise(ends)]) * norm.pdf(xi)
    x, w = hermegauss(n)
    points = np.stack([g.ravel() for g in np.meshgrid(xi, x, x, indexing="ij")], axis=1)
    weights = np.einsum("i,j,k->ijk", v, w, w).ravel()
    return by_points(mean, root, points, weights / weights.sum())


@pytest.mark.parametrize(
    ("range_m", "phase_rad", "rate_mps"),
    [(0.5, 0.05, 0.05), (2.0, 0.3, 0.2), (5.0, 1.0, 0.5), (5.0, 1.9, 1.0), (20.0, 0.7, 0.5)],
)
def test_range_phase_and_rate_together(range_m, phase_rad, rate_mps):
    """All moments within 0.1 (sigma / chip)^2 + 1e-6; 343 points miss them by 5 times as much.

    First order in sigma / chip, the kink, is exact; of second order R^2 is made of the projected R.
    """
    rng = np.random.default_rng(7)
    root = root_of(range_m, phase_rad, rate_mps)
    tolerance = 0.1 * (range_m / PARAMS[0, CHIP]) ** 2 + 1e-6
    total = np.zeros(2)
    for _ in range(4):
        mean = root @ rng.standard_normal(3)
        true = exact(mean, root)
        error = [
            max(np.abs(a - b).max() for a, b in zip(m, true, strict=True))
            for m in (moments(mean, root), by_points(mean, root, *gauss_hermite(7, 3)))
        ]
        assert error[0] < tolerance
        total += error
    assert total[0] < 0.2 * total[1]


@pytest.mark.nojit
@pytest.mark.parametrize("kink", [0.0, 0.7, -1.3])
def test_the_kink_of_the_range_keeps_its_variance(kink):
    """Range alone: E R exactly, Var R as the Hermite series of |xi - a| has it up to n = 7.

    Coefficients by Gauss-Legendre from kink to kink.  From points alone E |xi| is 0.04 off.
    """
    range_m, chip = 4.0, PARAMS[0, CHIP]
    x, w = np.polynomial.legendre.leggauss(60)
    energy = 0.0
    for n in range(8):
        c = 0.0
        for a, b in ((-9.0, kink), (kink, 9.0)):
            xi = 0.5 * (a + b) + 0.5 * (b - a) * x
            c += np.sum(
                0.5 * (b - a) * w * norm.pdf(xi) * abs(xi - kink) * hermeval(xi, np.eye(8)[n])
            )
        if n == 0:
            mean = c
        else:
            energy += c**2 / math.factorial(n)
    bend = range_m / chip * (1.0 - PARAMS[0, 0])
    at = np.array([-PARAMS[0, OFFSET] - kink * range_m, 0.0, 0.0])
    zbar, C, Omega = moments(at, np.diag([range_m, 0.0, 0.0]))
    assert zbar[0] == pytest.approx(1.0 - bend * mean, abs=1e-13)
    assert Omega[0, 0] + C[0] @ C[0] == pytest.approx(bend**2 * energy, abs=1e-13)


def test_omega_stays_positive():
    """Random covariances of all sizes: what f_n leave out may cost 1e-5 at most.

    R adds 1 / (2 A^2) to it: 8e-5 for a C/N0 of 55 dB-Hz.
    """
    rng = np.random.default_rng(3)
    for _ in range(500):
        size = 10.0 ** rng.uniform([-2.0, -3.0, -3.0], [1.5, 1.0, 0.7])
        axes = np.linalg.qr(rng.standard_normal((3, 3)))[0] @ np.diag(10.0 ** rng.uniform(-2, 0, 3))
        cov = (axes @ axes.T) * np.outer(size * [1.0, 1.0 / K, 1.0], size * [1.0, 1.0 / K, 1.0])
        mean = size * [1.0, 1.0 / K, 1.0] * rng.standard_normal(3)
        least = np.linalg.eigvalsh(moments(mean, np.linalg.cholesky(cov))[2])[0]
        assert least > -1e-5, (size, least)


@pytest.mark.nojit
@pytest.mark.parametrize("phase_rad", [30.0, 1e4])
def test_an_unknown_phase_leaves_half_the_power(phase_rad):
    zbar, _, Omega = moments(np.array([0.0, 0.0, 0.0]), np.diag([0.0, phase_rad / K, 0.0]))
    r = 1.0 - PARAMS[0, OFFSET] / PARAMS[0, CHIP] * (1.0 - PARAMS[0, 0])
    np.testing.assert_allclose(zbar[:2], 0.0, atol=1e-12)
    np.testing.assert_allclose(Omega[:2, :2], 0.5 * r * r * np.eye(2), atol=1e-12)


@pytest.mark.nojit
def test_directions_without_variance_have_no_slope():
    root = np.zeros((3, 3))
    root[0, 0] = 1.0
    zbar, G, Omega = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    regress_closed(np.zeros(3), root, PARAMS[0], np.empty(ROOM), zbar, G, Omega)
    assert np.isfinite(G).all()
    np.testing.assert_array_equal(G[:, 1:], 0.0)
    same = G.copy()
    solve_slope(root, same)
    np.testing.assert_allclose(same, G)


@pytest.mark.nojit
def test_instants_integrate_what_they_stand_for():
    """sin x / x and its square, as means of cosines: the functions of the tap model."""
    for x in (0.0, 0.1, 0.5, 1.0):
        first, second = INSTANT[:TIMES], INSTANT[TIMES:]
        assert WEIGHT[:TIMES] @ np.cos(x * first) == pytest.approx(np.sinc(x / np.pi), abs=2e-7)
        half = np.sinc(0.5 * x / np.pi) ** 2
        assert WEIGHT[TIMES:] @ np.cos(x * second) == pytest.approx(half, abs=1e-12)


@pytest.mark.nojit
def test_gauss_rule_of_a_discrete_measure():
    """Two points of {-1, 0, 1} with weights 1/4, 1/2, 1/4: +-sqrt(1/2), equal weights."""
    x, w = gauss_rule(np.array([-1.0, 0.0, 1.0]), np.array([0.25, 0.5, 0.25]), 2)
    np.testing.assert_allclose(x, [-np.sqrt(0.5), np.sqrt(0.5)], atol=1e-15)
    np.testing.assert_allclose(w, [0.5, 0.5], atol=1e-15)
