"""What a study script is made of: campaigns declared in advance, flown as sweeps, and a conclusion.

A script declares its campaigns, flies them with `Study.fly`, and ends with `Study.conclude`.  Its
command line: ``--out DIR`` (results; what is there is not flown again, unless ``--fresh``),
``--jobs``, ``--quick`` (few seeds), ``--record`` (ledger, README and figures beside the scripts
too), ``--count``.
"""

from __future__ import annotations

import argparse
import io
import math
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from PIL import Image

import ultratight
from common import ledger
from common.ledger import Claim
from ultratight.provenance import sources_sha256

HOME = Path(__file__).resolve().parents[1]
QUICK_RUNS = 2
CHI2_3_MEDIAN = 2.366
"""Median of chi-square with 3 degrees of freedom"""


@dataclass(frozen=True)
class Campaign:
    """A scenario, axes of named overrides, and how often each combination is flown.

    Run r has the seed ``seed`` + r.  ``weight`` is the cost of a run in units of one of 50 s in
    closed form; ``keep`` names series over time, ``every_s`` apart.
    """

    scenario: str
    over: Mapping[str, Mapping[str, Mapping[str, Any]]]
    runs: int
    seed: int = 1
    weight: float = 1.0
    keep: tuple[str, ...] = ()
    every_s: float = 0.1
    filters: Mapping[str, Callable[[], Any]] = field(default_factory=dict)

    @property
    def size(self) -> float:
        """Cost of all runs."""
        return self.weight * self.runs * math.prod(len(axis) for axis in self.over.values())


class Study:
    """One script at work."""

    def __init__(self, script: str, campaigns: Mapping[str, Campaign]) -> None:
        self.name = Path(script).stem
        options = _options(sys.argv[1:], self.name)
        self.quick, self.jobs, self.recording = options.quick, options.jobs, options.record
        self.fresh = options.fresh
        self.out: Path = options.out
        self.campaigns = {
            name: replace(c, runs=min(c.runs, QUICK_RUNS)) if self.quick else c
            for name, c in campaigns.items()
        }
        if options.count:
            print(sum(c.size for c in self.campaigns.values()))
            raise SystemExit(0)
        self.out.mkdir(parents=True, exist_ok=True)
        self.codes: set[str] = set()
        self._report: list[str] = []

    def fly(self, *names: str) -> xr.Dataset:
        """Campaigns that differ in their filters as one Dataset, under names that are short.

        before, jump, after, end [m/s], converged, position_end [m], nees (median of the velocity
        NEES in the jump over that of chi-square), n_lost, n_satellites, first_loss_s; error
        (.., run, t_s) [m/s] where velocity errors were kept, other series by their own names;
        lost_lock_s, off_carrier_s, off_signal_s, on_signal_s (.., run, channel), failure.
        """
        return (
            xr.concat([self._sweep(name) for name in names], "filter")
            if names[1:]
            else (self._sweep(names[0]))
        )

    def _sweep(self, name: str) -> xr.Dataset:
        c = self.campaigns[name]
        folder = self.out / ("quick" if self.quick else "full") / name
        swept = ultratight.sweep(
            c.scenario, over=c.over, runs=c.runs, seed=c.seed, jobs=self.jobs, out=folder,
            filters=c.filters, progress=_Clock(f"{self.name}, {name}"), keep=c.keep,
            every_s=c.every_s, fresh=self.fresh,
        )  # fmt: skip
        self.codes.add(sources_sha256()[:12])
        return short_names(swept)

    def say(self, text: str) -> None:
        """To the terminal, and into the report of the study."""
        print(text, flush=True)
        self._report.append(text)

    def table(self, title: str, ds: xr.Dataset, more: Sequence[str] = ()) -> None:
        """Medians and 90th percentiles, a line per combination."""
        self.say(f"\n{self.name}: {title} ({ds.sizes['run']} runs)")
        outer = [d for d in ds["converged"].dims if d != "run"]
        stacked = ds[["before", "jump", "end", "position_end", "nees", "converged", *more]]
        rows = stacked.stack(line=outer) if outer else stacked.expand_dims("line")
        self.say(
            f"{'':44} {'before':>8} {'jump (90 %)':>18} {'end':>8} {'pos. m':>7} {'NEES':>8} conv. "
            + " ".join(more)
        )
        for k in range(rows.sizes["line"]):
            row = rows.isel(line=k)
            labels = row["line"].values.item() if outer else ()
            self.say(f"{', '.join(map(str, np.atleast_1d(labels))):44} {_cells(row, more)}")

    def figure(self, name: str, page: Figure) -> None:
        """Save it, with a palette to keep it small; where results are recorded also there."""
        path, drawn = self.out / f"{name}.png", io.BytesIO()
        page.savefig(drawn, dpi=100)
        octree = Image.Quantize.FASTOCTREE  # keeps colours of which there is little, as in a legend
        Image.open(drawn).convert("RGB").quantize(256, octree).save(path, optimize=True)
        if self.recording:
            (HOME / "figures").mkdir(exist_ok=True)
            shutil.copyfile(path, HOME / "figures" / path.name)

    def conclude(self, claims: Sequence[Claim]) -> None:
        """Print the verdicts and merge the claims into the ledger."""
        command = f"ultratight study {self.name}"
        told = {
            "study": self.name,
            "command": command,
            "quick": self.quick,
            "code": ", ".join(sorted(self.codes)),
        }
        done = [replace(claim, **told) for claim in claims]
        self.say("")
        if self.quick:
            self.say("quick look: few runs and levels; these verdicts are not those of the ledger")
        for claim in done:
            row = claim.row()
            self.say(f"{row['verdict'].upper()}: {claim.claim}\n    theirs: {claim.theirs}")
            for quantity in row["ours"]:
                self.say(f"    ours: {ledger.words(quantity).replace('**', '')}")
        ledger.merge(self.out.parent / "ledger.json", done, self.name)
        ledger.write(self.out / "report.txt", "\n".join(self._report) + "\n")
        if self.recording:
            rows = ledger.merge(HOME / "ledger.json", done, self.name)
            ledger.refresh(HOME / "README.md", rows)


def carry_out(main: Callable[[], None]) -> None:
    """Run a script's ``main``: what is wrong or interrupted is told in a line, not a traceback."""
    try:
        main()
    except ultratight.InvalidInput as error:
        raise SystemExit("\n".join(f"error: {line}" for line in error.problems)) from None
    except KeyboardInterrupt as interrupt:
        print(f"interrupted: {interrupt}", file=sys.stderr)
        raise SystemExit(130) from None


class _Clock:
    """Says on stderr how far a campaign is and when it will be done, every ten seconds."""

    def __init__(self, what: str) -> None:
        self.what, self.began, self.said = what, time.monotonic(), time.monotonic()
        self.first: float | None = None  # share that was there before

    def __call__(self, share: float) -> None:
        now = time.monotonic()
        if self.first is None:
            self.first = share
        if now - self.said < 10.0 and share < 1.0:
            return
        self.said = now
        left = (now - self.began) * (1.0 - share) / max(share - self.first, 1e-6)
        text = f", {left:.0f} s left" if self.first < share < 1.0 else ""
        print(f"{self.what}: {100.0 * share:.0f} %{text}", file=sys.stderr, flush=True)


def short_names(swept: xr.Dataset) -> xr.Dataset:
    """A sweep's Dataset under the names that the studies use."""
    velocity = swept["velocity_rms_mps"]
    renamed = {
        "position_rms_end_m": "position_end",
        "first_lost_s": "first_loss_s",
        "velocity_error": "error",
    }
    keep = ["converged", "n_lost", "n_satellites", "fall_backs", "lost_lock_s", "off_carrier_s",
            "off_signal_s", "on_signal_s", "failure"]  # fmt: skip
    series = [str(name) for name in swept.data_vars if "time_s" in swept[name].dims]
    renamed = {old: new for old, new in renamed.items() if old in swept}
    out = swept[list(dict.fromkeys([*keep, *series, *renamed]))].rename(renamed)
    out = out.assign({w: velocity.sel(window=w, drop=True) for w in velocity["window"].values})
    out["nees"] = swept["nees_velocity"] * 3.0 / CHI2_3_MEDIAN
    return out.rename({"time_s": "t_s"} if "time_s" in out.dims else {}).load()


def speed_profile(preset: str) -> tuple[np.ndarray, np.ndarray]:
    """Time [s] and speed [m/s] of a preset with a profile of straight acceleration."""
    scenario = ultratight.load(preset)
    t = np.linspace(0.0, scenario.duration_s, 1001)
    speed = np.full(t.size, scenario.speed_mps)
    for s in scenario.profile:
        x = np.clip(t, s.t0_s, s.t1_s) - s.t0_s
        slope = (s.accel1_mps2 - s.accel0_mps2) / (s.t1_s - s.t0_s)
        speed += s.accel0_mps2 * x + 0.5 * slope * x**2
    return t, speed


def _cells(row: xr.Dataset, more: Sequence[str]) -> str:
    def middle(name: str, share: float = 0.5) -> float:
        values = row[name].values
        if not np.isfinite(values).any():
            return np.nan
        ranked = np.where(np.isfinite(values), values, np.inf)
        return float(np.quantile(ranked, share, method="inverted_cdf"))

    return (
        f"{middle('before'):8.4f} {middle('jump'):9.4f} ({middle('jump', 0.9):7.4g}) "
        f"{middle('end'):8.4f} {middle('position_end'):7.2f} {middle('nees'):8.3g} "
        f"{int(row['converged'].sum())}/{row.sizes['run']} "
        + " ".join(f"{middle(name):.2f}" for name in more)
    )


def _options(arguments: Sequence[str], name: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog=name)
    parser.add_argument("--out", type=Path, default=Path("results/studies") / name)
    parser.add_argument("--jobs", type=int, default=None)
    for flag in ("--quick", "--fresh", "--record", "--count"):
        parser.add_argument(flag, action="store_true")
    return parser.parse_args(arguments)
