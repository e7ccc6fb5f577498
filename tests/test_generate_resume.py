"""IF files are whole or not there; what was cut short is gone on with, to the same bytes."""

from __future__ import annotations

import hashlib
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from ultratight.__main__ import main

FEW = ["--set", "prns=[2, 6, 17, 28]"]
SLOW = ["--rate", "1100003", *FEW]
"""2.2 MB a second; a number of samples per second that leaves 3 over from bytes of four"""


def parts(name: str, data: str = "sigmf-data") -> list[str]:
    """What a run that was cut short leaves, and nothing else."""
    return [f"{name}.journal.partial", f"{name}.{data}.partial", f"{name}.truth.rows.partial"]


def names(folder: Path, name: str) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if p.name.startswith(f"{name}."))


def ultratight(
    folder: Path, *words: object, before: str = "", name: str = "half"
) -> subprocess.CompletedProcess[str]:
    """A process of its own that generates; ``before``: what happens to it first."""
    arguments = [str(w) for w in ("generate", "static", *words, "--out", name)]
    code = (
        f"import sys\n{before}from ultratight.__main__ import main\nsys.exit(main({arguments!r}))"
    )
    return limited(code, folder)


def killed_in_block(number: int, signal_number: int = 9) -> str:
    """Code: the process is sent a signal when it is to write the block of this number."""
    return (
        "import os\nfrom ultratight.if_parts import Parts\n"
        "write, done = Parts.write, []\n"
        "def writes(self, samples):\n"
        "    done.append(len(samples))\n"
        f"    if len(done) == {number}: os.kill(os.getpid(), {signal_number})\n"
        "    write(self, samples)\n"
        "Parts.write = writes\n"
    )


def same_files(folder: Path, one: str, other: str, data: str = "sigmf-data") -> None:
    """Byte by byte; names of the files stand in truth and description."""
    for ending in (data, "truth.nc", "json" if data == "bin" else "sigmf-meta"):
        a, b = ((folder / f"{name}.{ending}").read_bytes() for name in (one, other))
        assert a.replace(one.encode(), other.encode()) == b, ending


no_signals = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals")


@no_signals
@pytest.mark.parametrize(("form", "data"), [("ci8", "sigmf-data"), ("ri2p", "bin")])
def test_a_killed_run_is_gone_on_with(tmp_path: Path, form: str, data: str) -> None:
    """kill -9 in the third second (a second has 3 blocks): the same bytes as in one go.

    At this rate a packed second does not end with a byte.  Killed again, between the names: again.
    """
    words = ["--duration", 3.3, "--format", form, "--if-hz", "2e5", *SLOW]
    done = ultratight(tmp_path, *words, before=killed_in_block(8))
    assert done.returncode == -signal.SIGKILL
    assert names(tmp_path, "half") == sorted(parts("half", data))
    journal = json.loads((tmp_path / "half.journal.partial").read_text())
    kept = journal["kept"]
    assert kept["seconds"] in (1, 2)  # less than a second of work is lost
    assert kept["n_samples"] == kept["seconds"] * 1_100_003
    assert len(kept["rest"]) == (kept["n_samples"] % 4 if data == "bin" else 0)
    part = tmp_path / f"half.{data}.partial"
    assert part.stat().st_size > kept["samples"][0]  # what lies beyond is cut off

    twice = "import os; os.replace = lambda a, b, go=os.replace: (go(a, b), str(b).endswith"
    twice += f"({data!r}) and os.kill(os.getpid(), 9))\n"
    done = ultratight(tmp_path, *words, before=twice)
    assert done.returncode == -signal.SIGKILL
    assert done.stderr.startswith(f"half.{data}.partial: goes on after {kept['seconds']} s\n")
    assert f"half.{data}" in names(tmp_path, "half")
    assert not {"half.sigmf-meta", "half.json"} & set(names(tmp_path, "half"))

    done = ultratight(tmp_path, *words, "--json")
    assert (done.returncode, done.stderr.splitlines()[0]) == (
        0,
        f"half.{data}.partial: goes on after 3 s",
    )
    whole = ultratight(tmp_path, *words, "--json", "--quiet", name="full")
    assert whole.stderr == ""
    assert len(names(tmp_path, "half")) == len(names(tmp_path, "full")) == 3
    same_files(tmp_path, "half", "full", data)
    sha512 = hashlib.sha512((tmp_path / f"half.{data}").read_bytes()).hexdigest()
    assert json.loads(done.stdout)["sha512"] == json.loads(whole.stdout)["sha512"] == sha512


@no_signals
def test_what_is_kept_of_another_file_is_refused(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    base = ["--duration", "2.5", *SLOW, "--quiet"]
    assert ultratight(tmp_path, *base, before=killed_in_block(5)).returncode == -signal.SIGKILL
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}

    def say(*words: str) -> tuple[int, str]:
        code = main(["generate", "static", *base, "--out", "half", *words])
        return code, capsys.readouterr().err

    other = "error: half.sigmf-data.partial: of another file ({}); expected the same command, or "
    other += "--fresh to start anew\n"
    for words, differs in (
        (["--seed", "2"], "seed is 1 there, 2 here"),
        (["--rms", "20"], "rms is null there, 20.0 here"),
        (["--format", "ci2p"], 'format is "ci8" there, "ci2p" here'),
        (["--if-hz", "1e5"], "front_end.if_hz is 0.0 there, 100000.0 here"),
        (["--set", "cn0_dbhz=44"], "cn0_dbhz is 45.0 there, 44.0 here"),
    ):
        assert say(*words) == (2, other.format(differs))
    code, said = say("--duration", "0.9")
    assert code == 2
    assert "--duration: 0.9 given, expected at least the 1 s that half.sigmf-data.partial" in said
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before

    damaged = bytearray(before["half.sigmf-data.partial"])
    damaged[1000] ^= 1
    (tmp_path / "half.sigmf-data.partial").write_bytes(damaged)
    code, said = say()
    assert (code, said.count("\n")) == (2, 1)
    assert "half.sigmf-data.partial: damaged, not what its journal says" in said

    assert say("--seed", "2", "--fresh") == (0, "")
    assert names(tmp_path, "half") == ["half.sigmf-data", "half.sigmf-meta", "half.truth.nc"]
    assert main(["generate", "static", *base, "--out", "anew", "--seed", "2"]) == 0
    same_files(tmp_path, "half", "anew")


@no_signals
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_says_what_is_kept(tmp_path: Path, how: signal.Signals) -> None:
    """All whole seconds, and a shorter file may go on from them."""
    words = ["--duration", 9, *SLOW, "--quiet"]
    done = ultratight(tmp_path, *words, before=killed_in_block(7, how))
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == (
        "interrupted, half.sigmf-data.partial keeps 2 s of 9 s: the same command goes on there, "
        "--fresh starts anew\n"
    )
    assert names(tmp_path, "half") == parts("half")
    for name in ("half", "full"):
        out = ["--out", str(tmp_path / name)]
        assert main(["generate", "static", "--duration", "2.1", *SLOW, "--quiet", *out]) == 0
    same_files(tmp_path, "half", "full")


@no_signals
def test_imu_data_are_the_same_however_the_file_came_about(tmp_path: Path) -> None:
    """Gone on with after kill -9, and of a file that is longer; one row for each 5 ms."""
    words = ["--duration", "2.4", "--imu", *SLOW, "--quiet"]
    done = ultratight(tmp_path, *words, before=killed_in_block(7))
    assert done.returncode == -signal.SIGKILL
    assert not (tmp_path / "half.imu.csv").exists()
    for name, seconds in (("half", "2.4"), ("full", "2.4"), ("long", "2.6")):
        words[1] = seconds
        assert main(["generate", "static", *words, "--out", str(tmp_path / name)]) == 0
    half, full, long = ((tmp_path / f"{n}.imu.csv").read_text() for n in ("half", "full", "long"))
    assert half == full
    assert long.startswith(full)
    assert [len(text.splitlines()) for text in (full, long)] == [1 + 481, 1 + 521]
    assert not list(tmp_path.glob("*.partial"))


@no_signals
def test_an_interrupt_before_there_is_anything_leaves_nothing(tmp_path: Path) -> None:
    words = ["--duration", 9, *SLOW, "--quiet"]
    done = ultratight(tmp_path, *words, before=killed_in_block(1, signal.SIGINT))
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "interrupted, nothing half-written is left\n"
    assert list(tmp_path.iterdir()) == []


@no_signals
def test_two_processes_do_not_write_one_file(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["generate", "static", "--duration", "1", *SLOW, "--out", "x", "--quiet"]
    with (tmp_path / "x.sigmf-data.partial").open("wb") as other:
        fcntl = pytest.importorskip("fcntl")
        fcntl.flock(other, fcntl.LOCK_EX)
        assert main(words) == 1
    assert "x.sigmf-data.partial: another process is writing it" in capsys.readouterr().err
    assert main(words) == 0


def limited(code: str, tmp_path: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )


def file_limit(n_bytes: int) -> str:
    """Code: files may not exceed so much, and writing fails in the middle, as on a full disk."""
    return f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({n_bytes}, {n_bytes}))\n"


@pytest.mark.skipif(sys.platform == "win32", reason="no RLIMIT_FSIZE")
def test_a_full_disk_is_told_and_leaves_whole_seconds(tmp_path: Path) -> None:
    """2.2 MB a second: one fits into 3 MB, none into 2 MB."""
    (tmp_path / "half.sigmf-meta").write_text("an older file, to be kept")
    words = ["--duration", "2", *SLOW, "--quiet"]
    done = ultratight(tmp_path, *words, before=file_limit(2_000_000))
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)
    assert done.stderr.startswith("error: ")
    assert done.stderr.endswith("File too large\n")
    assert [p.name for p in tmp_path.iterdir()] == ["half.sigmf-meta"]

    for _ in range(2):  # still full at the second attempt
        done = ultratight(tmp_path, *words, before=file_limit(3_000_000))
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)
        assert "File too large; half.sigmf-data.partial keeps 1 s of 2 s: the same" in done.stderr
        assert names(tmp_path, "half") == sorted([*parts("half"), "half.sigmf-meta"])
    assert (tmp_path / "half.sigmf-meta").read_text() == "an older file, to be kept"
    for name in ("half", "full"):
        assert main(["generate", "static", *words, "--out", str(tmp_path / name)]) == 0
    same_files(tmp_path, "half", "full")


def test_too_little_room_is_found_before_the_work(
    tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]
) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=100_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    words = ["generate", "static", "--duration", "60", "--out", str(tmp_path / "x"), "--json"]
    assert main(words) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["error_kind"] == "io"
    assert "x.sigmf-data: needs 0.53" in said.err
    assert "GB, 0.1 GB are free there" in said.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="no VmHWM")
def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    """Peak memory of 10 s and of 60 s at 1.5 Msps."""

    def peak_kb(seconds: int) -> int:
        words = ["generate", "static", "--duration", str(seconds), "--rate", "1.5e6", *FEW]
        code = (
            "from pathlib import Path\nfrom ultratight.__main__ import main\n"
            f"assert main({[*words, '--out', 'm', '--quiet', '--json']!r}) == 0\n"
            # not getrusage: its peak begins with that of the process that started this one
            "print(Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])\n"
        )
        return int(limited(code, tmp_path).stdout.splitlines()[-1])

    short, long = peak_kb(10), peak_kb(60)
    assert long < short + 15_000
    assert long < 500_000
