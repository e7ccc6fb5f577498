"""Where a run comes from: scenario, seed, versions, and the path that the CPU took."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from llvmlite import binding
from numba.core import config as numba_config

import signals
from signals import cpu
from ultratight.scenario import Scenario

_FILES = {
    "constellation": "navigation_sha256",
    "trajectory": "trajectory_sha256",
    "galileo_codes": "galileo_codes_sha256",
    "receiver.filter": "filter_sha256",
}


def provenance(scenario: Scenario, seed: int) -> dict[str, Any]:
    """What one needs to repeat the run: scenario hash, seed, versions, CPU path."""
    files = scenario.files_sha256()
    return {
        "scenario_sha256": scenario.digest(),
        **{_FILES[key]: sha for key, sha in files.items()},
        "seed": seed,
        "cpu_path": cpu_path(),
        "machine": platform.machine(),
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Of Python and of what a result depends on."""
    names = ("ultratight", "numpy", "scipy", "numba", "llvmlite")
    return {"python": platform.python_version()} | {n: _version(n) for n in names}


def cpu_path() -> str:
    """Path of the vector kernels, see `signals.cpu`, and the CPU that kernels are compiled for."""
    path = cpu.path()
    if path == "python":
        return path
    return f"{path}:{numba_config.CPU_NAME or binding.get_host_cpu_name()}"


def sources_sha256() -> str:
    """SHA-256 of all our sources: a version alone does not tell two states of a work tree apart."""
    digest = hashlib.sha256()
    for root in (Path(signals.__file__).parent, Path(__file__).parent):
        for path in sorted(root.rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


@cache  # reading a package's metadata takes milliseconds
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
