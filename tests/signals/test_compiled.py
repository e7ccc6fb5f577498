"""Compiled kernels: an edit must reach every kernel that could have compiled it in, no other; the
same bits from a kernel that was compiled just now and from one that was loaded."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TREE = {
    "foreign/__init__.py": "",
    "foreign/apart.py": "UNUSED = 1\n",
    "foreign/deep.py": "STEP = 1.0\n",
    "foreign/middle.py": (
        "from signals.compiled import kernel\nfrom .deep import STEP\n\n\n"
        "@kernel\ndef add(x):\n    return x + STEP\n"
    ),
    "foreign/top.py": (
        "from foreign import (\n    middle,\n)\nfrom signals.compiled import kernel\n"
        "add = middle.add\n\n\n@kernel\ndef twice(x):\n    return add(add(x))\n"
    ),
}
SCRIPT = (
    "from foreign.top import twice\n"
    "hits, misses = twice.stats.cache_hits, twice.stats.cache_misses\n"
    "print(twice(1.0), sum(hits.values()), sum(misses.values()))"
)


SUMS = """
import numpy as np
from signals.compiled import FAST_SUM, borrowing


@borrowing
def total(x):
    s = 0.0
    for i in range(x.size):
        s += x[i]
    return s


@borrowing(fastmath=FAST_SUM)
def loose(x):
    return total(x)


@borrowing(fastmath=FAST_SUM)
def deflate(W, P):
    for q in range(0, W.shape[0], 3):
        for a in range(P.shape[0]):
            g, h, k = W[q, a], W[q + 1, a], W[q + 2, a]
            for c in range(P.shape[1]):
                P[a, c] -= g * W[q, c] + h * W[q + 1, c] + k * W[q + 2, c]


@borrowing(fastmath=FAST_SUM)
def twice(W, P):
    for b in range(2):
        deflate(W[3 * b : 3 * b + 3], P)
"""
"""A sum in order that a kernel with reordered sums calls; a kernel that is no part of its caller"""


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name, text in TREE.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    return tmp_path


def process(tree: Path, script: str, err: str = "") -> list[str]:
    """Words that a script prints in a process of its own; the cache lies in the tree.

    ``err`` must be in what it says on stderr, or stderr be empty.
    """
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(tree), str(ROOT)])}
    env |= {"ULTRATIGHT_CACHE_DIR": str(tree / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", script], env=env, capture_output=True, text=True, check=True
    )
    assert err in done.stderr
    assert done.stderr.count("\n") == (err != "")
    return done.stdout.split()


def twice(tree: Path, err: str = "") -> tuple[float, int, int]:
    """Result of the kernel in a fresh process, hits and misses of its cache."""
    value, hits, misses = process(tree, SCRIPT, err)
    return float(value), int(hits), int(misses)


def test_an_edit_two_modules_away_is_compiled_in_and_one_elsewhere_is_not(tree: Path) -> None:
    assert twice(tree) == (3.0, 0, 1)
    assert twice(tree) == (3.0, 1, 0)
    (tree / "foreign/apart.py").write_text("UNUSED = 22\n")
    assert twice(tree) == (3.0, 1, 0)
    # the same length and the same stamp: only the text tells
    deep = tree / "foreign/deep.py"
    stamp = deep.stat()
    deep.write_text("STEP = 2.0\n")
    os.utime(deep, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    assert twice(tree) == (5.0, 0, 1)


def test_the_same_sources_in_another_folder_find_what_was_compiled(tree: Path) -> None:
    assert twice(tree) == (3.0, 0, 1)
    moved = tree.parent / "moved"
    shutil.copytree(tree, moved, copy_function=shutil.copy)  # files as young as a new clone's
    assert twice(moved) == (3.0, 1, 0)


def test_a_damaged_cache_is_compiled_anew(tree: Path) -> None:
    twice(tree)
    damaged = [path for path in (tree / "cache").rglob("*") if path.is_file()]
    assert damaged
    for path in damaged:
        path.write_bytes(b"\x80\x04K\x01.")
    assert twice(tree)[0] == 3.0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a folder name that is a file, POSIX only")
def test_a_cache_folder_that_cannot_be_written_to_is_done_without_and_said_once(tree: Path) -> None:
    shutil.rmtree(tree / "cache", ignore_errors=True)
    (tree / "cache").write_text("a file where the folder should be")
    assert twice(tree, err="cache cannot be written to (Not a directory)")[0] == 3.0


def test_compiled_now_or_loaded_alone_or_after_what_it_calls_a_kernel_gives_the_same_bits(
    tree: Path,
) -> None:
    (tree / "foreign/sums.py").write_text(SUMS)
    n = 17
    prepare = (
        "import numpy as np; from foreign.sums import deflate, twice\n"
        f"W = np.random.default_rng(1).standard_normal((6, {n})); P = W[0] + W.T[:, :1]\n"
    )
    called = "twice(W, P); print(P.tobytes().hex())"
    compiled, loaded = process(tree, prepare + called), process(tree, prepare + called)
    after = process(tree, f"{prepare}deflate(W[:3], P.copy())\n{called}")
    assert len(compiled[0]) == 16 * n * n
    assert compiled == loaded == after


def test_a_kernel_does_not_take_the_options_of_the_caller_that_compiles_it(tree: Path) -> None:
    """The sum in the order that the kernel states, as Python adds it; reordered it is near 62."""
    (tree / "foreign/sums.py").write_text(SUMS)
    x = [1e16, *[1.0] * 62, -1e16]
    in_order = 0.0
    for value in x:
        in_order += value
    script = (
        "import numpy as np; from foreign.sums import loose, total\n"
        f"x = np.array({x}); loose(x); print(total(x))"
    )
    assert float(process(tree, script)[0]) == in_order


HELPERS = """
from signals.compiled import FAST_SUM, borrowing


@borrowing
def turned(x, y):
    z = x[0]
    for i in range(1, x.size):
        z = z * x[i] + y[i] * x[i]
    return z


@borrowing(fastmath=FAST_SUM)
def turned_loosely(x, y):
    z = x[0]
    for i in range(1, x.size):
        z = z * x[i] + y[i] * x[i]
    return z
"""
"""A product of complex numbers, which numba compiles apart, in kernels with and without flags"""


def test_what_numba_compiles_for_a_kernel_does_not_depend_on_the_kernel_before_it(
    tree: Path,
) -> None:
    """Bits of a kernel compiled alone, after another in its process, after another was cached."""
    (tree / "foreign/helpers.py").write_text(HELPERS)
    prepare = (
        "import numpy as np; from foreign.helpers import *\n"
        "r = np.random.default_rng(1); y = 1e3 + r.standard_normal(1001)\n"
        "x = np.exp(1j * y)\n"
    )
    first, show = "turned_loosely(x, y)", "print(np.array(turned(x, y)).tobytes().hex())"
    alone = process(tree, prepare + show)
    shutil.rmtree(tree / "cache")
    after = process(tree, f"{prepare}{first}\n{show}")
    shutil.rmtree(tree / "cache")
    process(tree, f"{prepare}{first}")
    cached = process(tree, prepare + show)
    assert len(alone[0]) == 32
    assert alone == after == cached
