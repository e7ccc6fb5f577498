"""Studies on JPL's trajectory: the motion is the one quoted, the four satellites see it."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from signals.constants import C_MPS, GPS_L1_HZ
from ultratight import load
from ultratight.world import World

STUDIES = Path(__file__).parents[1] / "studies"
G = 9.80665


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(STUDIES)
    return import_module


def test_four_satellites_see_25_g_and_100_g_per_s(script: Any) -> None:
    """Second and third derivatives of the truth's own carrier phase, 1288 Hz/s and 5153 Hz/s2."""
    jpl = script("common.jpl")
    still = {"clock.model": "ideal"}
    world = World(load("uniform", jpl.world() | jpl.ALONE | still), 1)
    assert world.prn.tolist() == list(jpl.LINE)
    calm = World(load("uniform", jpl.world() | jpl.ALONE | still | {"profile": []}), 1)
    start = jpl.LEAD_S + jpl.RAMP_S
    hz = 25.0 * G * GPS_L1_HZ / C_MPS
    turns = [np.diff(w.signal.carrier_phase_cycles[..., 1], axis=1) / 0.005 for w in (world, calm)]
    rate = turns[0] - turns[1]  # less the satellites' own motion
    t = world.signal.t_s[:-2] - start
    for t0, t1, sign in ((0.1, 2.9, -1.0), (3.6, 5.4, 1.0), (6.1, 8.0, -1.0)):
        seen = np.abs(rate[:, (t > t0) & (t < t1)])
        assert seen.min() > 0.97 * hz
        assert seen.max() < 1.06 * hz
        ahead = np.sign(rate[:, (t > t0) & (t < t1)]) * sign
        assert (ahead == ahead[:, :1]).all()
        assert sorted(ahead[:, 0]) == [-1.0, -1.0, 1.0, 1.0]
    jerk = np.abs(np.diff(rate, axis=1) / 0.005)[:, (t[:-1] > 3.05) & (t[:-1] < 3.4)]
    np.testing.assert_allclose(jerk, 5153.0, rtol=0.06)


@pytest.mark.parametrize(("cn0", "first"), [(25.0, 40.0), (42.0, 42.0)])
def test_cn0_falls_before_the_motion(script: Any, cn0: float, first: float) -> None:
    """40 dB-Hz to pull in, then that of the run, 2 s before the ramp; the receiver is told 40."""
    jpl = script("common.jpl")
    world = World(load("uniform", jpl.world() | jpl.ALONE | jpl.level(cn0)), 1)
    assert jpl.profile(jpl.LEAD_S)[0]["t0_s"] == 6.0
    given = world.cn0_dbhz(np.array([0.0, 3.4, 3.75, 4.0, 16.0]))
    assert given[:, 0] == pytest.approx([first, first, 0.5 * (first + cn0), cn0, cn0])
    assert world.knows.cn0_dbhz == pytest.approx(first, abs=4.0)  # told with 1 dB, 1 sigma


def test_sensors_are_as_their_grade_has_them(script: Any) -> None:
    """Not as the preset: a MEMS lags by 2.5 ms and has 3000 ppm, tactical sensors draw 525 ppm."""
    jpl = script("common.jpl")
    for name, lag_s, fixed, drawn in (("MEMS", 2.5e-3, 3e-3, 0.0), ("tactical", 0.0, 0.0, 525e-6)):
        errors = World(load("uniform", jpl.world() | jpl.GRADES[name]), 1).errors
        assert errors.lag_s == lag_s
        assert abs(errors.accel_scale_factor[0]) == pytest.approx(fixed)
        assert errors.accel_scale_factor_sigma == pytest.approx(drawn)


def test_lost_counts_the_four_and_what_failed(script: Any) -> None:
    """Off the carrier, or given up by the receiver itself; a fifth channel is none of the four."""
    jpl = script("common.jpl")
    names = [f"G{p:02d}:L1CA" for p in (2, 3, 4, 9, 12)]
    off, given_up = (np.full((4, 5), np.nan) for _ in range(2))
    off[0, [1, 2]] = 5.0  # one of the four, and one that is not
    given_up[3, [1, 3, 4]] = 5.0  # two
    off[3, 4] = 6.0  # of which one was off as well
    ds = xr.Dataset(
        {
            "off_carrier_s": (("run", "channel"), off),
            "lost_lock_s": (("run", "channel"), given_up),
            "failure": ("run", ["", "", "broke", ""]),
        },
        {"channel": names},
    )
    assert jpl.lost(ds).values.tolist() == [0.25, 0.0, 1.0, 0.5]
    assert jpl.astray(ds).values.tolist() == [0.25, 0.0, 1.0, 0.25]
    p, low, high = jpl.band(np.array([[0.25, 0.0, 0.25, 0.5]]), 4)  # 4 of 16
    assert (p[0], low[0], high[0]) == pytest.approx((0.25, 0.102, 0.495), abs=1e-3)  # Wilson


def test_smallest_bandwidth_from_which_on_all_hold(script: Any) -> None:
    """One that holds by chance below one that does not is no answer."""
    least = script("bandwidth").least
    share = np.array([[1.0, 0.0, 0.5, 0.1, 0.0], [0.0] * 5, [0.0, 0.0, 0.0, 0.0, 0.2]])
    assert least(np.array([1.0, 2.0, 3.0, 5.0, 8.0]), share).tolist() == [5.0, 1.0, np.inf]


@pytest.mark.parametrize("name", ["high_dynamics", "bandwidth"])
def test_every_setting_is_one_that_flies(script: Any, name: str) -> None:
    """The scenarios are valid; the last one of a campaign is that of all its axes."""
    module = script(name)
    made = module.campaigns() if hasattr(module, "campaigns") else module.CAMPAIGNS
    for campaign in made.values():
        axes = [list(axis.values()) for axis in campaign.over.values()]
        for k in range(max(map(len, axes))):
            change: dict[str, Any] = {}
            for axis in axes:
                more = axis[min(k, len(axis) - 1)]
                assert not change.keys() & more.keys()  # a sweep refuses what two axes set
                change |= more
            load(campaign.scenario, change)


def test_campaigns_fly_what_their_names_say(script: Any) -> None:
    """The C/N0 falls for those that pull in, each grade has its IMU, the best its own runs."""
    made = script("high_dynamics").campaigns()
    for name, campaign in made.items():
        if "cn0_dbhz" not in campaign.over:
            continue
        pulls_in = "VDFLL" not in name and "ultra" not in name
        for label, change in campaign.over["cn0_dbhz"].items():
            assert change["cn0_dbhz"] == float(label)
            assert ("channel.cn0_profile_s_db" in change) == pulls_in
        grades = {change.get("imu.grade") for change in campaign.over["setting"].values()}
        named = {"tactical": {"tactical"}, "MEMS": {"industrial-mems"}}
        assert grades == named.get(name.rpartition(", ")[2], {None})
        assert campaign.seed == (9001 if name.startswith("search ") else 2001)
    for name, change in script("bandwidth").CAMPAIGNS["aided"].over["grade"].items():
        assert change["imu.grade"] == {"MEMS": "industrial-mems"}.get(name, name)


def edge(name: str) -> float:
    """Channels are lost below this C/N0, or bandwidth."""
    if name in ("alone", "aided", "oscillator"):
        return 4.5
    kinds = {"PLL 2": 38.5, "FLL 2": 27.5, "aided": 22.5, "VDFLL": 25.5, "ultra": 20.5}
    return next((x for kind, x in kinds.items() if kind in name), 30.5)


@pytest.fixture
def invented(script: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Nothing is flown: all four channels are lost below an edge of the last axis.

    The INS keeps all NCOs on the carrier without signals, with an error of 3 m/s, else 0.1 m/s.
    """

    def fly(self: Any, name: str) -> xr.Dataset:
        axes = {key: list(axis) for key, axis in self.campaigns[name].over.items()}
        shape = [len(labels) for labels in axes.values()]
        last = [float(x) if x[0].isdigit() else np.inf for x in list(axes.values())[-1]]
        gone = np.broadcast_to(np.where(np.array(last) < edge(name), 1.0, np.nan), (*shape,))
        runs = self.campaigns[name].runs
        values = np.broadcast_to(gone[..., None, None], (*shape, runs, 4))
        channels = [f"G{p:02d}:L1CA" for p in script("common.jpl").LINE]
        error = 3.0 if name == "no signal" else 0.1
        return xr.Dataset(
            {
                "off_carrier_s": ((*axes, "run", "channel"), values),
                "lost_lock_s": ((*axes, "run", "channel"), values),
                "failure": ((*axes, "run"), np.full((*shape, runs), "")),
                "jump": ((*axes, "run"), np.full((*shape, runs), error)),
            },
            {**axes, "channel": channels},
        )

    monkeypatch.setattr(script("common.campaign").Study, "fly", fly)
    monkeypatch.setattr("sys.argv", ["study", "--out", str(tmp_path / "it")])
    return tmp_path


def test_thresholds_follow_from_the_losses(script: Any, invented: Path) -> None:
    """All lost at 30 and none at 31 dB-Hz: 10 % by linear interpolation at 30.9; 8 dB farther
    down, at 22 and 23, 22.9; at 20 and 22 21.8; of an FLL 27.9."""
    script("high_dynamics").main()
    told = " ".join((invented / "it" / "report.txt").read_text().split())
    assert "PLL 3 threshold 30.9 [30.9, 30.9] 65 Hz, 5 ms" in told
    assert "PLL 2 threshold 38.9 [38.9, 38.9] 100 Hz, 1 ms" in told
    assert "ultra-tight, MEMS threshold 21.8 [21.8, 21.8] qkf, differential" in told
    assert (invented / "it" / "high_dynamics.png").stat().st_size > 20_000
    ledger = script("json").loads((invented / "ledger.json").read_text())
    rows = {row["id"]: row for row in ledger}
    verdicts = {key.removeprefix("dynamics-"): row["verdict"] for key, row in rows.items()}
    assert verdicts == {
        "pll": "reproduced", "aiding": "reproduced", "tight": "met", "grade": "met",
        "order": "reproduced", "steered": "met",
    }  # fmt: skip
    ours = {q["name"]: q["value"] for row in rows.values() for q in row["ours"]}
    assert ours["PLL 3 − aided PLL, tactical"] == pytest.approx(8.0)
    assert ours["PLL 3 − aided PLL, MEMS"] == pytest.approx(7.1)  # lost at 22, held at 24: 23.8
    assert ours["PLL 3 − FLL 2"] == pytest.approx(3.0)
    assert ours["tactical: velocity error without signals"] == 3.0
    assert ours["tactical: 25 Hz off without signals"] == 0.0


def test_the_best_of_the_search_is_flown(script: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The setting that loses least, not the first."""
    module = script("high_dynamics")
    over = {"setting": ["a", "b", "c"], "cn0_dbhz": ["30", "31"]}
    off = np.full((3, 2, 1, 4), 1.0)
    off[1, 1, 0, :3], off[2, 1, 0, :2] = np.nan, np.nan  # b loses 5 of 8, c 6
    channels = [f"G{p:02d}:L1CA" for p in script("common.jpl").LINE]
    ds = xr.Dataset(
        {
            "off_carrier_s": ((*over, "run", "channel"), off),
            "lost_lock_s": ((*over, "run", "channel"), off * np.nan),
            "failure": ((*over, "run"), np.full((3, 2, 1), "")),
        },
        {**over, "channel": channels},
    )
    said: list[str] = []

    class Flown:
        def fly(self, name: str) -> xr.Dataset:
            assert name == "search PLL 3"
            return ds

        def say(self, text: str) -> None:
            said.append(text)

    assert module.search(Flown(), "PLL 3") == "b"
    assert said == ["search PLL 3: share lost a: 1.00, b: 0.62, c: 0.75"]


def test_a_threshold_beyond_the_levels_is_no_number(script: Any) -> None:
    """Nor is the difference of one that is and one that is not."""
    module = script("high_dynamics")

    def share(*loss: float) -> xr.DataArray:
        return xr.DataArray([loss, loss], {"cn0_dbhz": [35.0, 37.5]}, ("run", "cn0_dbhz"))

    for loss, side in (((1.0, 0.5), "above 37.5"), ((0.1, 0.0), "below 35")):
        q = module.threshold("PLL 2", share(*loss))
        assert (q.name, q.value, q.low) == (f"PLL 2 threshold {side}", None, None)
        both = {"a": share(1.0, 0.0), "b": share(*loss)}
        assert module.apart(both, "a", "b").value is None
    assert module.apart({"a": share(1.0, 0.0), "b": share(0.6, 0.0)}, "a", "b").value == (
        pytest.approx(2.5 * (0.9 - 5.0 / 6.0))
    )


def test_smallest_bandwidths_follow_from_the_losses(script: Any, invented: Path) -> None:
    """Lost below 4.5 Hz: 5 Hz is the next of the grid, and 8 Hz that of the unaided loop."""
    script("bandwidth").main()
    told = " ".join((invented / "it" / "report.txt").read_text().split())
    assert "unaided 8 navigation 0 ms 5 navigation 5 ms 5" in told
    assert "no error, TCXO 5 no error, OCXO 5" in told
    assert (invented / "it" / "bandwidth.png").stat().st_size > 20_000
