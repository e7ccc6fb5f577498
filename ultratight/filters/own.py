"""A user's own filter by its name: ``mine.py:MyFilter`` or ``package.module:MyFilter``.

What stands behind the name is called without arguments, once per run, and gives a filter
(`gaussian.Filter`: ``step`` and ``reset``).  Every ValueError here says in one line what was given
and what was expected; the name of the key is the caller's to add.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from threading import RLock
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ultratight.filters.gaussian import Filter

EXPECTED = "FILE.py:NAME or package.module:NAME"
_LOADING = RLock()


def is_own(name: str) -> bool:
    """Is it a user's own filter, not one of the catalogue?"""
    return ":" in name


def split(name: str) -> tuple[str, str]:
    """Where it is (a file or a module) and what it is called there.

    >>> split("mine.py:MyFilter")
    ('mine.py', 'MyFilter')
    """
    place, _, what = name.rpartition(":")
    dotted = place.replace(".", "_").isidentifier() and ".." not in place
    if not what.isidentifier() or not (is_file(place) or dotted):
        raise ValueError(f'"{name}" given, expected {EXPECTED}')
    return place, what


def is_file(place: str) -> bool:
    """Is the place a file, not a module?"""
    return place.endswith(".py")


def source(name: str) -> Path:
    """The file that holds the filter.  ValueError: there is none."""
    place, _ = split(name)
    if is_file(place):
        if not Path(place).is_file():
            raise ValueError(f'"{name}" given, expected {EXPECTED} (there is no such file)')
        return Path(place)
    try:
        spec = find_spec(place)
    except (ImportError, ValueError):
        spec = None
    if spec is None or not spec.origin or not Path(spec.origin).is_file():
        raise ValueError(f'"{name}" given, expected {EXPECTED} (there is no such module)')
    return Path(spec.origin)


def make(name: str) -> Filter:
    """A fresh filter.  ValueError: it cannot be loaded or made, or is none."""
    place, what = split(name)
    path = source(name)
    try:
        module = _from_file(path) if is_file(place) else import_module(place)
    except (Exception, SystemExit) as error:  # a script that ends its process
        raise _cannot(name, "cannot be loaded", error) from error
    factory: Callable[[], Filter] | None = getattr(module, what, None)
    if not callable(factory):
        raise ValueError(f'"{name}" given, expected a class or function in {path.name} (no {what})')
    return made_by(factory, name)


def made_by(factory: Callable[[], Filter], name: str) -> Filter:
    """What a factory makes, if it is a filter; ValueError else."""
    try:
        made = factory()
    except Exception as error:
        raise _cannot(name, "cannot be made without arguments", error) from error
    for method in ("step", "reset"):
        if not callable(getattr(made, method, None)):
            raise ValueError(f'"{name}" given, expected a filter (a {type(made).__name__} has no '
                             f"{method})")  # fmt: skip
    return made


def _cannot(name: str, what: str, error: BaseException) -> ValueError:
    said = " ".join(str(error).split())
    return ValueError(f'"{name}" given, expected a filter ({what}: {type(error).__name__}: {said})')


def _from_file(path: Path) -> ModuleType:
    """The module in a file; an edited one is another module, the same text is loaded once."""
    sha = hashlib.sha256(path.read_bytes() + str(path.resolve()).encode()).hexdigest()
    name = f"ultratight_own_{path.stem}_{sha[:16]}"
    with _LOADING:  # another thread of a worker must not find half of it
        if name in sys.modules:
            return sys.modules[name]
        spec = spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise ImportError(f"{path} is no Python source")
        module = module_from_spec(spec)
        sys.modules[name] = module  # dataclasses and kernels look their module up
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
        return module
