"""Plots: what is drawn is what the run holds, with units on the axes; nothing is shown or saved."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from ultratight import plots, plots_text
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
        summary={
            "filter": name,
            "closure": "ultra-tight",
            "scenario": "jump-1",
            "lost_lock_s": {"G05:L1CA": None, "G07:L1CA": 4.0, "G30:L1CA": None},
            "converged": error_mps < 0.5,
        },
    )


def make_scalar_run(events: list[Event]) -> Run:
    """The same with the scalar closure, whose rows have the prompts of whole bits."""
    base = make_run("", 0.1)
    for name in ("dump_channel", "dump_end", "tap_i", "tap_q"):
        del base.variables[name]
    prompts = np.random.default_rng(4).standard_normal((2, base.t_s.size, 3))
    for name, values in zip(("prompt_i", "prompt_q"), prompts, strict=True):
        base.variables[name] = Variable(values, ("t", "channel"), "1", name)
    return replace(
        base,
        scenario=load("jump-1", {"receiver.closure": "scalar"}).to_dict(),
        events=events,
        summary=base.summary | {"filter": None, "closure": "scalar"},
    )


def bars(ax: Axes, colour: str = plots.COLOURS[0]) -> dict[str, list[tuple[float, float]]]:
    """Row of the lock panel -> spans (start, stop) of its bars in this colour."""
    rows = [(text.get_position()[1], text.get_text()) for text in ax.get_yticklabels()]
    found: dict[str, list[tuple[float, float]]] = {name: [] for _, name in rows}
    for line in ax.lines:
        if (
            len(line.get_xdata()) == 2
            and line.get_color() == colour
            and line.get_marker() == "None"
        ):
            assert line.get_solid_capstyle() == "butt", "a bar reaches past its end"
            y = line.get_ydata()[0]
            name = min(rows, key=lambda row: abs(row[0] - y))[1]
            found[name].append(tuple(map(float, line.get_xdata())))
    return found


def crosses(ax: Axes) -> list[tuple[float, float]]:
    """(t_s, row) of all marks of loss."""
    lines = [line for line in ax.lines if line.get_marker() == "x"]
    return [point for line in lines for point in zip(*line.get_data(), strict=True)]


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


def test_prompts_of_the_rows_stand_in_for_dumps() -> None:
    run = make_scalar_run([])
    ax = plots.channel_iq(run, Figure().subplots(), "G30:L1CA")
    for line, name in zip(ax.lines, ("prompt_i", "prompt_q"), strict=True):
        np.testing.assert_array_equal(line.get_xdata(), run.t_s)
        np.testing.assert_array_equal(line.get_ydata(), run[name][:, 2])
    assert "over 20 ms" in ax.get_title(loc="left")


def test_a_channel_out_of_lock_leaves_a_gap(runs: list[Run]) -> None:
    ax = plots.lock_events(runs[:1], Figure().subplots())
    assert bars(ax) == {
        "G05": [(0.0, 10.0)],
        "G07": [(0.0, 4.0), (7.0, 10.0)],
        "G30": [(0.0, 10.0)],
        "coherent": [(2.0, 10.0)],
    }
    assert crosses(ax) == [(4.0, 1.0)]


def test_a_scalar_channel_is_in_lock_from_its_first_phase_lock() -> None:
    run = make_scalar_run(
        [
            Event(0.3, "G05:L1CA", "frequency lock", ""),
            Event(0.7, "G05:L1CA", plots.LOCKED, ""),
            Event(0.8, "G07:L1CA", plots.LOCKED, ""),
            Event(2.3, "G30:L1CA", plots.LOST, "no lock within 2.3 s"),
            Event(4.0, "G07:L1CA", plots.LOST, ""),
            Event(4.5, "G07:L1CA", "frequency lock", ""),
            Event(5.0, "G07:L1CA", plots.LOCKED, ""),
        ]
    )
    ax = plots.lock_events([run], Figure().subplots())
    expected = {"G05": [(0.7, 10.0)], "G07": [(0.8, 4.0), (5.0, 10.0)], "G30": []}
    assert bars(ax) == expected, "and there is no row of a receiver that never measures coherently"
    assert sorted(crosses(ax)) == [(2.3, 2.0), (4.0, 1.0)]


def test_a_diverged_receiver_has_no_lock(runs: list[Run]) -> None:
    runs[0].events.append(Event(8.0, "", plots.DIVERGED, "not finite"))
    ax = plots.lock_events(runs[:1], Figure().subplots())
    assert {spans[-1] for spans in bars(ax).values()} == {(0.0, 8.0), (7.0, 8.0), (2.0, 8.0)}


def test_legend_tells_the_marks_that_there_are(runs: list[Run]) -> None:
    runs[1].events[2:] = [Event(5.0, "", plots.BACK, ""), Event(7.0, "", plots.OVER, "")]
    ax = plots.lock_events(runs, Figure().subplots())
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts == ["KF", "FIQKF-R", "loss of lock", "hand-over", "fall-back"]
    assert bars(ax, plots.COLOURS[1])["coherent"] == [(2.0, 5.0), (7.0, 10.0)]


def test_acceleration_of_the_scenario_is_shaded_in_every_panel(runs: list[Run]) -> None:
    page = plots.figure(runs[:1])
    for ax in page.axes:
        (shade,) = ax.patches
        assert (shade.get_x(), shade.get_x() + shade.get_width()) == (20.0, 30.0)  # jump-1
    named = [t.get_text() for ax in page.axes for t in ax.get_legend().get_texts()]
    assert named.count("acceleration") == 1


def test_logarithmic_axis_labels_whole_decades(runs: list[Run]) -> None:
    ax = plots.velocity_error(runs[:1], Figure().subplots())
    low, high = np.log10(ax.get_ylim())
    assert low == round(low)
    assert high - low >= plots.DECADES
    ticks = np.log10(ax.get_yticks())
    assert {*np.arange(low, high + 0.5)} <= {*np.round(ticks, 9)}


def test_controls_that_coincide_have_markers_in_turn(runs: list[Run]) -> None:
    ax = plots.velocity_error(runs, Figure().subplots(), controls=[runs[0], runs[0]])
    first, second = ax.lines[2:]
    np.testing.assert_array_equal(first.get_ydata(), second.get_ydata())
    (a, step), (b, _) = first.get_markevery(), second.get_markevery()
    assert 0 < b - a < step
    assert first.get_marker() != second.get_marker()


def test_every_axis_of_the_page_has_a_unit_and_ink(runs: list[Run], tmp_path: Path) -> None:
    runs[1].events[1:] = []
    page = plots.figure(runs, controls=runs)
    units = [ax.get_ylabel().partition("[")[2].rstrip("]") for ax in page.axes]
    assert units == ["m/s", "m/s", "noise s.d.", "noise s.d.", "dB-Hz", ""]
    headings = [ax.get_title(loc="left") for ax in page.axes]
    assert headings[2].startswith("G07, KF"), "the channel that loses lock tells the story"
    assert headings[3].startswith("G07, FIQKF-R"), "and how the last run did there"
    assert page.axes[-1].get_xlabel() == "receiver time [s]"
    assert all(ax.lines for ax in page.axes)
    page.savefig(tmp_path / "page.png")
    assert (tmp_path / "page.png").read_bytes().startswith(b"\x89PNG")


def test_nothing_on_the_page_overlaps(runs: list[Run]) -> None:
    """Title, panels, headings and legends have rectangles of their own, inside the page."""
    page = plots.figure([runs[0], *runs, runs[1]], controls=[*runs, *runs])
    canvas = FigureCanvasAgg(page)
    canvas.draw()
    draw = canvas.get_renderer()
    boxes = [t.get_window_extent(draw) for t in page.texts]
    for ax in page.axes:
        boxes += [ax.get_window_extent(draw), ax.get_legend().get_window_extent(draw)]
        heading = [t for t in ax.get_children() if isinstance(t, Text) and t.get_text()]
        boxes += [t.get_window_extent(draw) for t in heading]
    assert len(boxes) == 1 + 2 * 6 + 3
    for k, a in enumerate(boxes):
        assert a.x0 >= 0.0
        assert a.x1 <= page.bbox.x1
        for b in boxes[k + 1 :]:
            # a pixel is what neighbours may share
            assert min(a.x1, b.x1) - max(a.x0, b.x0) < 1 or min(a.y1, b.y1) - max(a.y0, b.y0) < 1


def test_a_run_without_taps_and_cn0_still_makes_a_page(runs: list[Run]) -> None:
    for name in ("tap_i", "tap_q", "cn0"):
        del runs[0].variables[name]
    assert len(plots.figure(runs[:1]).axes) == 3


def test_page_says_what_was_flown_and_how_it_ended(runs: list[Run]) -> None:
    without = make_run("kf", 0.01)
    without.scenario["imu"]["accel_scale_factor_ppm"] = [0.0, 0.0, 0.0]
    assert "+3000 ppm on x (the cause)" in plots.figure(runs, controls=[without]).get_suptitle()
    text = plots.figure(runs).get_suptitle()
    assert "the cause" not in text
    assert "+100 m/s² from 20 s" in text
    assert "ultra-tight" in text
    assert "(KF, FIQKF-R)" in text
    assert text.endswith(plots_text.outcome(runs, ["KF", "FIQKF-R"]))


def test_closures_keep_their_case_and_filters_are_acronyms(runs: list[Run]) -> None:
    run = make_scalar_run([])
    assert [plots.label(r) for r in (run, *runs)] == ["scalar", "KF", "FIQKF-R"]
    assert plots.label(replace(run, summary={"closure": "scalar-ins"})) == "scalar-INS"
    assert plots.label(replace(run, summary={"filter": "MyFilter"})) == "MyFilter"


def fate(run: Run, n_lost: int, converged: bool, fall_backs: int = 0) -> Run:
    lost = {f"G{k:02d}": 1.0 if k < n_lost else None for k in range(10)}
    told = {"lost_lock_s": lost, "converged": converged, "fall_backs": fall_backs}
    return replace(run, summary=run.summary | told)


def test_outcome_groups_runs_that_fared_alike(runs: list[Run]) -> None:
    bad, good = fate(runs[0], 10, False), fate(runs[1], 0, True)
    told = plots_text.outcome([bad, bad, good], ["KF", "QKF", "FIQKF-R"], [good, good, good])
    assert told == (
        "KF, QKF: 10 of 10 channels lost lock, not converged; FIQKF-R: 0 of 10, converged; "
        "without the cause all converge, none loses lock"
    )


def test_outcome_tells_of_controls_that_fail_and_of_fall_backs(runs: list[Run]) -> None:
    run, control = fate(runs[0], 3, True, fall_backs=2), fate(runs[0], 1, False)
    assert plots_text.outcome([run], ["KF"], [control]) == (
        "KF: 3 of 10 channels lost lock, 2 fall-backs, converged; "
        "without the cause KF: 1 of 10 channels lost lock, not converged"
    )
    alone = plots_text.outcome([run], ["KF"], [fate(runs[0], 0, True)])
    assert alone.endswith("; without the cause it converges, no loss of lock")
    assert plots_text.outcome([replace(run, summary={})], ["KF"]) == ""
