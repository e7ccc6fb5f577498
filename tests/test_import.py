"""`import ultratight` is quick: what it loads beyond numpy and numba is named here, not timed."""

import json
import subprocess
import sys

SCRIPT = """
import json, sys
import numpy, numba
before = set(sys.modules)
{statement}
print(json.dumps(sorted(set(sys.modules) - before)))
"""
HEAVY = ("matplotlib", "scipy", "pydantic", "xarray", "typer", "rich", "h5py", "h5netcdf", "joblib")


def loaded(statement: str) -> list[str]:
    """Modules that a statement loads in a fresh process that has numpy and numba."""
    script = SCRIPT.format(statement=statement)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=120
    )
    return json.loads(done.stdout.splitlines()[-1])


def packages(modules: list[str]) -> set[str]:
    return {name.partition(".")[0] for name in modules}


def test_the_package_alone_loads_nothing_heavy_and_no_kernel():
    found = loaded("import ultratight")
    assert "ultratight" in found
    assert not packages(found) & set(HEAVY)
    assert not [name for name in found if name.startswith(("signals", "ultratight."))]


def test_a_run_in_closed_form_needs_neither_figures_nor_files_nor_samples():
    found = loaded("import ultratight; ultratight.run")
    assert "ultratight.simulation" in found
    assert not packages(found) & {"matplotlib", "xarray", "typer", "rich", "h5py", "h5netcdf"}
    assert "signals.correlator" not in found
