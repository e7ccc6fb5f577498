"""Rows by name are the block, and the block is in the order of the fields."""

import numpy as np
import pytest

from ultratight.scenario import load
from ultratight.simulation import new_closure
from ultratight.tracking.rows import Rows
from ultratight.world import World

pytestmark = pytest.mark.nojit


def test_names_are_views_of_the_block():
    fields = {
        "a": ((), (), "m", "a"),
        "b": ((2, 3), ("x", "y"), "m", "b"),
        "c": ((2,), ("x",), "", "c"),
    }
    rows = Rows(4, fields)
    assert rows.block.shape == (4, 9)
    assert np.isnan(rows.block).all()
    rows["a"][1], rows["b"][1], rows["c"][1] = 1.0, np.arange(2.0, 8.0).reshape(2, 3), [8.0, 9.0]
    np.testing.assert_array_equal(rows.block[1], np.arange(1.0, 10.0))
    assert np.isnan(rows.block[[0, 2, 3]]).all()


def test_the_ultra_tight_row_has_each_field_in_its_place():
    changes = ["duration_s=0.1", "profile=[]", "max_satellites=5"]
    closure = new_closure(load("jump-1", changes), World(load("jump-1", changes), 1).knows)
    s = closure.steering
    s.buffer[:23] = np.arange(23.0)
    closure.cov[:] = np.arange(289.0).reshape(17, 17)
    closure.lock.indicator[:] = np.arange(5.0)
    closure.amplitudes.amplitude2[:] = 0.02 * 10.0 ** (np.arange(30.0, 35.0) / 10.0)
    rows = Rows(2, closure.fields())
    closure.write(rows, 1)
    for name in ("r_eb_e", "v_eb_e", "C_b_e", "accel_bias", "gyro_bias"):
        np.testing.assert_array_equal(rows[name][1], getattr(s, name), err_msg=name)
    assert (rows["clock_m"][1], rows["clock_rate"][1]) == tuple(s.clock)
    np.testing.assert_array_equal(rows["covariance"][1], closure.cov)
    np.testing.assert_array_equal(rows["lock_indicator"][1], np.arange(5.0))
    np.testing.assert_allclose(rows["cn0"][1], np.arange(30.0, 35.0), rtol=1e-14)
    assert rows["coherent"][1] == 0.0
    for name in ("nis", "n_measurement", "fading_factor"):  # nothing measured yet
        assert np.isnan(rows[name][1])
