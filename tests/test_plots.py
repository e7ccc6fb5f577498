"""Plots: what is drawn is what the run holds, with units on the axes; nothing is shown or saved."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from ultratight import plots
from ultratight.results import Event, Run, Variable
from ultratight.scenario import load


def make_run(name: str, error_mps: float) -> Run:
    """10 s at 50 Hz, a constant velocity error, three channels of which the second slips."""
    t = np.arange(1, 501) * 0.02
    rng = np.random.default_rng(3)
    v = np.column_stack([200.0 + 10.0 * t, np.zeros_like(t), np.zeros_like(t)])
    channel, dump = np.tile([0, 1, 2], t.size), np.repeat(t, 3)
    taps = rng.standard_normal((2, dump.size, 3)) + 8.0
    xyz = ("t", "xyz")
    return Run(
        scenario=load("jump-1").to_dict(),
        seed=1,
        t_s=t,
        variables={
            "speed_true": Variable(v[:, 0], ("t",), "m/s", "true speed"),
            "v_eb_e_true": Variable(v, xyz, "m/s", "true velocity"),
            "v_eb_e": Variable(v - [0.0, error_mps, 0.0], xyz, "m/s", "velocity"),
            "channel": Variable(
                np.array(["G05:L1CA", "G07:L1CA", "G30:L1CA"]), ("channel",), "", "channel"
            ),
            "dump_channel": Variable(channel, ("dump",), "1", "channel"),
            "dump_end": Variable(dump, ("dump",), "s", "end"),
            "tap_i": Variable(taps[0], ("dump", "tap"), "1", "I"),
            "tap_q": Variable(taps[1], ("dump", "tap"), "1", "Q"),
            "cn0": Variable(np.full((t.size, 3), 35.0), ("t", "channel"), "dB-Hz", "C/N0"),
        },
        events=[
            Event(2.0, "", "hand-over", "differential to coherent"),
            Event(4.0, "G07:L1CA", plots.LOST, "lock indicator 0.2"),
            Event(7.0, "G07:L1CA", plots.REGAINED, "lock indicator 0.7"),
        ],
        summary={"filter": name, "closure": "ultra-tight", "scenario": "jump-1"},
    )


@pytest.fixture
def runs() -> list[Run]:
    return [make_run("kf", 0.5), make_run("fiqkf-r", 0.01)]


def test_velocity_error_is_the_length_of_the_difference(runs: list[Run]) -> None:
    ax = plots.velocity_error(runs, Figure().subplots())
    for line, expected in zip(ax.lines, (0.5, 0.01), strict=True):
        np.testing.assert_allclose(line.get_ydata(), expected, rtol=1e-9)
    assert ax.get_yscale() == "log"
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["KF", "FIQKF-R"]


def test_prompt_of_the_named_channel_is_drawn(runs: list[Run]) -> None:
    ax = plots.channel_iq(runs[0], Figure().subplots(), "G30:L1CA")
    mine = runs[0]["dump_channel"] == 2
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), runs[0]["tap_i"][mine, 1])
    np.testing.assert_array_equal(ax.lines[1].get_ydata(), runs[0]["tap_q"][mine, 1])
    with pytest.raises(ValueError, match="'G01:L1CA' given, expected one of G05"):
        plots.channel_iq(runs[0], Figure().subplots(), "G01:L1CA")


def test_prompts_of_the_rows_stand_in_for_dumps(runs: list[Run]) -> None:
    prompts = np.random.default_rng(4).standard_normal((2, runs[0].t_s.size, 3))
    for name in ("dump_channel", "dump_end", "tap_i", "tap_q"):
        del runs[0].variables[name]
    for name, values in zip(("prompt_i", "prompt_q"), prompts, strict=True):
        runs[0].variables[name] = Variable(values, ("t", "channel"), "1", name)
    page = plots.figure(runs[:1], channel="G30:L1CA")
    ax = next(ax for ax in page.axes if "prompt" in ax.get_ylabel())
    for line, values in zip(ax.lines, prompts, strict=True):
        np.testing.assert_array_equal(line.get_xdata(), runs[0].t_s)
        np.testing.assert_array_equal(line.get_ydata(), values[:, 2])


def test_a_channel_that_pulls_in_is_not_in_lock_before(runs: list[Run]) -> None:
    runs[0].events[1:1] = [Event(0.5, "G07:L1CA", plots.LOCKED, "phase lock indicator 0.7")]
    ax = plots.lock_events(runs[:1], Figure().subplots())
    spans = [tuple(line.get_xdata()) for line in ax.lines if len(line.get_xdata()) == 2]
    assert spans == [(0.0, 10.0), (0.5, 4.0), (7.0, 10.0), (0.0, 10.0)]


def test_a_channel_out_of_lock_leaves_a_gap(runs: list[Run]) -> None:
    ax = plots.lock_events(runs[:1], Figure().subplots())
    spans = [tuple(line.get_xdata()) for line in ax.lines if len(line.get_xdata()) == 2]
    assert spans == [(0.0, 10.0), (0.0, 4.0), (7.0, 10.0), (0.0, 10.0)]


def test_every_axis_of_the_page_has_a_unit_and_ink(runs: list[Run], tmp_path) -> None:
    page = plots.figure(runs, controls=runs)
    labels = [ax.get_ylabel() for ax in page.axes]
    assert [text.split("[")[-1].rstrip("]") for text in labels[:-1]] == [
        "m/s",
        "m/s",
        "noise s.d.",
        "dB-Hz",
    ]
    assert "G07" in labels[2], "the channel that loses lock tells the story"
    assert page.axes[-1].get_xlabel() == "receiver time [s]"
    assert all(ax.lines for ax in page.axes)
    page.savefig(tmp_path / "page.png")
    assert (tmp_path / "page.png").read_bytes().startswith(b"\x89PNG")


def test_a_run_without_taps_and_cn0_still_makes_a_page(runs: list[Run]) -> None:
    for name in ("tap_i", "tap_q", "cn0"):
        del runs[0].variables[name]
    assert len(plots.figure(runs[:1]).axes) == 3
