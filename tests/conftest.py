"""What all tests stand on."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import pytest

STUDIES = Path(__file__).parents[1] / "studies"

# A shell's background job ignores SIGINT, and its children would: what Ctrl-C does is tested.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


class Said(NamedTuple):
    """What a command ended with and wrote."""

    code: int
    out: str
    err: str


@pytest.fixture
def say(capsys: pytest.CaptureFixture[str]) -> Callable[..., Said]:
    """Run a command of the command line in this process."""
    from ultratight.__main__ import main

    def call(*arguments: object) -> Said:
        code = main([str(a) for a in arguments])
        return Said(code, *capsys.readouterr())

    return call


@pytest.fixture(scope="module")
def studies() -> Iterator[Callable[..., SimpleNamespace]]:
    """Import what studies are made of, ``name=module``; their folder is on no path but theirs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(STUDIES)
        yield lambda **named: SimpleNamespace(**{k: import_module(v) for k, v in named.items()})
