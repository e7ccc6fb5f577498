"""The command that searches a recording for satellites."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultratight.options import Json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from signals.recording import Recording
    from signals.signal_row import Signal
    from ultratight.tracking.acquisition import Acquisition, Search

FIGURES = (".png", ".pdf", ".svg")
_CLIPPED = 0.01
"""Share of the values at the ends of their type that is worth a word"""
_INVERTED = (
    "the codes run against the carriers, so that Dopplers have the wrong sign: expected samples in "
    "which a carrier above the IF turns counter-clockwise"
)


File = Annotated[Path, typer.Argument(metavar="FILE", help="SigMF name or raw samples")]
Prns = Annotated[
    list[str] | None,
    typer.Option("--prn", metavar="LIST", help="such as 1-32 or 3,7,120-158; default: 1-32"),
]
Doppler = Annotated[float, typer.Option("--doppler-hz", metavar="HZ", help="searched both ways")]
Coherent = Annotated[
    float | None, typer.Option(metavar="MS", help="whole code periods; default: one")
]
Noncoherent = Annotated[
    int, typer.Option(metavar="N", help="coherent sums whose energies are added")
]
FalseAlarm = Annotated[float, typer.Option(metavar="P", help="of finding a PRN that is not there")]
Skip = Annotated[float, typer.Option(metavar="S", help="seconds left out first")]
Form = Annotated[
    str | None, typer.Option("--format", metavar="NAME", help="of a raw file, e.g. ci8")
]
Rate = Annotated[float | None, typer.Option(metavar="HZ", help="of a raw file")]
IfHz = Annotated[
    float | None, typer.Option("--if-hz", metavar="HZ", help="where the carrier stands")
]
SwapIq = Annotated[bool, typer.Option("--swap-iq", help="the file has Q before I")]
Conjugate = Annotated[bool, typer.Option("--conjugate", help="the file has -Q for Q")]
Plot = Annotated[Path | None, typer.Option(metavar="FILE", help="write a figure (png, pdf, svg)")]


def acquire(
    file: File,
    prn: Prns = None,
    signal_name: Annotated[
        str, typer.Option("--signal", metavar="NAME", help="such as L1CA, L1CD, L5Q, E1C")
    ] = "L1CA",
    doppler_hz: Doppler = 5000.0,
    coherent_ms: Coherent = None,
    noncoherent: Noncoherent = 10,
    doppler_step_hz: Annotated[
        float | None,
        typer.Option("--doppler-step-hz", metavar="HZ", help="at most; default: half a sum's"),
    ] = None,
    false_alarm: FalseAlarm = 1e-3,
    skip: Skip = 0.0,
    form: Form = None,
    rate: Rate = None,
    if_hz: IfHz = None,
    swap_iq: SwapIq = False,
    conjugate: Conjugate = False,
    galileo_codes: Annotated[
        Path | None, typer.Option(metavar="FILE", help="memory codes of E1B and E1C (CSV)")
    ] = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Find the satellites in an IF file.

    Prints Doppler, code phase at the first sample and C/N0. The peak of each PRN is compared
    with the noise that its own search shows; a PRN that is not there is found with the probability
    --false-alarm.
    """
    from signals.codes import signal
    from signals.sigmf_files import open_recording
    from ultratight.results import check_writable
    from ultratight.tracking import acquisition

    if plot:
        check_writable(plot, FIGURES)
    row = signal(signal_name, galileo_codes)
    search = acquisition.Search(
        doppler_hz=doppler_hz,
        coherent_s=None if coherent_ms is None else coherent_ms * 1e-3,
        noncoherent=noncoherent,
        doppler_step_hz=doppler_step_hz,
        false_alarm=false_alarm,
    )
    prns = numbers_of(prn)
    recording = open_recording(
        file, sample_format=form, sample_rate_hz=rate, if_hz=if_hz,
        swap_iq=swap_iq, conjugate=conjugate,
    )  # fmt: skip
    first = first_sample_of(skip, recording)
    rows = acquisition.acquire(recording, row, prns, search, first)
    warnings = warnings_of(recording, row, rows)
    if plot:
        from ultratight import plots_acquisition as plots

        best = max(rows, key=lambda row: row.peak).prn
        surface = acquisition.surface(recording, row, best, search, first)
        write_figure(plot, plots.figure(rows, surface, best, title_of(recording, first)))
    if as_json:
        print(json.dumps(_told(recording, rows, row.label, search, warnings)))
        return
    print("\n".join(table_of(rows, recording)))
    if plot:
        print(f"written: {plot}")


def warnings_of(recording: Recording, row: Signal, rows: Sequence[Acquisition]) -> list[str]:
    """What is odd about the samples, also to stderr."""
    from ultratight.tracking.acquisition import Misfit, alike, misfit

    lines = _clipped(recording)
    same = alike(row, rows)
    if same:
        lines.append(
            f"{recording.name}: {same} of {sum(r.found for r in rows)} satellites share a Doppler "
            f"modulo {0.5 * row.chip_rate_hz / row.length_chips:g} Hz: one strong signal or line "
            "seen through all codes; are --format, --rate and --if-hz right?"
        )
    wrong = Misfit(False, 0.0) if same else misfit(recording, row, rows)
    if wrong.inverted:
        lines.append(f"{recording.name}: {_INVERTED}; try --conjugate, or without it")
    if wrong.offset_hz:
        lines.append(
            f"{recording.name}: the carriers stand {wrong.offset_hz / 1e3:+.1f} kHz from where the "
            f"codes say, all alike, expected at the IF of {recording.if_hz:g} Hz; try --if-hz "
            f"{recording.if_hz + wrong.offset_hz:.0f}"
        )
    for line in lines:
        print(f"warning: {line}", file=sys.stderr)
    return lines


def numbers_of(lists: Sequence[str] | None) -> list[int] | None:
    """1-3,7 as 1, 2, 3, 7."""
    if lists is None:
        return None
    numbers: list[int] = []
    for part in ",".join(lists).split(","):
        low, dash, high = part.strip().partition("-")
        if not (low.isdecimal() and (high.isdecimal() if dash else not high)):
            raise ValueError(f"--prn: {part!r} given, expected numbers and ranges such as 1-32,120")
        last = int(high) if dash else int(low)
        if not int(low) <= last <= 1000:
            raise ValueError(f"--prn: {part!r} given, expected a range that rises, below 1000")
        numbers.extend(range(int(low), last + 1))
    return numbers


def first_sample_of(seconds: float, recording: Recording) -> int:
    """Number of the first sample to be used."""
    if not 0.0 <= seconds <= len(recording) / recording.sample_rate_hz:
        raise ValueError(
            f"--skip: {seconds:g} given, expected 0 to "
            f"{len(recording) / recording.sample_rate_hz:g}, what {recording.name} has"
        )
    return recording.first_sample + round(seconds * recording.sample_rate_hz)


def _clipped(recording: Recording) -> list[str]:
    """A line if many values are at the ends of what their type holds."""
    import numpy as np

    form, kind = recording.format, recording.format.value_dtype
    if form.packed or kind.kind != "i":
        return []
    values = np.concatenate(list(recording.spread()))
    ends = np.iinfo(kind)
    share = float(np.mean((values <= ends.min + 1) | (values >= ends.max)))
    if share < _CLIPPED:
        return []
    return [
        f"{recording.name}: clipped, {share:.1%} of the values are at the ends of {form.name}, "
        f"{np.iinfo(form.dtype).min} and {np.iinfo(form.dtype).max}; expected below {_CLIPPED:.0%}"
    ]


def _told(
    recording: Recording,
    rows: Sequence[Acquisition],
    label: str,
    search: Search,
    warnings: list[str],
) -> dict[str, Any]:
    """What --json prints: numbers that mean nothing are null."""
    return {
        "file": recording.name,
        "format": recording.format.name,
        "rate_hz": recording.sample_rate_hz,
        "if_hz": recording.if_hz,
        "signal": label,
        "sample_index": rows[0].sample_index,
        "false_alarm": search.false_alarm,
        "found": [row.prn for row in rows if row.found],
        "satellites": [
            {
                "prn": row.prn,
                "found": row.found,
                "doppler_hz": row.doppler_hz if row.found else None,
                "code_phase_chips": row.code_phase_chips if row.found else None,
                "cn0_dbhz": row.cn0_dbhz if row.found else None,
                "peak": row.peak,
                "threshold": row.threshold,
            }
            for row in rows
        ],
        "warnings": warnings,
    }


def table_of(rows: Sequence[Acquisition], recording: Recording) -> list[str]:
    lines = ["  PRN  Doppler [Hz]  code phase [chips]  C/N0 [dB-Hz]  peak / threshold"]
    for row in rows:
        ratio = f"{row.peak / row.threshold:16.2f}"
        if row.found:
            at = f"{row.doppler_hz:12.1f}  {row.code_phase_chips:18.2f}  {row.cn0_dbhz:12.1f}"
        else:
            at = f"{'-':>12}  {'-':>18}  {'-':>12}"
        lines.append(f"{row.prn:5}  {at}  {ratio}")
    n = sum(row.found for row in rows)
    lines.append(f"{n} of {len(rows)} found; code phases are at sample {rows[0].sample_index}")
    if not n:
        r = recording
        lines.append(
            f"{r.name}: no satellite found as {r.format.name} at {r.sample_rate_hz:g} samples/s "
            f"with the IF at {r.if_hz:g} Hz; if the sky was open one of these is wrong, or the "
            "order or the sign of Q (--format, --rate, --if-hz, --swap-iq, --conjugate)"
        )
    return lines


def title_of(recording: Recording, first: int) -> str:
    return f"{Path(recording.name).name}, from sample {first} on"


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure, whole or not at all."""
    part = path.with_name(f".{path.name}.part")
    try:
        figure.savefig(part, format=path.suffix[1:].lower(), dpi=150)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
