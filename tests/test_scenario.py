"""Scenario: what ships is what the specification says, what is wrong is said in one line each."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ultratight import config, scenario
from ultratight.provenance import provenance
from ultratight.scenario import PRESETS, InvalidInput, Scenario, load


def problems(*changes: str, source: str | Path = "jump-1") -> list[str]:
    with pytest.raises(InvalidInput) as caught:
        load(source, changes)
    return caught.value.problems


# -- presets ---------------------------------------------------------------------------------------

# the specification's table of cases: first speed, speed at the end, peak |acceleration|
CASES = {
    "jump-1": (200.0, 1200.0, 100.0),
    "jump-2": (200.0, 200.0, 100.0),
    "jump-3": (1200.0, 200.0, 50.0),
    # 300 + 150 - 200 + 450 - 270 + 180 - 360 + 140 over the eight ramps
    "jump-4": (200.0, 590.0, 120.0),
    "uniform": (200.0, 200.0, 0.0),
    "accelerated": (200.0, 1200.0, 20.0),
    "static": (0.0, 0.0, 0.0),
}


@pytest.mark.parametrize("name", CASES)
def test_presets_fly_what_the_specification_says(name: str) -> None:
    s = load(name)
    gained = sum((g.accel0_mps2 + g.accel1_mps2) / 2 * (g.t1_s - g.t0_s) for g in s.profile)
    peak = max([0.0, *(max(abs(g.accel0_mps2), abs(g.accel1_mps2)) for g in s.profile)])
    assert (s.speed_mps, s.speed_mps + gained, peak) == pytest.approx(CASES[name])
    assert s.name == name
    assert s.title
    assert s.why
    assert not s.warnings()


@pytest.mark.parametrize("name", [p for p in CASES if p != "static"])
def test_paper_presets_share_sky_and_cause(name: str) -> None:
    s = load(name)
    assert (s.start_week, s.start_tow_s, s.mask_deg) == (2149, 475_220.0, 10.0)
    assert s.position_lla_deg_m == (39.9, 116.4, 8000.0)
    assert math.radians(s.heading_deg) == pytest.approx(0.7, abs=1e-15)
    assert s.imu.accel_scale_factor_ppm == (3000.0, 0.0, 0.0)
    assert s.imu.accel_scale_factor_alternates
    assert s.cn0_dbhz == 35.0
    assert s.receiver.measurement == "coherent"
    assert s.receiver.fall_back is False
    assert s.duration_s == 50.0


def test_every_shipped_file_is_listed() -> None:
    folder = Path(scenario.__file__).parent / "presets"
    assert {p.stem for p in folder.glob("*.toml")} == set(PRESETS)


def test_fall_back_is_on_unless_a_preset_says_otherwise() -> None:
    assert Scenario(name="x", duration_s=1.0).receiver.fall_back is True


# -- extends, overrides, round trips ---------------------------------------------------------------


def test_extends_merges_tables_and_replaces_lists(tmp_path: Path) -> None:
    (tmp_path / "base.toml").write_text(
        'extends = "jump-2"\ntitle = "mine"\n'
        "[imu]\nlag_s = 0.01\n[receiver.knows]\ntilt_sigma_mrad = 9\n"
    )
    top = tmp_path / "top.toml"
    top.write_text(
        'extends = "base.toml"\n[[profile]]\nt0_s = 1\nt1_s = 2\naccel0_mps2 = 5\naccel1_mps2 = 6\n'
    )
    s = load(top, {"cn0_dbhz": 40})
    assert (load(top.with_name("base.toml")).title, s.name) == ("mine", "top")
    assert (load(top).title, s.title) == ("base, changed", "top, changed: cn0_dbhz")
    assert (s.imu.lag_s, s.imu.accel_scale_factor_ppm) == (0.01, (3000.0, 0.0, 0.0))
    assert s.receiver.knows.tilt_sigma_mrad == 9.0
    assert [g.accel1_mps2 for g in s.profile] == [6.0]
    assert s.cn0_dbhz == 40.0


def test_extends_in_a_circle_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('extends = "b.toml"\n')
    (tmp_path / "b.toml").write_text('extends = "a.toml"\n')
    (line,) = problems(source=tmp_path / "a.toml")
    assert "a.toml -> b.toml -> a.toml" in line


def test_a_navigation_file_is_found_beside_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "brdc.nav").write_text("")
    (tmp_path / "mine.toml").write_text('extends = "jump-1"\nconstellation = "brdc.nav"\n')
    assert load(tmp_path / "mine.toml").constellation == str(tmp_path / "brdc.nav")


@pytest.mark.parametrize("name", PRESETS)
def test_toml_round_trip(name: str) -> None:
    s = load(name, {"channel.cn0_by_prn_dbhz": {"G07": 31.5}, "imu.lag_s": 1e-7})
    again = Scenario.from_toml(s.to_toml())
    assert again == s
    assert again.digest() == s.digest()


@given(
    st.recursive(
        st.booleans() | st.integers(-(2**62), 2**62) | st.floats(allow_nan=False) | st.text(),
        lambda inner: st.lists(inner, max_size=3),
        max_leaves=6,
    )
)
def test_written_toml_means_the_same(value: object) -> None:
    """Our writer against the standard library's reader."""
    text = config.write_toml({"a b": {"k": value}, "rows": [{"x": value}, {"x": 1}]})
    assert tomllib.loads(text) == {"a b": {"k": value}, "rows": [{"x": value}, {"x": 1}]}


def test_digest_is_stable_and_sees_every_change() -> None:
    base = load("jump-1")
    assert base.digest() == load("jump-1").digest() == base.replace({}).digest()
    assert len(base.digest()) == 64
    # an integer for a float is the same scenario
    assert load("jump-1", ["cn0_dbhz=35"]).digest() == base.digest()
    changes = ["cn0_dbhz=35.5", "imu.lag_s=0", "receiver.knows.cn0_sigma_db=2", "prns=[7,8,16,27]"]
    digests = {load("jump-1", [change]).digest() for change in changes}
    assert len(digests | {base.digest()}) == len(changes) + 1


def test_a_navigation_file_counts_by_its_content(tmp_path: Path) -> None:
    digests = []
    for folder, content in (("a", "one"), ("b", "one"), ("a", "two")):
        path = tmp_path / folder / f"brdc-{folder}.nav"
        path.parent.mkdir(exist_ok=True)
        path.write_text(content)
        digests.append(load("jump-1", {"constellation": str(path)}).digest())
    assert digests[0] == digests[1] != digests[2]
    # FIPS 180: printf two | sha256sum
    assert load("jump-1", {"constellation": str(path)}).files_sha256() == {
        "constellation": "3fc4ccfe745870e2c0d99f71f30ff0656c8dedd41cc1d7d3d376b0dbe685e2f3"
    }
    assert load("jump-1").files_sha256() == {}
    told = provenance(load("jump-1", {"constellation": str(path)}), 1)
    assert told["navigation_sha256"].startswith("3fc4ccfe")
    assert told["scenario_sha256"] == digests[2]
    assert "navigation_sha256" not in provenance(load("jump-1"), 1)


def test_a_trajectory_file_is_found_beside_the_scenario_and_counts_by_content(
    tmp_path: Path,
) -> None:
    (tmp_path / "flight.csv").write_text("t_s,x_m,y_m,z_m\n0,6.4e6,0,0\n60,6.4e6,0,0\n")
    file = tmp_path / "own.toml"
    file.write_text('extends = "static"\ntrajectory = "flight.csv"\n')
    scenario = load(file)
    assert scenario.trajectory == str(tmp_path / "flight.csv")
    assert provenance(scenario, 1)["trajectory_sha256"] == scenario.files_sha256()["trajectory"]
    before = scenario.digest()
    (tmp_path / "flight.csv").write_text("t_s,x_m,y_m,z_m\n0,6.4e6,0,0\n60,6.4e6,0,1\n")
    assert scenario.digest() != before
    with pytest.raises(InvalidInput, match=r'trajectory: "none.csv" given, expected a trajectory'):
        load("static", {"trajectory": "none.csv"})
    with pytest.raises(InvalidInput, match="expected no profile beside it"):
        load("jump-1", {"trajectory": str(tmp_path / "flight.csv")})


def test_what_the_receiver_does_not_know_of_the_air_is_said() -> None:
    assert load("static").warnings() == []
    lines = load("static", {"atmosphere.troposphere": True}).warnings()
    assert len(lines) == 1
    assert "corrects nothing" in lines[0]


def test_another_world_does_not_keep_title_and_reason(tmp_path: Path) -> None:
    changed = load("jump-1", ["imu.lag_s=0", "profile=[]", "receiver.filter=kf"])
    assert (changed.title, changed.why) == ("jump-1, changed: imu, profile", "")
    assert load("jump-1").replace(["cn0_dbhz=40"]).title == "jump-1, changed: cn0_dbhz"
    for same in (["receiver.filter=kf"], ["cn0_dbhz=35"]):
        assert load("jump-1", same).title == load("jump-1").title
    assert load("jump-1", {"profile": [], "title": "flat"}).title == "flat"
    path = tmp_path / "mine.toml"
    path.write_text('extends = "jump-2"\nprofile = []\n')
    assert (load(path).title, load(path).why) == ("jump-2, changed", "")


def test_a_printed_scenario_shows_every_key() -> None:
    rows = "channel.disturbance=[{t0_s=1,cn0_change_db=-3}]", "vibration=[{t0_s=1,t1_s=2,rms_g=1}]"
    text = load("jump-1", rows).to_toml()
    for key in config.keys(Scenario):
        leaf = key.name.rpartition(".")[2]
        assert (
            f"\n{leaf} = " in f"\n{text}" or f"\n# {leaf} = ..." in text or f"{key.name}]" in text
        )
    assert "# saturation_g = ...  # " in text


def test_keys_are_described_as_they_are() -> None:
    described = {key.name: key for key in config.keys(Scenario)}
    lag = described["imu.lag_s"]
    assert lag[1:4] == ("s", "number 0 to 1", "left out")
    assert described["imu.lever_arm_b_m"][1:4] == (
        "m",
        "[number -1000 to 1000] x 3",
        "[0.0, 0.0, 0.0]",
    )
    assert described["receiver.epoch_s"][1:4] == ("s", "number 0.001 to 0.1", "0.02")
    assert described["imu.velocity_random_walk_mps_sqrt_s"].unit == "m/s/sqrt(s)"
    assert described["duration_s"].default == "required"
    assert described["duration_s"].expected == "number more than 0 and 86400 or less"
    assert described["profile.t1_s"].expected == "number more than 0 and 1e+06 or less"
    assert described["correlator.kind"].expected == "model or samples"
    assert described["receiver.pll_order"].expected == "2 or 3"


def test_overrides_are_toml_values_or_bare_words() -> None:
    s = load(
        "jump-1",
        ["receiver.closure=scalar", 'correlator.kind="samples"', "imu.lever_arm_b_m=[1, 0, -2.5]"],
    )
    assert (s.receiver.closure, s.correlator.kind) == ("scalar", "samples")
    assert s.imu.lever_arm_b_m == (1.0, 0.0, -2.5)


def test_a_scenario_cannot_be_changed() -> None:
    s = load("jump-1")
    with pytest.raises(ValueError, match="frozen"):
        s.cn0_dbhz = 40.0
    assert s.replace({"cn0_dbhz": 40.0}).cn0_dbhz == 40.0
    assert s.cn0_dbhz == 35.0


def test_built_in_python_it_obeys_the_same_rules() -> None:
    with pytest.raises(ValueError, match="a multiple of epoch_s"):
        Scenario(name="x", duration_s=1.01)


# -- what is said about bad input ------------------------------------------------------------------


def test_all_problems_at_once_and_one_line_each() -> None:
    found = problems(
        "imu.lag=3",
        "imu.lag_s=true",
        "cn0_dbhz='35 dBHz'",
        "clock.bias_m=nan",
        "imu.lever_arm_b_m=[1,2]",
        "receiver.closure=loose",
        "receiver.filter=best",
        "front_end.if_hz=3e6",
        "profile=[{t0_s=3,t1_s=2},{t0_s=1,t1_s=90, a=3}]",
    )
    starts = {line.split(":")[0] for line in found}
    assert starts == {
        "imu.lag",
        "imu.lag_s",
        "cn0_dbhz",
        "clock.bias_m",
        "imu.lever_arm_b_m",
        "receiver.closure",
        "receiver.filter",
        "front_end.if_hz",
        "profile[1].a",
    }
    assert not [line for line in found if "\n" in line]


def test_rules_between_keys_are_all_listed() -> None:
    found = problems(
        "front_end.sample_rate_hz=1e6",
        "receiver.knows.data_bits=false",
        "duration_s=30.01",
        "profile=[{t0_s=3,t1_s=2},{t0_s=1,t1_s=90}]",
    )
    assert [line.split(":")[0] for line in found] == [
        "front_end.sample_rate_hz",
        "duration_s",
        "receiver.measurement",
        "profile[0].t1_s",
        "profile[1].t0_s",
        "profile[1].t1_s",
    ]


def test_data_bits_matter_to_the_coherent_closure_only() -> None:
    without = ["receiver.knows.data_bits=false"]
    for other in ("receiver.measurement=differential", "receiver.closure=scalar"):
        assert load("jump-1", [*without, other])


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            "integration_s=0.003",
            "0.003 given, expected one of 0.001, 0.002, 0.004, 0.005, 0.01, 0.02",
        ),
        ("bandwidth_hz=81", "81 given, expected at most 0.4 / integration_s = 80"),
        ("pll_order=4", "4 given, expected one of 2 or 3"),
        ("dll_order=0", "0 given, expected one of 1 or 2"),
    ],
)
def test_loops_that_cannot_be_built_are_refused(change: str, line: str) -> None:
    key = change.partition("=")[0]
    assert [f"receiver.{key}: {line}" in text for text in problems(f"receiver.{change}")] == [True]
    assert load("jump-1", ["receiver.bandwidth_hz=80", "receiver.dll_bandwidth_hz=20"])


def test_the_epoch_matters_to_the_ultra_tight_closure_only() -> None:
    odd = ["receiver.epoch_s=0.017", "duration_s=1.02", "profile=[]"]
    assert problems(*odd)
    assert load("jump-1", [*odd, "receiver.closure=scalar"])
    with pytest.raises(InvalidInput, match=r"duration_s: 1.01 given, expected a multiple of 0.02"):
        load("jump-1", ["duration_s=1.01", "profile=[]", "receiver.closure=scalar"])


def test_fastest_moment_counts_also_inside_a_ramp() -> None:
    """From +8000 to -8000 m/s2 in 8 s: the speed peaks at 16 km/s in the middle and is 0 after."""
    ramp = "profile=[{t0_s=1,t1_s=9,accel0_mps2=8000,accel1_mps2=-8000}]"
    (line,) = problems("speed_mps=0", ramp)
    assert "reaches 16000 m/s" in line
    assert load("jump-1", ["speed_mps=0", ramp.replace("8000", "5000")])


# -- warnings --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rate_hz", "phases"),
    [
        (4.092e6, 1),  # 4 samples per chip
        (2.046e6, 1),
        (2.5575e6, 2),  # 5/2
        (5.1150e6, 1),
        (1.023e6 * 37 / 10, 10),
        (4.092e6 * (1 + 1e-5), 1),  # as good as commensurate within a code period
        (4.0e6, None),  # 4000/1023
        (5.0e6, None),
        (1.023e6 * 41 / 11, None),
    ],
)
def test_sample_rates_in_step_with_the_code_are_warned_of(
    rate_hz: float, phases: int | None
) -> None:
    lines = load("jump-1", {"front_end.sample_rate_hz": rate_hz}).warnings()
    assert len(lines) == (phases is not None)
    if phases is not None:
        assert f"at {phases} phase(s) only" in lines[0]
        # brute force: where the edges of one code period fall between samples, in bins of 1/20
        edges = {round(k * rate_hz / 1.023e6 % 1.0 * 20) % 20 for k in range(1023)}
        assert len(edges) <= 2 * phases


def test_sample_rates_in_step_are_those_of_the_signals() -> None:
    """13.299 MHz is 13 samples per chip of L1C, thus 13/12 per sub-chip of TMBOC: no small ratio.

    12.276e6 * 5/4 is 5/4 per sub-chip of TMBOC; 20.46 MHz is 2 per chip of L5.
    """
    for rate_hz, label, said in (
        (13.299e6, "L1CP", None),
        (15.345e6, "L1CP", "is 5/4 samples per sub-chip of L1CP: the sub-chip edges"),
        (20.46e6, "L5Q", "is 2 samples per chip of L5Q: the chip edges"),
    ):
        changes = {
            "front_end.sample_rate_hz": rate_hz,
            "signals": [label],
            "correlator.spacing_chips": 0.2,
        }
        lines = load("uniform", changes).warnings()
        assert len(lines) == (said is not None)
        assert said is None or said in lines[0]
