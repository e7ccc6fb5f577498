"""What several commands take, and how they say how far they are."""

from __future__ import annotations

import logging
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

Source = Annotated[str, typer.Argument(metavar="PRESET|FILE.toml", help="what to fly")]
Override = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="change one key, e.g. imu.lag_s=0.0025"),
]
FilterName = Annotated[
    str | None, typer.Option("--filter", metavar="NAME", help="see `ultratight filters`")
]
Closure = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="ultra-tight, federated, vdfll, vdll, scalar, scalar-ins"),
]
Measurement = Annotated[str | None, typer.Option(metavar="NAME", help="coherent or differential")]
Correlator = Annotated[
    str | None, typer.Option(metavar="NAME", help="samples or model (closed form)")
]
Navigation = Annotated[
    Path | None, typer.Option(metavar="FILE", help="RINEX navigation file for the sky")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="no progress, no warnings")]
Json = Annotated[bool, typer.Option("--json", help="print one JSON object")]


def whole(given: str | int) -> int:
    """A whole number from the command line, none of them negative."""
    text = str(given)  # the default comes as a number
    if not (text.isascii() and text.isdigit() and int(text) < 2**63):
        raise typer.BadParameter(f"{text!r} given, expected a whole number from 0 to 2^63 - 1")
    return int(text)


def number(given: str | float) -> float:
    """A number from the command line."""
    try:
        return float(given)
    except ValueError:
        raise typer.BadParameter(f"{given!r} given, expected a number") from None


Seed = Annotated[
    int, typer.Option("--seed", parser=whole, metavar="N", help="seed of every random stream")
]


LINE_S = 60.0
"""A line at least this often"""


class Interrupted(Exception):
    """An interrupt after which there is something to say, in one line."""


@contextmanager
def interruptible() -> Iterator[None]:
    """What ends a job from outside (SIGTERM) is an interrupt; one that says something is told."""
    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, signal.default_int_handler) if main else None
    try:
        yield
    except KeyboardInterrupt as interrupt:
        if interrupt.args:
            raise Interrupted(*interrupt.args) from None
        raise
    finally:
        if main:
            signal.signal(signal.SIGTERM, before)


@contextmanager
def progress(what: str, quiet: bool) -> Iterator[Callable[[float], None] | None]:
    """A bar on a terminal, a line per tenth or minute when piped, nothing when quiet; on stderr.

    Both with the time left.
    """
    if quiet:
        before = logging.root.manager.disable
        logging.disable(logging.WARNING)
        try:
            yield None
        finally:
            logging.disable(before)
    elif sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import Progress

        with Progress(console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(f"{what} (the first run compiles)", total=1.0)
            yield lambda share: bar.update(task, completed=share)
    else:
        done, said = -1, -math.inf
        began: tuple[float, float] | None = None

        def report(share: float) -> None:
            nonlocal done, said, began
            now = time.monotonic()
            if began is None:
                began = now, share
            if int(share * 10.0) > done or now - said > LINE_S:
                done, said = int(share * 10.0), now
                left = (1.0 - share) * (now - began[0]) / max(share - began[1], 1e-9)
                known = share > began[1] and share < 1.0
                more = f", about {duration(left)} left" if known else ""
                print(f"{what}: {int(100.0 * share)} %{more}", file=sys.stderr, flush=True)

        yield report


def duration(seconds: float) -> str:
    """A time in a unit that suits it."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400.0 else f"{seconds / 3600:.1f} h"
