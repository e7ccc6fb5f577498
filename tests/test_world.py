"""What a world says about its sky before anything is flown."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from ultratight.options import progress
from ultratight.scenario import load
from ultratight.simulation import run
from ultratight.world import World

MUNICH = {"position_lla_deg_m": [48.0, 11.0, 500.0], "duration_s": 0.2}


def test_a_place_that_the_embedded_ephemerides_hardly_cover_is_warned_of(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Ephemerides received in East Asia: from Munich few of these satellites are up."""
    far = load("static", MUNICH)
    n = len(World(far, 1).prn)
    assert n < 7
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.getMessage().startswith(f"constellation: {n} satellites of the embedded sky")
    assert "--nav FILE" in record.getMessage()
    caplog.clear()
    World(load("static", {"duration_s": 0.2}), 1)
    World(load("static", MUNICH | {"constellation": "nominal-24"}), 1)
    with progress("", quiet=True):
        World(far, 1)
    assert not caplog.records


def test_the_runs_of_a_sweep_share_a_sky_that_cannot_be_written_to() -> None:
    scenario = load("jump-1")
    sky = World(scenario, 1).sky
    assert World(scenario, 2).sky is sky
    with pytest.raises(ValueError, match="read-only"):
        sky.prn[0] = 0


def test_a_run_that_is_not_whole_says_the_same_of_the_receiver() -> None:
    """Without dumps and sky: what is left is the same to the last bit."""
    scenario = load("jump-1", {"duration_s": 0.4, "profile": [], "max_satellites": 5})
    whole, part = run(scenario, 1), run(scenario, 1, whole=False)
    left_out = set(whole.variables) - set(part.variables)
    assert {"tap_i", "dump_channel", "pseudorange_true", "elevation"} <= left_out
    assert set(part.variables) < set(whole.variables)
    for name in part.variables:
        np.testing.assert_array_equal(part[name], whole[name], err_msg=name)
    assert not left_out & {"v_eb_e", "v_eb_e_true", "covariance", "C_b_e_true"}
