"""The compiled update of the tap models is that of the plain reference, by every rule."""

import numpy as np
import pytest

from signals.codes import GPS_L1CA, GPS_L1CP, GPS_L5Q
from ultratight.filters.gaussian import Gaussian, Measurement, update
from ultratight.filters.reference import update_reference
from ultratight.filters.rules import RULES
from ultratight.tracking.channels import channels
from ultratight.tracking.code_model import HALF, OFFSET, SPACING, code_rows
from ultratight.tracking.tap_model import TapModel

FIELDS = ("mean", "cov", "innovation", "S", "gain", "nis", "H")


def problem(d, scale, n=20, nb=5):
    """nb channels; 1 s.d. of (range, [phase,] rate) is ``scale`` times 60 m, [2 rad,] 2.5 m/s."""
    rng = np.random.default_rng(d)
    root = rng.standard_normal((n, n))
    cov = root @ root.T / n
    A = rng.standard_normal((nb, d, n))
    spread = np.sqrt(np.einsum("bdn,nm,bdm->bd", A, cov, A))
    A *= scale * np.array([60.0, 2.5] if d == 2 else [60.0, 0.06, 2.5])[:, None] / spread[..., None]
    signals = [GPS_L1CA, GPS_L1CA, GPS_L5Q, GPS_L1CP, GPS_L1CA][:nb]
    params = code_rows(channels(signals, [1, 3, 7, 9, 22][:nb], 0.0))
    params[:, OFFSET] = 5.0 * rng.standard_normal(nb)
    params[:, [HALF, SPACING]] = 0.01, 0.25
    model = TapModel(params)
    z = [0.8, 0.0, 0.0] + 0.3 * rng.standard_normal((nb, 3))
    R = np.broadcast_to(np.diag([0.01, 0.02, 0.03]), (nb, 3, 3)).copy()
    state = Gaussian(0.1 * rng.standard_normal(n), cov)
    return state, Measurement(z, A, R, model, model.jacobian, np.arange(nb))


def assert_same(found, expected):
    for name in FIELDS:
        a, b = np.asarray(getattr(found, name)), np.asarray(getattr(expected, name))
        assert np.abs(a - b).max() < 1e-12 * max(1.0, np.abs(b).max()), name


@pytest.mark.parametrize("name", ["linearised", "gh3", "gh7", "gh3x7x3", "unscented-projected"])
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_one_call_is_the_reference(name, d, scale):
    """Points -> h -> sums in numpy, from the definitions; model C's own order of sums included."""
    if name == "gh3x7x3" and d == 2:
        name = "gh5"
    state, measurement = problem(d, scale)
    for iterations in (1, 2):
        found = update(state, measurement, RULES[name], iterations)
        assert_same(found, update_reference(state, measurement, RULES[name], iterations))


def test_one_call_is_the_python_path():
    """The same h as a plain function: called between two compiled steps, same figures."""
    state, measurement = problem(3, 0.7)
    model = measurement.h
    plain = measurement._replace(h=lambda y: model(y), h_jacobian=lambda y: model.jacobian(y))
    for name in ("linearised", "gh7"):
        found = update(state, measurement, RULES[name])
        assert_same(found, update(state, plain, RULES[name]))


@pytest.mark.nojit
def test_which_rules_have_an_inner_axis():
    assert [RULES[name].table(3)[1] for name in ("gh3", "gh7", "gh3x7x3")] == [3, 7, 3]
    for name in ("linearised", "cubature-projected", "unscented-projected"):
        assert RULES[name].table(3)[1] == 1
