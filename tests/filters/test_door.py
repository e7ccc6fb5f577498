"""What a filter refuses: every row of the catalogue, before its memory is touched."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ultratight.filters.adaptive import SageHusa
from ultratight.filters.catalog import CATALOG, make_filter
from ultratight.filters.classified import Classified
from ultratight.filters.door import whole
from ultratight.filters.fading import BLOCK
from ultratight.filters.gaussian import Gaussian
from ultratight.filters.interval import intersect_boxes
from ultratight.filters.jump_triggered import JumpOptions
from ultratight.filters.multiple_model import ImmOptions, bank_of
from ultratight.filters.robust import Ishakf

N = 17
ROWS = ("kf", "kf-sage-husa", "kf-sage-husa-2", "kf-ishakf", "kf-acekf", "kf-rekf", "kf-gate",
        "qkf-sqrt", "fiqkf-r", "imm2", "jtq")  # fmt: skip


def epoch(make):
    state, measurement = make.problem("linear", 5, nb=3, n=N)
    return state, make.prediction(N, 3), measurement


def put(array, where, value):
    out = np.array(array)
    out[where] = value
    return out


def at(place, where, value):
    """Changes (state, prediction, measurement) in one entry."""
    index, name = {"mean": (0, "mean"), "cov": (0, "cov"), "phi": (1, "phi"), "q": (1, "q"),
                   "z": (2, "z"), "A": (2, "A"), "R": (2, "R")}[place]  # fmt: skip

    def change(*parts):
        out = list(parts)
        new = put(getattr(parts[index], name), where, value)
        out[index] = parts[index]._replace(**{name: new})
        return out

    return change


def scaled(place, factor):
    def change(state, prediction, measurement):
        if place == "q":
            return state, prediction._replace(q=factor * prediction.q), measurement
        return state, prediction, measurement._replace(R=factor * measurement.R)

    return change


ATTACKS = {
    "z nan": (at("z", (1, 0), np.nan), r"^z: nan at \(1, 0\), expected finite"),
    "z inf": (at("z", (2, 1), -np.inf), r"^z: -inf at \(2, 1\), expected finite"),
    "z 1e200": (at("z", (0, 0), 1e200), r"^z: 1e\+200 at \(0, 0\), .*squares are finite"),
    "R nan": (at("R", (1, 0, 0), np.nan), "^R: nan at"),
    "q nan": (at("q", (4, 4), np.nan), "^q: nan at"),
    "phi nan": (at("phi", (0, 3), np.nan), "^phi: nan at"),
    "A nan": (at("A", (0, 0, 0), np.nan), "^A: nan at"),
    "mean nan": (at("mean", 3, np.nan), "^mean: nan at"),
    "cov nan": (at("cov", (3, 3), np.nan), "^cov: nan at"),
    "R negative": (scaled("R", -1.0), "^R: -.* on the diagonal, expected no variance below 0"),
    "q negative": (scaled("q", -1.0), "^q: -0.0001 on the diagonal"),
    "R lopsided": (at("R", (0, 0, 1), 0.01), "^R: expected a symmetric matrix"),
    "R beyond": (at("R", (0, [0, 1], [1, 0]), 9.0), "^R: expected a positive semi-definite"),
    "q shape": (lambda s, p, m: (s, p._replace(q=p.q[1:, 1:]), m), r"^q: shape \(16, 16\)"),
    "R shape": (lambda s, p, m: (s, p, m._replace(R=np.eye(9))), r"^R: shape \(9, 9\), expected"),
    "A shape": (lambda s, p, m: (s, p, m._replace(A=m.A[:, :, 1:])), "^A: shape"),
    "cov shape": (lambda s, p, m: (Gaussian(s.mean, s.cov[1:, 1:]), p, m), "^cov: shape"),
    "channel": (lambda s, p, m: (s, p, m._replace(channel=m.channel[1:])), "^channel: shape"),
}


@pytest.mark.parametrize("name", ROWS)
def test_refused_and_forgotten(make, name):
    """One clear line each; the epochs after are as if it had not been."""
    spoiled, spared = make_filter(name), make_filter(name)
    state, prediction, measurement = epoch(make)
    first = [f.step(state, prediction, measurement) for f in (spoiled, spared)]
    for change, text in ATTACKS.values():
        with pytest.raises(ValueError, match=text):
            spoiled.step(*change(state, prediction, measurement))
    one, two = (
        f.step(Gaussian(u.mean, u.cov), prediction, measurement)
        for f, u in zip((spoiled, spared), first, strict=True)
    )
    np.testing.assert_array_equal(one.mean, two.mean)
    np.testing.assert_array_equal(one.cov, two.cov)


@pytest.mark.parametrize("name", ["kf", "kf-sage-husa", "kf-ishakf", "kf-acekf", "kf-gate"])
def test_variance_below_zero(make, name):
    """numpy's LinAlgError is what the receiver takes for divergence."""
    state, prediction, measurement = epoch(make)
    with pytest.raises(np.linalg.LinAlgError, match=r"^cov: -1\.0 on the diagonal"):
        make_filter(name).step(
            Gaussian(state.mean, put(state.cov, (2, 2), -1.0)), prediction, measurement
        )


@pytest.mark.parametrize("name", ROWS)
def test_singular_noises_and_no_channel_are_no_fault(make, name):
    """Q = 0, Q and R of rank one, no block: finite, no variance below zero."""
    state, prediction, measurement = epoch(make)
    one = np.ones((3, 3, 3))
    none = measurement._replace(
        z=measurement.z[:0], A=measurement.A[:0], R=one[:0], channel=measurement.channel[:0]
    )
    for q, m in (
        (0.0 * prediction.q, measurement), (1e-3 * np.ones((N, N)), measurement),
        (prediction.q, measurement._replace(R=one + 1e-3 * np.eye(3))), (prediction.q, none),
    ):  # fmt: skip
        found = make_filter(name).step(state, prediction._replace(q=q), m)
        assert np.isfinite(found.mean).all()
        assert np.linalg.eigvalsh(found.cov).min() > -1e-9


@pytest.mark.parametrize(
    ("make_options", "text"),
    [
        (lambda: SageHusa(b=0.95), "b: 0.95, expected two numbers from 0 to 1"),
        (lambda: SageHusa(b=None), "b: None, expected two numbers"),
        (lambda: SageHusa(a=("x", 0.5)), "a: .*expected two numbers"),
        (lambda: Ishakf(window=math.nan), "window: nan, expected a whole number, at least 1"),
        (lambda: Ishakf(window=True), "window: True, expected a whole number"),
        (lambda: Ishakf(max_reject="x"), "max_reject: x, expected a whole number, at least 0"),
        (lambda: Classified(window=math.inf), "window: inf, expected a whole number, at least 1"),
        (lambda: Classified(window=-3), "window: -3, expected a whole number, at least 1"),
        (lambda: ImmOptions((0.0, math.inf), (0.0, 0.1)), "expected none below 0 or infinite"),
        (lambda: JumpOptions(accel_mps2=math.nan), "expected sizes >= 0"),
        (lambda: JumpOptions(prior=(0.5, 0.5)), "prior: .*expected four positive numbers of sum 1"),
        (lambda: JumpOptions(gate=math.nan), "gates: nan, 80.0, expected above 0"),
        (lambda: make_filter("kf", iterations=0), "iterations: 0, expected a whole number"),
        (lambda: make_filter("kf", noise=42), "noise: 42, expected SageHusa or Ishakf"),
        (lambda: make_filter("kf", weights=SageHusa()), "weights: .*, expected Classified"),
    ],
)
def test_bad_options(make_options, text):
    with pytest.raises(ValueError, match=text):
        make_options()


@pytest.mark.parametrize(
    ("name", "part", "text"),
    [
        ("kf-acekf", {"noise": SageHusa()}, "noise, weights: expected one of these"),
        ("imm2", {"noise": SageHusa()}, "several, noise: expected one of these"),
        ("jtq", {"weights": Classified()}, "several, weights: expected one of these"),
        ("kf-ishakf", {"fading": BLOCK}, "noise, fading: expected one of these"),
        ("kf-ishakf", {"intersect": intersect_boxes}, "noise, intersect: expected one"),
    ],
)
def test_no_part_keeps_another_idle(name, part, text):
    """Each of them has the whole step to itself: a second one would be passed over in silence."""
    with pytest.raises(ValueError, match=text):
        make_filter(name, **part)


def test_every_row_is_let_in():
    for name, recipe in CATALOG.items():
        assert make_filter(name) is not None
        assert replace(recipe) == recipe


@pytest.mark.parametrize("weight", [[], [0.5, 0.4], [-0.5, 1.5], [np.nan, 1.0]])
def test_weights_that_do_not_sum_to_one(make, weight):
    state, _ = make.problem("linear", 1)
    with pytest.raises(ValueError, match="expected one or more >= 0, of sum 1"):
        bank_of(state, np.array(weight))


def test_whole_numbers():
    for value in (1, 1.0, np.int64(7), np.float64(3.0)):
        whole("n", value, 1)
    for value in (0, 1.5, True, None, "2", math.nan, math.inf, np.float64("nan")):
        with pytest.raises(ValueError, match=r"^n: .*expected a whole number, at least 1"):
            whole("n", value, 1)
