"""Faults on purpose: a disk that fails or loses power, requests to a bucket that are cut, and a lock that another takes."""

import builtins
import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import obstore
import pytest
from obstore.exceptions import GenericError

from schemas.dataset.commit import CommitRecord, FileEntry
from schemas.dataset.layout import is_shape
from schemas.errors import CorruptError
from services.run import lock as module
from services.run.lock import Beat, Lock, hold_lock
from workers.store import file_system, local, objects
from workers.store.commit import committed_files
from workers.store.store import Store

_STEPS = ("link", "replace", "rename", "mkdir", "unlink", "rmdir", "fsync")


class Killed(BaseException):
    """The process is gone."""


class Disk:
    """Steps so far; the step `at` is ended half way (`torn`) or before it, or `instead` runs just before it."""

    def __init__(self, at: int = -1, then: Callable[[], object] | None = None) -> None:
        self.steps = 0
        self.synced: set[int] = set()
        self._at = at
        self._then = then
        self._busy = False

    def step(self) -> bool:
        """Counts one step. True where a write must be torn; raises Killed afterwards for ever."""
        if self._busy:
            return False
        self.steps += 1
        if self.steps - 1 != self._at:
            if self._then is None and -1 < self._at < self.steps - 1:
                raise Killed
            return False
        if self._then is None:
            return True
        self._busy = True
        try:
            self._then()
        finally:
            self._busy = False
        return False


@contextmanager
def disk(at: int = -1, then: Callable[[], object] | None = None) -> Iterator[Disk]:
    """Counts the steps taken in this context. At step `at` the process is killed, or `then` runs. Nothing is flushed."""
    watched = Disk(at, then)
    with pytest.MonkeyPatch.context() as patch:
        for name in _STEPS:
            patch.setattr(os, name, _counted(watched, name, getattr(os, name)))
        for module in (local, file_system):
            patch.setattr(
                module, "open", lambda path, mode="r", **more: _open(watched, path, mode, **more), raising=False
            )
        patch.setattr(file_system, "_syncfs", lambda descriptor: _sync_all(watched, descriptor))
        patch.setattr(file_system, "_trusts_syncfs", lambda folder: True)
        yield watched


@pytest.fixture(scope="module")
def unflushed() -> Iterator[None]:
    """Nothing is flushed in this module: for tests that lose no power, which a busy disk would slow down."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        patch.setattr(file_system, "_syncfs", lambda folder: True)
        patch.setattr(file_system, "_trusts_syncfs", lambda folder: True)
        yield


def lose_power(watched: Disk, root: Path) -> None:
    """Empties every file below `root` whose bytes were never flushed."""
    for parent, _, names in os.walk(root):
        for name in names:
            path = os.path.join(parent, name)
            if os.stat(path).st_ino not in watched.synced:
                os.truncate(path, 0)


def _counted(watched: Disk, name: str, real: Callable) -> Callable:
    def call(*arguments, **named):
        if watched.step():
            raise Killed
        if name != "fsync":
            return real(*arguments, **named)
        watched.synced.add(os.fstat(arguments[0]).st_ino)
        return None

    return call


def _open(watched: Disk, path, mode: str, **more):
    """The open file; reading is no step, because it leaves nothing behind."""
    if "r" in mode:
        return builtins.open(path, mode, **more)
    if watched.step():
        raise Killed
    file = builtins.open(path, mode, **more)  # noqa: SIM115 - the caller's to close
    watched.synced.discard(os.fstat(file.fileno()).st_ino)
    write = file.write

    def torn_or_whole(data):
        if watched.step():
            write(data[: len(data) // 2])
            file.flush()
            raise Killed
        return write(data)

    return _Writing(file, torn_or_whole)


class _Writing:
    """A file whose `write` is watched."""

    def __init__(self, file, write) -> None:
        self._file = file
        self.write = write
        self.close, self.flush, self.fileno = file.close, file.flush, file.fileno

    def __enter__(self):
        return self

    def __exit__(self, *raised) -> None:
        self._file.close()


def _sync_all(watched: Disk, descriptor: int) -> bool:
    if watched.step():
        raise Killed
    for parent, _, names in os.walk(os.readlink(f"/proc/self/fd/{descriptor}")):
        watched.synced |= {os.stat(os.path.join(parent, name)).st_ino for name in names}
    return True


CHANGES = ("put", "copy", "delete")
REQUESTS = (*CHANGES, "get", "head", "list", "list_with_delimiter")

Fault = Literal["killed before", "killed after", "answer lost"]


class Requests:
    """`obstore`, with its requests counted; number `at` meets the fault, or `then` runs just before it."""

    def __init__(self, names: tuple[str, ...], at: int, fault: Fault, then: Callable[[], object] | None) -> None:
        self.count = 0
        self.decision = -1
        """The number of the latest conditional put."""
        self.names = names
        self.at = at
        self._fault = fault
        self._then = then
        self._busy = False
        self._counting = threading.Lock()

    def __getattr__(self, name: str):
        real = getattr(obstore, name)
        return self._watched(real) if name in self.names else real

    def _watched(self, real: Callable) -> Callable:
        def call(*arguments, **named):
            if self._busy:
                return real(*arguments, **named)
            with self._counting:
                mine = self.count
                self.count += 1
                if named.get("mode") == "create":
                    self.decision = mine
            if mine == self.at and self._then is not None:
                self._run_then()
            elif self._then is None and -1 < self.at <= mine and self._fault != "answer lost":
                if mine == self.at and self._fault == "killed after":
                    real(*arguments, **named)
                raise Killed
            elif mine == self.at and self._then is None:
                real(*arguments, **named)
                raise GenericError("the answer was lost")
            return real(*arguments, **named)

        return call

    def _run_then(self) -> None:
        assert self._then is not None
        self._busy = True
        try:
            self._then()
        finally:
            self._busy = False


@contextmanager
def requests(
    at: int = -1,
    fault: Fault = "killed before",
    then: Callable[[], object] | None = None,
    names: tuple[str, ...] = CHANGES,
) -> Iterator[Requests]:
    """Counts the requests with these names in this context; number `at` meets the fault, or `then` runs before it."""
    watched = Requests(names, at, fault, then)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(objects, "obstore", watched)
        yield watched


FAST = Beat(period_s=0.02, patience=15)
STILL = Beat(period_s=0.02 * 3600, patience=1)
"""A heartbeat that does not come while a test lasts."""


@contextlib.contextmanager
def taken_over(store: Store) -> Iterator[Lock]:
    """Another machine finds the holder silent and takes the lock over; yields its lock."""
    with contextlib.ExitStack() as stack:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "_machine", lambda: "another")
            patch.setattr(module.socket, "gethostname", lambda: "far")
            theirs = stack.enter_context(hold_lock(store, FAST))
        yield theirs


def check_published(store: Store, record: CommitRecord) -> tuple[FileEntry, ...]:
    """Every file of the record.

    Raises CorruptError naming one that is not in its final place with its size. A shape that a mix of stacks shares
    keeps the size of whichever was first.
    """
    files = committed_files(store, record)
    for entry in files:
        final = store.size(entry.path)
        exact = record.terms.fingerprint_mode == "strict" or not is_shape(entry.path)
        if final is None or (exact and final != entry.bytes):
            raise CorruptError(f"{entry.path} has {final} bytes in its final place, and its commit says {entry.bytes}")
    return files
