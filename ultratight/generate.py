"""IF files that other receivers can navigate with: samples, their description, and the truth.

The truth is made in windows of one second from the start of the run and the samples follow them, so
that memory does not grow with the length of the file.  Windows are part of the definition: a
longer file begins with the bits of a shorter one, whatever the number of threads.

Nothing carries its final name before it is whole: files are written as NAME.partial and renamed
at the end, the description last.  A run that is cut short leaves whole seconds and a journal of
them, see `if_parts`, and the next goes on: noise and truth are functions of absolute time, so that
its place is all that it needs to know.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from signals.constants import CA_CHIP_RATE_HZ, GPS_L1_HZ
from signals.propagation import SignalState
from signals.sample_formats import FileFormat, file_format
from signals.sigmf_files import Description, paths, write_description
from ultratight import named_files
from ultratight.config import InvalidInput
from ultratight.if_parts import Kept, Parts, Places, read_journal
from ultratight.if_source import blocks, if_source
from ultratight.if_truth import ROW_S, TruthFile, TruthRows, rows_of, table_of, width
from ultratight.if_world import WINDOW_S, FileWorld
from ultratight.ins.earth import geodetic_from_ecef
from ultratight.ins.imu_table import write_increments
from ultratight.provenance import provenance, sources_sha256
from ultratight.results import check_writable
from ultratight.resume import flat
from ultratight.scenario import PRESETS, Scenario, load
from ultratight.world import NODE_S, World

_NODES_PER_WINDOW = round(WINDOW_S / NODE_S)
_NODES_PER_ROW = round(ROW_S / NODE_S)
_ROWS_PER_WINDOW = _NODES_PER_WINDOW // _NODES_PER_ROW
OPEN_SKY_DBHZ = 45.0
_SPARE_BYTES = 50_000_000


def scenario_for(
    source: str,
    changes: list[str],
    duration_s: float,
    rate_hz: float | None = None,
    if_hz: float | None = None,
    start: str | None = None,
    trajectory: Path | None = None,
    nav: Path | None = None,
) -> Scenario:
    """The scenario of a file: options laid over a preset or file, then ``changes`` (key=value).

    Unless ``changes`` say otherwise data bits are the navigation message and a preset's satellites
    at 45 dB-Hz; a trajectory file takes the place of the profile.  Raises `InvalidInput`.
    """
    if not (math.isfinite(duration_s) and 0.0 < duration_s <= 86_400.0):
        raise InvalidInput(f"--duration: {duration_s:g} given, expected more than 0, at most 86400")
    options: dict[str, Any] = {
        # whole data bits: the file may end inside one
        "duration_s": math.ceil(duration_s / ROW_S - 1e-9) * ROW_S,
        "data_bits": "lnav",
        # presets are weak for the sake of the filters: common receivers would not acquire
        "cn0_dbhz": OPEN_SKY_DBHZ if source in PRESETS else None,
        "front_end.sample_rate_hz": rate_hz,
        "front_end.if_hz": if_hz,
        "trajectory": trajectory and str(trajectory),
        "profile": [] if trajectory else None,
        "constellation": nav and str(nav),
    }
    if start is not None:
        options |= _start(start)
    given = {change.partition("=")[0].strip() for change in changes} - {"duration_s"}
    lines = [
        f"{key}={json.dumps(value)}"
        for key, value in options.items()
        if value is not None and key not in given
    ]
    return load(source, [*lines, *changes])


def _start(text: str) -> dict[str, float]:
    week, colon, tow = text.partition(":")
    try:
        if colon and week.isdecimal():
            return {"start_week": int(week), "start_tow_s": float(tow)}
    except ValueError:
        pass
    raise InvalidInput(f"--start: {text} given, expected WEEK:TOW, e.g. 2149:475220")


class Plan(NamedTuple):
    """What is to be written, checked."""

    world: FileWorld
    form: FileFormat
    rms: float | None
    sigma: float
    n_samples: int
    duration_s: float
    samples: Path
    metadata: Path
    truth: Path
    imu: Path | None  # the IMU's data, if they are wanted
    places: Places
    made: dict[str, Any]
    """What the samples and the truth of any second depend on"""
    kept: Kept
    """By an earlier run"""


def plan(
    scenario: Scenario,
    seed: int,
    out: Path,
    *,
    duration_s: float,
    form: str = "ci8",
    rms: float | None = None,
    fresh: bool = False,
    imu: bool = False,
) -> Plan:
    """Check everything that can be checked before the work.

    The scenario must run at least as long as ``duration_s``.  What an earlier run has left is gone
    on with, or is written over where ``fresh``.  ``imu``: its data are wanted too.

    Raises
    ------
    InvalidInput, ValueError
        A scenario, format, r.m.s. or place that cannot be used; an earlier run has left another
        file there.
    OSError
        Not enough room on the disk.
    """
    kind = file_format(form)
    out = Path(out)
    if out.name in ("", ".", ".."):
        raise InvalidInput(f"--out: {out} given, expected a name without ending")
    if out.suffix in (".sigmf-data", ".sigmf-meta"):
        out = out.with_suffix("")
    if kind.packed and rms is not None:
        raise InvalidInput(f"--rms: {rms:g} given, expected none: {form} has fixed levels")
    data, meta = paths(out, form)
    truth = out.with_name(f"{out.name}.truth.nc")
    table = out.with_name(f"{out.name}.imu.csv") if imu else None
    for path in (data, meta, truth, *([table] if table else [])):
        check_writable(path, (path.suffix,))
    f = scenario.front_end
    world = FileWorld(scenario, seed)
    first = if_source(world, world.signal_between(0, 1), kind, rms)  # refuses what cannot be
    n = round(duration_s * f.sample_rate_hz)
    if n < 1:
        raise InvalidInput(f"--duration: {duration_s:g} given, expected at least one sample")
    places, made = Places.of(out, data), _made(world, kind, rms)
    kept = Kept() if fresh else read_journal(places, made)
    if kept.n_samples > n:
        raise InvalidInput(
            f"--duration: {duration_s:g} given, expected at least the {kept.seconds} s that "
            f"{places.samples.name} has, or --fresh to start anew"
        )
    p = Plan(
        world, kind, rms, first.sigma, n, duration_s, data, meta, truth, table, places, made, kept
    )
    # the truth stands there twice while its file is made of its rows
    truth_bytes = 2 * 8 * width(len(world.prn)) * _n_row(p)
    need = kind.n_bytes(n) + truth_bytes + _SPARE_BYTES - kept.samples[0] - kept.rows[0]
    free = shutil.disk_usage(data.parent).free
    if need > free:
        raise OSError(f"{data}: needs {need / 1e9:.3g} GB, {free / 1e9:.3g} GB are free there")
    return p


def _made(world: FileWorld, form: FileFormat, rms: float | None) -> dict[str, Any]:
    """`Plan.made`: not the duration, as a longer file begins with the bits of a shorter one."""
    s = world.scenario
    tree = named_files.by_content(s.to_dict())
    # a last segment that reaches the end of the run holds beyond it
    duration_s, *_ = (tree.pop(key, None) for key in ("duration_s", "name", "title", "why"))
    lasts = bool(s.profile) and s.profile[-1].t1_s >= duration_s - 1e-9
    where = provenance(s, world.seed)
    return {
        "seed": world.seed,
        "format": form.name,
        "rms": rms,
        **flat(tree),
        "profile_lasts": lasts,
        "prns": world.prn.tolist(),
        "cpu_path": where["cpu_path"],
        "machine": where["machine"],
        **where["versions"],
        "sources_sha256": sources_sha256(),
    }


def generate(p: Plan, progress: Callable[[float], None] | None = None) -> dict[str, Any]:
    """Write the files of a plan; returns what `ultratight generate --json` prints.

    On any failure, an interrupt included, whole seconds are kept and said to be: in an OSError's
    message, or as what a KeyboardInterrupt carries.  If there are none nothing is left.
    """
    truth = p.truth.with_name(f"{p.truth.name}.partial")
    _take_back(p)
    parts = Parts(p.places, p.form, p.made, p.kept)
    try:
        sha512 = _write(p, parts, progress)
        _write_truth(p, parts, truth)
        if p.imu is not None:
            _write_imu(p.world, p.imu)
        parts.close()
        p.metadata.unlink(missing_ok=True)  # an older one would describe the new samples
        os.replace(p.places.samples, p.samples)
        os.replace(truth, p.truth)
        write_description(p.metadata, _description(p, sha512))
    except BaseException as error:
        with suppress(OSError):
            truth.unlink(missing_ok=True)
        if not (seconds := parts.stop()):
            raise
        kept = (
            f"{p.places.samples.name} keeps {seconds} s of {p.duration_s:g} s: the same command "
            "goes on there, --fresh starts anew"
        )
        if isinstance(error, OSError):
            raise OSError(f"{error}; {kept}") from error
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt(kept) from None
        raise
    parts.remove()
    s = p.world.scenario
    return {
        "samples": str(p.samples),
        "metadata": str(p.metadata),
        "truth": str(p.truth),
        "imu": p.imu and str(p.imu),
        "rate_hz": s.front_end.sample_rate_hz,
        "if_hz": s.front_end.if_hz,
        "format": p.form.name,
        "start_week": s.start_week,
        "start_tow_s": s.start_tow_s,
        "duration_s": p.n_samples / s.front_end.sample_rate_hz,
        "n_samples": p.n_samples,
        "prns": p.world.prn.tolist(),
        "cn0_dbhz": s.cn0_dbhz,
        "position_lla": list(_start_lla(p.world)),
        "seed": p.world.seed,
        "sha512": sha512,
    }


def _take_back(p: Plan) -> None:
    """Samples that got their name from a run that ended before their description had its own."""
    if p.kept.seconds and not p.places.samples.exists() and not p.metadata.exists():
        with suppress(FileNotFoundError):
            os.replace(p.samples, p.places.samples)


def _write(p: Plan, parts: Parts, progress: Callable[[float], None] | None) -> str:
    """Samples and truth, window by window; returns the SHA-512 of the samples."""
    for state, first_node in _windows(p):
        rows = _rows(p.world, state, first_node)
        parts.write_rows(table_of(rows))
        source = if_source(p.world, state, p.form, p.rms)
        for block in blocks(source, p.n_samples):
            parts.write(block)
            if progress is not None:
                progress(parts.n_samples / p.n_samples)
        if len(rows.t_s) == _ROWS_PER_WINDOW and parts.n_samples == source.end_sample:
            parts.whole(first_node // _NODES_PER_WINDOW + 1)
    return parts.finish()


def _write_truth(p: Plan, parts: Parts, path: Path) -> None:
    """The truth's file from its rows, on the disk."""
    n_channel, first = len(p.world.prn), 0
    with TruthFile(path, _n_row(p), p.world.names, _facts(p)) as file:
        file.write_bits(*p.world.symbols)
        for table in parts.rows(width(n_channel)):
            file.write(rows_of(table, first, n_channel))
            first += len(table)
    with path.open("rb+") as written:
        os.fsync(written.fileno())


def _write_imu(w: FileWorld, path: Path) -> None:
    """The IMU's data, from the interval that ends at the first sample on."""
    part = path.with_name(f"{path.name}.partial")
    try:
        write_increments(part, w.imu[0])
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _n_row(p: Plan) -> int:
    """Rows of the truth: to the end of the samples, included."""
    return math.ceil(p.duration_s / ROW_S - 1e-9) + 1


def _windows(p: Plan) -> Iterator[tuple[SignalState, int]]:
    """The truth of each window that is not kept, and its first node.

    The last ends with the last row's piece.
    """
    end = (_n_row(p) - 1) * _NODES_PER_ROW + 1
    w = p.world
    for first in range(p.kept.seconds * _NODES_PER_WINDOW, end, _NODES_PER_WINDOW):
        up = w.look_all(w.t_s[first : first + 1])[0][0] >= math.radians(w.scenario.mask_deg)
        yield w.signal_between(first, min(first + _NODES_PER_WINDOW, end), up), first


def _rows(w: FileWorld, state: SignalState, first_node: int) -> TruthRows:
    """The rows of the truth that lie in a window: nodes, hence without interpolation."""
    pieces = np.arange(0, len(state.t_s) - 1, _NODES_PER_ROW)
    nodes = first_node + pieces
    t_s = w.t_s[nodes]
    r, v = w.antenna(t_s)
    elevation, azimuth = w.look_all(t_s)
    return TruthRows(
        first=first_node // _NODES_PER_ROW,
        t_s=t_s,
        r_ea_e=r,
        v_ea_e=v,
        lla=np.stack(geodetic_from_ecef(r), axis=1),
        clock_m=w.clock.clock_m[nodes],
        clock_rate_mps=w.clock.clock_rate_mps[nodes],
        code_phase_chips=state.code_phase_chips[:, pieces, 0].T,
        carrier_phase_cycles=state.carrier_phase_cycles[:, pieces, 0].T,
        doppler_hz=state.carrier_phase_cycles[:, pieces, 1].T,
        cn0_dbhz=np.where(state.valid, state.cn0_dbhz, np.nan)[:, pieces].T,
        elevation=elevation,
        azimuth=azimuth,
    )


def _start_lla(w: World) -> tuple[float, float, float]:
    """Antenna at the first sample: deg, deg, m."""
    lat, lon, h = geodetic_from_ecef(w.antenna(np.zeros(1))[0][0])
    return float(np.degrees(lat)), float(np.degrees(lon)), float(h)


def _facts(p: Plan) -> dict[str, Any]:
    """Attributes of the truth file."""
    s = p.world.scenario
    return {
        "start_week": s.start_week,
        "start_tow_s": s.start_tow_s,
        "sample_rate_hz": s.front_end.sample_rate_hz,
        "if_hz": s.front_end.if_hz,
        "n_samples": p.n_samples,
        "samples": p.samples.name,
        "scenario": json.dumps(s.to_dict()),
        "provenance": json.dumps(provenance(s, p.world.seed)),
    }


def _description(p: Plan, sha512: str) -> Description:
    w, f = p.world, p.world.scenario.front_end
    names = ", ".join(f"G{n:02d}" for n in w.prn.tolist())
    half = min(CA_CHIP_RATE_HZ, f.sample_rate_hz / 2.0)
    return Description(
        format=p.form.name,
        sample_rate_hz=f.sample_rate_hz,
        if_hz=f.if_hz,
        n_samples=p.n_samples,
        sigma=p.sigma,
        start_week=w.scenario.start_week,
        start_tow_s=w.scenario.start_tow_s,
        text=f"Simulated GPS L1 C/A of {names}; {w.scenario.title}",
        recorder=f"ultratight {provenance(w.scenario, w.seed)['versions']['ultratight']}",
        sha512=sha512,
        position_lla_deg_m=_start_lla(w),
        annotations=(
            {
                "core:sample_start": 0,
                "core:sample_count": p.n_samples,
                "core:freq_lower_edge": GPS_L1_HZ - half,
                "core:freq_upper_edge": GPS_L1_HZ + half,
                "core:label": "GPS L1 C/A",
                "core:comment": f"main lobes of {names}",
            },
        ),
        more={
            "truth": p.truth.name,
            "seed": w.seed,
            "scenario_sha256": w.scenario.digest(),
            "prns": w.prn.tolist(),
            "atmosphere": [name for name, on in w.scenario.atmosphere if on],
        },
    )
