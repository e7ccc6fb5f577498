"""IF files that other receivers can navigate with: samples, their description, and the truth.

The truth is made in windows of one second from the start of the run and the samples follow them, so
that memory does not grow with the length of the file.  Windows are part of the definition: a
longer file begins with the bits of a shorter one, whatever the number of threads.

Satellites are those with a healthy set of ephemerides at the start.  Each is received while it
is at or above the mask, which is looked at once per window; one that rises later is in the file
from then on.  A set serves until 2 h from its toe: a longer file is refused.

Nothing carries its final name before it is whole: files are written as NAME.partial and renamed
at the end, the description last.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from signals.constants import CA_CHIP_RATE_HZ, GPS_L1_HZ
from signals.propagation import SignalState
from signals.sample_formats import VALUES_PER_BYTE, FileFormat, encode, file_format
from signals.sigmf_files import Description, paths, write_description
from ultratight import sky
from ultratight.config import InvalidInput
from ultratight.if_source import blocks, if_source
from ultratight.if_truth import ROW_S, TruthFile, TruthRows
from ultratight.ins.earth import geodetic_from_ecef
from ultratight.provenance import provenance
from ultratight.results import check_writable
from ultratight.scenario import PRESETS, Scenario, load
from ultratight.world import NODE_S, World

WINDOW_S = 1.0
_NODES_PER_WINDOW = round(WINDOW_S / NODE_S)
_NODES_PER_ROW = round(ROW_S / NODE_S)
_LOOK_S = 30.0
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


class FileWorld(World):
    """The world of an IF file: satellites rise and set; see the module."""

    def _choose_satellites(self) -> None:
        s = self.scenario
        if s.signals != ("L1CA",):
            raise InvalidInput(
                f"signals: {', '.join(s.signals)} given, expected L1CA: files hold no other yet"
            )
        self.sky = sky.constellation(s)
        t = np.unique(np.append(np.arange(0.0, s.duration_s, _LOOK_S), s.duration_s))
        seen = {p: self._highest(p, t) for p in self.sky.prn.tolist() if _wanted(s, p)}
        up = {p: e for p, e in seen.items() if e >= s.mask_deg}
        order = sorted(up, key=lambda p: (-up[p], p))[: s.max_satellites]
        if not order:
            raise InvalidInput(
                f"mask_deg: no satellite of {s.constellation} at or above {s.mask_deg:g} deg at "
                f"any time{sky.other_sky(s)}"
            )
        self.prn = np.array(sorted(order))
        self._check_ages()
        prn, rows = self.sky.select(s.start_week, s.start_tow_s)
        self._name_channels(self.prn, rows[np.searchsorted(prn, self.prn)])

    def _highest(self, prn: int, t_s: np.ndarray) -> float:
        """Highest elevation [deg] at those of the times at which the set of the start serves."""
        t = t_s[t_s < sky.valid_until_s(self.sky, prn, self.scenario)]
        return float(np.degrees(self.look(prn, t)[0].max())) if t.size else -90.0

    def _check_ages(self) -> None:
        s = self.scenario
        until = {p: sky.valid_until_s(self.sky, p, s) for p in self.prn.tolist()}
        first = min(until, key=lambda p: until[p])
        if until[first] < s.duration_s + 2.0 * WINDOW_S:
            most = math.floor(until[first] - 2.0 * WINDOW_S)
            raise InvalidInput(
                f"duration_s: {s.duration_s:g} given, expected at most {most}: the ephemeris of "
                f"G{first:02d} at the start is then 2 h from its toe"
            )

    def look(self, prn: int, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Elevation and azimuth (n,) [rad] of a satellite at receiver times (n,)."""
        s, r = self.scenario, self.antenna(t_s)[0]
        return sky.look(self.sky, prn, s.start_week, s.start_tow_s + self.true_time(t_s), r)

    def look_all(self, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Elevation and azimuth (n, n_channel) [rad] of the channels."""
        both = [self.look(p, t_s) for p in self.prn.tolist()]
        return np.stack([b[0] for b in both], axis=1), np.stack([b[1] for b in both], axis=1)


def _wanted(s: Scenario, prn: int) -> bool:
    return s.prns is None or prn in s.prns


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


def plan(
    scenario: Scenario,
    seed: int,
    out: Path,
    *,
    duration_s: float,
    form: str = "ci8",
    rms: float | None = None,
) -> Plan:
    """Check everything that can be checked before the work.

    The scenario must run at least as long as ``duration_s``.

    Raises
    ------
    InvalidInput, ValueError
        A scenario, format, r.m.s. or place that cannot be used.
    OSError
        Not enough room on the disk.
    """
    kind = file_format(form)
    out = Path(out)
    if out.name in ("", ".", ".."):
        raise InvalidInput(f"--out: {out} given, expected a name without ending")
    if out.suffix in (".sigmf-data", ".sigmf-meta"):
        out = out.with_suffix("")
    data, meta = paths(out, form)
    truth = out.with_name(f"{out.name}.truth.nc")
    for path in (data, meta, truth):
        check_writable(path, (path.suffix,))
    f = scenario.front_end
    world = FileWorld(scenario, seed)
    first = if_source(world, world.signal_between(0, 1), kind, rms)  # refuses what cannot be
    n = round(duration_s * f.sample_rate_hz)
    made = Plan(world, kind, rms, first.sigma, n, duration_s, data, meta, truth)
    truth_bytes = _n_row(made) * (8 * len(world.prn) * 6 + 100)
    need = kind.n_bytes(n) + truth_bytes + _SPARE_BYTES
    free = shutil.disk_usage(data.parent).free
    if need > free:
        raise OSError(f"{data}: needs {need / 1e9:.3g} GB, {free / 1e9:.3g} GB are free there")
    return made


def generate(p: Plan, progress: Callable[[float], None] | None = None) -> dict[str, Any]:
    """Write the files of a plan; returns what `ultratight generate --json` prints.

    On any failure, an interrupt included, nothing of them is left.
    """
    parts = [path.with_name(f"{path.name}.partial") for path in (p.samples, p.truth)]
    try:
        sha512 = _write(p, parts[0], parts[1], progress)
        os.replace(parts[0], p.samples)
        os.replace(parts[1], p.truth)
        write_description(p.metadata, _description(p, sha512))
    finally:
        for part in parts:
            with suppress(OSError):
                part.unlink(missing_ok=True)
    s = p.world.scenario
    return {
        "samples": str(p.samples),
        "metadata": str(p.metadata),
        "truth": str(p.truth),
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


def _write(p: Plan, data: Path, truth: Path, progress: Callable[[float], None] | None) -> str:
    """Samples and truth, window by window; returns the SHA-512 of the samples."""
    with ExitStack() as stack:
        samples = stack.enter_context(_Samples(data, p.form))
        rows = stack.enter_context(TruthFile(truth, _n_row(p), p.world.names, _facts(p)))
        rows.write_bits(*p.world.symbols)
        for state, first_node in _windows(p):
            rows.write(_rows(p.world, state, first_node))
            source = if_source(p.world, state, p.form, p.rms)
            for block in blocks(source, p.n_samples):
                samples.write(block)
                if progress is not None:
                    progress(samples.n_samples / p.n_samples)
        return samples.finish()


def _n_row(p: Plan) -> int:
    """Rows of the truth: to the end of the samples, included."""
    return math.ceil(p.duration_s / ROW_S - 1e-9) + 1


def _windows(p: Plan) -> Iterator[tuple[SignalState, int]]:
    """The truth of each window and its first node; the last ends with the last row's piece."""
    end = (_n_row(p) - 1) * _NODES_PER_ROW + 1
    w = p.world
    for first in range(0, end, _NODES_PER_WINDOW):
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
        },
    )


class _Samples:
    """A file of samples under way; packed formats carry what does not fill a byte to the next."""

    def __init__(self, path: Path, form: FileFormat) -> None:
        self._form, self._sha = form, hashlib.sha512()
        shape = (0,) if form.real else (0, 2)
        self._rest: np.ndarray = np.empty(shape, np.int8)
        self.n_samples = 0
        self._file = path.open("wb")

    def __enter__(self) -> _Samples:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, samples: np.ndarray) -> None:
        self.n_samples += len(samples)
        if self._form.packed:
            samples = np.concatenate([self._rest, samples])
            whole = len(samples) - len(samples) % (VALUES_PER_BYTE // self._form.components)
            samples, self._rest = samples[:whole], samples[whole:]
        self._put(samples)

    def finish(self) -> str:
        """Write what is left; the SHA-512 of all."""
        if len(self._rest):
            self._put(self._rest)
        self._file.flush()
        os.fsync(self._file.fileno())
        return self._sha.hexdigest()

    def _put(self, samples: np.ndarray) -> None:
        stored = encode(samples, self._form).view(np.uint8).reshape(-1).data
        self._file.write(stored)
        self._sha.update(stored)
