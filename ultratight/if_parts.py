"""The parts of an IF file under way: they outlive the process that writes them.

Samples and rows of the truth grow in files of their own.  A journal says of what they are, and how
many whole seconds of both are on the disk: it is written after them and replaced as a whole, so
that what it says is there, whenever the process or the power goes.  A next run cuts off what lies
beyond and goes on.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from signals.sample_formats import FileFormat, encode
from ultratight.config import InvalidInput
from ultratight.resume import differences, lock

MARK = "ultratight-if-journal-1"
KEEP_EVERY_S = 1.0
"""Work that kill -9 can cost: to wait for the disk each second of the file would slow it down"""
_ANEW = "expected the same command, or --fresh to start anew"
_CHUNK = 1 << 22
_ROWS = 3_000


class Kept(NamedTuple):
    """What is whole: so many seconds from the start."""

    seconds: int = 0
    n_samples: int = 0
    rest: tuple[Any, ...] = ()
    """The last of the samples, which do not yet fill a byte"""
    samples: tuple[int, str] = (0, hashlib.sha512().hexdigest())
    """Bytes and their SHA-512"""
    rows: tuple[int, str] = samples


class Places(NamedTuple):
    """Where the parts of a file are."""

    samples: Path
    rows: Path
    journal: Path

    @staticmethod
    def of(name: Path, samples: Path) -> Places:
        """Those of the file NAME with its samples at ``samples``."""
        return Places(
            samples.with_name(f"{samples.name}.partial"),
            name.with_name(f"{name.name}.truth.rows.partial"),
            name.with_name(f"{name.name}.journal.partial"),
        )


def read_journal(places: Places, made: dict[str, Any]) -> Kept:
    """What an earlier run has left of a file that is ``made`` (plain data) in this way.

    Raises
    ------
    InvalidInput
        It is of another file, or is not what the journal says.
    """
    journal = _journal(places.journal)
    if journal is None:
        return Kept()
    if journal.get("mark") != MARK:
        raise InvalidInput(f"{places.journal}: not a journal ({MARK}); {_ANEW}")
    then, part = journal["made"], places.samples.with_name(journal["part"])
    if differ := differences(then, made):
        raise InvalidInput(f"{part}: of another file ({differ}); {_ANEW}")
    seconds, n_samples, rest, samples, rows = (journal["kept"][key] for key in Kept._fields)
    return Kept(seconds, n_samples, tuple(rest), (samples[0], samples[1]), (rows[0], rows[1]))


def _journal(path: Path) -> dict[str, Any] | None:
    """The journal as it stands, None where there is none; another kind of file is an empty one."""
    try:
        read = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except ValueError:
        return {}
    return read if isinstance(read, dict) else {}


class Parts:
    """Samples and rows under way, gone on with after what is ``kept``.

    Ends with `finish`, `close` and, when all has its final name, `remove`; or with `stop`.

    Raises
    ------
    InvalidInput
        What is kept is damaged.
    OSError
        Another process is writing it.
    """

    def __init__(self, places: Places, form: FileFormat, made: dict[str, Any], kept: Kept) -> None:
        self._places, self._form, self._made = places, form, made
        self._whole = self._journaled = kept
        self._last_s = -np.inf
        self.n_samples = kept.n_samples
        shape = (-1,) if form.real else (-1, 2)
        self._rest = np.array(kept.rest, np.int8).reshape(shape)
        self._samples, self._rows = _Growing(places.samples), _Growing(places.rows)
        try:
            self._samples.lock()
            if not kept.seconds:
                self._forget()
            self._samples.go_on_after(*kept.samples)
            self._rows.go_on_after(*kept.rows)
        except BaseException:
            self.close()
            raise

    def _forget(self) -> None:
        """The journal goes before what it speaks of, and samples of another format with it."""
        journal = _journal(self._places.journal) or {}
        self._places.journal.unlink(missing_ok=True)
        other = self._places.samples.with_name(Path(journal.get("part", "")).name or "-")
        if other != self._places.samples and other.suffix == ".partial":
            other.unlink(missing_ok=True)

    def write(self, samples: np.ndarray) -> None:
        """Append samples; packed formats carry what does not fill a byte to the next."""
        self.n_samples += len(samples)
        if self._form.packed:
            samples = np.concatenate([self._rest, samples])
            whole = len(samples) - len(samples) % (self._form.per_byte // self._form.components)
            samples, self._rest = samples[:whole], samples[whole:]
        self._samples.write(encode(samples, self._form))

    def write_rows(self, rows: np.ndarray) -> None:
        """Append rows of the truth (n, width)."""
        self._rows.write(np.ascontiguousarray(rows, "<f8"))

    def whole(self, seconds: int) -> None:
        """So many seconds are written: keep them, or remember to."""
        rest = tuple(self._rest.tolist())
        self._whole = Kept(seconds, self.n_samples, rest, self._samples.state(), self._rows.state())
        if time.monotonic() - self._last_s >= KEEP_EVERY_S:
            self._keep()

    def finish(self) -> str:
        """All is written: the SHA-512 of the samples."""
        if self._whole != self._journaled:
            self._keep()
        if len(self._rest):
            self._samples.write(encode(self._rest, self._form))
        self._samples.sync()
        return self._samples.state()[1]

    def rows(self, width: int) -> Iterator[np.ndarray]:
        """The rows written, (n, width) each."""
        n_bytes, at = self._rows.state()[0], 0
        with self._places.rows.open("rb") as file:
            while at < n_bytes:
                read = file.read(min(n_bytes - at, 8 * width * _ROWS))
                at += len(read)
                yield np.frombuffer(read, "<f8").reshape(-1, width)

    def stop(self) -> int:
        """Keep what is whole: so many seconds; of none nothing is left."""
        if self._whole != self._journaled:
            with suppress(OSError):
                self._samples.cut(self._whole.samples[0])  # on a full disk: room for the journal
                self._rows.cut(self._whole.rows[0])
                self._keep()
        self.close()
        if not self._journaled.seconds:
            self.remove()
        return self._journaled.seconds

    def remove(self) -> None:
        """Remove the parts, the journal first."""
        self.close()
        for path in reversed(self._places):
            with suppress(OSError):
                path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close what is open."""
        self._samples.close()
        self._rows.close()

    def _keep(self) -> None:
        """Samples and rows to the disk, then the journal that says so."""
        self._samples.sync()
        self._rows.sync()
        journal = {
            "mark": MARK,
            "part": self._places.samples.name,
            "made": self._made,
            "kept": self._whole._asdict(),
        }
        path = self._places.journal
        new = path.with_name(f"{path.name}.new")
        try:
            with new.open("w", encoding="utf-8") as file:
                json.dump(journal, file, indent=1)
                file.flush()
                os.fsync(file.fileno())
            os.replace(new, path)
        finally:
            new.unlink(missing_ok=True)
        self._journaled, self._last_s = self._whole, time.monotonic()


class _Growing:
    """A file that grows, and the SHA-512 of what is in it."""

    def __init__(self, path: Path) -> None:
        self._path, self._sha, self._n_bytes = path, hashlib.sha512(), 0
        # no buffer: what a full disk refuses does not wait to be refused again
        self._file = path.open("a+b", buffering=0)

    def lock(self) -> None:
        lock(self._file, self._path)

    def go_on_after(self, n_bytes: int, sha512: str) -> None:
        """Cut off what lies beyond; refuse what is not what was written."""
        self._file.seek(0)
        while self._n_bytes < n_bytes:
            read = self._file.read(min(_CHUNK, n_bytes - self._n_bytes))
            if not read:
                break
            self._sha.update(read)
            self._n_bytes += len(read)
        if self.state() != (n_bytes, sha512):
            raise InvalidInput(f"{self._path}: damaged, not what its journal says; {_ANEW}")
        self.cut(n_bytes)

    def cut(self, n_bytes: int) -> None:
        self._file.truncate(n_bytes)

    def write(self, array: np.ndarray) -> None:
        left = array.view(np.uint8).reshape(-1).data
        self._sha.update(left)
        self._n_bytes += len(left)
        while left:  # a disk that fills up takes a part first
            left = left[self._file.write(left) :]

    def state(self) -> tuple[int, str]:
        return self._n_bytes, self._sha.hexdigest()

    def sync(self) -> None:
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()
