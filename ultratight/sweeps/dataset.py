"""A sweep as one netCDF file: a dimension per swept key, then the run, written run by run.

Memory holds one block of runs at a time, however many there are.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5netcdf
import h5py
import numpy as np

from ultratight import config
from ultratight.sweeps.cells import RESERVED, Axis, Cell
from ultratight.sweeps.flights import COST, Record, values_of
from ultratight.sweeps.series import SERIES, times

FORMAT = "ultratight-sweep-1"
NAME = "sweep.nc"
PARTS = f".{NAME}.*.part"
"""What is not whole yet"""
INNER = {
    "velocity_rms_mps": "window", "lost_lock_s": "channel", "off_carrier_s": "channel",
    "off_signal_s": "channel", "on_signal_s": "channel",
}  # fmt: skip
"""Tables of a summary, and the dimension that their keys become"""
_BLOCK = 256
_LEFT_OUT = ("seed", "duration_s")
_TEXT = h5py.string_dtype()
_WORDS = {
    "converged": "r.m.s. velocity error of the end below the limit; false where the run failed",
    "velocity_rms_mps": "r.m.s. length of the velocity error in a window",
    "position_rms_end_m": "r.m.s. length of the position error at the end",
    "nees_velocity": "median of NEES/3 of the velocity in the jump",
    "nis_per_measurement": "mean of NIS per measured number outside the jump",
    "lost_lock_s": "first loss of lock of each channel",
    "off_carrier_s": "since when the NCO of each channel was off the true carrier",
    "off_signal_s": "since when each replica was off its signal, carrier or code",
    "on_signal_s": "since when each replica was on its signal to the end of the run",
    "n_lost": "channels that lost lock",
    "first_lost_s": "first loss of lock of any channel",
    "fall_backs": "returns from the coherent to the differential measurement",
    "failure": "why the run has no result; empty where it has one",
    "took_s": "wall time of the run with its figures",
    "estimate_sha256": "of the estimated trajectory, every bit of it",
}
TAKEN = {*RESERVED, *_WORDS, *COST, *SERIES, *(f"{name}_of" for name in _WORDS), "n_satellites"}
"""What a swept key or set of keys cannot be called"""


def check_names(axes: Sequence[Axis]) -> None:
    """`InvalidInput` for a dimension that the file cannot have beside the results."""
    for axis in axes:
        if axis.dim in TAKEN or "/" in axis.dim or not axis.dim.strip(" ."):
            raise config.InvalidInput(
                f"over {axis.dim}: a name that results have or no file can hold, expected another, "
                "e.g. {'cause': {'late': {'imu.lag_s': 0.01}}}"
            )


def facts(record: Record) -> dict[str, Any]:
    """Numbers, tables and texts of a record under the names that they have in the Dataset."""
    out: dict[str, Any] = {
        key: value
        for key, value in record["summary"].items()
        if not isinstance(value, str | list) and key not in _LEFT_OUT
    }
    lost = [t for t in out.get("lost_lock_s", {}).values() if t is not None]
    if "lost_lock_s" in out:
        out["n_lost"], out["first_lost_s"] = len(lost), min(lost, default=None)
    out |= {key: value for key, value in record["cost"].items() if not isinstance(value, str)}
    out["failure"] = record["failure"]
    out["estimate_sha256"] = record["estimate_sha256"] or ""
    return out


class Layout:
    """What variables there are: found in a first pass over the records."""

    def __init__(self, records: Iterable[Record]) -> None:
        self.kinds: dict[str, str] = {"converged": "bool"}
        self.inner: dict[str, dict[str, int]] = {}
        """Dimension -> labels with their places"""
        self.tables: dict[str, str] = {}
        """Table -> its dimension"""
        self.cpu_paths: dict[str, None] = {}
        for record in records:
            for key, value in facts(record).items():
                self._see(key, value)
            if path := record["cost"].get("cpu_path"):
                self.cpu_paths[path] = None

    def _see(self, key: str, value: Any) -> None:
        if isinstance(value, Mapping):
            dim = self.tables.setdefault(key, INNER.get(key, f"{key}_of"))
            labels = self.inner.setdefault(dim, {})
            for label in value:
                labels.setdefault(label, len(labels))
        elif isinstance(value, str):
            self.kinds[key] = "text"
        else:
            self.kinds.setdefault(key, "bool" if isinstance(value, bool) else "number")


def write(
    path: Path,
    axes: Sequence[Axis],
    cells: Sequence[Cell],
    seeds: range,
    records: Iterable[Record],
    layout: Layout,
    keep: Sequence[str],
    every_s: float,
    attributes: Mapping[str, Any],
) -> None:
    """Write the file, whole or not at all; ``records`` come cell by cell and run by run."""
    part = path.with_name(PARTS.replace("*", str(os.getpid())))
    longest = max(cell.scenario.duration_s for cell in cells)
    try:
        with _Disk(part, "w+") as disk:
            with h5netcdf.File(disk, "w") as file:
                _prepare(file, axes, seeds, layout, attributes)
                n_time = _prepare_series(file, axes, keep, longest, every_s) if keep else 0
                for block in _blocks(records):
                    _fill(file, cells[block[0]["cell"]].place, block, layout, keep, n_time)
                    disk.check()
            disk.check()
        os.replace(part, path)
    finally:
        with suppress(OSError):
            part.unlink()


class _Disk(io.FileIO):
    """A file that tells us that the disk is full, not HDF5, which would crash as it closes."""

    refused: OSError | None = None

    def write(self, data: Any) -> int:
        left = memoryview(data).cast("B")
        n = len(left)
        try:
            while left and self.refused is None:  # a disk that fills up takes a part first
                left = left[super().write(left) or 0 :]
        except OSError as error:
            self.refused = error
        return n

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.refused = self.refused or error
            return size or 0

    def check(self) -> None:
        """OSError: not everything has been written."""
        if self.refused is not None:
            raise self.refused


def _prepare(
    file: Any, axes: Sequence[Axis], seeds: range, layout: Layout, attributes: Mapping[str, Any]
) -> None:
    sizes = {axis.dim: len(axis.labels) for axis in axes} | {"run": len(seeds)}
    file.dimensions = sizes | {dim: len(labels) for dim, labels in layout.inner.items()}
    for key, value in {"format": FORMAT, "coordinates": "seed", **attributes}.items():
        file.attrs[key] = value if isinstance(value, str | int | float) else json.dumps(value)
    for axis in axes:
        unit = config.unit(axis.dim)
        _variable(file, axis.dim, (axis.dim,), np.array(axis.labels), axis.key, unit)
    _variable(file, "run", ("run",), np.arange(len(seeds)), "number of the run", "1")
    _variable(file, "seed", ("run",), np.array(seeds, np.int64), "seed of the run", "1")
    for dim, labels in layout.inner.items():
        _variable(file, dim, (dim,), np.array(list(labels)), dim, "")
    outer = tuple(sizes)
    for name, kind in layout.kinds.items():
        _empty(file, name, outer, {"bool": "i1", "text": _TEXT, "number": "f8"}[kind])
        if kind == "bool":
            file.variables[name].attrs["dtype"] = "bool"
    for name, dim in layout.tables.items():
        _empty(file, name, (*outer, dim), "f8")


def _prepare_series(
    file: Any, axes: Sequence[Axis], keep: Sequence[str], longest_s: float, every_s: float
) -> int:
    t = times(longest_s, every_s)
    file.dimensions["time_s"] = t.size
    _variable(file, "time_s", ("time_s",), t, "receiver time since the start", "s")
    for name in keep:
        v = _empty(file, name, (*(axis.dim for axis in axes), "run", "time_s"), "f8")
        v.attrs["units"], v.attrs["long_name"] = SERIES[name].units, SERIES[name].long_name
    return int(t.size)


def _variable(
    file: Any, name: str, dims: tuple[str, ...], values: np.ndarray, text: str, unit: str
) -> None:
    is_text = values.dtype.kind in "UT"
    v = file.create_variable(name, dims, _TEXT if is_text else values.dtype)
    v[...] = values.astype(object) if is_text else values
    v.attrs["long_name"], v.attrs["units"] = text, unit


def _empty(file: Any, name: str, dims: tuple[str, ...], dtype: Any) -> Any:
    if dtype == "f8":
        v = file.create_variable(name, dims, dtype, fillvalue=np.nan)
    else:
        v = file.create_variable(name, dims, dtype)
    v.attrs["long_name"], v.attrs["units"] = _WORDS.get(name, name), config.unit(name) or "1"
    return v


def _blocks(records: Iterable[Record]) -> Iterator[list[Record]]:
    """Runs of one cell without a gap, not too many at a time."""
    block: list[Record] = []
    for record in records:
        last = block[-1] if block else None
        if last is not None and (
            len(block) == _BLOCK
            or record["cell"] != last["cell"]
            or record["run"] != last["run"] + 1
        ):
            yield block
            block = []
        block.append(record)
    if block:
        yield block


def _fill(
    file: Any,
    index: tuple[int, ...],
    block: Sequence[Record],
    layout: Layout,
    keep: Sequence[str],
    n_time: int,
) -> None:
    rows = [facts(record) for record in block]
    at = (*index, slice(block[0]["run"], block[-1]["run"] + 1))
    for name, kind in layout.kinds.items():
        if kind == "text":
            file.variables[name][at] = np.array([row.get(name, "") for row in rows], object)
        elif kind == "bool":
            file.variables[name][at] = np.array([bool(row.get(name)) for row in rows], np.int8)
        else:
            file.variables[name][at] = np.array([_number(row.get(name)) for row in rows])
    for name, dim in layout.tables.items():
        table = np.full((len(rows), len(layout.inner[dim])), np.nan)
        for row, values in zip(rows, table, strict=True):
            for label, value in row.get(name, {}).items():
                values[layout.inner[dim][label]] = _number(value)
        file.variables[name][at] = table
    for name in keep:
        series = np.full((len(rows), n_time), np.nan)
        for record, values in zip(block, series, strict=True):
            if name in record["series"]:
                kept = values_of(record["series"][name])
                values[: kept.size] = kept
        file.variables[name][at] = series


def _number(value: Any) -> float:
    return np.nan if value is None else float(value)


def open_sweep(folder: str | Path, load: bool = False) -> Any:
    """The Dataset of a finished sweep; its arrays stay in the file until they are used.

    ``load``: all of it into memory.  `InvalidInput`: there is none.
    """
    import xarray as xr

    path = Path(folder) / NAME
    if not path.is_file():
        raise config.InvalidInput(f"{path}: no such file, expected a finished sweep")
    read = xr.load_dataset if load else xr.open_dataset
    return read(path, engine="h5netcdf", decode_times=False, decode_timedelta=False)
