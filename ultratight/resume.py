"""What work that is gone on with needs: is it the same work, and is nobody else at it?"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

_SHOWN = 3


def flat(tree: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Keys with dots, so that what differs can be named."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= (
            flat(value, f"{above}{key}.") if isinstance(value, Mapping) else {above + key: value}
        )
    return found


def differences(then: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """What differs between two flat trees, in part of a line; empty where nothing does."""
    found = [
        f"{key} is {_short(then.get(key))} there, {_short(here.get(key))} here"
        for key in {**here, **then}
        if then.get(key) != here.get(key)
    ]
    more = f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
    return "; ".join(found[:_SHOWN]) + more


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def lock(file: BinaryIO, path: Path) -> None:
    """Two processes must not write one file; without locks (Windows) nobody is kept off.

    OSError: another process is writing it.
    """
    if sys.platform != "win32":
        import fcntl

        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OSError(f"{path}: another process is writing it") from None
        except OSError:
            pass  # a file system without locks
