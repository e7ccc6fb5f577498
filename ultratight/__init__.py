"""Ultra-tight GNSS/INS coupling at signal level: the receiver's mind, and the runs.

    import ultratight

    scenario = ultratight.load("jump-1", {"receiver.filter": "kf"})
    run = ultratight.run(scenario, seed=1)
    run.summary, run["v_eb_e"], run.to_xarray()

Public names are loaded when they are first used: the package itself is quick to import.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ultratight.monte_carlo import rerun, sweep
    from ultratight.results import Run, Variable
    from ultratight.results import load as load_run
    from ultratight.scenario import PRESETS, InvalidInput, Scenario, load
    from ultratight.simulation import run

__all__ = [
    "PRESETS",
    "InvalidInput",
    "Run",
    "Scenario",
    "Variable",
    "load",
    "load_run",
    "rerun",
    "run",
    "sweep",
]

_HOMES = {
    "PRESETS": ("scenario", "PRESETS"),
    "InvalidInput": ("scenario", "InvalidInput"),
    "Run": ("results", "Run"),
    "Scenario": ("scenario", "Scenario"),
    "Variable": ("results", "Variable"),
    "load": ("scenario", "load"),
    "load_run": ("results", "load"),
    "rerun": ("monte_carlo", "rerun"),
    "run": ("simulation", "run"),
    "sweep": ("monte_carlo", "sweep"),
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'ultratight' has no attribute {name!r}")
    module, attribute = _HOMES[name]
    return getattr(import_module(f"ultratight.{module}"), attribute)


def __dir__() -> list[str]:
    return sorted(__all__)


def _foreign_signals() -> str | None:
    """Path of a ``signals`` that is not the package beside this one; None if all is well.

    ``python -m ultratight`` puts the current folder first, and `signals` is a name that others
    use too.  The foreign file is not executed.
    """
    ours = Path(__file__).resolve().parent.parent / "signals" / "__init__.py"
    try:
        spec = find_spec("signals")
    except ValueError:  # already imported, without a spec
        return str(getattr(sys.modules["signals"], "__file__", None))
    found = spec.origin if spec else None
    return None if found and Path(found).resolve() == ours else str(found)


if _found := _foreign_signals():
    _line = (
        f"ultratight: {_found} hides ultratight's own package `signals`; "
        "expected no such name here: rename it or work in another folder"
    )
    if sys.argv[:1] == ["-m"]:  # python -m ultratight
        print(_line, file=sys.stderr)
        raise SystemExit(2)
    raise ImportError(_line)
