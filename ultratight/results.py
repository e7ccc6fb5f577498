"""Run: what a simulation gives back.  Histories with units, events, provenance; netCDF in and out.

Truth stands beside the estimate.  Nothing here knows how a run is made.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ultratight.config import InvalidInput

if TYPE_CHECKING:
    import xarray

FORMAT = "ultratight-run-2"
"""Mark of our files; the number grows when an old reader would misread a new file"""
EPOCH = "t_s"
"""Dimension of everything that is recorded once per epoch, and its coordinate `Run.t_s`"""
_COMPLEX = "real_imag"
"""Dimension that stands for complex numbers in a file: netCDF has no complex type"""

_EVENT_COLUMNS = ("t_s", "channel", "kind", "reason")
_DOCUMENTS = ("scenario", "provenance", "summary")

Group = Literal["", "truth", "estimate", "taps", "nco", "covariance", "filter"]


@dataclass(frozen=True)
class Variable:
    """An array with the names of its dimensions, its unit ("1" for none) and a plain sentence."""

    data: np.ndarray
    dims: tuple[str, ...]
    units: str
    long_name: str
    group: Group = ""

    def __post_init__(self) -> None:
        if self.data.ndim != len(self.dims):
            raise ValueError(
                f"{self.long_name}: {self.data.ndim} axes given, expected {len(self.dims)} "
                f"({', '.join(self.dims)})"
            )


@dataclass(frozen=True)
class Event:
    """Something that happened at receiver time ``t_s``; without channel: to the whole receiver."""

    t_s: float
    channel: str
    kind: str
    reason: str


@dataclass(frozen=True)
class Run:
    """One scenario, flown once.

    ``run["v_eb_e"]`` is the array of a variable, ``run.variables["v_eb_e"]`` the array with its
    dimensions and unit.
    """

    scenario: dict[str, Any]
    seed: int
    t_s: np.ndarray  # (n_epoch,) receiver time since the start [s]
    variables: dict[str, Variable]
    events: list[Event] = field(default_factory=list)
    provenance: dict[str, Any] = field(default_factory=dict)
    summary: dict[str, Any] = field(default_factory=dict)

    def __getitem__(self, name: str) -> np.ndarray:
        """The array of a variable; KeyError names those that there are."""
        try:
            return self.variables[name].data
        except KeyError:
            there = ", ".join(sorted(self.variables))
            raise KeyError(f"{name}; this run has {there}; time is run.t_s") from None

    def __repr__(self) -> str:
        s = self.summary
        how = [s[k] for k in ("closure", "filter", "measurement") if s.get(k)]
        end = (s.get("velocity_rms_mps") or {}).get("end")
        said = "" if end is None else f"; velocity r.m.s. of the end {end:.3g} m/s"
        return (
            f"<Run {self.scenario.get('name', '')}, seed {self.seed}: {', '.join(how)}; "
            f"{self.t_s.size} epochs to {self.t_s[-1] if self.t_s.size else 0.0:g} s, "
            f"{len(self.variables)} variables, {len(self.events)} events{said}>"
        )

    def __contains__(self, name: object) -> bool:
        return name in self.variables

    def to_xarray(self) -> xarray.Dataset:
        """Everything as one Dataset; scenario, provenance and summary as JSON texts.

        Dimensions carry their labels: ``dataset.v_eb_e.sel(t_s=2.0, xyz="x", method=...)``.
        """
        import xarray as xr

        values = {
            name: xr.Variable(v.dims, _storable(v.data), _attributes(v))
            for name, v in self.variables.items()
        }
        coordinates: dict[str, Any] = {
            "t_s": xr.Variable(
                (EPOCH,), self.t_s, {"units": "s", "long_name": "receiver time since the start"}
            )
        }
        for name in _EVENT_COLUMNS:
            column = [getattr(event, name) for event in self.events]
            data = np.array(column, dtype=np.float64 if name == "t_s" else str)
            attributes = {"units": "s" if name == "t_s" else "", "long_name": f"{name} of an event"}
            values[f"event_{name}"] = xr.Variable(("event",), _storable(data), attributes)
        for name in _DOCUMENTS:  # variables, for an attribute may not exceed 64 kB
            text = json.dumps(getattr(self, name))
            values[name] = xr.Variable((), text, {"units": "", "long_name": f"{name} as JSON"})
        return xr.Dataset(values, coordinates, {"format": FORMAT, "seed": self.seed})

    @classmethod
    def from_xarray(cls, dataset: xarray.Dataset) -> Run:
        """What `to_xarray` made, back again.  ValueError for any other Dataset."""
        if dataset.attrs.get("format") != FORMAT:
            raise ValueError(f"not a run of ultratight (expected format {FORMAT})")
        variables = {
            str(name): Variable(
                _as_given(array.values),
                tuple(str(d) for d in array.dims),
                array.attrs["units"],
                array.attrs["long_name"],
                array.attrs.get("group", ""),
            )
            for name, array in dataset.variables.items()
            if name not in ("t_s", *_DOCUMENTS) and array.dims != ("event",)
        }
        columns = [dataset[f"event_{name}"].values.tolist() for name in _EVENT_COLUMNS]
        documents = {name: json.loads(str(dataset[name].item())) for name in _DOCUMENTS}
        return cls(
            seed=int(dataset.attrs["seed"]),
            t_s=dataset["t_s"].values,
            variables=variables,
            events=[Event(*row) for row in zip(*columns, strict=True)],
            **documents,
        )

    def save(self, path: str | Path) -> None:
        """Write one netCDF-4 file, whole or not at all.  OSError where that is impossible."""
        path = Path(path)
        dataset = _without_complex(self.to_xarray())
        for name in dataset.variables:
            dataset[name].encoding["_FillValue"] = None  # NaN is a value here, not a hole
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            dataset.to_netcdf(part, engine="h5netcdf")
            os.replace(part, path)
        finally:
            with suppress(OSError):
                part.unlink()


def load(path: str | Path) -> Run:
    """Read what `Run.save` wrote.  `InvalidInput` names a missing, truncated or foreign file."""
    import xarray as xr

    path = Path(path)
    if not path.is_file():
        raise InvalidInput(f"{path}: no such file, expected a run (netCDF)")
    try:
        dataset = xr.load_dataset(path, engine="h5netcdf", decode_times=False, mask_and_scale=False)
        return Run.from_xarray(_with_complex(dataset))
    except (OSError, ValueError, KeyError, RuntimeError, TypeError) as error:
        reason = "not a run of ultratight" if "format" in str(error) else "truncated or foreign"
        raise InvalidInput(
            f"{path}: {reason}, expected a netCDF file from `ultratight run --out`"
        ) from None


def check_writable(path: str | Path, suffixes: tuple[str, ...] = (".nc",)) -> None:
    """Find out before the work whether ``path`` can be written; `InvalidInput` says why not."""
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise InvalidInput(f"{path}: expected a file name that ends in {' or '.join(suffixes)}")
    if path.is_dir():
        raise InvalidInput(f"{path}: is a folder, expected the name of a file")
    if not path.parent.is_dir():
        raise InvalidInput(f"{path}: no such folder {path.parent}, expected one that exists")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise InvalidInput(
            f"{path}: cannot write in {path.parent} ({error.strerror}), expected a writable folder"
        ) from None


def _attributes(variable: Variable) -> dict[str, str]:
    attributes = {"units": variable.units, "long_name": variable.long_name}
    return attributes | ({"group": variable.group} if variable.group else {})


def _storable(data: np.ndarray) -> np.ndarray:
    """Texts as objects, which are stored with a length of their own."""
    return data.astype(object) if data.dtype.kind in "UT" else data


def _as_given(data: np.ndarray) -> np.ndarray:
    return np.array(data.tolist(), dtype=str) if data.dtype.kind in "OT" else data


def _without_complex(dataset: xarray.Dataset) -> xarray.Dataset:
    changed: Mapping[str, Any] = {
        str(name): (
            (*array.dims, _COMPLEX),
            np.stack([array.values.real, array.values.imag], axis=-1),
            array.attrs,
        )
        for name, array in dataset.data_vars.items()
        if array.dtype.kind == "c"
    }
    return dataset.assign(changed) if changed else dataset


def _with_complex(dataset: xarray.Dataset) -> xarray.Dataset:
    changed: Mapping[str, Any] = {
        str(name): (
            array.dims[:-1],
            np.ascontiguousarray(array.values).view(np.complex128)[..., 0],
            array.attrs,
        )
        for name, array in dataset.data_vars.items()
        if array.dims[-1:] == (_COMPLEX,)
    }
    return dataset.assign(changed) if changed else dataset
