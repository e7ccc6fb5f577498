"""The main job: one velocity jump, three filters, the same samples; and the cause switched off."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from signals.front_end import Recording, SyntheticIf
from ultratight import plots, results
from ultratight.results import Run
from ultratight.scenario import InvalidInput, Scenario, load
from ultratight.simulation import run
from ultratight.world import World

PRESET = "jump-1"
FILTERS = ("kf", "qkf", "fiqkf-r")
WARM_UP_S = 4.0
CAUSE = "imu.accel_scale_factor_ppm"


def main(out: Path, seed: int = 1, quiet: bool = False) -> None:
    """Fly, print a table, write figure and results below ``out``.

    Raises
    ------
    InvalidInput
        The folder cannot be made or written.
    """
    began = time.perf_counter()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInput(f"{out}: cannot be made ({error.strerror}), expected a folder") from None
    figure_path = out / f"{PRESET}.png"
    results.check_writable(figure_path, (".png",))
    scenario = load(PRESET, ['correlator.kind="samples"'])
    without = scenario.replace({CAUSE: [0.0, 0.0, 0.0]})
    flights = [
        (name, cause, base.replace({"receiver.filter": name}))
        for cause, base in (("on", scenario), ("off", without))
        for name in FILTERS
    ]
    runs: dict[tuple[str, str], Run] = {}
    with _progress(quiet) as task:
        source = World(scenario, seed).samples
        assert isinstance(source, SyntheticIf)
        report = task("IF samples, generated once")
        recording = source.record(progress=lambda done, of: report(done / of))
        warm_up = task("compiling what is not in the cache yet")
        for k, (_, _, flown) in enumerate(flights[: len(FILTERS)]):
            _warm_up(flown, seed, recording)
            warm_up((k + 1) / len(FILTERS))
        for name, cause, flown in flights:
            label = f"{name}, scale-factor error {cause}"
            runs[name, cause] = run(flown, seed, progress=task(label), samples=recording)
    for (name, cause), flown_run in runs.items():
        flown_run.save(out / f"{PRESET}-{name}-cause-{cause}.nc")
    _draw(runs, scenario, seed, figure_path)
    summary = out / f"{PRESET}.json"
    summary.write_text(
        json.dumps([{"cause": c} | r.summary for (_, c), r in runs.items()], indent=1) + "\n"
    )
    console = Console()
    _print_table(console, runs, scenario, seed)
    console.print(f"figure   {figure_path}", soft_wrap=True)
    console.print(f"results  {out / (PRESET + '-*.nc')}, {summary}", soft_wrap=True)
    console.print(f"time     {time.perf_counter() - began:.0f} s")


def _warm_up(scenario: Scenario, seed: int, samples: Recording) -> None:
    """Fly past the hand-over, so that the flights that are timed compile nothing."""
    short = {"duration_s": WARM_UP_S, "profile": (), "jump_window_s": None}
    run(scenario.replace(short), seed, samples=samples)


def _cause(scenario: Scenario, seed: int) -> str:
    ppm = scenario.imu.accel_scale_factor_ppm
    value = 0.0 if ppm is None else ppm[0]
    sign = -1.0 if scenario.imu.accel_scale_factor_alternates and seed % 2 == 0 else 1.0
    return f"accelerometer scale factor {sign * value:+g} ppm on x"


def _draw(runs: dict[tuple[str, str], Run], scenario: Scenario, seed: int, path: Path) -> None:
    on = [runs[name, "on"] for name in FILTERS]
    off = [runs[name, "off"] for name in FILTERS]
    title = (
        f"{PRESET}: {scenario.title}\nmodel C (coherent), IF samples at "
        f"{scenario.front_end.sample_rate_hz / 1e6:g} Msps, {on[0].summary['n_satellites']} GPS "
        f"satellites at {scenario.cn0_dbhz:g} dB-Hz, fall-back off\n"
        f"cause: {_cause(scenario, seed)} (thin lines: without it)"
    )
    plots.figure(on, controls=off, title=title).savefig(path, dpi=130)


def _print_table(
    console: Console, runs: dict[tuple[str, str], Run], scenario: Scenario, seed: int
) -> None:
    table = Table(
        title=f"{PRESET}: {scenario.title}; model C (coherent), {scenario.cn0_dbhz:g} dB-Hz, "
        "IF samples",
        caption=Text(
            f"cause: {_cause(scenario, seed)}; off: 0 ppm, same samples and noise. before (5 s to "
            "the jump), jump, after (10 s), end (last 2.5 s): velocity error r.m.s. in m/s; "
            "pos.: position error r.m.s. at the end; lost: channels that lost lock; conv.: end "
            "below 0.5 m/s; x r.t.: speed against real time, compiled."
        ),
        padding=(0, 1, 0, 0),
        box=box.SIMPLE,
    )
    for name in ("cause", "filter", "before", "jump", "after", "end", "pos. m", "lost", "conv.",
                 "x r.t."):  # fmt: skip
        justify: Literal["left", "right"] = "left" if name in ("cause", "filter") else "right"
        table.add_column(name, justify=justify, no_wrap=True)
    for (name, cause), flown in runs.items():
        s = flown.summary
        velocity = [f"{v:.3f}" for v in s["velocity_rms_mps"].values()]
        lost = sum(t is not None for t in s["lost_lock_s"].values())
        table.add_row(
            cause, name, *velocity, f"{s['position_rms_end_m']:.2f}",
            f"{lost}/{len(s['lost_lock_s'])}", "yes" if s["converged"] else "no",
            f"{s['realtime_factor']:.1f}",
        )  # fmt: skip
    console.print(table)


Report = Callable[[float], None]


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[str], Report]]:
    """Gives a maker of reports: bars on a terminal, one line per task when piped."""
    if quiet:
        yield lambda text: lambda share: None
        return
    console = Console(stderr=True)
    if not console.is_terminal:

        def announce(text: str) -> Report:
            print(f"{text} ...", file=sys.stderr, flush=True)
            return lambda share: None

        yield announce
        return
    columns = (TextColumn("{task.description:38}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bars:

        def start(text: str) -> Report:
            task = bars.add_task(text, total=1.0)
            return lambda share: bars.update(task, completed=share)

        yield start
