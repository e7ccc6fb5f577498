"""The one way kernels are compiled: `kernel`, a numba ``njit`` with a cache that can be trusted.

numba's disk cache notices a change in the file of a function, not in a function that it imports
from another module.  The cache folder is therefore keyed by a hash of *all* sources of the
package that owns the kernel (and of `signals`), so that edited code never meets an old binary.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba

KEEP_S = 30 * 86_400
"""Age at which the cache of other sources goes"""

FAST_SUM = {"reassoc", "contract", "arcp", "nsz"}
"""The only fast-math flags in use: sums may be reordered; NaN and inf keep their meaning."""


def _cache_root() -> Path:
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


@cache
def _cache_dir(package: str) -> str | None:
    """Folder for the kernels of a top-level package; None where nothing can be written."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version}".encode())
    roots = {Path(__file__).parent}
    roots.update(Path(p) for p in getattr(sys.modules.get(package), "__path__", []))
    for root in sorted(roots):
        for source in sorted(root.rglob("*.py")):
            digest.update(source.relative_to(root).as_posix().encode())
            digest.update(source.read_bytes())
    folder = _cache_root() / digest.hexdigest()[:16]
    try:
        if not folder.exists():
            _prune(folder.parent)
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return str(folder)
    except OSError:
        return None


def _prune(root: Path) -> None:
    """Remove caches of other sources that have not been written to for a month."""
    if root.name != "ultratight" or not root.is_dir():
        return  # a folder that somebody named: not ours alone
    for other in root.iterdir():
        if len(other.name) == 16 and time.time() - other.stat().st_mtime > KEEP_S:
            shutil.rmtree(other, ignore_errors=True)


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """``numba.njit`` with the keyed disk cache; used as ``@kernel`` or ``@kernel(fastmath=...)``.

    Options are numba's.  Where the cache folder cannot be written the kernel is compiled anew in
    each process and works all the same.
    """
    if function is None:
        return lambda f: kernel(f, **options)
    folder = _cache_dir(function.__module__.partition(".")[0])
    options = {"cache": folder is not None, "nogil": True, "error_model": "numpy"} | options
    # numba reads its global setting when a function is decorated: set it for that moment only, so
    # that a user's own kernels keep their own cache.
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = folder or before
    try:
        return numba.njit(**options)(function)
    finally:
        numba.config.CACHE_DIR = before
