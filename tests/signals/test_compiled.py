"""The kernel cache: an edit must reach every kernel that could have compiled it in, no other."""

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


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name, text in TREE.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    return tmp_path


def twice(tree: Path, **environment: str) -> tuple[float, int, int]:
    """Result of the kernel in a fresh process, hits and misses of its cache."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(tree), str(ROOT)])}
    env |= {"ULTRATIGHT_CACHE_DIR": str(tree / "cache")} | environment
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=env, capture_output=True, text=True, check=True
    )
    value, hits, misses = done.stdout.split()
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


def test_a_damaged_cache_is_compiled_anew(tree: Path) -> None:
    twice(tree)
    damaged = [path for path in (tree / "cache").rglob("*") if path.is_file()]
    assert damaged
    for path in damaged:
        path.write_bytes(b"\x80\x04K\x01.")
    assert twice(tree)[0] == 3.0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a folder name that is a file, POSIX only")
def test_a_cache_folder_that_cannot_be_written_to_is_done_without(tree: Path) -> None:
    shutil.rmtree(tree / "cache", ignore_errors=True)
    (tree / "cache").write_text("a file where the folder should be")
    assert twice(tree)[0] == 3.0
