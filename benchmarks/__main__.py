"""Run the groups, print a table, write JSON."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from benchmarks.harness import ROUNDS, Row, measure
from benchmarks.peers import MACHINE, PLAIN_GSPS, YARDSTICK

GROUPS = (
    "correlator", "generator", "acquisition", "receiver", "loop", "closures", "sweep", "startup",
)  # fmt: skip
PATHS = ("avx512", "avx2", "portable")
ON_EVERY_PATH = ("correlator", "generator")


def main(
    only: Annotated[
        list[str] | None, typer.Argument(metavar="[GROUP]...", help=", ".join(GROUPS))
    ] = None,
    out: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="also as JSON")] = None,
    rounds: Annotated[int, typer.Option(min=1, help="turns of each case")] = ROUNDS,
    one_path: Annotated[bool, typer.Option("--one-path", help="not the slower CPU paths")] = False,
) -> None:
    """Measure and print; every figure beside its target."""
    names = only or list(GROUPS)
    for name in names:
        if name not in GROUPS:
            print(f"error: group: {name!r}, expected one of {', '.join(GROUPS)}", file=sys.stderr)
            raise SystemExit(2)
    report: dict[str, Any] = {"machine": _machine(), "peers_machine": MACHINE, "groups": []}
    for group in _all(names, rounds, one_path):
        report["groups"].append(group)
        if out is None or str(out) != "-":
            _print(group)
    if out is None or str(out) != "-":
        _print_yardstick(report["groups"])
    if out is not None:
        text = json.dumps(report, indent=1)
        if str(out) == "-":
            print(text)
        else:
            out.parent.mkdir(parents=True, exist_ok=True)
            out.write_text(text + "\n", encoding="utf-8")


def _all(names: list[str], rounds: int, one_path: bool) -> Iterator[dict[str, Any]]:
    from signals import cpu

    here = cpu.path()
    for name in names:
        for title, cases in import_module(f"benchmarks.{name}").groups():
            yield {
                "title": title,
                "cpu_path": here,
                "rows": [row.as_dict() for row in measure(cases, rounds)],
            }
        if name in ON_EVERY_PATH and not one_path and here in PATHS:
            for path in PATHS[PATHS.index(here) + 1 :]:
                yield from _elsewhere(name, path, rounds)


def _elsewhere(name: str, path: str, rounds: int) -> list[dict[str, Any]]:
    """The same group on a lesser path of this CPU, in a process of its own."""
    command = [sys.executable, "-m", "benchmarks", name, "--json", "-", "--one-path"]
    done = subprocess.run(
        [*command, "--rounds", str(rounds)],
        env=os.environ | {"ULTRATIGHT_CPU_PATH": path},
        stdout=subprocess.PIPE,
        check=True,
    )
    groups: list[dict[str, Any]] = json.loads(done.stdout)["groups"]
    return groups


def _machine() -> dict[str, Any]:
    from llvmlite import binding

    return {
        "cpu": binding.get_host_cpu_name(),
        "cores": os.cpu_count(),
        "load": [round(x, 1) for x in os.getloadavg()] if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "system": platform.platform(),
    }


def _print_yardstick(groups: list[dict[str, Any]]) -> None:
    """How fast this machine was, so that absolute figures can be read."""
    plain = [r["figure"] for g in groups for r in g["rows"] if r["name"] == YARDSTICK]
    if plain:
        print(
            f"{YARDSTICK}: {min(plain):.3f}-{max(plain):.3f} G/s here, {PLAIN_GSPS} where "
            "the targets were set; ratios to it do not depend on clock and load as much"
        )


def _print(group: dict[str, Any]) -> None:
    table = Table(title=f"{group['title']}  [{group['cpu_path']}]", title_justify="left")
    columns = ("", "figure", "unit", "target", "of limit", "x baseline", "error", "peers, note")
    for column in columns:
        table.add_column(column, justify="left" if column in ("", "unit", columns[-1]) else "right")
    for entry in group["rows"]:
        row = Row(**entry)
        table.add_row(*_cells(row))
    Console(width=None if sys.stdout.isatty() else 170).print(table)


def _cells(row: Row) -> tuple[str, ...]:
    sign = "<=" if row.cost else ">="
    marks = {None: "", True: " met", False: " MISSED"}
    mark = marks[row.met]
    target = "" if row.target is None else f"{sign} {row.target:g}{mark}"
    of_limit = "" if row.limit is None else f"{row.figure / row.limit:.0%} of {row.limit:g}"
    ratio = "" if row.ratio is None else f"{row.ratio:.3g}"
    if row.ratio_target is not None:
        ratio += f" (>= {row.ratio_target:g}){marks[row.ratio_met]}"
    error = "" if row.error is None else f"{row.error:.1e}"
    if row.error_target is not None:
        error += f" (<= {row.error_target:g})"
        error += mark if row.target is None else ""
    note = "; ".join(text for text in (row.peer, row.note) if text)
    return row.name, f"{row.figure:.3g}", row.unit, target, of_limit, ratio, error, note


if __name__ == "__main__":
    typer.run(main)
