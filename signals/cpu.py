"""The path that vector kernels take on this CPU, chosen once per process.

``avx512``   16 float32 lanes, explicit vectors (`signals.lanes`)
``avx2``     8 lanes
``portable`` plain numba, whatever LLVM makes of it: every other machine
``python``   no compilation at all: NUMBA_DISABLE_JIT=1

The first one whose instructions the CPU has and whose kernels give what their plain twins give is
taken; ``ULTRATIGHT_CPU_PATH`` names another.  Paths agree to float32 rounding, not to the bit.
"""

from __future__ import annotations

import logging
import os
from functools import cache

from numba.core import config
from numba.core.registry import cpu_target

VARIABLE = "ULTRATIGHT_CPU_PATH"
"""Environment variable that names the path"""

LANES = {"avx512": 16, "avx2": 8}
"""float32 lanes of the paths that have explicit vectors"""

_NEEDS = {
    "avx512": {"avx512f", "avx512bw", "avx512dq", "avx512vl", "fma"},
    "avx2": {"avx2", "fma"},
    "portable": set[str](),
}
_log = logging.getLogger(__name__)


@cache
def path() -> str:
    """Path in force: "avx512", "avx2", "portable" or "python".

    Raises
    ------
    ValueError : the environment names a path that does not exist or that this CPU lacks.
    """
    wanted = os.environ.get(VARIABLE) or None  # empty is unset
    if wanted is not None and wanted not in _NEEDS:
        raise ValueError(f"{VARIABLE} is {wanted!r}: expected one of {', '.join(_NEEDS)}")
    if config.DISABLE_JIT:
        return "python"
    able = available()
    if wanted is not None and wanted not in able:
        raise ValueError(f"{VARIABLE} is {wanted!r}: this CPU has {', '.join(able)}")
    for name in able if wanted is None else [wanted]:
        wrong = [row for row in check(name) if not row[1] <= row[2]]
        if not wrong:
            return name
        for kernel, error, tolerance in wrong:
            _log.warning(
                "path %s is not taken: its %s is off by %g, tolerance %g",
                name, kernel, error, tolerance,
            )  # fmt: skip
    return "portable"


def available() -> list[str]:
    """Paths whose instructions numba may use on this CPU, the fastest first."""
    _, _, features = cpu_target.target_context.codegen().magic_tuple()
    has = {flag[1:] for flag in features.split(",") if flag.startswith("+")}
    return [name for name, needs in _NEEDS.items() if needs <= has]


def check(name: str | None = None) -> list[tuple[str, float, float]]:
    """Largest error of each vector kernel of a path against its plain twin, and its tolerance.

    ``name`` is a path; None: the one in force.  Paths without explicit vectors have no rows.
    """
    from signals import lanes_check

    return lanes_check.check(path() if name is None else name)
