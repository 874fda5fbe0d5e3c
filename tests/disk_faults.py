"""Counting what a program does to the disk, and ending or disturbing it at any one of those steps.

A kill is an exception that nothing catches, and every later step raises it again: clean-up code cannot touch the disk
either, as after a real kill. A loss of power also empties every file whose bytes were not flushed since they were
written.
"""

import builtins
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from workers.store import file_system, local

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
