"""The files that a scenario names: data of the world, and the source of a user's own filter.

They enter what identifies a scenario by their content, wherever they are.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ultratight.filters import own

CONSTELLATIONS = ("embedded", "nominal-24", "galileo-24")
"""Skies that need no file"""
FILTER = "receiver.filter"
_EXPECTED = {
    "constellation": '"embedded", "nominal-24", "galileo-24" or a RINEX navigation file',
    "galileo_codes": "a file of the E1 memory codes (CSV)",
    "trajectory": "a trajectory file (CSV)",
}


def named(tree: Mapping[str, Any]) -> dict[str, str]:
    """What the keys of the world that name files hold, where they do."""
    held = {key: tree.get(key) for key in _EXPECTED}
    return {
        key: name
        for key, name in held.items()
        if isinstance(name, str) and name and name not in CONSTELLATIONS
    }


def own_filter(tree: Mapping[str, Any]) -> str | None:
    """The name of a user's own filter, where the receiver has one."""
    receiver = tree.get("receiver")
    name = receiver.get("filter") if isinstance(receiver, Mapping) else None
    return name if isinstance(name, str) and own.is_own(name) else None


def problems(tree: Mapping[str, Any]) -> list[str]:
    """A line for each file that is not there, and for a filter that cannot be loaded."""
    lines = [
        f'{key}: "{path}" given, expected {_EXPECTED[key]} (there is no such file)'
        for key, path in named(tree).items()
        if not Path(path).is_file()
    ]
    if name := own_filter(tree):
        try:
            own.make(name)
        except ValueError as error:
            lines.append(f"{FILTER}: {error}")
    return lines


def moved(tree: Mapping[str, Any], to: Callable[[str], str]) -> dict[str, Any]:
    """A tree that names ``to(path)`` in place of each file; modules stay where they are."""
    changed = dict(tree) | {key: to(path) for key, path in named(tree).items()}
    if name := own_filter(tree):
        place, _, what = name.rpartition(":")
        if own.is_file(place):
            changed["receiver"] = dict(tree["receiver"]) | {"filter": f"{to(place)}:{what}"}
    return changed


def paths(tree: Mapping[str, Any]) -> dict[str, Path]:
    """Key -> file; ValueError where the filter's is not there."""
    found = {key: Path(name) for key, name in named(tree).items()}
    if name := own_filter(tree):
        found[FILTER] = own.source(name)
    return found


def sha256(tree: Mapping[str, Any]) -> dict[str, str]:
    """Key -> SHA-256 of its file; OSError, ValueError where it is gone."""
    return {key: hashlib.sha256(path.read_bytes()).hexdigest() for key, path in paths(tree).items()}


def by_content(tree: Mapping[str, Any]) -> dict[str, Any]:
    """A tree in which the content of each file stands for its name."""
    shas = sha256(tree)
    marks = {key: f"sha256:{sha}" for key, sha in shas.items()}
    mark = marks.pop(FILTER, None)
    changed = dict(tree) | marks
    if mark is not None:
        what = tree["receiver"]["filter"].rpartition(":")[2]
        changed["receiver"] = dict(tree["receiver"]) | {"filter": f"{mark}:{what}"}
    return changed
