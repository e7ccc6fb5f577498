"""Errors while a disturbance lasts, and their ratios to the plain QKF's."""

from __future__ import annotations

import numpy as np
import xarray as xr

from common.adaptation_cells import (
    AFTER_S,
    BEGIN_S,
    CAMPAIGNS,
    FACED,
    JUMP_S,
    QKF,
    STEPS,
    Flown,
)
from common.campaign import Study


def judged(study: Study, model: str, kind: str = "") -> Flown:
    """What was flown, by disturbance, with its figure of merit and the error before."""
    out: Flown = {}
    for which in FACED[model]:
        name = f"{which}-{model}{kind}".replace(" ", "-")
        names = [n for n in (name, f"{name}-more") if n in CAMPAIGNS]
        if names:
            ds = study.fly(*names)
            one = {dim: 0 for dim in ("model", "taps", "disturbance") if dim in ds.dims}
            out[which] = with_merit(ds.isel(one), which)
    return out


def with_merit(ds: xr.Dataset, which: str) -> xr.Dataset:
    """With ``merit``, the error while the disturbance lasts, and ``quiet``, that before."""
    step = STEPS.get(which)
    start, end = (JUMP_S, AFTER_S) if step is None else (BEGIN_S, step.until_s)
    series = ds["position_error" if step and step.position else "error"]
    return ds.assign(merit=rms(series, start, end), quiet=rms(ds["error"], start - 3.0, start))


def rms(series: xr.DataArray, start_s: float, end_s: float) -> xr.DataArray:
    """Root mean square after the start, up to the end; infinite where a run ended before."""
    part = series.where(
        (series["t_s"] > start_s + 1e-6) & (series["t_s"] < end_s + 1e-6), drop=True
    )
    return np.sqrt((part**2).mean("t_s", skipna=False)).fillna(np.inf)


def ratio(ds: xr.Dataset, label: str, what: str = "merit") -> np.ndarray:
    """A row's error over the QKF's, seed by seed; two that diverged are equal."""
    mine, base = (ds[what].sel(filter=x).values for x in (label, QKF))
    with np.errstate(invalid="ignore"):
        found = mine / base
    return np.where(np.isinf(mine) & np.isinf(base), 1.0, found)


def difference(ds: xr.Dataset, label: str) -> np.ndarray:
    """A row's error less the QKF's, seed by seed."""
    mine, base = (ds["merit"].sel(filter=x).values for x in (label, QKF))
    with np.errstate(invalid="ignore"):
        return np.where(np.isinf(mine) & np.isinf(base), 0.0, mine - base)
