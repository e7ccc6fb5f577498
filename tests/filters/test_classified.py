"""Weights of suspect residuals: formulas by hand, memory, classes, definiteness, refusals."""

import numpy as np
import pytest

from ultratight.filters.catalog import make_filter
from ultratight.filters.classified import CLASS_A, CLASS_B, LEFT_OUT, NORMAL, Classified, Weights
from ultratight.filters.factored import make_pair
from ultratight.filters.gaussian import Gaussian, Measurement, predict, update
from ultratight.filters.rules import RULES, get_rule

RULE = RULES["linearised"]


class Scalars:
    """n states seen directly, all in one block; P = 1, R as given, no process noise."""

    def __init__(self, make, R=(1.0, 4.0)):
        n = len(R)
        self.h = make.LinearH(np.eye(n)[None])
        self.R = np.diag(R)[None]
        self.state, self.quiet = Gaussian(np.zeros(n), np.eye(n)), make.prediction(
            n, 1, q=np.zeros((n, n)), layout_=0
        )  # fmt: skip

    def step(self, weights, z):
        z = np.array([z], float)
        A = np.eye(z.size)[None]
        measurement = Measurement(z, A, self.R, self.h.h, self.h.h_jacobian, np.zeros(1, int))
        return weights.step(self.state, self.quiet, measurement, RULE)


def weights(form="plain", **options):
    return Weights(Classified(**options), make_pair(form))


@pytest.mark.nojit
def test_class_a_is_covered_by_its_own_square(make):
    """By hand: S0 = (2, 5), e = (60, 10): d = (3600 - 2, (100 - 5)/4), mean 1810.9."""
    w, problem = weights(), Scalars(make)
    found = problem.step(w, (60.0, 10.0))
    d = np.array([3598.0, 95.0 / 4.0])
    assert w.kind[0] == CLASS_A
    # sum e^2/R over sum S0/R
    assert w.eta[0] == pytest.approx((3600.0 + 25.0) / (2.0 + 1.25))
    np.testing.assert_allclose(w.weight[0], [d[0], d.mean()], rtol=1e-13)
    # the worst number's residual is exactly one sigma; its correction is P e / e^2
    assert found.innovation[0] ** 2 == pytest.approx(found.S[0, 0])
    assert found.mean[0] == pytest.approx(1.0 / 60.0)
    for combine, expected in (("channel", d), ("scalar", [d.mean()] * 2)):
        problem.step(w := weights(combine=combine), (60.0, 10.0))
        np.testing.assert_allclose(w.weight[0], expected, rtol=1e-13)


@pytest.mark.nojit
def test_class_b_is_covered_by_the_residuals_before(make):
    """By hand, window of 2: the present residual and the oldest one are out of it."""
    problem, past = Scalars(make), [(30.0, 30.0), (4.0, 3.0), (3.0, -2.0)]
    cases = (
        ({}, np.array([(16 + 9) / 2, (9 + 4) / 2])),
        ({"current": True}, np.array([(9 + 25) / 2, (4 + 36) / 2])),
        ({"centred": True}, np.array([0.5, 12.5])),
    )
    for options, M in cases:
        w = weights(window=2, combine="channel", **options)
        for z in past:
            problem.step(w, z)
        problem.step(w, (5.0, 6.0))
        assert w.kind[0] == CLASS_B
        expected = np.maximum(0.0, (M - [2.0, 5.0]) / [1.0, 4.0])
        np.testing.assert_allclose(w.weight[0], expected, rtol=1e-13, err_msg=str(options))


@pytest.mark.nojit
def test_normal_and_first_residuals_are_weighted_as_ever(make):
    """(26); and with no past M = S0."""
    problem = Scalars(make)
    for z, kind in (((0.5, 0.5), NORMAL), ((5.0, 5.0), CLASS_B)):
        w = weights()
        found = problem.step(w, z)
        assert w.kind[0] == kind
        assert not w.weight.any()
        np.testing.assert_allclose(found.mean, np.array(z) * [1 / 2, 1 / 5], rtol=1e-13)


@pytest.mark.nojit
def test_swapped_and_both(make):
    """Exchanged, the first large residual enters with full weight."""
    problem = Scalars(make)
    problem.step(w := weights(swapped=True), (60.0, 10.0))
    assert w.kind[0] == CLASS_A
    assert not w.weight.any()
    problem.step(w := weights(both=True), (6.0, 0.0))
    assert w.kind[0] == CLASS_B
    np.testing.assert_allclose(w.weight[0], [34.0, (34.0 - 5.0 / 4.0) / 2], rtol=1e-13)


@pytest.mark.nojit
def test_rows_of_others(make):
    """REKF raises number by number beyond chi2(0.95, 2) = 5.991, AEKF all alike at any time."""
    problem = Scalars(make)
    rekf, aekf = (make_filter(n).weights for n in ("kf-rekf", "kf-aekf"))
    problem.step(rekf, (3.4, 0.0))  # NIS 5.78
    assert not rekf.weight.any()
    rekf.reset()
    problem.step(rekf, (3.6, 0.0))  # NIS 6.48
    np.testing.assert_allclose(rekf.weight[0], [3.6**2 - 2.0, 0.0], rtol=1e-13)
    problem.step(aekf, (2.0, 2.5))
    np.testing.assert_allclose(aekf.weight[0], [(2.0 + 1.25 / 4.0) / 2] * 2, rtol=1e-13)


@pytest.mark.nojit
@pytest.mark.parametrize("form", ["plain", "square-root", "ud"])
def test_what_is_left_out_leaves_the_prediction(make, form):
    """To a part in `LEFT_OUT` of the correction."""
    problem = Scalars(make)
    w = weights(form, detector="nis", reject=True)
    found = problem.step(w, (6.0, 0.0))
    assert np.all(np.abs(found.mean) < 10.0 / LEFT_OUT)
    np.testing.assert_allclose(found.cov, problem.state.cov, atol=10.0 / LEFT_OUT)
    assert w.kind[0] == CLASS_A


@pytest.mark.nojit
def test_a_channel_is_judged_by_itself(make):
    """Two good channels keep the weight that they have alone; a bad one loses its own."""
    state, measurement = make.problem("linear", 3, nb=3, n=6, scale=0.4)
    rng = np.random.default_rng(1)
    prior = predict(state, np.eye(6), 1e-4 * np.eye(6))
    expected = update(prior, measurement, RULE)
    z = measurement.z - expected.innovation.reshape(3, 3)  # exactly what is predicted
    z[1] += 100.0 * rng.standard_normal(3)
    w = weights("ud")
    found = w.step(state, make.prediction(6, 3), measurement._replace(z=z), RULE)
    np.testing.assert_array_equal(w.kind, [NORMAL, CLASS_A, NORMAL])
    assert not w.weight[[0, 2]].any()
    # correlated noise of a block is raised as L R L: definite, and S covers the residual
    assert np.linalg.eigvalsh(found.noise).min() > 0.0
    assert np.linalg.eigvalsh(found.cov).min() > 0.0
    assert found.innovation[3:6] ** 2 == pytest.approx(
        np.minimum(found.innovation[3:6] ** 2, np.diag(found.S)[3:6])
    )


@pytest.mark.nojit
def test_no_measurement_and_reset(make):
    state, measurement = make.problem("linear", 3, nb=2, n=5, scale=0.4)
    none = measurement._replace(
        z=measurement.z[:0], A=measurement.A[:0], R=measurement.R[:0],
        channel=measurement.channel[:0],
    )  # fmt: skip
    w = weights("ud")
    found = w.step(state, make.prediction(5, 2), none, get_rule("linearised"))
    np.testing.assert_allclose(found.cov, state.cov + 1e-4 * np.eye(5), atol=1e-12)
    first = w.step(state, make.prediction(5, 2), measurement, RULE)
    w.step(state, make.prediction(5, 2), measurement._replace(z=measurement.z + 9.0), RULE)
    w.reset()
    again = w.step(state, make.prediction(5, 2), measurement, RULE)
    np.testing.assert_array_equal(again.mean, first.mean)


@pytest.mark.nojit
@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"window": -3}, "window: -3, expected a whole number, at least 1"),
        ({"window": 0}, "window: 0"), ({"window": 2.5}, "window: 2.5"),
        ({"detector": "eta"}, "detector: 'eta', expected one of classes"),
        ({"combine": "min"}, "combine: 'min'"), ({"measure": "x"}, "measure: 'x'"),
        ({"units": "m"}, "units: 'm'"), ({"xi": -0.1}, "xi, eta1: -0.1"),
        ({"eta1": 1.0}, "xi, eta1: 0.1, 1.0"), ({"eta1": np.nan}, "xi, eta1: 0.1, nan"),
        ({"probability": 1.0}, "probability: 1.0"),
    ],
)  # fmt: skip
def test_refused_options(options, said):
    with pytest.raises(ValueError, match=said):
        Classified(**options)


@pytest.mark.nojit
@pytest.mark.parametrize("form", ["plain", "ud"])
def test_noise_without_variance_is_refused(make, form):
    """Weights are relative to R; a correlated, singular block is none."""
    with pytest.raises(ValueError, match=r"R: diagonal \[1.0, 0.0\], expected above 0"):
        Scalars(make, (1.0, 0.0)).step(weights(form), (1.0, 1.0))
    problem = Scalars(make)
    problem.R = np.ones((1, 2, 2))
    found = problem.step(weights(form), (60.0, 10.0))
    assert np.isfinite(found.mean).all()
    assert np.linalg.eigvalsh(found.cov).min() >= -1e-12
