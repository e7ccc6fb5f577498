"""An epoch in three compiled calls is the epoch that the filter steps through in Python."""

import numpy as np
import pytest

from ultratight.filters.catalog import RecipeFilter, make_filter
from ultratight.history import FEWEST_DUMPS
from ultratight.scenario import load
from ultratight.simulation import fly, new_closure, run
from ultratight.tracking.at_once import GATE_OPEN, TO_FILTER, AtOnce
from ultratight.world import World


class Stepwise:
    """A filter of the catalogue that the receiver does not know as one."""

    def __init__(self, name):
        self.filter = make_filter(name)

    def reset(self):
        self.filter.reset()

    def step(self, state, prediction, measurement):
        return self.filter.step(state, prediction, measurement)


def scenario(measurement, name="fiqkf-r"):
    changes = ["duration_s=4.0", "profile=[]", "max_satellites=8", f"receiver.filter={name}"]
    return load("jump-1", [*changes, f"receiver.measurement={measurement}"])


@pytest.mark.parametrize("name", ["fiqkf-r", "kf", "fiqkf-c"])
@pytest.mark.parametrize("measurement", ["coherent", "differential"])
def test_same_bits_as_the_filters_own_step(name, measurement):
    """Hand-over at 2 s and the fading factor's second update are among the 200 epochs."""
    chosen = scenario(measurement, name)
    found, expected = run(chosen, 2), run(chosen, 2, filter=Stepwise(name))
    for variable in found.variables:
        np.testing.assert_array_equal(found[variable], expected[variable], err_msg=variable)
    assert found.events == expected.events
    if name == "fiqkf-r":
        assert np.nanmax(found["fading_factor"]) > 1.0
    assert found["coherent"].max() == (measurement == "coherent")


def test_what_is_left_to_python_is_seldom(monkeypatch):
    outcomes, call = [], AtOnce.__call__

    def listening(self, *given):
        found = call(self, *given)
        outcomes.append(found[0])
        return found

    monkeypatch.setattr(AtOnce, "__call__", listening)
    run(scenario("differential"), 2)
    assert len(outcomes) == 200
    assert 1 <= outcomes.count(TO_FILTER) <= 2  # no bit is complete in the first epoch
    assert 1 <= outcomes.count(GATE_OPEN) < 20


def test_a_step_of_ones_own_is_called():
    """A subclass of `RecipeFilter` may do more than its recipe says."""

    class Counting(RecipeFilter):
        steps = 0

        def step(self, state, prediction, measurement):
            self.steps += 1
            return super().step(state, prediction, measurement)

    mine = Counting(make_filter("qkf").recipe)
    run(scenario("differential", "qkf"), filter=mine)
    assert mine.steps == 200


@pytest.mark.parametrize("name", ["qkf-intq", "qkf-ud", "fiqkf-r-box", "kf-sage-husa", "ukf"])
def test_a_recipe_with_more_to_it_steps_by_itself(name):
    assert make_filter(name).at_once is None


def test_all_dumps_are_kept_in_order():
    chosen = scenario("differential", "qkf")
    world = World(chosen, 1)
    correlator, dumps = world.correlator(), []

    def listening(nco):
        taps = correlator(nco)
        dumps.append(taps)
        return taps

    history = fly(new_closure(chosen, world.knows), listening, world.imu[0], chosen.duration_s)
    kept = history.variables(world.names)
    expected = [np.concatenate([t[i] for t in dumps]) for i in range(5)]
    assert len(expected[0]) > 2 * FEWEST_DUMPS  # the arrays have grown twice
    for name, values in zip(("channel", "number", "start", "end"), expected, strict=False):
        np.testing.assert_array_equal(kept[f"dump_{name}"].data, values)
    np.testing.assert_array_equal(kept["tap_i"].data, expected[4].real)
    np.testing.assert_array_equal(kept["tap_q"].data, expected[4].imag)
