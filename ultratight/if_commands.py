"""The commands that write and read IF files."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from ultratight.options import (
    Json,
    Navigation,
    Override,
    Quiet,
    Seed,
    Source,
    interruptible,
    progress,
)

_NO_ATTITUDE = (
    "a trajectory has no attitude: the IMU's body axes stay north-east-down of the first point; "
    "give track --attitude 0,0,0"
)


def generate(
    source: Source,
    out: Annotated[
        Path, typer.Option(metavar="NAME", help="files NAME.sigmf-data, -meta and .truth.nc")
    ],
    duration: Annotated[float, typer.Option(metavar="S", help="length of the file in seconds")],
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="sampling rate")] = None,
    if_hz: Annotated[
        float | None, typer.Option("--if-hz", metavar="HZ", help="where L1 stands in the file")
    ] = None,
    form: Annotated[
        str,
        typer.Option(
            "--format", metavar="NAME", help="ci8 ci16 cf32 cu8 ci1p ci2p ci4p; real: ri8 and so on"
        ),
    ] = "ci8",
    start: Annotated[
        str | None, typer.Option(metavar="WEEK:TOW", help="GPS time of the first sample")
    ] = None,
    rms: Annotated[
        float | None, typer.Option(metavar="X", help="noise in each value, in units of the file")
    ] = None,
    trajectory: Annotated[
        Path | None, typer.Option(metavar="FILE", help="positions over time (CSV), no attitude")
    ] = None,
    changes: Override = None,
    nav: Navigation = None,
    seed: Seed = 1,
    imu: Annotated[
        bool,
        typer.Option(
            "--imu",
            help="NAME.imu.csv too: what the scenario's IMU measures; with --trajectory in axes "
            "that stay north-east-down of the first point",
        ),
    ] = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="start anew: leave out what a cut short run has kept")
    ] = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write an IF file for other receivers, and its truth.

    Samples are I + jQ, I first; a carrier above the centre of the file turns counter-clockwise,
    positive Doppler raises it, L1 stands at --if-hz. The data bits are the navigation message of
    the constellation. A preset is taken with 45 dB-Hz, unless --set cn0_dbhz says otherwise.
    What was cut short goes on by the same command, to the same files.
    """
    from ultratight import generate as files

    with interruptible():
        chosen = files.scenario_for(
            source, changes or [], duration, rate, if_hz, start, trajectory, nav
        )
        plan = files.plan(
            chosen, seed, out, duration_s=duration, form=form, rms=rms, fresh=fresh, imu=imu
        )
        if imu and chosen.trajectory and not quiet:
            print(_NO_ATTITUDE, file=sys.stderr)
        if plan.kept.seconds and not quiet:
            name = plan.places.samples.name
            print(f"{name}: goes on after {plan.kept.seconds} s", file=sys.stderr)
        with progress(f"writing {plan.samples.name}", quiet) as report:
            made = files.generate(plan, report)
    if as_json:
        print(json.dumps(made))
    elif not quiet:
        for key in ("samples", "metadata", "truth", "imu"):
            if made[key]:
                print(f"written: {made[key]}")


def info(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="SigMF name or raw samples")],
    form: Annotated[
        str | None, typer.Option("--format", metavar="NAME", help="of a raw file, e.g. ci8")
    ] = None,
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="of a raw file")] = None,
    if_hz: Annotated[float | None, typer.Option("--if-hz", metavar="HZ")] = None,
    as_json: Json = False,
) -> None:
    """Show what an IF file holds.

    Format, rate, IF, length, mean, r.m.s. and how often each level occurs.
    """
    from signals.sigmf_files import open_recording
    from signals.statistics import summary

    recording = open_recording(file, sample_format=form, sample_rate_hz=rate, if_hz=if_hz)
    told = summary(recording)
    if as_json:
        print(json.dumps(told))
        return
    for key, (name, unit) in _INFO.items():
        values = told[key] if isinstance(told[key], list) else [told[key]]
        numbers = ", ".join(f"{v:.10g}" if isinstance(v, float) else str(v) for v in values)
        print(f"{name:20} {numbers} {unit}".rstrip())
    for level, share in told["levels"].items():
        print(f"{'level ' + level:20} {share:.4f} of the values")


_INFO = {
    "format": ("format", ""),
    "rate_hz": ("rate", "Hz"),
    "if_hz": ("IF", "Hz"),
    "n_samples": ("length", "samples"),
    "duration_s": ("duration", "s"),
    "sigma": ("noise sigma", "in units of the file, of each of I and Q"),
    "mean": ("mean", "in units of the file"),
    "rms": ("r.m.s. about it", "in units of the file"),
    "measured_samples": ("measured on", "samples"),
}
"""Name and unit of each line of `info`"""
