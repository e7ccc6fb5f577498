"""Sage-Husa, scenario 1, over-stated Q_0: what flight, P_0, R_0 and b change (A13)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

SEEDS, MANY = range(710_001, 710_005), range(710_001, 710_021)
SCATTER = {"1": 1.35, "3": 1.27, "4": 1.67, "5": 1.66}
"""Factor by which a single run's peak scatters, of the prototype's 40 seeds"""
MEANS = np.sqrt(1 / len(SEEDS) + 1 / 2)
"""Of the difference between a mean of ours and one of its 2 to 3 seeds, in units of that"""
SPEEDS = {150.0: {"1": (3.5, 5.1), "3": (5.0, 7.8), "4": (12, 19), "5": (3.9, 8.4)},
          250.0: {"1": (4.0, 5.0), "3": (5.0, 7.7), "4": (13, 38), "5": (6.0, 12)}}  # fmt: skip
FORGETTING = {
    0.0: {"1": (13, 12), "4": (31, 50)}, 0.1: {"1": (3.7, 5.0), "4": (41, 34)},
    0.5: {"1": (2.4, 3.6), "4": (3.5, 19)}, 0.7: {"1": (2.4, 3.2), "4": (5.1, 15)},
    0.95: {"1": (4.8, 3.9), "4": (5.9, 9.3)}, 1.0: {"1": (1.1, 1.8), "4": (1.2, 5.5)},
}  # fmt: skip
"""The prototype's peaks of V_x and V_y [m/s]"""

pytestmark = pytest.mark.campaign


@pytest.fixture(scope="module")
def peaks(studies):
    """Peaks (seed,) [m/s] of a filter, the geometric mean of both velocities'."""
    parts = studies(flight="common.platform_flight", cells="common.platform_cells")
    flight, cells = parts.flight, parts.cells

    def found(n, first=(1.0, 1.0), b=None, seeds=SEEDS, **changes):
        world = replace(flight.SCENARIOS["1"], **changes)
        noise = cells.algorithm(n, "1", **({} if b is None else {"b": (b, b)}))
        Q, out = flight.Q0["over-stated"], []
        for seed in seeds:
            run = flight.estimate(world, *flight.measure(world, seed), Q, noise, first)
            m = flight.merits(run)
            out.append(np.sqrt(m["peak_x"] * m["peak_y"]))
        return np.array(out)

    return found


def mean(values):
    return float(np.exp(np.mean(np.log(values))))


def off(n, found, theirs):
    """Ours against the prototype's, in sigma of both means."""
    x, y = theirs
    return abs(np.log(mean(found) / np.sqrt(x * y))) / (np.log(SCATTER[n]) * MEANS)


@pytest.mark.parametrize("speed_mps", SPEEDS)
def test_speed(peaks, speed_mps) -> None:
    for n, theirs in SPEEDS[speed_mps].items():
        assert off(n, peaks(n, speed_mps=speed_mps), theirs) < 3.0, n


@pytest.mark.parametrize("deg_per_s", [1.2, 3.0])
def test_turn_rate(peaks, deg_per_s) -> None:
    """1 stays at 3.3-4.0 / 5.5-5.9, 4 at 9-27 / 20-32, 5 at 6-8 / 6-10 m/s."""
    middles = {"1": (3.6, 5.7), "4": (15.6, 25.3), "5": (6.9, 7.7)}
    for n, theirs in middles.items():
        assert off(n, peaks(n, turn_rate=np.radians(deg_per_s)), theirs) < 3.0, n


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 180.0, 270.0])
def test_heading(peaks, heading_deg) -> None:
    """1 stays at 3.4-4.4 / 4.6, 4 at 17-33 / 10-21, 5 at 3.6-7.6 / 3-15 m/s."""
    middles = {"1": (3.9, 4.6), "4": (23.7, 14.5), "5": (5.2, 6.7)}
    for n, theirs in middles.items():
        assert off(n, peaks(n, heading_deg=heading_deg), theirs) < 3.0, n


@pytest.mark.parametrize("sigma", [0.3, 10.0])
def test_first_covariance_of_the_state(peaks, sigma) -> None:
    """P_0 changes 1, 3 and 5 by less than 20 %; that of 1 scatters by a fifth, hence 20 seeds."""
    for n in "135":
        changed = peaks(n, (sigma, 1.0), seeds=MANY) / peaks(n, seeds=MANY)
        assert mean(changed) == pytest.approx(1.0, abs=0.2), n


@pytest.mark.parametrize(
    ("sigma", "theirs"),
    [(0.3, {"3": (16, 20), "5": (12, 17)}), (3.0, {"3": (2.3, 3.9), "5": (2.1, 3.0)})],
)
def test_first_noise(peaks, sigma, theirs) -> None:
    """R_0 matters to 3 and 5, which hold it, and not to 1."""
    for n, value in theirs.items():
        assert off(n, peaks(n, (1.0, sigma)), value) < 3.0, n
    assert mean(peaks("1", (1.0, sigma)) / peaks("1")) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("b", FORGETTING)
def test_forgetting(peaks, b) -> None:
    """Near 0 both are at their worst; 4 takes b near 1."""
    for n, theirs in FORGETTING[b].items():
        assert off(n, peaks(n, b=b), theirs) < 3.0, n
