"""What all tests stand on."""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import NamedTuple

import pytest

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
