"""The command that runs study scripts: each in a process of its own, one after the other.

Studies are not part of the package: they are scripts in a folder, `./studies` of a clone or one
that `--dir` names.  A script takes ``--out``, ``--jobs``, ``--quick``, ``--fresh``, ``--record``,
answers ``--count`` with the number of its runs, and merges its claims into ``ledger.json`` one
level above its own folder of results.
"""

from __future__ import annotations

import ast
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from ultratight.config import InvalidInput
from ultratight.options import Interrupted, Json, whole

LEDGER = "ledger.json"


@dataclass(frozen=True)
class Result:
    """How one script ended."""

    name: str
    exit_code: int
    wall_s: float


def study(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME...", help="none: list what there is")
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="every study, one by one")] = False,
    folder: Annotated[
        Path, typer.Option("--dir", metavar="DIR", help="where the scripts are")
    ] = Path("studies"),
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="results; what is there is not run again")
    ] = Path("results/studies"),
    quick: Annotated[bool, typer.Option("--quick", help="few seeds; the ledger says so")] = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="forget the results that are there")
    ] = False,
    jobs: Annotated[
        int | None, typer.Option(metavar="J", parser=whole, help="processes; default: all cores")
    ] = None,
    record: Annotated[
        bool, typer.Option("--record", help="also into DIR: ledger.json, README.md, figures")
    ] = False,
    as_json: Json = False,
) -> None:
    """Run studies and print their claim ledger.

    Interrupted at any moment, the same command goes on where it was.
    """
    scripts = find(folder)
    if not (names or everything):
        for name, path in scripts.items():
            print(f"{name:18} {headline(path)}")
        return
    chosen = choose(scripts, names or [], everything)
    if record and quick:
        raise InvalidInput("--record: --quick given too, expected full numbers of seeds to record")
    if jobs == 0:
        raise InvalidInput("--jobs: 0 given, expected a whole number from 1")
    options = ["--jobs", str(jobs or os.cpu_count() or 1)]
    options += ["--quick"] * quick + ["--fresh"] * fresh + ["--record"] * record
    _rows(out / LEDGER)  # readable, or hours of work would end with an error
    results = _run_all(chosen, options, out, talk=not as_json)
    done = {result.name for result in results if result.exit_code == 0}
    rows = [row for row in _rows(out / LEDGER) if row["study"] in done]
    if as_json:
        told = [vars(result) for result in results]
        print(json.dumps({"studies": told, "claims": rows}))
    else:
        print("\n".join(lines(rows)))
    if any(result.exit_code for result in results):
        raise typer.Exit(1)


def find(folder: Path) -> dict[str, Path]:
    """The scripts of a folder by name: Python files whose docstring says what they study."""
    scripts = {path.stem: path for path in sorted(folder.glob("*.py")) if path.name[0] != "_"}
    scripts = {name: path for name, path in scripts.items() if headline(path)}
    if not scripts:
        raise InvalidInput(
            f"{folder}: no studies here, expected the folder studies of a clone (--dir DIR)"
        )
    return scripts


def choose(scripts: dict[str, Path], names: Sequence[str], everything: bool) -> dict[str, Path]:
    """Those asked for, in the order given; all of them in the order of the folder."""
    if everything and names:
        raise InvalidInput(f"--all: {' '.join(names)} given too, expected names or --all")
    unknown = [name for name in names if name not in scripts]
    if unknown:
        raise InvalidInput(f"study: {unknown[0]!r}, expected one of {', '.join(scripts)}")
    return {name: scripts[name] for name in (names or scripts)}


def headline(path: Path) -> str:
    """First line of a script's docstring, "" if it has none."""
    try:
        tree = ast.parse(path.read_bytes())
    except (SyntaxError, ValueError) as error:
        why = f"{getattr(error, 'msg', error)}, line {getattr(error, 'lineno', None) or '?'}"
        raise InvalidInput(f"{path}: no Python script ({why}), expected a study") from None
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be read ({error.strerror}), expected a study") from None
    return (ast.get_docstring(tree) or "").partition("\n")[0]


def lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Verdicts, a line per claim, and how many of each there are."""
    width = max((len(row["id"]) for row in rows), default=0)
    told = [f"{row['id']:{width}}  {row['verdict']:33}  {row['claim']}" for row in rows]
    counts: dict[str, int] = {}
    for row in rows:
        counts[row["verdict"]] = counts.get(row["verdict"], 0) + 1
    summed = ", ".join(f"{n} {verdict}" for verdict, n in counts.items())
    return [*told, f"{len(rows)} claims: {summed or 'none written'}"]


# -- processes ------------------------------------------------------------------------------------


def _run_all(chosen: dict[str, Path], options: list[str], out: Path, talk: bool) -> list[Result]:
    """One after the other; what a script prints goes to stderr when stdout is for JSON."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInput(
            f"{out}: cannot be written to ({error.strerror}), expected a folder"
        ) from None
    sizes = {name: _count(path, options, out / name) for name, path in chosen.items()}
    left, results = sum(sizes.values()), []
    began = time.monotonic()
    for k, (name, path) in enumerate(chosen.items(), start=1):
        _say(f"study {k} of {len(chosen)}, {name}: {sizes[name]:.0f} runs of {left:.0f} left")
        start = time.monotonic()
        code = _run(path, options, out / name, None if talk else sys.stderr)
        now = time.monotonic()
        results.append(Result(name, code, now - start))
        left -= sizes[name]
        pace = (now - began) / max(1.0, sum(sizes.values()) - left)
        how = "done" if code == 0 else f"failed (exit code {code})"
        _say(f"{name}: {how} in {_span(now - start)}; about {_span(pace * left)} left")
    return results


def _run(path: Path, options: list[str], out: Path, stdout: Any) -> int:
    """Exit code of a script; Ctrl-C reaches both processes, SIGTERM is passed on."""
    command = [sys.executable, str(path), "--out", str(out), *options]
    process = subprocess.Popen(command, stdout=stdout, env=_environment())

    def ended(*_: object) -> None:
        process.terminate()
        raise KeyboardInterrupt

    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, ended) if main else None
    try:
        return process.wait()
    except KeyboardInterrupt:
        process.wait()
        kept = f"finished runs are kept in {out.parent}: the same command goes on from there"
        raise Interrupted(kept) from None
    finally:
        if main:
            signal.signal(signal.SIGTERM, before)


def _count(path: Path, options: list[str], out: Path) -> float:
    """Runs that a script still has to fly, in units of one closed-form run; 0 if it cannot say."""
    command = [sys.executable, str(path), "--out", str(out), *options, "--count"]
    done = subprocess.run(command, capture_output=True, text=True, env=_environment())
    try:
        return float(done.stdout)
    except ValueError:
        return 0.0


def _environment() -> dict[str, str]:
    """Ours, in which the script finds this very package."""
    home = str(Path(__file__).resolve().parents[1])
    paths = [home, *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)}


def _rows(path: Path) -> list[dict[str, Any]]:
    try:
        rows: list[dict[str, Any]] = json.loads(path.read_bytes()) if path.is_file() else []
    except ValueError:
        raise InvalidInput(
            f"{path}: damaged, expected JSON; without it the same command writes it anew"
        ) from None
    return rows


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _span(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"
