"""The rule of dependence, and what may be imported by whom."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_import_contracts_are_kept() -> None:
    """In a process of its own: import-linter switches off all loggers that it finds."""
    code = "import sys; from importlinter import cli; sys.exit(cli.lint_imports(no_cache=True))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def loaded(statement: str) -> set[str]:
    """Top-level modules in memory after a statement in a fresh interpreter."""
    code = f"import sys; {statement}; print(' '.join({{m.partition('.')[0] for m in sys.modules}}))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


def test_the_package_is_quick_to_import() -> None:
    heavy = {"numpy", "scipy", "numba", "matplotlib", "pydantic", "xarray", "typer", "rich"}
    assert not loaded("import ultratight") & heavy


@pytest.mark.parametrize("name", ["run", "load", "load_run", "Scenario", "Run", "PRESETS"])
def test_public_names_lead_where_they_say(name: str) -> None:
    import ultratight

    assert name in ultratight.__all__
    assert getattr(ultratight, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'frobnicate'"):
        _ = ultratight.frobnicate


def test_dir_shows_public_names_only() -> None:
    import ultratight

    assert dir(ultratight) == sorted(ultratight.__all__)


def test_a_simulation_draws_nothing() -> None:
    assert "matplotlib" not in loaded("import ultratight.simulation, ultratight.results")


def test_packages_do_not_print() -> None:
    """Only the command line and the showcase talk; everything else returns or logs."""
    talkers = {
        "__main__.py", "acquire_commands.py", "if_commands.py", "options.py", "showcase.py",
        "study.py", "sweep_commands.py", "track_commands.py",
    }  # fmt: skip
    silent = [
        path
        for package in ("signals", "ultratight")
        for path in (ROOT / package).rglob("*.py")
        if path.name not in talkers and path != ROOT / "ultratight" / "__init__.py"
    ]
    assert len(silent) > 10
    assert not [p for p in silent if "print(" in p.read_text(encoding="utf-8")]


def test_sizes_stay_readable() -> None:
    """400 lines are a module's limit; tables of facts do not count."""
    facts = {"embedded_2021_03_19.py"}
    long = {
        path.name: n
        for package in ("signals", "ultratight")
        for path in (ROOT / package).rglob("*.py")
        if (n := len(path.read_text(encoding="utf-8").splitlines())) > 400
        and path.name not in facts
    }
    assert not long
