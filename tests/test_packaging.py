"""The wheel holds what is needed and works where nobody prepared anything."""

from __future__ import annotations

import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

from ultratight.scenario import PRESETS

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.slow


def call(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(a) for a in arguments], cwd=cwd, capture_output=True, text=True, timeout=300
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    built = call(
        sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT,
        cwd=folder,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh environment with the wheel; the dependencies are borrowed by a path file."""
    folder = tmp_path_factory.mktemp("fresh")
    venv.create(folder, with_pip=False, symlinks=True)
    scripts = "Scripts" if sys.platform == "win32" else "bin"
    python = folder / scripts / "python"
    site = Path(
        call(
            python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder
        ).stdout.strip()
    )
    pip = call(
        sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--quiet",
        "--target", site, wheel, cwd=folder,
    )  # fmt: skip
    assert pip.returncode == 0, pip.stderr
    (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return python


def test_the_wheel_holds_two_packages_and_their_data(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == {"signals", "ultratight"}
    needed = {"signals/py.typed", "ultratight/py.typed"}
    needed |= {f"ultratight/presets/{name}.toml" for name in PRESETS}
    assert needed <= set(names)
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_the_wheel_works_in_a_fresh_environment(python: Path, tmp_path: Path) -> None:
    where = call(python, "-c", "import ultratight; print(ultratight.__file__)", cwd=tmp_path)
    assert Path(where.stdout.strip()).is_relative_to(python.parents[1]), "not the checkout"
    assert call(python, "-m", "ultratight", "--version", cwd=tmp_path).stdout.startswith("ultra")
    valid = call(python, "-m", "ultratight", "validate", "jump-1", cwd=tmp_path)
    assert (valid.returncode, valid.stderr) == (0, "")


def test_the_wheel_in_a_folder_with_a_foreign_signals(python: Path, tmp_path: Path) -> None:
    (tmp_path / "signals.py").write_text("raise SystemExit('must not run')\n")
    for arguments in (["--version"], ["run", "jump-1"]):
        said = call(python, "-m", "ultratight", *arguments, cwd=tmp_path)
        assert (said.returncode, said.stdout, said.stderr.count("\n")) == (2, "", 1)
        assert "signals.py" in said.stderr
