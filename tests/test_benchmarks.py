"""The benchmark's arithmetic: what is called met, and what a ratio is."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def harness(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(ROOT))
    return import_module("benchmarks.harness")


def case(harness, name: str, seconds: list[float], work: float, **given):
    """A case whose turns take these times, after one that warms it up."""
    turns = iter([0.0, *seconds])
    return harness.Case(name, lambda: next(turns), work, "M/s", 1e-6, reports=True, **given)


def test_figure_is_of_the_best_turn_and_ratio_the_median_of_pairs(harness) -> None:
    plain = case(harness, "plain", [4.0, 2.0, 3.0], 1e6)
    ours = case(harness, "ours", [1.0, 1.0, 0.5], 4e6, baseline="plain", target=8.0)
    rows = {row.name: row for row in harness.measure([plain, ours], rounds=3)}
    assert rows["plain"].figure == pytest.approx(0.5)  # 1e6 in 2 s
    assert rows["plain"].met is None
    assert rows["ours"].figure == pytest.approx(8.0)  # 4e6 in 0.5 s
    assert rows["ours"].met is True
    # rates of ours 4, 4, 8; of plain 1/4, 1/2, 1/3: ratios 16, 8, 24
    assert rows["ours"].ratio == pytest.approx(16.0)


@pytest.mark.parametrize(
    ("given", "met"),
    [
        ({"target": 2.1}, False),
        ({"target": 0.4, "cost": True}, False),
        ({"target": 0.6, "cost": True}, True),
        ({"error": lambda: 2e-6, "error_target": 1e-6}, False),
        ({"error": lambda: 1e-7, "error_target": 1e-6, "target": 1.9}, True),
        ({"error": lambda: float("nan"), "error_target": 1e-6, "target": 1.9}, False),
    ],
)
def test_a_target_is_met_or_not(harness, given: dict, met: bool) -> None:
    given = {"scale": 1e-6} | given
    cost = given.get("cost", False)
    turns = iter([0.0, 0.5])
    scale = 1.0 if cost else given.pop("scale")
    given.pop("scale", None)
    one = harness.Case(
        "one", lambda: next(turns), 1.0 if cost else 1e6, "", scale, reports=True, **given
    )
    (row,) = harness.measure([one], rounds=1)
    assert row.met is met


def test_an_unknown_group_is_one_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "corelator"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith("error: group: 'corelator', expected one of correlator,")
    assert done.stderr.count("\n") == 1
