"""A sweep goes on where it was, however it ended; what was finished is neither lost nor changed."""

from __future__ import annotations

import json
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import ultratight

OVER = {"receiver.filter": ["kf", "fiqkf-r"]}
RUNS = 6
COMMON = f"""
import os, random, resource, signal, sys, time
from pathlib import Path
import ultratight
SHORT = {{"duration_s": 1.0, "prns": [2, 6, 17, 28]}}
def sweep(out, runs={RUNS}):
    scenario = ultratight.load("uniform", SHORT)
    return ultratight.sweep(scenario, {OVER!r}, runs=runs, jobs=1, out=out).attrs["digest"]
"""


def sweep(out: Path, runs: int = RUNS) -> str:
    names: dict = {}
    exec(COMMON, names)
    digest: str = names["sweep"](out, runs)
    return digest


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, bytes]:
    """Digest and journal of a sweep that nothing has interrupted."""
    out = tmp_path_factory.mktemp("whole")
    return sweep(out), (out / "journal.txt").read_bytes()


def science(journal: bytes) -> dict[tuple[int, int], str]:
    """Checksum of each record; fails where a run stands twice."""
    found: dict[tuple[int, int], str] = {}
    for line in journal.splitlines()[1:]:
        record = json.loads(line.partition(b" ")[2])
        place = record["cell"], record["run"]
        assert place not in found
        found[place] = record["sha256"]
    return found


def in_a_process(code: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    text = COMMON + textwrap.dedent(code)
    return subprocess.run(
        [sys.executable, "-c", text, *map(str, arguments)], capture_output=True, text=True
    )


def test_kill_at_random_moments(tmp_path: Path, whole: tuple[str, bytes]) -> None:
    """Children that have all loaded are killed anywhere from their first step to their last."""
    done = in_a_process(
        """
        sweep(Path(sys.argv[1]) / "warm", 1)
        began = time.perf_counter()
        sweep(Path(sys.argv[1]) / "timed")
        took = time.perf_counter() - began
        random.seed(7)
        out, kept, killed = Path(sys.argv[1]) / "out", b"", 0
        for _ in range(8):
            child = os.fork()
            if child == 0:
                sweep(out)
                os._exit(0)
            time.sleep(random.uniform(0.05, 0.5) * took)
            os.kill(child, signal.SIGKILL)
            killed += os.WIFSIGNALED(os.waitpid(child, 0)[1])
            if (out / "journal.txt").exists():
                now = (out / "journal.txt").read_bytes()
                whole = kept[: kept.rfind(b"\\n") + 1]
                assert now.startswith(whole), "a finished run was lost"
                kept = now
        print(killed, sweep(out))
        """,
        tmp_path,
    )
    assert done.returncode == 0, done.stderr
    killed, digest = done.stdout.split()
    assert int(killed) >= 3
    assert digest == whole[0]
    assert science((tmp_path / "out" / "journal.txt").read_bytes()) == science(whole[1])


@pytest.mark.parametrize("share", [0.003, 0.2, 0.5, 0.77, 0.999])
def test_torn_journal(tmp_path: Path, whole: tuple[str, bytes], share: float) -> None:
    """Cut off anywhere, in its first line too: whole lines stay as they are."""
    cut = int(share * len(whole[1]))
    kept = whole[1][:cut]
    (tmp_path / "journal.txt").write_bytes(kept)
    assert sweep(tmp_path) == whole[0]
    after = (tmp_path / "journal.txt").read_bytes()
    assert after.startswith(kept[: kept.rfind(b"\n") + 1])
    assert science(after) == science(whole[1])


def test_a_damaged_line_is_flown_again(tmp_path: Path, whole: tuple[str, bytes]) -> None:
    lines = whole[1].splitlines(keepends=True)
    at = lines[4].index(b'"sha256"') + 15
    digit = b"1" if lines[4][at : at + 1] != b"1" else b"2"
    lines[4] = lines[4][:at] + digit + lines[4][at + 1 :]
    (tmp_path / "journal.txt").write_bytes(b"".join(lines))
    assert sweep(tmp_path) == whole[0]
    after = (tmp_path / "journal.txt").read_bytes().splitlines()
    assert len(after) == len(lines) + 1  # the damaged one stays, and counts for nothing


def test_disk_full_at_once(tmp_path: Path) -> None:
    """Not even room for the first line, of which nothing is left."""
    done = in_a_process(
        """
        resource.setrlimit(resource.RLIMIT_FSIZE, (300, -1))
        try:
            sweep(Path(sys.argv[1]))
        except OSError as error:
            print(error)
        """,
        tmp_path,
    )
    path = tmp_path / "journal.txt"
    assert done.stdout == f"{path}: cannot be written (File too large)\n"
    assert path.read_bytes() == b""


@pytest.mark.parametrize("share", [0.5, 1.2])
def test_disk_full(tmp_path: Path, whole: tuple[str, bytes], share: float) -> None:
    """No file may grow beyond some bytes: half of the journal, or all of it but not the Dataset."""
    done = in_a_process(
        f"""
        resource.setrlimit(resource.RLIMIT_FSIZE, ({int(share * len(whole[1]))}, -1))
        try:
            sweep(Path(sys.argv[1]))
        except OSError as error:
            print(error)
        """,
        tmp_path,
    )
    kept = (tmp_path / "journal.txt").read_bytes()
    assert kept.endswith(b"\n")
    n = len(science(kept))
    assert 0 < n < 2 * RUNS or share > 1.0
    assert len(done.stdout.splitlines()) == 1, done.stderr
    assert (done.returncode, done.stderr) == (0, "")
    assert "cannot be written (File too large); 12 of 12" in done.stdout or share < 1.0
    assert "File too large" in done.stdout
    assert f"{n} of {2 * RUNS} runs are kept" in done.stdout
    assert sorted(p.name for p in tmp_path.iterdir()) == ["journal.txt"]
    assert sweep(tmp_path) == whole[0]
    assert (tmp_path / "journal.txt").read_bytes().startswith(kept)


def test_a_finished_sweep_flies_nothing(
    tmp_path: Path, whole: tuple[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "journal.txt").write_bytes(whole[1])
    monkeypatch.setattr("ultratight.sweeps.flights.simulate", None)
    assert sweep(tmp_path) == whole[0]
    assert (tmp_path / "journal.txt").read_bytes() == whole[1]


def test_more_runs_are_added(tmp_path: Path, whole: tuple[str, bytes]) -> None:
    few = sweep(tmp_path, 2)
    assert few != whole[0]
    assert sweep(tmp_path) == whole[0]
    assert sweep(tmp_path, 2) == few  # the others stay in the folder
    assert len(science((tmp_path / "journal.txt").read_bytes())) == 2 * RUNS


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"seed": 2}, "seed is 1 there, 2 here"),
        ({"over": {"receiver.filter": ["kf", "qkf"]}}, "over.receiver.filter is"),
        ({"scenario": {"cn0_dbhz": 36.0}}, "scenario.cn0_dbhz is 35.0 there, 36.0 here"),
        ({"keep": ("velocity_error",)}, "keep is [] there"),
    ],
)
def test_another_sweep_is_refused(
    tmp_path: Path, whole: tuple[str, bytes], changes: dict, words: str
) -> None:
    (tmp_path / "journal.txt").write_bytes(whole[1])
    short = {"duration_s": 1.0, "prns": [2, 6, 17, 28]}
    scenario = ultratight.load("uniform", short | changes.pop("scenario", {}))
    arguments = {"over": OVER, "runs": RUNS, "jobs": 1, "out": tmp_path} | changes
    with pytest.raises(ultratight.InvalidInput) as refused:
        ultratight.sweep(scenario, **arguments)
    assert words in str(refused.value)
    assert "another folder, or --fresh" in str(refused.value)
    assert len(refused.value.problems) == 1
    assert (tmp_path / "journal.txt").read_bytes() == whole[1]
    assert ultratight.sweep(scenario, **arguments, fresh=True).attrs["digest"] != whole[0]


@pytest.mark.parametrize("fresh", [False, True])
@pytest.mark.parametrize("text", ["shopping list\n", "no line's end", "deadbeef {}", "\0" * 99])
def test_what_others_wrote_stays(tmp_path: Path, text: str, fresh: bool) -> None:
    """Not even --fresh forgets a file that is no journal."""
    (tmp_path / "journal.txt").write_text(text)
    with pytest.raises(ultratight.InvalidInput, match=r"not a journal .* expected another folder"):
        ultratight.sweep("uniform", out=tmp_path, fresh=fresh)
    assert (tmp_path / "journal.txt").read_text() == text


def test_leftovers_are_cleared(
    tmp_path: Path, whole: tuple[str, bytes], caplog: pytest.LogCaptureFixture
) -> None:
    """What a killed process was writing goes, a damaged line is told."""
    lines = whole[1].splitlines(keepends=True)
    (tmp_path / "journal.txt").write_bytes(b"".join(lines[:-1]) + b"0" + lines[-1])
    (tmp_path / ".sweep.nc.123.part").write_text("half")
    assert sweep(tmp_path) == whole[0]
    assert "journal.txt: 1 damaged lines are left out" in caplog.text
    assert sorted(p.name for p in tmp_path.iterdir()) == ["journal.txt", "sweep.nc"]


def test_a_sweep_begun_anew_has_no_old_result(
    tmp_path: Path, whole: tuple[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cut short before its first run is finished, it leaves no Dataset of the one before."""
    (tmp_path / "journal.txt").write_bytes(whole[1])
    (tmp_path / "sweep.nc").write_text("of the sweep before")

    def full(*_: object, **__: object) -> None:
        raise OSError("no room")

    monkeypatch.setattr("ultratight.sweeps.flights.simulate", full)
    scenario = ultratight.load("uniform", {"duration_s": 1.0, "prns": [2, 6, 17, 28]})
    with pytest.raises(OSError, match=f"no room; 0 of {2 * RUNS} runs are kept"):
        ultratight.sweep(scenario, OVER, runs=RUNS, jobs=1, out=tmp_path, fresh=True)
    assert [p.name for p in tmp_path.iterdir()] == ["journal.txt"]


def test_busy_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ultratight.InvalidInput, match="expected a folder"):
        sweep(tmp_path / "file")
    busy = tmp_path / "busy"
    sweep(busy, 1)
    import fcntl

    with (busy / "journal.txt").open("ab") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(OSError, match="another process is writing"):
            sweep(busy, 1)
