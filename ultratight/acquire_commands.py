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
    from signals.recording import Recording
    from ultratight.tracking.acquisition import Acquisition, Search

_FIGURES = (".png", ".pdf", ".svg")
_CLIPPED = 0.01
"""Share of the values at the ends of their type that is worth a word"""
_INVERTED = (
    "the codes run against the carriers, so that Dopplers have the wrong sign: expected samples in "
    "which a carrier above the IF turns counter-clockwise"
)


def acquire(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="SigMF name or raw samples")],
    prn: Annotated[
        list[str] | None,
        typer.Option("--prn", metavar="LIST", help="such as 1-32 or 3,7,120-158; default: 1-32"),
    ] = None,
    signal_name: Annotated[
        str, typer.Option("--signal", metavar="NAME", help="such as L1CA, L1CD, L5Q, E1C")
    ] = "L1CA",
    doppler_hz: Annotated[
        float, typer.Option("--doppler-hz", metavar="HZ", help="searched both ways")
    ] = 5000.0,
    coherent_ms: Annotated[
        float | None, typer.Option(metavar="MS", help="whole code periods; default: one")
    ] = None,
    noncoherent: Annotated[
        int, typer.Option(metavar="N", help="coherent sums whose energies are added")
    ] = 10,
    doppler_step_hz: Annotated[
        float | None,
        typer.Option("--doppler-step-hz", metavar="HZ", help="at most; default: half a sum's"),
    ] = None,
    false_alarm: Annotated[
        float, typer.Option(metavar="P", help="of finding a PRN that is not there")
    ] = 1e-3,
    skip: Annotated[float, typer.Option(metavar="S", help="seconds left out first")] = 0.0,
    form: Annotated[
        str | None, typer.Option("--format", metavar="NAME", help="of a raw file, e.g. ci8")
    ] = None,
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="of a raw file")] = None,
    if_hz: Annotated[
        float | None, typer.Option("--if-hz", metavar="HZ", help="where the carrier stands")
    ] = None,
    swap_iq: Annotated[bool, typer.Option("--swap-iq", help="the file has Q before I")] = False,
    conjugate: Annotated[bool, typer.Option("--conjugate", help="the file has -Q for Q")] = False,
    galileo_codes: Annotated[
        Path | None, typer.Option(metavar="FILE", help="memory codes of E1B and E1C (CSV)")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="write a figure (png, pdf, svg)")
    ] = None,
    as_json: Json = False,
) -> None:
    """Find the satellites in an IF file: Doppler, code phase at the first sample, C/N0.

    The peak of each PRN is compared with the noise that its own search shows; a PRN that is not
    there is found with the probability --false-alarm.
    """
    from signals.codes import signal
    from signals.sigmf_files import open_recording
    from ultratight.results import check_writable
    from ultratight.tracking import acquisition

    if plot:
        check_writable(plot, _FIGURES)
    row = signal(signal_name, galileo_codes)
    search = acquisition.Search(
        doppler_hz=doppler_hz,
        coherent_s=None if coherent_ms is None else coherent_ms * 1e-3,
        noncoherent=noncoherent,
        doppler_step_hz=doppler_step_hz,
        false_alarm=false_alarm,
    )
    prns = None if prn is None else _numbers(prn)
    recording = open_recording(
        file, sample_format=form, sample_rate_hz=rate, if_hz=if_hz,
        swap_iq=swap_iq, conjugate=conjugate,
    )  # fmt: skip
    first = recording.first_sample + _skipped(skip, recording)
    rows = acquisition.acquire(recording, row, prns, search, first)
    warnings = _clipped(recording)
    if acquisition.is_inverted(recording, row, rows):
        warnings.append(f"{recording.name}: {_INVERTED}; try --conjugate, or without it")
    for line in warnings:
        print(f"warning: {line}", file=sys.stderr)
    if plot:
        best = acquisition.surface(recording, row, _best(rows).prn, search, first)
        _draw(plot, recording, rows, best)
    told = _told(recording, rows, row.label, search, warnings)
    if as_json:
        print(json.dumps(told))
        return
    print("\n".join(_table(rows, recording)))
    if plot:
        print(f"written: {plot}")


def _numbers(lists: Sequence[str]) -> list[int]:
    """1-3,7 as 1, 2, 3, 7."""
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


def _skipped(seconds: float, recording: Recording) -> int:
    if not 0.0 <= seconds <= len(recording) / recording.sample_rate_hz:
        raise ValueError(
            f"--skip: {seconds:g} given, expected 0 to "
            f"{len(recording) / recording.sample_rate_hz:g}, what {recording.name} has"
        )
    return round(seconds * recording.sample_rate_hz)


def _clipped(recording: Recording) -> list[str]:
    """A line if many values are at the ends of what their type holds."""
    import numpy as np

    kind = recording.format.dtype
    if recording.format.packed or kind.kind != "i":
        return []
    values = np.concatenate(list(recording.spread()))
    ends = np.iinfo(kind)
    share = float(np.mean((values <= ends.min + 1) | (values >= ends.max)))
    if share < _CLIPPED:
        return []
    return [
        f"{recording.name}: clipped, {share:.1%} of the values are at the ends of "
        f"{recording.format.name}, {ends.min} and {ends.max}; expected below {_CLIPPED:.0%}"
    ]


def _best(rows: Sequence[Acquisition]) -> Acquisition:
    return max(rows, key=lambda row: row.peak)


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


def _table(rows: Sequence[Acquisition], recording: Recording) -> list[str]:
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


def _draw(path: Path, recording: Recording, rows: Sequence[Acquisition], of_best: Any) -> None:
    """Write the figure, whole or not at all."""
    from ultratight import plots_acquisition

    part = path.with_name(f".{path.name}.part")
    title = f"{Path(recording.name).name}, from sample {rows[0].sample_index} on"
    try:
        figure = plots_acquisition.figure(rows, of_best, _best(rows).prn, title)
        figure.savefig(part, format=path.suffix[1:].lower(), dpi=150)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
