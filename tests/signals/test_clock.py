"""The oscillator against Allan-variance theory and its own definition."""

import numpy as np
import pytest
from scipy.stats import chi2

from signals.clock import OSCILLATORS, Oscillator, simulate
from signals.constants import C_MPS


def allan_variance(clock_m: np.ndarray, h: float, m: int) -> tuple[float, float]:
    """Allan variance at m h from adjacent, *non-overlapping* second differences of the bias.

    Returns it with its equivalent degrees of freedom.  Second differences of white and
    random-walk frequency noise are correlated between neighbours by at most r = -1/2 (white) or
    +1/4 (random walk) and not beyond: variance of the mean square is (2 / k) (1 + 2 r^2) s^4 at
    most, hence edf >= k / (1 + 2 / 4).
    """
    x = clock_m[::m] / C_MPS
    second = np.diff(x, 2) / (m * h)
    return float(np.mean(second**2) / 2.0), len(second) / 1.5


@pytest.mark.parametrize("name", ["tcxo", "ocxo"])
def test_allan_variance_is_that_of_the_h_parameters(name):
    # sigma_y^2 = h0 / (2 tau) + (2 pi^2 / 3) tau h-2 (IEEE 1139, annex B); h = 5 ms, 4000 s
    oscillator = OSCILLATORS[name]
    h, n = 5e-3, 800_000
    clock = simulate(oscillator, np.arange(n + 1) * h, np.random.default_rng(7), 100.0, -3.0)
    for m in (1, 4, 20, 200, 2000):
        tau = m * h
        theory = oscillator.h0 / (2 * tau) + 2 * np.pi**2 / 3 * tau * oscillator.h_minus2
        measured, edf = allan_variance(clock.clock_m, h, m)
        low, high = chi2.ppf([0.0005, 0.9995], edf) / edf
        assert low < measured / theory < high, (m, measured / theory, low, high)


def test_flicker_floor():
    # sigma_y^2 = 2 ln 2 h-1 at every tau.  Neighbouring second differences are less correlated
    # than those of white noise; the sampled process meets the floor from some ten samples on.
    h, n = 1e-2, 400_000
    oscillator = Oscillator("flicker", h_minus1=1e-20)
    clock = simulate(oscillator, np.arange(n + 1) * h, np.random.default_rng(3))
    for m in (20, 100, 500):
        measured, edf = allan_variance(clock.clock_m, h, m)
        low, high = chi2.ppf([0.0005, 0.9995], edf) / edf
        assert low < measured / (2 * np.log(2) * 1e-20) < high, (m, measured)


def test_allan_deviations_of_the_published_oscillators():
    # sigma_y at 1 s and 100 s computed from Winkel's table 2.1, four digits
    expected = {
        "winkel_quartz": (4.912e-10, 3.629e-9),
        "winkel_tcxo": (3.82e-10, 3.63e-9),
        "winkel_ocxo_1": (2.075e-10, 1.717e-10),
        "winkel_ocxo_2": (4.106e-11, 4.064e-10),
        "winkel_rubidium_1": (1e-10, 1.048e-11),
        "winkel_rubidium_2": (1.199e-11, 1.213e-11),
        "winkel_cesium_1": (2.236e-10, 2.236e-11),
        "winkel_cesium_2": (1.005e-10, 1.404e-11),
    }
    for name, pair in expected.items():
        o = OSCILLATORS[name]
        for tau, value in zip((1.0, 100.0), pair, strict=True):
            variance = (
                o.h0 / (2 * tau) + 2 * np.log(2) * o.h_minus1 + 2 * np.pi**2 / 3 * tau * o.h_minus2
            )
            assert np.sqrt(variance) == pytest.approx(value, rel=5e-4)


def test_densities_of_the_two_state_model():
    # c^2 h0 / 2 and 2 pi^2 c^2 h-2: 4.494e-5 m2/s and 0.03548 m2/s3 for h0 = 1e-21, h-2 = 2e-20
    assert OSCILLATORS["tcxo"].bias_psd == pytest.approx(4.494e-5, rel=1e-4)
    assert OSCILLATORS["tcxo"].drift_psd == pytest.approx(0.03548, rel=1e-4)


def test_covariance_of_one_step():
    # Q = [[S_f h + S_g h^3/3, S_g h^2/2], [S_g h^2/2, S_g h]] (Brown & Hwang, 4th ed., 9.3); the
    # spacing is chosen so that all three terms matter
    oscillator = OSCILLATORS["tcxo"]
    s_f, s_g, h = oscillator.bias_psd, oscillator.drift_psd, 0.05
    n = 100_000
    clock = simulate(oscillator, np.arange(n + 1) * h, np.random.default_rng(11))
    innovation = np.array(
        [np.diff(clock.clock_m) - h * clock.drift_mps[:-1], np.diff(clock.drift_mps)]
    )
    expected = np.array([[s_f * h + s_g * h**3 / 3, s_g * h**2 / 2], [s_g * h**2 / 2, s_g * h]])
    measured = innovation @ innovation.T / n
    # standard deviation of a sample covariance: sqrt((Q_ii Q_jj + Q_ij^2) / n)
    diagonal = np.diag(expected)
    sigma = np.sqrt((np.outer(diagonal, diagonal) + expected**2) / n)
    assert (np.abs(measured - expected) < 4 * sigma).all()


def test_ideal_clock_is_exactly_deterministic():
    t = np.arange(2001) * 5e-3
    a = simulate(OSCILLATORS["ideal"], t, np.random.default_rng(1), 1234.5, -67.0)
    b = simulate(OSCILLATORS["ideal"], t, np.random.default_rng(2), 1234.5, -67.0)
    np.testing.assert_array_equal(a.clock_m, 1234.5 - 67.0 * t)
    np.testing.assert_array_equal(a.clock_rate_mps, np.full(2001, -67.0))
    np.testing.assert_array_equal(a.drift_mps, np.full(2001, -67.0))
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x, y)


def test_frequency_steps_with_the_force():
    # 1 ppb/g and 50 g: c 50e-9 = 14.9896229 m/s from the moment of the step on
    t = np.arange(401) * 5e-3
    force = np.where(t[:-1] < 1.0, 0.0, 50 * 9.80665)
    clock = simulate(OSCILLATORS["ideal"], t, np.random.default_rng(0), 10.0, 2.0, 1.0, force)
    step = 14.9896229
    expected = 10.0 + 2.0 * t + step * np.maximum(t - 1.0, 0.0)
    np.testing.assert_allclose(clock.clock_m, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(clock.drift_mps, 2.0 + step * (t >= 1.0), rtol=1e-12)
    slope = 2.0 + step * np.where(t < 1.0, 0.0, np.where(t > 1.0, 1.0, 0.5))
    np.testing.assert_allclose(clock.clock_rate_mps, slope, rtol=1e-9)


def test_force_at_the_nodes_is_linear_between_them():
    t = np.arange(401) * 5e-3
    clock = simulate(OSCILLATORS["ideal"], t, np.random.default_rng(0), 0.0, 0.0, 2.0, 9.80665 * t)
    # c 2e-9 t [m/s], integrated
    np.testing.assert_allclose(clock.clock_m, 0.299792458 * t**2, rtol=0, atol=1e-12)


def test_slopes_let_the_cubic_follow_the_drawn_biases():
    # the mean slope of each piece is the difference of its ends; the slopes at the nodes are the
    # central differences of the biases, whatever noise made them
    t = np.arange(1001) * 5e-3
    clock = simulate(OSCILLATORS["tcxo"], t, np.random.default_rng(5), 0.0, 30.0)
    central = (clock.clock_m[2:] - clock.clock_m[:-2]) / (t[2:] - t[:-2])
    np.testing.assert_allclose(clock.clock_rate_mps[1:-1], central, rtol=0, atol=1e-8)
    # they scatter around the drift by sqrt(S_f / (2 h)), which the drift itself does not
    scatter = np.std(clock.clock_rate_mps[1:-1] - clock.drift_mps[1:-1])
    sigma = np.sqrt(OSCILLATORS["tcxo"].bias_psd / (2 * 5e-3))
    assert scatter == pytest.approx(sigma, rel=4 / np.sqrt(1000))


def test_same_stream_same_clock_and_force_leaves_the_noise_alone():
    t = np.arange(101) * 5e-3
    runs = [
        simulate(OSCILLATORS["tcxo"], t, np.random.default_rng(9), 0.0, 0.0, gamma, np.ones(100))
        for gamma in (0.0, 0.0, 1.0)
    ]
    np.testing.assert_array_equal(runs[0].clock_m, runs[1].clock_m)
    pulled = C_MPS * 1e-9 / 9.80665 * t
    np.testing.assert_allclose(runs[2].clock_m - runs[0].clock_m, pulled, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t_s": np.array([0.0])}, "t_s has shape"),
        ({"t_s": np.array([0.0, 0.1, 0.3])}, "t_s is not uniform"),
        ({"t_s": np.array([0.0, -0.1, -0.2])}, "t_s is not uniform and increasing"),
        ({"bias_m": np.nan}, "bias_m = nan"),
        ({"drift_mps": np.inf}, "drift_mps = inf"),
        ({"specific_force_x": np.zeros(9)}, r"specific_force_x has shape \(9,\)"),
        ({"specific_force_x": np.array([0.0, np.nan])}, "specific_force_x contains"),
    ],
)
def test_bad_input_is_refused(change, message):
    arguments = {"t_s": np.arange(3) * 0.1, "rng": np.random.default_rng(0)} | change
    with pytest.raises(ValueError, match=message):
        simulate(OSCILLATORS["tcxo"], **arguments)


def test_negative_parameter_is_refused():
    with pytest.raises(ValueError, match=r"h0 = -1.0 of x: expected a number >= 0"):
        Oscillator("x", h0=-1.0)
