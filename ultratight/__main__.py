"""The command line: thin.  Options become overrides of a scenario, results become text."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ultratight import acquire_commands, if_commands, sweep_commands, track_commands
from ultratight import study as studies
from ultratight.options import (
    Closure,
    Correlator,
    FilterName,
    Interrupted,
    Json,
    Measurement,
    Navigation,
    Override,
    Quiet,
    Seed,
    Source,
    progress,
)

if TYPE_CHECKING:
    from ultratight.results import Run
    from ultratight.scenario import Scenario

DONE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
FIGURES = (".png", ".pdf", ".svg")

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="GNSS receiver baseband simulator with ultra-tight INS coupling at signal level.",
)


@app.command()
def run(
    source: Source,
    filter_: FilterName = None,
    closure: Closure = None,
    measurement: Measurement = None,
    correlator: Correlator = None,
    changes: Override = None,
    nav: Navigation = None,
    seed: Seed = 1,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.nc", help="write the run (netCDF)")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="write a figure (png, pdf, svg)")
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Fly a scenario and print how it went.

    What no option says is as the scenario has it: see `ultratight scenarios --print NAME`.
    """
    from ultratight import report, results

    chosen = _chosen(source, changes, nav, filter_, closure, measurement, correlator)
    if out:
        results.check_writable(out)
    if plot:
        results.check_writable(plot, FIGURES)
    if not quiet:
        for line in chosen.warnings():
            print(f"warning: {line}", file=sys.stderr)
    flown = _fly(chosen, seed, quiet)
    if out:
        flown.save(out)
    if plot:
        _draw([flown], plot)
    print(json.dumps(flown.summary) if as_json else "\n".join(report.report(flown)))
    if not (quiet or as_json):
        for path in (out, plot):
            if path:
                print(f"written: {path}")


@app.command()
def doctor(as_json: Json = False) -> None:
    """Say which kernels run here, and check them."""
    from ultratight import doctor as examiner

    if not as_json and sys.stderr.isatty():
        print("checking the kernels; those that are not kept yet are compiled", file=sys.stderr)
    told = examiner.examine()
    print(json.dumps(told) if as_json else "\n".join(examiner.lines(told)))
    if not told["healthy"]:
        raise typer.Exit(FAILED)


@app.command()
def scenarios(
    name: Annotated[
        str | None, typer.Option("--print", metavar="NAME", help="print one as TOML, every key")
    ] = None,
    keys: Annotated[
        bool, typer.Option("--keys", help="list every key: unit, choices, default, meaning")
    ] = False,
) -> None:
    """List the scenarios that ship, and why each exists."""
    from ultratight import report, scenario

    if keys:
        print("\n".join(report.keys()))
        return
    if name is not None:
        print(scenario.load(name).to_toml(), end="")
        return
    width = max(len(preset) for preset in scenario.PRESETS)
    for preset in scenario.PRESETS:
        tree = scenario.preset_tree(preset)
        print(f"{preset:{width}}  {tree['title']}\n{'':{width}}  {tree['why']}")


@app.command()
def filters() -> None:
    """List the filters by name, with their source."""
    from ultratight.filters.catalog import CATALOG

    width = max(len(name) for name in CATALOG)
    for name, recipe in CATALOG.items():
        print(f"{name:{width}}  {recipe.description}\n{'':{width}}  [{recipe.source}]")


@app.command()
def show(file: Annotated[Path, typer.Argument(metavar="FILE.nc")], as_json: Json = False) -> None:
    """Show what a saved run holds."""
    from ultratight import report, results

    kept = results.load(file)
    if as_json:
        print(json.dumps(kept.summary))
        return
    print("\n".join(report.report(kept)))
    print("\n".join(report.made_with(kept.provenance)))
    for event in kept.events:
        print(f"{event.t_s:9.3f} s  {event.channel or 'receiver':12}  {event.kind}  {event.reason}")
    for name, v in sorted(kept.variables.items()):
        shape = ", ".join(f"{d} {n}" for d, n in zip(v.dims, v.data.shape, strict=True))
        print(f"{name:24} ({shape}) {v.long_name} [{v.units or '1'}]")


@app.command()
def validate(
    source: Source,
    filter_: FilterName = None,
    closure: Closure = None,
    measurement: Measurement = None,
    correlator: Correlator = None,
    changes: Override = None,
    nav: Navigation = None,
) -> None:
    """Check a scenario, list every problem; fly nothing."""
    chosen = _chosen(source, changes, nav, filter_, closure, measurement, correlator)
    for line in chosen.warnings():
        print(f"warning: {line}", file=sys.stderr)
    what = f"{chosen.name}, {chosen.duration_s:g} s, scenario hash {chosen.digest()[:16]}"
    print(f"{source}: valid ({what})")


@app.command()
def predict(
    source: Source,
    filter_: FilterName = None,
    closure: Closure = None,
    measurement: Measurement = None,
    correlator: Correlator = None,
    changes: Override = None,
    nav: Navigation = None,
    as_json: Json = False,
) -> None:
    """Jitter, stress and margin of each channel before a run."""
    from ultratight import prediction

    chosen = _chosen(source, changes, nav, filter_, closure, measurement, correlator)
    found = prediction.predict(chosen)
    print(json.dumps(found.to_dict()) if as_json else "\n".join(prediction.lines(found)))


@app.command()
def showcase(
    out: Annotated[Path, typer.Option(help="folder for figure and results")] = Path("results"),
    seed: Seed = 1,
    quiet: Quiet = False,
) -> None:
    """Fly jump-1 with three filters, with and without its cause.

    All on the same IF samples; writes a figure, the runs and a summary.
    """
    from ultratight import showcase as script

    script.main(out, seed, quiet)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"ultratight {version('ultratight')}")
        raise typer.Exit


app.command()(if_commands.generate)
app.command()(if_commands.info)
app.command()(acquire_commands.acquire)
app.command()(track_commands.track)
app.command()(sweep_commands.sweep)
app.command()(sweep_commands.rerun)
app.command()(studies.study)


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="print the version")
    ] = False,
) -> None:
    pass


# -- what commands are made of --------------------------------------------------------------------


def _chosen(
    source: str,
    changes: list[str] | None,
    nav: Path | None,
    filter_: str | None,
    closure: str | None,
    measurement: str | None,
    correlator: str | None,
) -> Scenario:
    """The scenario with the options laid over it."""
    from ultratight import scenario

    options = {
        "receiver.filter": filter_,
        "receiver.closure": closure,
        "receiver.measurement": measurement,
        "correlator.kind": correlator,
        "constellation": nav and str(nav),
    }
    given = [f"{key}={json.dumps(value)}" for key, value in options.items() if value is not None]
    chosen = scenario.load(source, [*given, *(changes or [])])
    _refuse_meaningless(chosen, filter=filter_, measurement=measurement)
    return chosen


def _refuse_meaningless(chosen: Scenario, **options: str | None) -> None:
    """Refuse options that the chosen closure has no use for."""
    from ultratight.consistency import TIGHT
    from ultratight.scenario import Unsupported

    closure = chosen.receiver.closure
    if closure in TIGHT:
        return
    lines = [
        f"--{name}: {value} given, but closure {closure} has no {name}; "
        "expected --closure ultra-tight or federated, or no such option"
        for name, value in options.items()
        if value is not None
    ]
    if lines:
        raise Unsupported(lines)


def _fly(chosen: Scenario, seed: int, quiet: bool) -> Run:
    with progress(f"flying {chosen.name}", quiet) as report:
        from ultratight.simulation import run as simulate  # inside: it may warn

        return simulate(chosen, seed, progress=report)


def _draw(runs: Sequence[Run], path: Path) -> None:
    """Write the figure, whole or not at all."""
    from ultratight import plots

    part = path.with_name(f".{path.name}.part")
    try:
        plots.figure(runs).savefig(part, format=path.suffix[1:].lower(), dpi=150)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _failure(error: BaseException) -> tuple[int, str, list[str]] | None:
    """(exit code, error_kind, lines) for what a user can do something about, else None."""
    from ultratight.config import InvalidInput, Unsupported

    if hasattr(error, "format_message"):  # the command line itself
        return BAD_INPUT, "invalid_input", [" ".join(error.format_message().split())]
    if isinstance(error, InvalidInput):
        kind = "unsupported" if isinstance(error, Unsupported) else "invalid_input"
        return BAD_INPUT, kind, error.problems
    line = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, ArithmeticError) or type(error).__name__ == "LinAlgError":
        return FAILED, "numerical", [f"numerical failure: {line}"]
    if isinstance(error, OSError):
        return FAILED, "io", [line]
    if isinstance(error, ValueError):
        return BAD_INPUT, "invalid_input", [line]
    return None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0 done, 1 failed, 2 bad input, 130 interrupted."""
    given = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if arguments is None and given[0] == "predict":
        os.environ["NUMBA_DISABLE_JIT"] = "1"  # a few calls of each kernel: compiling takes longer
    left = "nothing half-written is left"
    try:
        # typer itself turns an interrupt into this code, or into Abort, by version
        code = int(app(given, prog_name="ultratight", standalone_mode=False) or DONE)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Interrupted as interrupt:
        code, left = INTERRUPTED, str(interrupt)
    except Exception as error:
        failure = _failure(error)
        if failure is None:
            raise
        code, kind, lines = failure
        for line in lines:
            print(f"error: {line}", file=sys.stderr)
        if "--json" in given:
            print(json.dumps({"error_kind": kind, "message": "\n".join(lines)}))
    if code == INTERRUPTED:
        print(f"interrupted, {left}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
