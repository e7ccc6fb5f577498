"""`ultratight doctor`: healthy here on every path there is, and it tells when it is not."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from signals import cpu
from ultratight import doctor
from ultratight.__main__ import main


@pytest.mark.slow
@pytest.mark.parametrize("path", cpu.available())
def test_every_path_of_this_cpu_agrees_with_the_reference(path: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "ultratight", "doctor", "--json"],
        env=os.environ | {cpu.VARIABLE: path}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    told = json.loads(done.stdout)
    assert told["cpu_path"] == path
    assert told["healthy"]
    assert all(check["error"] <= check["tolerance"] for check in told["checks"])


@pytest.mark.slow
def test_a_cpu_without_vectors_takes_the_portable_path() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "ultratight", "doctor", "--json"],
        env=os.environ | {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    told = json.loads(done.stdout)
    assert told["cpu_path"] == "portable"
    assert told["healthy"]


def test_a_path_that_there_is_not_is_one_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "ultratight", "doctor"],
        env=os.environ | {cpu.VARIABLE: "sse9"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith("error: ULTRATIGHT_CPU_PATH is 'sse9'")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("error", [3e-3, float("nan")])
def test_a_kernel_that_is_wrong_is_told(
    error: float, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor.cpu, "check", lambda: [("wipe", error, 1e-6)])
    assert main(["doctor"]) == 1
    told = capsys.readouterr().out
    assert "WRONG" in told
    assert "NOT healthy" in told
