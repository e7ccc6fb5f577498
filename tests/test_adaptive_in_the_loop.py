"""The study of adaptive filters in the loop: its disturbances can be flown, its claims follow."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

import ultratight
from ultratight.filters.catalog import CATALOG
from ultratight.world import World

STUDIES = Path(__file__).parents[1] / "studies"
N_RUN = 20


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The script with its modules, and the ledger; their folder is on no path but theirs."""
    monkeypatch.syspath_prepend(STUDIES)
    import adaptive_in_the_loop
    from common import adaptation_cells, adaptation_claims, adaptation_measures, ledger

    modules = adaptation_cells, adaptation_measures, adaptation_claims, adaptive_in_the_loop
    names = {name: value for module in modules for name, value in vars(module).items()}
    return SimpleNamespace(script=SimpleNamespace(**names), ledger=ledger)


def made_up(script, errors: dict[tuple[str, str], float], model: str = "C") -> dict:
    """Flights whose errors are 1 where nothing else is said, infinite ones not converged."""
    labels, flown = script.FLOWN[model], {}
    for which in script.FACED[model]:
        level = np.array([errors.get((which, label), 1.0) for label in labels])
        merit = level[:, None] * np.linspace(0.9, 1.1, N_RUN)
        flown[which] = xr.Dataset(
            {
                "merit": (("filter", "run"), merit),
                "quiet": (("filter", "run"), np.ones_like(merit)),
                "converged": (("filter", "run"), np.isfinite(merit)),
            },
            {"filter": list(labels), "run": np.arange(N_RUN), "seed": ("run", np.arange(N_RUN))},
        )
    return flown


def test_every_row_and_every_disturbance_can_be_flown(study) -> None:
    """Each campaign's scenarios are valid, and the satellites that they name are in view."""
    script = study.script
    assert set(script.ROWS.values()) <= set(CATALOG)
    assert set(script.STEPS) | set(script.JUMPS) == set(script.SAID)
    for campaign in script.CAMPAIGNS.values():
        base = ultratight.load(campaign.scenario)
        for name, change in campaign.over["disturbance"].items():
            world = World(base.replace(change), 1)
            hit = [d.affected.sum() for d in world.disturbances]
            assert hit == {"power all": [10], "fault step": [1]}.get(name, [])
            assert max([0.0] + [d.t1_s for d in world.disturbances]) <= world.scenario.duration_s


def test_claims_follow_from_the_runs(study) -> None:
    """A family helps if every row's error is below the QKF's; one that diverges is no help."""
    script = study.script
    better = {("fault step", label): 0.1 for label in script.FAMILIES["weights"]}
    verdict = {
        c.id: study.ledger.verdict(c.row()) for c in script.asked("C", made_up(script, better))
    }
    assert verdict["adaptive-C-fault-step-weights"] == "met"
    assert verdict["adaptive-C-fault-step-R"] == "not met"  # as good as the QKF is no help
    assert verdict["adaptive-C-fault-step-Q"] == "met"  # but no harm
    worse = better | {("fault step", "ACEKF"): np.inf}
    claims = {c.id: c.row() for c in script.asked("C", made_up(script, worse))}
    assert study.ledger.verdict(claims["adaptive-C-fault-step-weights"]) == "not met"
    assert all(row["why"] and row["target"] for row in claims.values())
    few = list(script.asked("D", made_up(script, {}, "D")))
    assert len(few) == sum(q[0] in script.FACED["D"] for q in script.QUESTIONS)


def test_one_for_all_is_the_least_bad_row(study) -> None:
    script = study.script
    errors = {(w, label): 3.0 for w in script.SAID for label in script.FLOWN["C"] if label != "QKF"}
    errors |= {(w, "IMM2"): 1.1 for w in script.SAID} | {("jump", "IMM2"): 0.3}
    claim = script.serves("C", made_up(script, errors))
    assert "IMM2" in claim.ours[0].name
    assert study.ledger.verdict(claim.row()) == "not met"  # 1.1 in the fault is not half
    errors |= {("fault step", "IMM2"): 0.3}
    assert study.ledger.verdict(script.serves("C", made_up(script, errors)).row()) == "met"


def test_two_that_diverged_are_equal(study) -> None:
    ds = made_up(study.script, {("jump", "QKF"): np.inf, ("jump", "KF"): np.inf})["jump"]
    assert np.array_equal(study.script.ratio(ds, "KF"), np.ones(N_RUN))
    assert np.array_equal(study.script.ratio(ds, "IMM2"), np.zeros(N_RUN))
    assert np.array_equal(study.script.difference(ds, "KF"), np.zeros(N_RUN))


def test_error_while_a_disturbance_lasts(study) -> None:
    """Root mean square of t over (7, 17] in steps of 0.1 s, by the sum of squares."""
    t = np.round(np.arange(1, 201) * 0.1, 9)
    error = np.stack([t, np.where(t < 9.0, t, np.nan)])
    ds = xr.Dataset(
        {"error": (("run", "t_s"), np.ones_like(error)), "position_error": (("run", "t_s"), error)},
        {"t_s": t},
    )
    found = study.script.with_merit(ds, "fault step")
    k = np.arange(71, 171)
    assert found["merit"].values == pytest.approx([0.1 * np.sqrt(np.mean(k**2)), np.inf])
    assert found["quiet"].values == pytest.approx([1.0, 1.0])


def test_quick_claims_and_figures_are_produced(study, monkeypatch, tmp_path: Path) -> None:
    """The whole script on made-up flights: every question has its claim, judged and written."""
    script = study.script

    def fly(self, *names: str) -> xr.Dataset:
        parts = [flight(self.campaigns[name]) for name in names]
        return xr.concat(parts, "filter") if parts[1:] else parts[0]

    monkeypatch.setattr(script.Study, "fly", fly)
    out = tmp_path / "adaptive_in_the_loop"
    monkeypatch.setattr(sys, "argv", ["adaptive_in_the_loop", "--quick", "--out", str(out)])
    script.main()
    rows = json.loads((tmp_path / "ledger.json").read_text())
    asked = sum(q[0] in script.FACED[m] for q in script.QUESTIONS for m in script.MODELS)
    assert len(rows) == len({row["id"] for row in rows}) == asked + 2 * 3 + 1
    assert {row["verdict"] for row in rows} <= {"met", "not met"}
    assert all(row["quick"] and row["study"] == "adaptive_in_the_loop" for row in rows)
    assert {path.name for path in out.glob("*.png")} == {
        "adaptive_C.png", "adaptive_D.png", "adaptive_time.png"
    }  # fmt: skip
    said = (out / "report.txt").read_text()
    assert all(label in said for label in script.FLOWN["C"])


def flight(campaign) -> xr.Dataset:
    """As `Study.fly` gives a campaign's flights: errors of a tenth, those of the QKF of one."""
    axes = {dim: list(labels) for dim, labels in campaign.over.items()}
    size = [len(labels) for labels in axes.values()] + [campaign.runs]
    dims = (*axes, "run")
    t = np.arange(1, 331) * 0.1
    level = np.array([1.0 if x == "QKF" else 0.1 for x in axes["filter"]])
    level = level.reshape([-1 if d == "filter" else 1 for d in dims])
    series = np.broadcast_to((level * np.ones(size))[..., None], (*size, t.size))
    coordinates = axes | {"run": np.arange(campaign.runs), "t_s": t}
    kept = dict.fromkeys(("error", "position_error", "cn0"), ((*dims, "t_s"), series))
    return xr.Dataset(kept | {"converged": (dims, np.ones(size, bool))}, coordinates)
