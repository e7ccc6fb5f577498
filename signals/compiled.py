"""The one way kernels are compiled: `kernel`, a numba ``njit`` with a cache that can be trusted.

numba's disk cache notices a change in the file of a function, not in a function that it imports
from another module.  The cache folder of a module's kernels is therefore keyed by a hash of its
source and of *all* sources that it imports, directly or not, from its own package and from
`signals`: edited code never meets an old binary, and an edit elsewhere compiles nothing anew.
Where `signals.cpu` is among them, so is the path in force: paths never mix.  Nothing else counts:
the same sources in another folder find the same binaries (`_Cache`).

A kernel gives the same bits whether it was compiled in this process or loaded, whatever else the
process ran before.  numba's ``njit`` does not promise that, for three reasons:

* numba links a copy of each called kernel into its caller and optimises it again there, as a weak
  symbol.  The first copy that a process loads serves all callers: in a compiling process the
  called kernel's own, in one that loads the caller from the cache the caller's.  Where sums may be
  reordered (`FAST_SUM`) the copies differ in the last bit.  Here the copies are private, so that
  each kernel runs its own (`_ClosedLibrary`).
* Options that a kernel leaves open are taken from whichever caller happens to compile it first, and
  go into the cache with it.  Here none is left open (`_OPTIONS`).
* numba's own helpers, such as the product of two complex numbers, are compiled once with the
  fast-math flags of the kernel that first needs them, and then serve all.  Here kernels share them
  only with kernels of the same flags (`_Close`).
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import numba
from llvmlite.binding import Linkage
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import FunctionPass, PassManager, register_pass
from numba.core.typed_passes import NopythonTypeInference

_log = logging.getLogger(__name__)

KEEP_S = 30 * 86_400
"""Age at which the cache of other sources goes"""

_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+(\S+)[ \t]+import[ \t]+(\([^)]*\)|[^\n#]*)|import[ \t]+([^\n#]*))", re.M
)
_NAME = re.compile(r"[A-Za-z_]\w*")

FAST_SUM = {"reassoc", "contract", "arcp", "nsz"}
"""The only fast-math flags in use: sums may be reordered; NaN and inf keep their meaning."""

_OPTIONS: dict[str, Any] = {
    "nogil": True, "error_model": "numpy", "fastmath": False, "forceinline": False, "_nrt": True
}  # fmt: skip
"""Of each kernel that does not say otherwise: all that numba would inherit from a caller"""


def cache_root() -> Path:
    """Folder that holds the caches of all modules and versions of their sources."""
    named = os.environ.get("ULTRATIGHT_CACHE_DIR") or os.environ.get("NUMBA_CACHE_DIR")
    if named:
        return Path(named)
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home()))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return base / "ultratight"


def cache_is_writable() -> bool:
    """Are compiled kernels kept for the next process?"""
    return _cache_dir(__name__) is not None


@cache
def _cache_dir(module: str) -> str | None:
    """Folder for the kernels of a module; None where nothing can be written."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version} {module}".encode())
    sources = _sources(module)
    if not sources:
        return None  # typed into a console: no file to tell versions apart by
    for name, text in sources:
        digest.update(name.encode())
        digest.update(text.encode())
    chooser = f"{__name__.rpartition('.')[0]}.cpu"
    if chooser in dict(sources):
        digest.update(import_module(chooser).path().encode())
    root = cache_root()
    folder = root / digest.hexdigest()[:16]
    try:
        if not folder.exists():
            _prune(folder.parent)
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return str(folder)
    except OSError as error:
        _warn(root, error.strerror or type(error).__name__)
        return None


@cache
def _warn(root: Path, reason: str) -> None:
    """Once for all modules."""
    _log.warning(
        "kernel cache %s cannot be written to (%s): each process compiles anew, which takes "
        "minutes; ULTRATIGHT_CACHE_DIR names another folder",
        root, reason,
    )  # fmt: skip


def _sources(module: str) -> list[tuple[str, str]]:
    """Names and texts of a module and of all that it imports from its package and `signals`."""
    packages = {module.partition(".")[0], __name__.partition(".")[0]}
    found: dict[str, str] = {}
    waiting = {module, __name__}
    while waiting:
        name = waiting.pop()
        if name not in found and name.partition(".")[0] in packages:
            found[name], imported = _read(name)
            waiting |= imported
    return sorted((name, text) for name, text in found.items() if text)


@cache
def _read(module: str) -> tuple[str, set[str]]:
    """Source of a module and the names that its import statements may mean; empty: no source."""
    home, _, _ = module.rpartition(".")
    path = getattr(sys.modules.get(module), "__file__", None)
    if path is None:  # not yet imported, or no module: `from home import name`
        folders = getattr(sys.modules.get(home), "__path__", [])
        files = [Path(f) / f"{module.rpartition('.')[2]}.py" for f in folders]
        path = next((f for f in files if f.is_file()), None)
    if path is None or not str(path).endswith(".py"):
        return "", set()
    text = Path(path).read_text(encoding="utf-8")
    imported: set[str] = set()
    for base, names, plain in _IMPORT.findall(text):
        imported.update(n.split()[0] for n in plain.split(",") if n.strip())
        if base.startswith("."):
            dots = len(base) - len(base.lstrip("."))
            base = f"{module.rsplit('.', dots)[0]}.{base[dots:]}".rstrip(".")
        if base:
            imported.add(base)
            imported.update(f"{base}.{n}" for n in _NAME.findall(names))
    return text, imported


def _prune(root: Path) -> None:
    """Remove caches of other sources that have not been written to for a month."""
    if root.name != "ultratight" or not root.is_dir():
        return  # a folder that somebody named: not ours alone
    for other in root.iterdir():
        if len(other.name) == 16 and time.time() - other.stat().st_mtime > KEEP_S:
            shutil.rmtree(other, ignore_errors=True)


class _Locator(_CacheLocator):
    """Where a function's binaries lie; numba's own locators go by path and age of its file."""

    def __init__(self, module: str, line: int) -> None:
        self._folder, self._line = _cache_dir(module), line

    def get_cache_path(self) -> str | None:
        return self._folder

    def get_source_stamp(self) -> str:
        return ""  # the folder's name says it all

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> _Locator:
        return cls(py_func.__module__, py_func.__code__.co_firstlineno)


class _Stored(CompileResultCacheImpl):
    """What numba stores, where we say."""

    _locator_classes: ClassVar = [_Locator]


class _Cache(FunctionCache):
    """numba's cache of a function, by the text of its sources alone."""

    _impl_class = _Stored


class _ClosedLibrary(JITCodeLibrary):
    """Machine code of one kernel, which runs its own copies of the kernels that it calls."""

    def _optimize_final_module(self) -> None:
        super()._optimize_final_module()
        for function in self._final_module.functions:
            if function.linkage == Linkage.linkonce_odr and not function.is_declaration:
                function.linkage = Linkage.private


_helpers: dict[tuple[str, bool], dict[Any, Any]] = {}
"""Compiled helpers of numba's lowering, by the flags of the kernels that they serve"""


@register_pass(mutates_CFG=False, analysis_only=False)
class _Close(FunctionPass):
    """Give the kernel the helpers of its flags, and its library, which numba's lowering makes only
    where there is none."""

    _name = "close_library"

    def __init__(self) -> None:
        super().__init__()

    def run_pass(self, state: Any) -> bool:
        state.library = _ClosedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        flags = str(sorted(state.flags.fastmath.flags)), bool(state.flags.nrt)
        own = _helpers.setdefault(flags, {})
        state.targetctx = state.targetctx.subtarget(cached_internal_func=own)
        return False


class _Compiler(CompilerBase):
    """numba's compiler with closed libraries."""

    def define_pipelines(self) -> list[PassManager]:
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(_Close, NopythonTypeInference)
        passes.finalize()
        return [passes]


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """``numba.njit`` with the keyed disk cache; used as ``@kernel`` or ``@kernel(fastmath=...)``.

    Options are numba's.  Where the cache folder cannot be written the kernel is compiled anew in
    each process and works all the same.
    """
    if function is None:
        return lambda f: kernel(f, **options)
    options = _OPTIONS | {"pipeline_class": _Compiler} | options
    compiled = numba.njit(**options)(function)
    if _cache_dir(function.__module__) is not None and hasattr(compiled, "enable_caching"):
        compiled._cache = _Cache(function)  # what `enable_caching` does, with our locator
    return compiled


borrowing: Any = partial(kernel, _nrt=False)
"""`kernel` for functions that neither own nor return an array: counting references to arguments, an
atomic operation each, would cost more than much of the arithmetic"""


def seal(kernel: Any) -> bool:
    """Let a kernel that has run raise TypeError where it would now be compiled for other types.

    A sealed kernel checks types and layout of its arrays, at no cost.  False: it is plain Python.
    """
    if not hasattr(kernel, "disable_compile"):
        return False
    kernel.disable_compile()
    return True
