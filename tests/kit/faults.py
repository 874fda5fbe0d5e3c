"""Faults on purpose: something else at a step on a disk, requests to a bucket that are cut, a lock that another takes."""

import builtins
import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
    """Counts steps; `then` runs just before the step `at`, whose own steps do not count."""

    def __init__(self, at: int, then: Callable[[], object] | None) -> None:
        self.steps = 0
        self._at = at
        self._then = then
        self._busy = False

    def step(self) -> None:
        """One step."""
        if self._busy:
            return
        self.steps += 1
        if self.steps - 1 == self._at and self._then is not None:
            self._busy = True
            try:
                self._then()
            finally:
                self._busy = False


@contextmanager
def disk(at: int = -1, then: Callable[[], object] | None = None) -> Iterator[Disk]:
    """Counts the steps taken in this context: what leaves something behind. `then` runs at step `at`. Nothing is flushed."""
    watched = Disk(at, then)

    def counted(name: str, real: Callable) -> Callable:
        def call(*arguments, **named):
            watched.step()
            return None if name == "fsync" else real(*arguments, **named)

        return call

    def opened(path, mode="r", **more):
        if "r" in mode:
            return builtins.open(path, mode, **more)
        watched.step()
        file = builtins.open(path, mode, **more)  # noqa: SIM115 - the caller's to close
        return Written(file, counted("write", file.write))

    with pytest.MonkeyPatch.context() as patch:
        for name in _STEPS:
            patch.setattr(os, name, counted(name, getattr(os, name)))
        for module in (local, file_system):
            patch.setattr(module, "open", opened, raising=False)
        patch.setattr(file_system, "_syncfs", lambda descriptor: watched.step())
        patch.setattr(file_system, "_trusts_syncfs", lambda folder: True)
        yield watched


class Written:
    """An open file with another `write`."""

    def __init__(self, file, write) -> None:
        self._file = file
        self.write = write
        self.close, self.flush, self.fileno = file.close, file.flush, file.fileno

    def __enter__(self):
        return self

    def __exit__(self, *raised) -> None:
        self._file.close()


@pytest.fixture(scope="module")
def unflushed() -> Iterator[None]:
    """Nothing is flushed in this module: for tests that lose no power, which a busy disk would slow down."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        patch.setattr(file_system, "_syncfs", lambda folder: True)
        patch.setattr(file_system, "_trusts_syncfs", lambda folder: True)
        yield


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


def in_threads(*works: Callable[[], object]) -> None:
    """Runs each work in a thread of its own, all from one moment on; raises what one raised when all have ended."""
    begin, faults = threading.Barrier(len(works)), []

    def run(work: Callable[[], object]) -> None:
        begin.wait()
        try:
            work()
        except Exception as error:
            faults.append(error)

    threads = [threading.Thread(target=run, args=(work,)) for work in works]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert faults == []
