"""The ultra-tight closure: what it says to a filter that does not keep its word."""

from __future__ import annotations

import pytest

from ultratight.scenario import load
from ultratight.simulation import run


class Forgetful:
    """Returns the density alone."""

    def reset(self) -> None:
        """Nothing to forget."""

    def step(self, state, prediction, measurement):
        return state


def test_a_filter_that_gives_no_update_is_named() -> None:
    message = r"^Forgetful\.step gave Gaussian, expected an ultratight\.filters\.gaussian\.Update$"
    with pytest.raises(TypeError, match=message):
        run(load("jump-1", ["duration_s=0.1", "profile=[]"]), filter=Forgetful())
