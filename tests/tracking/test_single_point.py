"""Fixes against the place that made the pseudoranges; residuals against chi-square."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from signals.atmosphere import ionosphere_delay_m, troposphere_delay_m
from signals.propagation import elevation_azimuth, pseudorange
from signals.satellites import embedded
from ultratight.ins.earth import geodetic_from_ecef
from ultratight.statistics import wilson
from ultratight.tracking import position_filter
from ultratight.tracking.single_point import (
    Dop,
    Epoch,
    Models,
    dilutions,
    limit_of,
    predicted,
    solve,
    variances,
)

TOW = 475_250.0
TRUE_V = np.array([30.0, -20.0, 10.0])
NO_MODELS = Models(atmosphere=False)


@pytest.fixture(scope="module")
def state(place: np.ndarray) -> np.ndarray:
    return np.array([*place, 5_000.0, *TRUE_V, -60.0])


@pytest.fixture(scope="module")
def epoch(state: np.ndarray) -> Epoch:
    """Ten satellites and more, without noise."""
    _, rows = embedded().select(2149, TOW)
    return _made(rows, TOW, state)


def _made(rows: np.ndarray, tow_s: float, x: np.ndarray, mask_deg: float = 10.0) -> Epoch:
    told = np.array([pseudorange(row, tow_s, x[:3], x[4:7], x[3], x[7]) for row in rows])
    elevation, _ = elevation_azimuth(x[:3], told[:, 2:])
    up = elevation > np.radians(mask_deg)
    n = int(up.sum())
    return Epoch(tow_s, rows[up], told[up, 0], told[up, 1], np.full(n, 42.0), np.zeros(n, int))


def test_from_the_centre_of_the_earth(epoch: Epoch, state: np.ndarray) -> None:
    fix = solve(epoch, NO_MODELS)
    assert fix is not None
    np.testing.assert_allclose(fix.state[:4], state[:4], atol=1e-5)
    np.testing.assert_allclose(fix.state[4:], state[4:], atol=1e-6)
    assert fix.used.all()
    assert fix.consistent


def test_dop_of_four_satellites_of_the_textbook() -> None:
    """One overhead, three on the horizon 120 deg apart: G = diag(2/3, 2/3, 4/3, 1/3) up, time.

    (H'H)^-1 worked out by hand: HDOP sqrt(4/3), VDOP sqrt(4/3), TDOP sqrt(1/3).
    """
    a = np.radians([90.0, 210.0, 330.0])
    u = np.array([[1.0, 0.0, 0.0], *np.column_stack([0.0 * a, np.cos(a), np.sin(a)])])
    H = np.column_stack([-u, np.ones(4)])
    dop = dilutions(np.linalg.inv(H.T @ H), np.array([6.4e6, 0.0, 0.0]))
    expected = Dop(*np.sqrt([3.0, 8.0 / 3.0, 4.0 / 3.0, 4.0 / 3.0, 1.0 / 3.0]).tolist())
    np.testing.assert_allclose(dop, expected, rtol=1e-12)


def test_errors_and_residuals_are_as_the_covariance_says(epoch: Epoch, state: np.ndarray) -> None:
    """300 draws: NEES of 4, chi-square of n - 4, and alarms as often as stated, at 99.9 %."""
    rng = np.random.default_rng(3)
    sigma = np.sqrt(variances(epoch, np.ones(len(epoch.rows)), np.zeros(1), False))
    n, draws, nees, square, alarms = len(sigma), 300, 0.0, 0.0, 0
    for _ in range(draws):
        noisy = epoch._replace(pseudorange_m=epoch.pseudorange_m + sigma * rng.standard_normal(n))
        fix = solve(noisy, NO_MODELS, state, false_alarm=0.1)
        assert fix is not None
        alarms += fix.excluded >= 0 or not fix.consistent
        whole = solve(noisy, NO_MODELS, state, false_alarm=1e-12)
        assert whole is not None
        e = whole.state[:4] - state[:4]
        nees += float(e @ np.linalg.solve(whole.cov, e))
        square += whole.chi_square
    for total, dof in ((nees, 4 * draws), (square, (n - 4) * draws)):
        low, high = chi2.ppf([0.0005, 0.9995], dof)
        assert low < total < high
    share = wilson(alarms, draws, 0.999)
    assert share.low < 0.1 < share.high


def test_limit_is_that_of_chi_square() -> None:
    for dof in (1, 6):
        assert limit_of(dof, 1e-3) == pytest.approx(chi2.isf(1e-3, dof), rel=1e-9)
    assert limit_of(0, 1e-3) == np.inf


@pytest.mark.parametrize(("bad", "by_m"), [(0, 60.0), (3, -80.0), (5, 299_792.458)])
def test_one_wrong_satellite_is_left_out(
    epoch: Epoch, state: np.ndarray, bad: int, by_m: float
) -> None:
    rho = epoch.pseudorange_m.copy()
    rho[bad] += by_m
    fix = solve(epoch._replace(pseudorange_m=rho), NO_MODELS)
    assert fix is not None
    assert (fix.excluded, fix.consistent) == (bad, True)
    assert not fix.used[bad]
    np.testing.assert_allclose(fix.state[:4], state[:4], atol=1e-3)
    assert fix.residual_m[bad] == pytest.approx(by_m, abs=1e-2)


def test_five_satellites_tell_that_one_is_wrong_but_not_which(epoch: Epoch) -> None:
    five = Epoch(epoch.tow_s, *(x[:5] for x in epoch[1:]))
    rho = five.pseudorange_m.copy()
    rho[1] += 20_000.0
    fix = solve(five._replace(pseudorange_m=rho), NO_MODELS)
    assert fix is not None
    assert (fix.excluded, fix.consistent) == (-1, False)
    four = Epoch(epoch.tow_s, *(x[:4] for x in epoch[1:]))
    alone = solve(four, NO_MODELS)
    assert alone is not None
    assert alone.limit == np.inf
    assert solve(Epoch(epoch.tow_s, *(x[:3] for x in epoch[1:])), NO_MODELS) is None


def test_the_atmosphere_is_corrected(epoch: Epoch, state: np.ndarray) -> None:
    """Delays of the models at the true place; a fix without correction is metres too high."""
    lat, lon, h = geodetic_from_ecef(state[:3])
    elevation, azimuth = elevation_azimuth(state[:3], predicted(epoch, state)[:, 2:])
    iono = embedded().iono_utc
    delay = troposphere_delay_m(lat, h, elevation) + ionosphere_delay_m(
        lat, lon, azimuth, elevation, TOW, iono.alpha, iono.beta
    )
    late = epoch._replace(pseudorange_m=epoch.pseudorange_m + delay)
    corrected = solve(late, Models(True, iono))
    plain = solve(late, NO_MODELS)
    assert corrected is not None
    assert plain is not None
    assert np.linalg.norm(corrected.state[:3] - state[:3]) < 0.01
    assert np.linalg.norm(plain.state[:3] - state[:3]) > 3.0


def test_filter_is_consistent(state: np.ndarray) -> None:
    """Motion and clock drawn from its model: mean NEES of 8 states, 12 flights, at 99.9 %.

    An epoch a second, so that the code loop's noise is all but independent; successive errors are
    correlated, hence one epoch of each flight.
    """
    rng = np.random.default_rng(5)
    _, rows = embedded().select(2149, TOW)
    nees = 0.0
    Q = np.linalg.cholesky(position_filter._process(1.0, 1.0))
    phi = np.eye(8) + np.eye(8, k=4)
    flights = 12
    for _ in range(flights):
        x = state.copy()
        first = _made(rows, TOW, x, 15.0)
        fix = solve(first, NO_MODELS)
        assert fix is not None
        estimate = position_filter.begin(fix)
        x = x + np.linalg.cholesky(estimate.cov) @ rng.standard_normal(8)
        for k in range(1, 13):
            x = phi @ x + Q @ rng.standard_normal(8)
            e = _made(rows, TOW + k, x, 15.0)
            a = np.exp(-4.0)
            chip_m = 293.05
            sigma = chip_m * np.sqrt(0.5 / 10**4.2 * (1 + a) / (1 - a))
            n = len(e.rows)
            e = e._replace(
                pseudorange_m=e.pseudorange_m + sigma * rng.standard_normal(n),
                rate_mps=e.rate_mps + 0.05 * rng.standard_normal(n),
            )
            estimate = position_filter.advance(estimate, 1.0, e, NO_MODELS)
            assert not estimate.lost
        away = x - estimate.state
        nees += float(away @ np.linalg.solve(estimate.cov, away))
    low, high = chi2.ppf([0.0005, 0.9995], 8 * flights)
    assert low < nees < high


def test_filter_gates_one_and_gives_up_when_all_are_beyond(epoch: Epoch, state: np.ndarray) -> None:
    fix = solve(epoch, NO_MODELS)
    assert fix is not None
    start = position_filter.begin(fix)
    later = _made(epoch.rows, TOW + 1.0, state + np.concatenate([state[4:], np.zeros(4)]))
    rho = later.pseudorange_m.copy()
    rho[2] += 500.0
    one = position_filter.advance(start, 1.0, later._replace(pseudorange_m=rho), NO_MODELS)
    assert np.flatnonzero(~one.used).tolist() == [2]
    assert not one.lost
    assert np.linalg.norm(one.state[:3] - state[:3] - state[4:7]) < 0.1
    far = later._replace(rate_mps=later.rate_mps + 300.0 * np.arange(len(rho)))
    assert position_filter.advance(start, 1.0, far, NO_MODELS).lost
