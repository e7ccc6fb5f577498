"""The commands that search a recording for satellites, and track them."""

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
    from ultratight.tracking.from_samples import Tracks

_FIGURES = (".png", ".pdf", ".svg")
_CLIPPED = 0.01
"""Share of the values at the ends of their type that is worth a word"""
_SHOWN_BITS = 30
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
        check_writable(plot, _FIGURES)
    row = signal(signal_name, galileo_codes)
    search = acquisition.Search(
        doppler_hz=doppler_hz,
        coherent_s=None if coherent_ms is None else coherent_ms * 1e-3,
        noncoherent=noncoherent,
        doppler_step_hz=doppler_step_hz,
        false_alarm=false_alarm,
    )
    prns = _numbers(prn)
    recording = open_recording(
        file, sample_format=form, sample_rate_hz=rate, if_hz=if_hz,
        swap_iq=swap_iq, conjugate=conjugate,
    )  # fmt: skip
    first = _skipped(skip, recording)
    rows = acquisition.acquire(recording, row, prns, search, first)
    warnings = _warnings(recording, row, rows)
    if plot:
        from ultratight import plots_acquisition as plots

        best = max(rows, key=lambda row: row.peak).prn
        surface = acquisition.surface(recording, row, best, search, first)
        _write(plot, plots.figure(rows, surface, best, _title(recording, first)))
    if as_json:
        print(json.dumps(_told(recording, rows, row.label, search, warnings)))
        return
    print("\n".join(_table(rows, recording)))
    if plot:
        print(f"written: {plot}")


def track(
    file: File,
    duration: Annotated[
        float | None, typer.Option(metavar="S", help="at most, after --skip; default: all")
    ] = None,
    prn: Prns = None,
    doppler_hz: Doppler = 5000.0,
    coherent_ms: Coherent = None,
    noncoherent: Noncoherent = 10,
    false_alarm: FalseAlarm = 1e-3,
    skip: Skip = 0.0,
    bandwidth_hz: Annotated[
        float, typer.Option("--bandwidth-hz", metavar="HZ", help="of the phase loops")
    ] = 18.0,
    integration_ms: Annotated[
        float, typer.Option("--integration-ms", metavar="MS", help="1, 2, 4, 5, 10 or 20")
    ] = 5.0,
    form: Form = None,
    rate: Rate = None,
    if_hz: IfHz = None,
    swap_iq: SwapIq = False,
    conjugate: Conjugate = False,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Track the GPS satellites in an IF file.

    Those found are tracked to its end. Every channel finds its own bit edges and has its own phase
    and code loop. Bits are those whose 20 ms were tracked; each channel's sign is unknown.
    """
    from signals.codes import GPS_L1CA
    from signals.sigmf_files import open_recording
    from ultratight.results import check_writable
    from ultratight.tracking import acquisition, from_samples

    if plot:
        check_writable(plot, _FIGURES)
    search = acquisition.Search(
        doppler_hz=doppler_hz,
        coherent_s=None if coherent_ms is None else coherent_ms * 1e-3,
        noncoherent=noncoherent,
        false_alarm=false_alarm,
    )
    settings = from_samples.SETTINGS._replace(
        bandwidth_hz=bandwidth_hz, integration_s=integration_ms * 1e-3
    )
    prns = _numbers(prn)
    recording = open_recording(
        file, sample_format=form, sample_rate_hz=rate, if_hz=if_hz,
        swap_iq=swap_iq, conjugate=conjugate,
    )  # fmt: skip
    first = _skipped(skip, recording)
    end = recording.end_sample
    if duration is not None:
        if not 0.0 < duration < 1e6:
            raise ValueError(f"--duration: {duration:g} given, expected more than 0 s")
        end = min(end, first + round(duration * recording.sample_rate_hz))
    rows = acquisition.acquire(recording, GPS_L1CA, prns, search, first)
    warnings = _warnings(recording, GPS_L1CA, rows)
    found = [row for row in rows if row.found]
    tracks = from_samples.track(recording, found, end, settings)
    if plot:
        from ultratight import plots_acquisition as plots

        _write(plot, plots.tracks(tracks, _title(recording, first)))
    told = _tracked(recording, tracks, [row.prn for row in found], warnings)
    if as_json:
        print(json.dumps(told))
        return
    print("\n".join(_table_of_tracks(told)) if found else _table(rows, recording)[-1])
    if plot:
        print(f"written: {plot}")


def _warnings(recording: Recording, row: Signal, rows: Sequence[Acquisition]) -> list[str]:
    """What is odd about the samples, also to stderr."""
    from ultratight.tracking.acquisition import is_inverted

    lines = _clipped(recording)
    if is_inverted(recording, row, rows):
        lines.append(f"{recording.name}: {_INVERTED}; try --conjugate, or without it")
    for line in lines:
        print(f"warning: {line}", file=sys.stderr)
    return lines


def _tracked(
    recording: Recording, tracks: Tracks, found: list[int], warnings: list[str]
) -> dict[str, Any]:
    """What --json prints."""
    satellites = []
    for i, prn in enumerate(tracks.prn.tolist()):
        rows = tracks.channel == i
        sums, _ = tracks.bits(i)
        late = tracks.iq[rows, 1][-100:]
        satellites.append(
            {
                "prn": prn,
                "edge_probability": float(tracks.edge_probability[i]),
                "doppler_hz": float(tracks.doppler_hz[rows][-100:].mean()),
                "cn0_dbhz": float(tracks.cn0_dbhz[i]),
                "phase_lock": float(tracks.phase_lock[i]),
                "locked": bool(tracks.locked[i]),
                "prompt_i_rms": float((late.real**2).mean() ** 0.5),
                "prompt_q_rms": float((late.imag**2).mean() ** 0.5),
                "bits": "".join("1" if z.real < 0.0 else "0" for z in sums),
            }
        )
    return {
        "file": recording.name,
        "end_s": float(tracks.t_s.max(initial=0.0)),
        "found": found,
        "not_synchronised": [prn for prn in found if prn not in tracks.prn],
        "satellites": satellites,
        "events": [
            {"t_s": t, "prn": int(tracks.prn[i]), "kind": kind, "reason": reason}
            for t, i, kind, reason in tracks.events
        ],
        "warnings": warnings,
    }


def _table_of_tracks(told: dict[str, Any]) -> list[str]:
    lines = ["  PRN  Doppler [Hz]  C/N0 [dB-Hz]  I r.m.s.  Q r.m.s.  bits, up to their sign"]
    for s in told["satellites"]:
        bits = s["bits"] if len(s["bits"]) <= _SHOWN_BITS else s["bits"][:_SHOWN_BITS] + "..."
        lines.append(
            f"{s['prn']:5}  {s['doppler_hz']:12.1f}  {s['cn0_dbhz']:12.1f}  "
            f"{s['prompt_i_rms']:8.2f}  {s['prompt_q_rms']:8.2f}  {bits}"
        )
    lost = ", ".join(str(prn) for prn in told["not_synchronised"])
    lines.append(
        f"{len(told['satellites'])} tracked to {told['end_s']:.3f} s; prompts of 1 ms, the last "
        "0.1 s, in standard deviations of the noise"
    )
    if lost:
        lines.append(f"no sure bit edge, not tracked: {lost}")
    for e in told["events"]:
        if e["kind"] == "loss of lock":
            lines.append(f"{e['t_s']:9.3f} s  PRN {e['prn']}  {e['kind']}  {e['reason']}")
    return lines


def _numbers(lists: Sequence[str] | None) -> list[int] | None:
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


def _skipped(seconds: float, recording: Recording) -> int:
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


def _title(recording: Recording, first: int) -> str:
    return f"{Path(recording.name).name}, from sample {first} on"


def _write(path: Path, figure: Figure) -> None:
    """Write a figure, whole or not at all."""
    part = path.with_name(f".{path.name}.part")
    try:
        figure.savefig(part, format=path.suffix[1:].lower(), dpi=150)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
