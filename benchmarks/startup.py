"""What a user waits for before anything runs: imports, and the first call of cached kernels."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

from benchmarks.harness import Case

CPU = """
import time
{before}
began = time.process_time()
{what}
print(time.process_time() - began)
"""
FLY = 'ultratight.run(ultratight.load("jump-1", {"duration_s": 0.1, "profile": []}))'


def groups() -> Iterator[tuple[str, list[Case]]]:
    """CPU time in fresh processes; the disk cache of the kernels is warm."""
    heavy = "import numpy, numba"
    yield (
        "start of a process, CPU time",
        [
            _case("import numpy, numba", "", heavy),
            _case("import ultratight, beyond these", heavy, "import ultratight", 0.1),
            _case("first run of 0.1 s, cached kernels", f"{heavy}\nimport ultratight", FLY),
            _case(
                "the same, modules imported before",
                f"{heavy}\nimport ultratight, ultratight.simulation, ultratight.plots",
                FLY,
                0.3,
            ),
            _case("import ultratight alone", "", "import ultratight", 0.3),
        ],
    )


def _case(name: str, before: str, what: str, target: float | None = None) -> Case:
    text = CPU.format(before=before, what=what)

    def seconds() -> float:
        command = [sys.executable, "-c", text]
        return float(subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout)

    return Case(name, seconds, 1.0, "s", 1.0, target, cost=True, reports=True)
