"""The path of the vector kernels: what is chosen, what is refused, what a wrong kernel does."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from signals import cpu, lanes_check

ROOT = Path(__file__).parents[2]


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The choice is made anew in the test, and again after it."""
    monkeypatch.delenv(cpu.VARIABLE, raising=False)
    cpu.path.cache_clear()
    yield
    cpu.path.cache_clear()


def elsewhere(statement: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a statement in a fresh interpreter."""
    env = os.environ | {"PYTHONPATH": str(ROOT)} | environment
    return subprocess.run(
        [sys.executable, "-c", statement], env=env, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("path", cpu.available())
def test_vector_kernels_are_their_twins(path: str) -> None:
    rows = cpu.check(path)
    assert len(rows) == (0 if path == "portable" else 5)
    for name, error, tolerance in rows:
        assert error <= tolerance, name


@pytest.mark.usefixtures("fresh")
def test_the_fastest_path_that_is_right_is_taken(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    assert cpu.path() == cpu.available()[0]

    def broken(*arguments: np.ndarray) -> None:
        lanes_check.exercise_plain(*arguments)
        arguments[6][0, 3] += 1e-3  # one sum of two taps

    for path in cpu.LANES:
        monkeypatch.setattr(lanes_check, f"exercise_{cpu.LANES[path]}", broken)
    cpu.path.cache_clear()
    assert cpu.path() == "portable"
    wrong = [path for path in cpu.LANES if path in cpu.available()]
    assert [f"path {path} is not taken: its add is off by" in caplog.text for path in wrong] == [
        True for _ in wrong
    ]
    assert "wipe" not in caplog.text


@pytest.mark.usefixtures("fresh")
def test_the_environment_names_a_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(cpu.VARIABLE, "portable")
    assert cpu.path() == "portable"
    monkeypatch.setenv(cpu.VARIABLE, "sse9")
    cpu.path.cache_clear()
    with pytest.raises(ValueError, match="PATH is 'sse9': expected one of avx512, avx2, portable"):
        cpu.path()


def test_instructions_that_numba_may_not_use_are_not_used() -> None:
    """Without AVX only the portable path is left; to ask for another one is answered."""
    statement = "from signals import cpu; print(cpu.path())"
    assert elsewhere(statement, NUMBA_ENABLE_AVX="0").stdout == "portable\n"
    asked = elsewhere(statement, NUMBA_ENABLE_AVX="0", **{cpu.VARIABLE: "avx2"})
    assert asked.stderr.splitlines()[-1] == (
        f"ValueError: {cpu.VARIABLE} is 'avx2': this CPU has portable"
    )
    assert elsewhere(statement, NUMBA_DISABLE_JIT="1").stdout == "python\n"


def test_caches_of_paths_are_apart() -> None:
    statement = (
        "from signals.compiled import _cache_dir as at; import signals.exact; "
        "print(at('signals.exact'), at('signals.lanes_check'))"
    )
    ours, portable = (
        elsewhere(statement, **{cpu.VARIABLE: path}).stdout.split()
        for path in (cpu.available()[0], "portable")
    )
    if cpu.available()[0] != "portable":
        assert ours[0] != portable[0]
    assert ours[1] == portable[1]  # what decides on the path does not hang on it
