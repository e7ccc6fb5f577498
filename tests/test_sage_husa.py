"""The Sage-Husa study: its facts, its figures of merit, and acceptance on other seeds."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture(scope="module")
def study(studies):
    return studies(
        flight="common.platform_flight", cells="common.platform_cells",
        measures="common.platform_measures", targets="common.platform_targets",
        ledger="common.ledger",
    )  # fmt: skip


def test_flight_and_disturbances_are_the_papers(study) -> None:
    """Table 2 has 44 stages; 301-899 and 5301-5899 s without GPS; 300", 60" and 0.067"/s."""
    f = study.flight
    assert 7 + 4 * len(f.TURNS) + 1 == 44
    starts = [t for turn in f.TURNS for t in turn[:4]]
    assert starts == sorted(starts)
    assert [side for *_, side in f.TURNS] == [-1, -1, 1, -1, 1, -1, 1, -1, 1]
    assert f.OUTAGE.sum() == 2 * 599
    assert list(f.OUTAGE[[299, 300, 898, 899]]) == [False, True, True, False]
    seconds = f.FAULT / f.ARCSEC
    assert seconds[[1000, 1002, 1500, 1799, 2099, 2599]] == pytest.approx([300, 300, 60, 60, 6.7,
                                                                           40.2])  # fmt: skip
    assert np.count_nonzero(seconds) == 3 + 300 + 600
    x, z = f.measure(f.SCENARIOS["3"], 7)
    assert np.isnan(z).all(axis=1).sum() == 2 * 599
    residual = (z - x[:, 2:4])[~f.OUTAGE] - f.FAULT[~f.OUTAGE, None]
    n = residual.size
    assert residual.std() == pytest.approx(f.GPS_SIGMA, rel=4 / np.sqrt(2 * n))


def test_no_velocity_noise_in_the_outages(study) -> None:
    """Errors of two seeds differ by noise alone: in a gap by the propagation of what was."""
    f = study.flight
    Phi, _ = f.matrices(f.SCENARIOS["1"])
    gap = np.flatnonzero(f.OUTAGE)[1:500]
    a, b = (f.measure(f.SCENARIOS["1"], seed)[0] for seed in (1, 2))
    difference = a - b
    new = difference[gap] - np.einsum("kij,kj->ki", Phi[gap], difference[gap - 1])
    assert np.abs(new[:, :2]).max() < 1e-12
    assert new[:, 4:7].std() == pytest.approx(np.sqrt(2) * f.TILT_WALK, rel=0.1)


def test_stretches_bridge_gaps_of_half_a_minute(study) -> None:
    above = np.zeros(200, dtype=bool)
    above[[10, 11, 42, 60]] = above[92:95] = True  # gaps of 30, 17 and 31 s
    assert study.flight.stretch(above, 11) == 51.0
    assert study.flight.stretch(above, 60) == 51.0
    assert study.flight.stretch(above, 93) == 3.0
    assert study.flight.stretch(above, 100) == 0.0


@pytest.mark.parametrize("q", ["over-stated", "matched"])
def test_improved_1_is_sage_husa_for_one_b_and_all_stay_definite(study, q) -> None:
    """Over the whole flight with errors outside the model: equal to 1e-9 of each state's range."""
    Q = study.flight.Q0[q]
    means = {}
    for n in "123456":
        run = study.cells.one_flight("2", Q, study.cells.algorithm(n, "2"), 11).run
        assert set(run.first) == {-1}, n
        means[n] = run.mean
    span = np.abs(means["1"]).max(axis=0)
    assert np.all(np.abs(means["2"] - means["1"]) < 1e-9 * span)
    assert np.any(np.abs(means["3"] - means["1"]) > 1e-2 * span)


def test_threads_and_company_change_no_bit(study) -> None:
    cells = study.cells.cells()
    few = {name: cells[name] for name in ("1 matched 1", "3 matched 4")}
    both = study.cells.fly_all(few, 2, 2)
    alone = study.cells.fly_all({"3 matched 4": few["3 matched 4"]}, 2, 1)
    for key, values in alone["3 matched 4"].items():
        np.testing.assert_array_equal(values, both["3 matched 4"][key])


@pytest.mark.campaign
def test_acceptance_on_other_seeds(study) -> None:
    """Peaks, ratios, times and definiteness that an independent prototype measured."""
    first = 700_001
    wanted = ("1 over-stated", "1 matched", "2", "3", "5 none", "5 fix", "5 q", "full")
    cells = {
        name: cell for name, cell in study.cells.cells().items()
        if name.startswith(wanted) and len(name.split(" ")) < 4
    }  # fmt: skip
    flown = study.cells.fly_all(cells, 40, 2, first)
    claims = study.targets.prototype(flown, study.measures.equal_b(first))
    assert len(claims) == 8
    for claim in claims:
        assert claim.row()["verdict"] == study.ledger.MET, claim
    for name, merits in flown.items():
        if not name.startswith("5 q"):  # which grows without bound
            assert np.all(np.isfinite(merits["lost"]) == name.startswith("5 none")), name
