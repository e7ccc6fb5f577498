"""What a world says about its sky before anything is flown."""

from __future__ import annotations

import logging

import pytest

from ultratight.options import progress
from ultratight.scenario import load
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
