"""Our own receiver on a file of ours, from the samples alone, beside the truth of the file."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ultratight.__main__ import main
from ultratight.ins.earth import ecef_from_geodetic

pytestmark = pytest.mark.receiver
SECONDS = 33


def test_the_first_fix_and_those_after_it(tmp_path: Path, say: Callable[..., Any]) -> None:
    """Within 3 m (r.m.s.), and 1 s after the message allows it.

    The file begins 10 s before a frame, whose subframe 3 ends 28 s after the start, and arrives
    66 to 84 ms later.
    """
    name = tmp_path / "flight"
    words = ["generate", "static", "--duration", str(SECONDS), "--rate", "4e6", "--quiet"]
    assert main([*words, "--out", str(name)]) == 0
    told = json.loads(say("track", name, "--out", tmp_path, "--json").out)
    nav = told["navigation"]
    assert told["not_synchronised"] == []
    assert all(c["words"]["wrong"] + c["words"]["unsure"] == 0 for c in nav["channels"])
    assert 28.066 < nav["first_fix_s"] < 29.0
    (feature,) = json.loads((tmp_path / "flight.geojson").read_text())["features"]
    lon, lat, h = np.array(feature["geometry"]["coordinates"]).T
    r = ecef_from_geodetic(np.radians(lat), np.radians(lon), h)
    place = ecef_from_geodetic(np.radians(39.9), np.radians(116.4), 50.0)
    assert len(r) > 40
    assert np.sqrt(np.mean(np.sum((r - place) ** 2, axis=1))) < 3.0
