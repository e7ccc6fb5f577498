"""The pre-filter of a channel and what it hands over, against Riccati, least squares and sums."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from signals.codes import GPS_L1CA
from signals.constants import C_MPS, CA_CHIP_RATE_HZ, GPS_L1_HZ
from ultratight.tracking.channels import channels
from ultratight.tracking.code_model import code_rows
from ultratight.tracking.measurements import range_rows
from ultratight.tracking.pre_filter import (
    CODE_M,
    PHASE_M,
    T_S,
    PreFilters,
    absorb,
    advance,
    begin,
    channel_facts,
    new_pre_filters,
    take_in,
)
from ultratight.tracking.pre_filter_hand_over import (
    clock_step,
    clock_step_into,
    error_variances,
    hand_over,
)
from ultratight.tracking.steering import new_steering, views

PRN, SPACING, HALF_S = 17, 0.25, 0.01
WAVELENGTH_M, CHIP_M = C_MPS / GPS_L1_HZ, C_MPS / CA_CHIP_RATE_HZ
CHANNELS = channels([GPS_L1CA], [PRN], 0.0)
FACTS = channel_facts(code_rows(CHANNELS), CHANNELS.pilot, SPACING)
LAG1 = float(GPS_L1CA.autocorrelation(PRN)[1])
NONE_KNOWN = np.zeros((1, 0), np.int8)


def triangle(d: float) -> float:
    return 1.0 - min(abs(d), 1.0) * (1.0 - LAG1)


def bit(k: int, r: float, p: float, v: float, a2: float, data: float = 1.0, turn: float = 0.0):
    """Bit k (0.02 k to 0.02 k + 0.02 s) without noise: errors r, p at its middle; Bits of one."""
    taps = np.empty((1, 2, 3), complex)
    for half in range(2):
        t = (half - 0.5) * HALF_S
        d = (r + v * t) / CHIP_M
        angle = -2.0 * np.pi * (p + v * t) / WAVELENGTH_M + turn
        taps[0, half] = [triangle(d - e) for e in (-SPACING, 0.0, SPACING)]
        taps[0, half] *= data * np.sqrt(a2) * np.exp(1j * angle)
    span = np.array([[0.02 * k + 0.01, HALF_S, 0.0]])
    return np.zeros(1, np.int64), np.array([k]), span, taps


def started(a2: float, most: int = 40, doppler_sigma: float = 1.0) -> PreFilters:
    pre = new_pre_filters(np.array([a2]), most)
    begin(0, 30.0**2, doppler_sigma**2, WAVELENGTH_M, pre)
    return pre


def take(pre: PreFilters, bits, known=NONE_KNOWN, clock_sf=0.0, unrest=0.0) -> int:
    return take_in(*bits, FACTS, known, 0, clock_sf, np.array([unrest]), pre)


# -- the filter -----------------------------------------------------------------------------------


@pytest.mark.parametrize("cn0_dbhz", [20.0, 35.0, 45.0])
@pytest.mark.parametrize("known", [True, False])
def test_steady_state_is_that_of_the_riccati_equation(cn0_dbhz: float, known: bool) -> None:
    """Phase and Doppler of a two-state model with a phase each 10 ms: to them the code, metres
    against millimetres, is nothing.  Code minus phase is a constant, of which R / n is left."""
    a2 = 2.0 * 10.0 ** (cn0_dbhz / 10.0) * HALF_S
    sf, unrest, n_bit = 4.5e-5, 0.04, 400
    pre = started(a2, 2 * n_bit)
    data = np.ones((1, n_bit), np.int8) if known else NONE_KNOWN
    for k in range(n_bit):
        assert take(pre, bit(k, 0.0, 0.0, 0.0, a2), data, sf, unrest) == -1
    T = HALF_S
    F, H = np.array([[1.0, T], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    Q = np.array([[sf * T + unrest * T**3 / 3, unrest * T**2 / 2], [unrest * T**2 / 2, unrest * T]])
    radians2 = (1.0 + 1.0 / a2) / a2
    if a2 < 8.0:
        radians2 = 1.0 / (a2 * (1.0 if known else math.erf(math.sqrt(a2)) ** 2))
    R = np.array([[radians2 * (WAVELENGTH_M / (2.0 * np.pi)) ** 2]])
    P = solve_discrete_are(F.T, H.T, Q, R)
    P = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
    np.testing.assert_allclose(pre.cov[0, 1:, 1:], P, rtol=2e-4)
    # Kaplan & Hegarty, 3rd ed., ch. 8: dot product, 2 spacing = D chips, variance
    # D / (4 T C/N0) (1 + 1 / (T C/N0)); D of wide-band chips becomes D (1 - R(1)) / (1 - R(1))^2
    c = a2 / 2.0  # T C/N0
    code = 2.0 * SPACING / (4.0 * c) * (1.0 + 1.0 / c) * CHIP_M**2 / (1.0 - LAG1)
    left = pre.cov[0, 0, 0] - 2.0 * pre.cov[0, 0, 1] + pre.cov[0, 1, 1]
    assert 1.0 / left == pytest.approx(2 * n_bit / code + 1.0 / 30.0**2, rel=1e-3)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("data", [1.0, -1.0])
def test_errors_are_measured_with_their_signs(known: bool, data: float) -> None:
    """8 m, 0.3 m/s and a phase that the first bit finds, without noise and at 60 dB-Hz; early minus
    late times prompt grows with d R(d), their power with R(d)^2."""
    a2, v = 2e4, 0.3
    pre = started(a2 * triangle(8.0 / CHIP_M) ** 2)
    bits = np.full((1, 5), data, np.int8) if known else NONE_KNOWN
    for k in range(5):
        p = 0.02 + v * 0.02 * k
        take(pre, bit(k, 8.0, p, v, a2, data), bits)
    kept = pre.kept[0, :10]
    np.testing.assert_allclose(np.diff(kept[:, T_S]), HALF_S, atol=1e-12)
    np.testing.assert_allclose(np.diff(kept[:, PHASE_M]), v * HALF_S, atol=1e-6)
    first = kept[0, PHASE_M] - (0.02 - 0.5 * v * HALF_S)
    turns = first / (WAVELENGTH_M if known else WAVELENGTH_M / 2.0)
    assert turns == pytest.approx(round(turns), abs=1e-6)
    np.testing.assert_allclose(kept[:, CODE_M], 8.0 / triangle(8.0 / CHIP_M), rtol=1e-3)
    assert pre.mean[0, 2] == pytest.approx(v, abs=2e-3)


def test_unknown_bits_may_have_any_sign_and_known_ones_hold_a_whole_wavelength() -> None:
    """Half a turn between two bits: data to one receiver, 0.5 cycles to the other."""
    a2 = 500.0
    for known, expected in ((False, 0.0), (True, 0.5)):
        pre = started(a2, doppler_sigma=0.01)
        bits = np.ones((1, 9), np.int8) if known else NONE_KNOWN
        for k in range(3):
            take(pre, bit(k, 0.0, 0.0, 0.0, a2), bits)
        take(pre, bit(3, 0.0, 0.0, 0.0, a2, turn=-np.pi + 1e-6), bits)
        found = (pre.kept[0, 6, PHASE_M] - pre.kept[0, 5, PHASE_M]) / WAVELENGTH_M
        assert abs(found) == pytest.approx(expected, abs=1e-5)


def test_a_bit_that_is_not_known_is_named_by_its_row() -> None:
    pre = started(100.0)
    assert take(pre, bit(9, 0.0, 0.0, 0.0, 100.0), np.ones((1, 9), np.int8)) == 0
    assert take(pre, bit(8, 0.0, 0.0, 0.0, 100.0), np.ones((1, 9), np.int8)) == -1


def test_what_is_in_phase_is_one_for_a_signal_and_zero_without() -> None:
    """Mean and variance over 1500 bits of unit noise, at an expected 20 dB-Hz."""
    a2, rng = 2.0, np.random.default_rng(3)
    for known in (True, False):
        for signal in (1.0, 0.0):
            found = []
            for _ in range(1500):
                pre = started(a2)
                pre.cov[0, 1, 1], pre.t_s[0] = 1e-8, 0.0
                index, number, span, taps = bit(0, 0.0, 0.0, 0.0, a2 * signal + 1e-12)
                taps[0] += rng.standard_normal((2, 3)) + 1j * rng.standard_normal((2, 3))
                take(pre, (index, number, span, taps), np.ones((1, 1), np.int8)[:, : int(known)])
                found.append(pre.in_phase[0, 0])
            variance = pre.in_phase[0, 1]
            assert np.mean(found) == pytest.approx(signal, abs=4.0 * np.sqrt(variance / 1500))
            if signal:
                assert np.var(found) == pytest.approx(variance, rel=0.15)


def test_what_others_take_in_leaves_the_estimate() -> None:
    """The estimate is off the new reference by what it was off the old one, less the step."""
    pre = started(100.0)
    pre.mean[0], pre.t_s[0] = [5.0, 0.03, 0.2], 0.97
    before, rho, rate = np.array([[100.0], [7.0]]), np.array([103.0]), np.array([7.1])
    absorb(1.0, before, rho, rate, np.array([0.02]), pre)
    # 3 m and 0.1 m/s at t = 1 s are 2.997 m at 0.97 s
    np.testing.assert_allclose(pre.mean[0], [5.0 - 2.997, 0.03 - 0.017, 0.1], atol=1e-12)
    begin(0, 1.0, 1.0, WAVELENGTH_M, pre)
    absorb(1.0, before, rho, rate, np.array([0.02]), pre)
    assert not pre.mean[0].any()


def test_prediction_is_that_of_the_continuous_model() -> None:
    """exp(F dt) and the integral of exp(F s) G G' exp(F s)' by Simpson's rule, exact for cubics."""
    pre = started(100.0)
    rng = np.random.default_rng(1)
    root, x = rng.standard_normal((3, 3)), rng.standard_normal(3)
    pre.mean[0], pre.cov[0], pre.t_s[0] = x, root @ root.T, 0.0
    F = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    G = np.array([[0.3, 0.3, 0.0], [0.3, 0.3, 0.0], [0.0, 0.0, 0.5]])

    def moved(s: float) -> np.ndarray:
        return (np.eye(3) + F * s) @ G @ (np.eye(3) + F * s).T

    Q = 0.04 / 6.0 * (moved(0.0) + 4.0 * moved(0.02) + moved(0.04))
    expected = (np.eye(3) + F * 0.04) @ (root @ root.T) @ (np.eye(3) + F * 0.04).T + Q
    advance(0, 0.04, 0.3, 0.5, pre)
    np.testing.assert_allclose(pre.cov[0], expected, rtol=1e-12)
    np.testing.assert_allclose(pre.mean[0], (np.eye(3) + F * 0.04) @ x, rtol=1e-12)


# -- what is handed over --------------------------------------------------------------------------


def sky() -> np.ndarray:
    """Buffer of a steering in free direction, with force, tilt and lever arm."""
    steering = new_steering(1, 0.005, 0.1)
    rng = np.random.default_rng(5)
    C, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    steering.C_b_e[:] = C * np.linalg.det(C)
    u = rng.standard_normal(3)
    steering.u[0] = u / np.linalg.norm(u)
    steering.mean_force[0] = [30.0, -5.0, -9.8]
    steering.lever_arm_b[:] = [1.0, 0.5, -0.3]
    steering.last_alpha[:] = [1e-3, -2e-3, 5e-4]
    return steering.buffer


def kept_by(rng: np.random.Generator, n: int, t_s: float) -> PreFilters:
    """Integrations of any spacing, value and variance."""
    pre = started(100.0)
    times = np.sort(rng.uniform(t_s - 0.12, t_s - 0.004, n))
    pre.kept[0, :n] = np.column_stack([
        times, rng.normal(0.0, 10.0, n), rng.normal(0.0, 0.1, n), rng.uniform(20.0, 90.0, n),
        rng.uniform(5e-6, 3e-5, n),
    ])  # fmt: skip
    pre.n_kept[0] = n
    return pre


def handed(pre: PreFilters, t_s: float, step, n_scale: int = 3):
    n_state = 18 + n_scale
    z, A, R = np.empty((1, 2)), np.empty((1, 2, n_state)), np.empty((1, 2, 2))
    channel = np.empty(1, np.int64)
    use = np.ones(1, np.bool_)
    assert hand_over(t_s, sky(), n_scale, step, use, pre, z, A, R, channel) == 1
    assert pre.n_kept[0] == 0
    return z[0], A[0], R[0]


QUIET = clock_step(0.1, 0.0, 0.0)


@pytest.mark.parametrize("n", [2, 3, 10])
def test_hand_over_is_the_least_squares_path(n: int) -> None:
    """Three unknowns (range, phase, rate at t) by numpy's own least squares."""
    rng = np.random.default_rng(n)
    t_s = 3.0
    pre = kept_by(rng, n, t_s)
    kept = pre.kept[0, :n].copy()
    t = kept[:, 0] - t_s
    design = np.concatenate([
        np.column_stack([np.ones(n), np.zeros(n), t]), np.column_stack([np.zeros(n), np.ones(n), t])
    ])  # fmt: skip
    sigma = np.sqrt(np.concatenate([kept[:, 3], kept[:, 4]]))
    whitened = design / sigma[:, None]
    x, *_ = np.linalg.lstsq(whitened, np.concatenate([kept[:, 1], kept[:, 2]]) / sigma, rcond=None)
    cov = np.linalg.inv(whitened.T @ whitened)[np.ix_([0, 2], [0, 2])]
    z, _, R = handed(pre, t_s, QUIET)
    np.testing.assert_allclose(z, x[[0, 2]], rtol=1e-9)
    np.testing.assert_allclose(R, cov, rtol=1e-9)


def test_what_is_handed_over_is_that_much_of_the_central_state() -> None:
    """Code and phase that 20 states (and gravity's) would move, without noise: z = A x exactly."""
    rng, t_s, n = np.random.default_rng(8), 5.0, 9
    x = np.append(rng.standard_normal(20) * ([5.0] * 3 + [0.5] * 3 + [1e-3] * 3 + [0.05] * 3
        + [1e-4] * 3 + [9.0, 0.4] + [3e-3] * 3), 0.0)  # fmt: skip
    pre = kept_by(rng, n, t_s)
    s = views(sky(), 1)
    rows = np.empty((2, 21))
    range_rows(s, 0, 0.0, 3, rows)
    level = rows[0] @ x
    for j in range(n):
        range_rows(s, 0, pre.kept[0, j, T_S] - t_s, 3, rows)
        pre.kept[0, j, CODE_M] = rows[0] @ x
        pre.kept[0, j, PHASE_M] = rows[0] @ x - level + 0.071
    z, A, _ = handed(pre, t_s, QUIET)
    np.testing.assert_allclose(A @ x, z, rtol=1e-9)
    range_rows(s, 0, 0.0, 3, rows)
    # the bend of tilt and bias matters: the rate is that of the middle of the interval
    assert abs(z[1] - rows[1] @ x) > 1e-3


def test_the_clock_since_the_integrations_is_step_and_noise() -> None:
    """Covariances of what B and G did, by sums over 10 us steps instead of polynomials."""
    T, sf, sg, t_s = 0.1, 4.5e-5, 0.0355, 2.0
    step = clock_step(T, sf, sg)
    ds = 1e-5
    s = (np.arange(round(0.13 / ds)) + 0.5) * ds  # ago

    def noises(ago: float) -> np.ndarray:
        """What each step of B and G puts into a clock reading so long ago."""
        after = s < ago
        return np.concatenate([-np.sqrt(sf * ds) * after, np.sqrt(sg * ds) * (ago - s) * after])

    inside = s < T
    bias = np.concatenate([np.sqrt(sf * ds) * inside, np.sqrt(sg * ds) * s * inside])
    drift = np.concatenate([np.zeros(s.size), np.sqrt(sg * ds) * inside])
    nominal = sum(w * noises(a) for w, a in zip(step.weight, step.ago_s, strict=True))
    assert nominal @ nominal == pytest.approx(step.variance, rel=1e-3)
    assert nominal @ bias == pytest.approx(step.with_bias, rel=1e-3)
    assert nominal @ drift == pytest.approx(step.with_drift, rel=1e-3)

    pre = kept_by(np.random.default_rng(2), 8, t_s)
    kept = pre.kept[0, :8].copy()
    again = PreFilters(*(x.copy() for x in pre))
    _, _, quiet = handed(pre, t_s, QUIET)
    _, A, R = handed(again, t_s, step)
    t = kept[:, 0] - t_s
    design = np.concatenate([
        np.column_stack([np.ones(8), np.zeros(8), t]), np.column_stack([np.zeros(8), np.ones(8), t])
    ])  # fmt: skip
    weight = 1.0 / np.concatenate([kept[:, 3], kept[:, 4]])
    gain = np.linalg.solve(design.T @ (design * weight[:, None]), design.T * weight)[[0, 2]]
    clock = np.array([noises(-x) for x in t])
    seen = gain @ np.concatenate([clock, clock])
    np.testing.assert_allclose(A[:, -1] * step.variance, seen @ nominal, rtol=2e-3, atol=1e-9)
    whole = quiet + seen @ seen.T
    np.testing.assert_allclose(
        R + np.outer(A[:, -1], A[:, -1]) * step.variance, whole, rtol=2e-3
    )  # fmt: skip
    # most of what it does to the rate is common to all channels
    assert R[1, 1] - quiet[1, 1] < 0.25 * (seen @ seen.T)[1, 1]


def test_the_step_is_new_in_every_epoch() -> None:
    step = clock_step(0.04, 4.5e-5, 0.0355)
    phi, q = np.ones((18, 18)), np.full((18, 18), 0.3)
    q[15, 15] = 1.0
    clock_step_into(0.04, step, phi, q)
    assert not phi[17].any()
    assert not phi[:, 17].any()
    assert q[17, 17] == step.variance
    assert q[15, 17] == q[17, 15] == step.with_bias
    assert q[16, 17] == q[17, 16] == step.with_drift
    assert not q[17, :15].any()
    # of clock bias, drift and step: a covariance
    own = clock_step_own(0.04, 4.5e-5, 0.0355, step)
    assert np.linalg.eigvalsh(own).min() > 0.0


def clock_step_own(T: float, sf: float, sg: float, step) -> np.ndarray:
    return np.array([
        [sf * T + sg * T**3 / 3.0, sg * T**2 / 2.0, step.with_bias],
        [sg * T**2 / 2.0, sg * T, step.with_drift],
        [step.with_bias, step.with_drift, step.variance],
    ])  # fmt: skip


def test_error_variances_are_those_of_the_rows() -> None:
    """Range, rate and acceleration of 10 000 drawn states, by differences over 1 s."""
    rng = np.random.default_rng(4)
    sigma = np.array([5.0] * 3 + [0.5] * 3 + [1e-3] * 3 + [0.05] * 3 + [1e-4] * 3 + [9.0, 0.4, 0.0])
    found = np.empty((1, 3))
    error_variances(sky(), 0, np.diag(sigma**2), found)
    x = rng.standard_normal((10_000, 18)) * sigma
    now, later = np.empty((2, 18)), np.empty((2, 18))
    range_rows(views(sky(), 1), 0, 0.0, 0, now)
    range_rows(views(sky(), 1), 0, 1.0, 0, later)
    drawn = np.stack([x @ now[0], x @ now[1], x @ (later[1] - now[1])])
    np.testing.assert_allclose(drawn.var(axis=1), found[0], rtol=4.0 * np.sqrt(2.0 / 10_000))


def test_a_spacing_without_slope_is_refused() -> None:
    with pytest.raises(ValueError, match=r"spacing_chips is 1.5: early minus late has no slope"):
        channel_facts(code_rows(CHANNELS), CHANNELS.pilot, 1.5)
