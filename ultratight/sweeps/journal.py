"""The journal of a sweep: a line for each finished run, appended and never changed.

The first line says what is swept.  Each line carries its own checksum, so that one that was torn
by an interrupt, a full disk or a lost machine is known and left out; its run is flown again.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ultratight.config import InvalidInput
from ultratight.resume import differences, flat, lock
from ultratight.sweeps.flights import Record

MARK = "ultratight-sweep-1"
NAME = "journal.txt"
_SYNC_S = 1.0
"""A record is safe from the end of the process at once, from that of the machine after this"""
_CHECK = 16
"""Hexadecimal digits of a line's checksum"""
_ANEW = "expected the same sweep, another folder, or --fresh to start anew"
_BEGINS = f'{{"mark":"{MARK}"'.encode()
"""Of the first line, behind its checksum"""


def _line(data: Mapping[str, Any]) -> bytes:
    text = json.dumps(data, separators=(",", ":")).encode()
    return hashlib.sha256(text).hexdigest()[:_CHECK].encode() + b" " + text + b"\n"


def _parsed(line: bytes) -> dict[str, Any] | None:
    """The data of a line; None for one that is torn or damaged."""
    check, _, text = line[:-1].partition(b" ")
    if not line.endswith(b"\n") or hashlib.sha256(text).hexdigest()[:_CHECK].encode() != check:
        return None
    data: dict[str, Any] = json.loads(text)
    return data


def _is_ours(begin: bytes) -> bool:
    """Does a journal begin like this, whole or cut short?"""
    check, _, text = begin.partition(b" ")
    known = len(check) <= _CHECK and set(check) <= set(b"0123456789abcdef")
    return known and (text.startswith(_BEGINS) or _BEGINS.startswith(text))


def read_header(folder: Path) -> dict[str, Any]:
    """What the sweep in a folder is.  `InvalidInput`: there is none."""
    path = Path(folder) / NAME
    try:
        with path.open("rb") as file:
            header = _parsed(file.readline())
    except OSError:
        header = None
    if header is None or header.get("mark") != MARK:
        raise InvalidInput(f"{folder}: holds no sweep, expected the folder of `ultratight sweep`")
    return header


def find(folder: Path, cell: int, run: int) -> Record | None:
    """The record of a finished run; None where there is none."""
    with (folder / NAME).open("rb") as file:
        file.readline()
        for line in file:
            data = _parsed(line)
            if data is not None and (data["cell"], data["run"]) == (cell, run):
                return data
    return None


class Journal:
    """The finished runs of a sweep in a folder.

    Parameters
    ----------
    folder : of the sweep.
    made : plain data on which every run depends; ``made["about"]`` is for readers only.
    shape : cells and runs asked for; further runs in the file are kept there and left out here.
    fresh : forget what there is.

    Raises
    ------
    InvalidInput
        The folder has another sweep.
    OSError
        Another process is writing it.
    """

    def __init__(
        self, folder: Path, made: Mapping[str, Any], shape: tuple[int, int], fresh: bool = False
    ) -> None:
        self.path = folder / NAME
        self._at = np.full(shape, -1, np.int64)
        self._sha = np.zeros((*shape, 32), np.uint8)
        self._synced_s = time.monotonic()
        self.damaged = 0
        """Lines that are left out, apart from a torn last one; their runs are flown again"""
        # no buffer: what a full disk refuses does not wait to be refused again
        self._file = self.path.open("a+b", buffering=0)
        try:
            lock(self._file, self.path)
            self._refuse_foreign()
            if fresh:
                self._file.truncate(0)
            self._end = self._read(dict(made))
            self._file.truncate(self._end)
            if self._end == 0:
                self._begin(_line({"mark": MARK, **made}))
        except BaseException:
            self._file.close()
            raise

    def _begin(self, line: bytes) -> None:
        try:
            self._append(line)
        except OSError as error:
            raise OSError(f"{self.path}: cannot be written ({error.strerror})") from None

    def _refuse_foreign(self) -> None:
        """What somebody else has written is neither gone on with nor forgotten."""
        self._file.seek(0)
        if not _is_ours(self._file.read(_CHECK + 1 + len(_BEGINS))):
            raise InvalidInput(f"{self.path}: not a journal ({MARK}), expected another folder")

    def _read(self, made: dict[str, Any]) -> int:
        """Find the records; returns where the whole lines end."""
        self._file.seek(0)
        end = 0
        with self.path.open("rb") as file:
            for line in file:
                data = _parsed(line)
                if end == 0 and data is None and not line.endswith(b"\n"):
                    return 0  # cut short in its first line
                if end == 0:
                    self._check(data, made)
                elif data is not None:
                    self._note(data, end)
                elif line.endswith(b"\n"):
                    self.damaged += 1
                else:
                    break
                end += len(line)
        return end

    def _check(self, header: dict[str, Any] | None, made: dict[str, Any]) -> None:
        if header is None or header.get("mark") != MARK:
            raise InvalidInput(f"{self.path}: its first line is damaged; {_ANEW}")
        then = {k: v for k, v in header.items() if k not in ("mark", "about")}
        here = json.loads(json.dumps({k: v for k, v in made.items() if k != "about"}))
        if differ := differences(flat(then), flat(here)):
            raise InvalidInput(f"{self.path.parent}: has another sweep ({differ}); {_ANEW}")

    def _note(self, data: Record, at: int) -> None:
        place = data["cell"], data["run"]
        if place[0] < self._at.shape[0] and place[1] < self._at.shape[1] and not self.has(*place):
            self._at[place] = at
            self._sha[place] = np.frombuffer(bytes.fromhex(data["sha256"]), np.uint8)

    def has(self, cell: int, run: int) -> bool:
        """Is this run finished?"""
        return bool(self._at[cell, run] >= 0)

    @property
    def n_done(self) -> int:
        """Finished runs, of those asked for."""
        return int((self._at >= 0).sum())

    def left(self) -> np.ndarray:
        """(n, 2) run and cell of what is not finished: all cells of a run, then of the next."""
        return np.argwhere(self._at.T < 0)

    def add(self, data: Record) -> None:
        """Append a record, whole or not at all.  OSError: no room."""
        if self.has(data["cell"], data["run"]):
            return
        at = self._end
        self._append(_line(data))
        self._note(data, at)

    def _append(self, line: bytes) -> None:
        left = memoryview(line)
        try:
            while left:  # a disk that fills up takes a part first
                left = left[self._file.write(left) :]
        except BaseException:
            self._file.truncate(self._end)
            raise
        self._end += len(line)
        if time.monotonic() - self._synced_s > _SYNC_S:
            self.sync()

    def sync(self) -> None:
        """To the disk."""
        os.fsync(self._file.fileno())
        self._synced_s = time.monotonic()

    def records(self) -> Iterator[Record]:
        """Finished runs asked for, cell by cell and run by run."""
        with self.path.open("rb") as file:
            for at in self._at.reshape(-1).tolist():
                if at >= 0:
                    file.seek(at)
                    data = _parsed(file.readline())
                    if data is None:
                        raise OSError(f"{self.path}: damaged while it was in use")
                    yield data

    def digest(self) -> str:
        """One SHA-256 over all finished runs asked for, whatever their order."""
        done = self._sha[self._at >= 0]
        rows = sorted(bytes(row) for row in done)
        return hashlib.sha256(b"".join(rows)).hexdigest()

    def close(self) -> None:
        """To the disk, and let others at it."""
        if not self._file.closed:
            try:
                self.sync()
            finally:
                self._file.close()
