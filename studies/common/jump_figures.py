"""What the jump-triggered filter does, by cause, case and model, and outside its envelope."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from common.campaign import Study
from common.figures import heat_map
from common.jump_cells import (
    BEST,
    CASES,
    GRID,
)
from common.worlds import MODELS


def draw_grid(study: Study, flown: dict[str, xr.Dataset]) -> None:
    """Mechanism by model and case."""
    columns = {(m, c): flown[f"case-{c}"].sel(model=m, filter=BEST) for m in MODELS for c in CASES}
    jump = np.column_stack([d["jump"].fillna(np.inf).median("run") for d in columns.values()])
    hits = np.column_stack([d["converged"].sum("run") for d in columns.values()])
    nees = np.column_stack([d["nees"].fillna(np.inf).median("run") for d in columns.values()])
    notes = np.array(
        [f"{j:.3f}\n{k:.0f}, N {n:.2f}" for j, k, n in zip(jump.flat, hits.flat, nees.flat,
                                                        strict=True)]
    ).reshape(jump.shape)  # fmt: skip
    page = Figure(figsize=(9.0, 5.0), layout="constrained")
    ax = page.subplots()
    names = [f"{m}, case {c}" for m, c in columns]
    heat_map(ax, jump, notes, GRID["mechanisms"], names, (0.005, 1.0))
    n_run = next(iter(columns.values())).sizes["run"]
    ax.set_title(
        f"{BEST}: velocity error in the jump (median r.m.s., m/s); below it, how many of "
        f"{n_run} runs converged,\nand N, the median velocity NEES over that of chi-square",
        fontsize=9.0,
    )
    study.figure("jtq_grid", page)


def draw_envelope(study: Study, ds: xr.Dataset) -> None:
    """Cells outside the envelope, by receiver."""
    mine = ds.transpose("cell", "receiver", "run", ...)
    jump = mine["jump"].fillna(np.inf).median("run").values
    hits = mine["converged"].sum("run").values
    notes = np.array([f"{j:.2g}\n{k}" for j, k in zip(jump.flat, hits.flat, strict=True)])
    page = Figure(figsize=(6.5, 5.5), layout="constrained")
    ax = page.subplots()
    heat_map(ax, jump, notes.reshape(jump.shape), mine["cell"].values, mine["receiver"].values,
             (0.01, 10.0))  # fmt: skip
    ax.set_title(
        "Outside the envelope: velocity error in the motion (median r.m.s., m/s)\n"
        f"and, below it, how many of {ds.sizes['run']} runs converged",
        fontsize=9.0,
    )
    study.figure("jtq_envelope", page)
