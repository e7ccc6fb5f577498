"""The command that tracks the satellites of a recording, decodes their message and positions it."""

from __future__ import annotations

import json
import sys
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultratight import flight_commands
from ultratight.acquire_commands import (
    FIGURES,
    Coherent,
    Conjugate,
    Doppler,
    FalseAlarm,
    File,
    Form,
    IfHz,
    Noncoherent,
    Plot,
    Prns,
    Rate,
    Skip,
    SwapIq,
    first_sample_of,
    numbers_of,
    table_of,
    title_of,
    warnings_of,
    write_figure,
)
from ultratight.flight_commands import (
    AttitudeSigma,
    AttitudeText,
    ClosureName,
    Grade,
    ImuFile,
    TakeOver,
    attitude_of,
)
from ultratight.options import FilterName, Json, Override, Quiet, progress

if TYPE_CHECKING:
    from signals.recording import Recording
    from ultratight.tracking.from_samples import Tracks
    from ultratight.tracking.navigation import Navigation

_SHOWN_BITS = 30
TWO_BITS_S = 0.04
"""The fewest that show where bits begin"""


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
    atmosphere: Annotated[
        bool | None,
        typer.Option(help="corrected or not; default: it is, unless the file says there is none"),
    ] = None,
    near_week: Annotated[
        int, typer.Option(metavar="WEEK", help="within 511 GPS weeks of the true one")
    ] = 2400,
    interval_ms: Annotated[
        int, typer.Option(metavar="MS", help="between observations and positions")
    ] = 100,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="write observations (RINEX), NMEA, GeoJSON, KML there"),
    ] = None,
    closure: ClosureName = None,
    imu: ImuFile = None,
    grade: Grade = None,
    filter_: FilterName = None,
    attitude: AttitudeText = None,
    attitude_sigma_deg: AttitudeSigma = 1.0,
    take_over: TakeOver = None,
    changes: Override = None,
    plot: Plot = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Track the GPS satellites in an IF file.

    Those found are tracked to its end. Every channel finds its own bit edges and has its own phase
    and code loop. Bits are those whose 20 ms were tracked, up to each channel's sign. Where the
    file is long enough (18 to 30 s) the message is decoded and positions follow. --plot writes
    prompts, and beside them NAME-position with C/N0, Doppler and positions.

    With --closure that closure takes over from the first position on and flies to the end, by the
    samples and, for ultra-tight, federated and scalar-ins, an IMU's data; --set changes its
    receiver. It measures differentially: nobody knows the data bits of a recording beforehand.
    --out and --plot then write NAME.CLOSURE and NAME-CLOSURE too.
    """
    from signals.codes import GPS_L1CA
    from signals.sigmf_files import open_recording
    from ultratight import recording_flight
    from ultratight.results import check_writable
    from ultratight.tracking import acquisition, from_samples
    from ultratight.tracking.navigation import navigate

    if plot:
        check_writable(plot, FIGURES)
    if out is not None and not out.is_dir():
        raise ValueError(f"--out: {out} given, expected a folder that exists")
    if not 1 <= interval_ms <= 60_000:
        raise ValueError(f"--interval-ms: {interval_ms} given, expected 1 to 60000")
    if not 0 <= near_week < 10_000:
        raise ValueError(f"--near-week: {near_week} given, expected 0 to 9999")
    search = acquisition.Search(
        doppler_hz=doppler_hz,
        coherent_s=None if coherent_ms is None else coherent_ms * 1e-3,
        noncoherent=noncoherent,
        false_alarm=false_alarm,
    )
    settings = from_samples.SETTINGS._replace(
        bandwidth_hz=bandwidth_hz, integration_s=integration_ms * 1e-3
    )
    prns = numbers_of(prn)
    recording = open_recording(
        file, sample_format=form, sample_rate_hz=rate, if_hz=if_hz,
        swap_iq=swap_iq, conjugate=conjugate,
    )  # fmt: skip
    first = first_sample_of(skip, recording)
    end = recording.end_sample
    if duration is not None:
        if not 0.0 < duration < 1e6:
            raise ValueError(f"--duration: {duration:g} given, expected more than 0 s")
        end = min(end, first + round(duration * recording.sample_rate_hz))
    if (end - first) / recording.sample_rate_hz < TWO_BITS_S:
        raise ValueError(
            f"{file}: {1e3 * (end - first) / recording.sample_rate_hz:.3g} ms to track, expected "
            f"at least {1e3 * TWO_BITS_S:g} ms, two data bits"
        )
    planned = None
    given = {"--imu": imu, "--imu-grade": grade, "--filter": filter_, "--attitude": attitude,
             "--take-over": take_over, "--set": changes}  # fmt: skip
    if closure is not None:
        planned = recording_flight.plan(
            closure, end / recording.sample_rate_hz, filter_name=filter_, imu=imu, grade=grade,
            attitude=attitude_of(attitude, attitude_sigma_deg), take_over_s=take_over,
            changes=changes or [],
        )  # fmt: skip
    elif alone := [name for name, value in given.items() if value is not None]:
        raise ValueError(f"{alone[0]}: given without --closure, expected both")
    rows = acquisition.acquire(recording, GPS_L1CA, prns, search, first)
    warnings = warnings_of(recording, GPS_L1CA, rows)
    found = [row for row in rows if row.found]
    tracks = from_samples.track(recording, found, end, settings)
    atmosphere = has_atmosphere(file) if atmosphere is None else atmosphere
    nav = navigate(tracks, atmosphere=atmosphere, near_week=near_week, interval_ms=interval_ms)
    warnings += _missing(recording, nav)
    flown = None
    if planned is not None:
        with progress(f"flying {closure}", quiet or as_json) as report:
            flown = recording_flight.fly_recording(
                planned, recording, nav, end, atmosphere=atmosphere, progress=report
            )
    title, name = title_of(recording, first), Path(recording.name).name.split(".")[0]
    written = _figures(nav, plot, title) if plot else []
    if out is not None:
        written += _files(nav, out, name)
    where = flight_commands.places_of(flown, interval_ms) if flown else []
    if flown and plot:
        written.append(flight_commands.write_plot(flown, nav, plot, title))
    if flown and out is not None:
        written += flight_commands.write_files(flown, where, out, name)
    told = _tracked(recording, tracks, [row.prn for row in found], warnings)
    told["navigation"] = _navigated(nav)
    told["flight"] = flight_commands.told(flown, where) if flown else None
    if as_json:
        print(json.dumps(told))
        return
    print("\n".join(_table_of_tracks(told) if found else table_of(rows, recording)[-1:]))
    if found:
        print("\n".join(_lines_of_positions(told["navigation"])))
    if flown:
        print("\n".join(flight_commands.lines(told["flight"])))
    for path in written:
        print(f"written: {path}")


def _missing(recording: Recording, nav: Navigation) -> list[str]:
    """A line, also to stderr, where the message says that samples are missing."""
    from ultratight.tracking.observables import missing_s

    found = missing_s(nav.tracks, nav.telemetry)
    if not found:
        return []
    at = ", ".join(f"PRN {prn} from {t[0]:.1f} s" for prn, t in found.items())
    line = (
        f"{recording.name}: words are strong and yet wrong, as where samples are missing: {at}; "
        "the time is not believed from there to the next subframes"
    )
    print(f"warning: {line}", file=sys.stderr)
    return [line]


def has_atmosphere(file: Path) -> bool:
    """Unless the file's description says that the signals came through none."""
    from signals.sigmf_files import own_facts

    said = own_facts(file).get("atmosphere")
    return not (isinstance(said, list) and not said)


def _figures(nav: Navigation, plot: Path, title: str) -> list[Path]:
    """Prompts; C/N0, Doppler and position if there are observations."""
    from ultratight import plots_acquisition, plots_position

    write_figure(plot, plots_acquisition.tracks(nav.tracks, title))
    if nav.observations is None or not len(nav.observations.t_s):
        return [plot]
    second = plot.with_name(f"{plot.stem}-position{plot.suffix}")
    write_figure(second, plots_position.figure(nav, title))
    return [plot, second]


def _files(nav: Navigation, folder: Path, name: str) -> list[Path]:
    """What there is: observations need a week, the others a position."""
    from datetime import datetime

    from signals.rinex_observations import write_observations
    from ultratight import position_files
    from ultratight.provenance import versions

    written = []
    seen, where = nav.observations, position_files.places(nav)
    if seen is not None and len(seen.t_s) and nav.week:
        path = folder / f"{name}.obs"
        last = nav.positions[-1].estimate or nav.positions[-1].fix if nav.positions else None
        write_observations(
            path, nav.week, seen.tow_ms, seen.prn, seen.pseudorange_m, seen.carrier_cycles,
            seen.doppler_hz, seen.cn0_dbhz, seen.restarted,
            program=f"ultratight {versions()['ultratight']}",
            made=datetime.now(UTC).strftime("%Y%m%d %H%M%S"),
            position_m=last.state[:3] if last else None,
        )  # fmt: skip
        written.append(path)
    return written + position_files.write(where, folder, name)


def _navigated(nav: Navigation) -> dict[str, Any]:
    """What --json prints of message and positions; null where there is none."""
    from ultratight import position_files
    from ultratight.sky_view import sky_paths

    words = nav.telemetry
    where = position_files.places(nav)
    sky = {path.prn: path for path in sky_paths(nav)}
    channels = [
        {
            "prn": prn,
            "elevation_deg": float(sky[prn].elevation_deg[-1]) if prn in sky else None,
            "azimuth_deg": float(sky[prn].azimuth_deg[-1]) if prn in sky else None,
            "subframes": [s.number for s in one.subframes],
            "words": one.words._asdict(),
            "ephemeris": nav.sky is not None and bool((nav.sky.prn == prn).any()),
        }
        for prn, one in zip(nav.tracks.prn.tolist(), words, strict=True)
    ]
    fixes = [p.fix for p in nav.positions if p.fix]
    return {
        "why_not": nav.why_not or None,
        "week": nav.week or None,
        "channels": channels,
        "possible_s": None if nav.possible_s != nav.possible_s else nav.possible_s,
        "first_fix_s": where[0].t_s if where else None,
        "n_position": len(where),
        "excluded": sum(f.excluded >= 0 for f in fixes),
        "pdop": fixes[-1].dop.position if fixes else None,
        "last": where[-1]._asdict() if where else None,
    }


def _lines_of_positions(told: dict[str, Any]) -> list[str]:
    words = [c["words"] for c in told["channels"]]
    right, wrong, unsure = (sum(w[k] for w in words) for k in ("right", "wrong", "unsure"))
    lines = [
        f"message: {right} words right, {wrong} with a wrong parity, {unsure} too weak to believe; "
        f"{sum(c['ephemeris'] for c in told['channels'])} ephemerides"
    ]
    last = told["last"]
    if last is None:
        return [*lines, f"no position: {told['why_not']}"]
    lines.append(
        f"{told['n_position']} positions, the first after {told['first_fix_s']:.1f} s (the message "
        f"allowed it after {told['possible_s']:.1f} s); {told['excluded']} with a satellite left "
        "out"
    )
    lines.append(
        f"{last['utc']}  {last['lat_deg']:.7f} deg  {last['lon_deg']:.7f} deg  "
        f"{last['height_m']:.2f} m above the ellipsoid  {last['speed_mps']:.2f} m/s  "
        f"{last['n_used']} satellites"
    )
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
