"""A sweep in a table: a row per cell, medians with percentiles, counts with intervals."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from ultratight.statistics import wilson

if TYPE_CHECKING:
    import xarray
    from rich.table import Table

PERCENTILES = (10.0, 50.0, 90.0)
SHOWN = {
    "jump": ("velocity_rms_mps", "jump", "velocity in the jump m/s"),
    "end": ("velocity_rms_mps", "end", "velocity at the end m/s"),
    "nees": ("nees_velocity", None, "NEES/3"),
}
"""Columns of the table: variable, window, heading"""


def rows(data: xarray.Dataset) -> Iterator[dict[str, Any]]:
    """A row of plain data per cell.

    ``labels``, ``runs``, ``failed``, ``converged`` (number and Wilson's 95 % interval), ``lost``
    (runs that lost a channel), the 10, 50 and 90 % percentiles of each figure over the runs that
    have it, and ``took_s``, the median time of a run.
    """
    axes = [str(dim) for dim in data["failure"].dims[:-1]]
    for place in product(*(range(data.sizes[dim]) for dim in axes)):
        cell = data.isel(dict(zip(axes, place, strict=True)))
        n, converged = int(cell.sizes["run"]), int(cell["converged"].values.sum())
        share = wilson(converged, n)
        yield {
            "labels": {dim: cell[dim].values.item() for dim in axes},
            "runs": n,
            "failed": int((cell["failure"].values != "").sum()),
            "converged": {"runs": converged, "share": share.value, "low": share.low,
                          "high": share.high},
            "lost": int((cell["n_lost"].values > 0).sum()) if "n_lost" in cell else None,
            **{name: _percentiles(cell, *what[:2]) for name, what in SHOWN.items()},
            "took_s": _middle(cell["took_s"].values),
        }  # fmt: skip


def _percentiles(cell: xarray.Dataset, name: str, window: str | None) -> dict[str, float] | None:
    """10, 50 and 90 % over the runs with a number; None where there are none."""
    if name not in cell or (window is not None and window not in cell["window"]):
        return None
    values = (cell[name] if window is None else cell[name].sel(window=window)).values
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return None
    return {f"p{p:g}": float(q) for p, q in zip(PERCENTILES, np.percentile(finite, PERCENTILES),
                                                strict=True)}  # fmt: skip


def _middle(values: np.ndarray) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None


def table(data: xarray.Dataset) -> Table:
    """The same for people."""
    from rich.table import Table

    found = list(rows(data))
    axes = list(found[0]["labels"])
    out = Table(title="median [10 %, 90 %] over runs; converged with 95 % interval (Wilson)")
    for name in axes:
        out.add_column(name, overflow="fold")
    for name in ("runs", "failed", "converged", "lost lock"):
        out.add_column(name, justify="right")
    for _, _, heading in SHOWN.values():
        out.add_column(heading, justify="right")
    out.add_column("s per run", justify="right")
    for row in found:
        c = row["converged"]
        out.add_row(
            *(f"{label:g}" if isinstance(label, float) else str(label)
              for label in row["labels"].values()),
            str(row["runs"]),
            str(row["failed"]),
            f"{c['runs']} [{c['low']:.0%}, {c['high']:.0%}]",
            "-" if row["lost"] is None else str(row["lost"]),
            *(_cell(row[name]) for name in SHOWN),
            "-" if row["took_s"] is None else f"{row['took_s']:.2g}",
        )  # fmt: skip
    return out


def _cell(p: dict[str, float] | None) -> str:
    return "-" if p is None else f"{p['p50']:.3g} [{p['p10']:.3g}, {p['p90']:.3g}]"
