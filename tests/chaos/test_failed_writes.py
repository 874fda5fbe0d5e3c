"""Writes that fail after they were accepted, where another program is told of it first: no attempt commits them."""

import os
import resource
from pathlib import Path

import pytest

from schemas.dataset.commit import Span
from schemas.errors import MachineError
from tests.made_up_scenes import small_scene, terms
from workers.store import file_system
from workers.store.attempt import Attempt, begin_attempt
from workers.store.commit import read_record
from workers.store.local import LocalStore

EIO = 5


class FileSystemErrors:
    """The kernel's rule (lib/errseq.c): an error is told once for each descriptor opened before anybody was told."""

    def __init__(self) -> None:
        self.number = 0
        self.told = True
        self.known: dict[int, int] = {}

    def opened(self, descriptor: int) -> int:
        self.known[descriptor] = self.number if self.told else self.number - 1
        return descriptor

    def fail(self) -> None:
        self.number += 1
        self.told = False

    def syncfs(self, descriptor: int) -> None:
        before, self.known[descriptor] = self.known.get(descriptor, self.number), self.number
        if before != self.number:
            self.told = True
            raise OSError(EIO, os.strerror(EIO))


@pytest.fixture
def errors(monkeypatch) -> FileSystemErrors:
    modelled = FileSystemErrors()
    real = os.open
    monkeypatch.setattr(os, "open", lambda *given, **named: modelled.opened(real(*given, **named)))
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
    monkeypatch.setattr(file_system, "_trusts_syncfs", lambda folder: True)
    monkeypatch.setattr(file_system, "_syncfs", modelled.syncfs)
    return modelled


def begun(root: Path) -> tuple[LocalStore, Attempt]:
    """A store, and an attempt at two scenes that lacks its second."""
    store = LocalStore(root)
    store.prepare()
    attempt = begin_attempt(store, Span(start=0, stop=2), terms(range_size=2))
    attempt.add_scene(small_scene(0))
    return store, attempt


def test_a_failed_write_that_another_program_was_told_of_stops_the_commit(tmp_path, errors):
    other = os.open(tmp_path, os.O_RDONLY)
    store, attempt = begun(tmp_path / "out")
    errors.fail()
    with pytest.raises(OSError, match="Input"):
        errors.syncfs(other)
    os.close(other)
    file_system.sync_folders(
        tmp_path / "out", [f"{n}" for n in range(9)]
    )  # a descriptor that is opened now hears nothing
    attempt.add_scene(small_scene(1))
    with pytest.raises(MachineError, match="the disk reports an input/output error; check it before going on"):
        attempt.commit()
    assert read_record(store, 0) is None


def test_a_failed_write_from_before_an_attempt_is_no_business_of_it(tmp_path, errors):
    other = os.open(tmp_path, os.O_RDONLY)
    errors.fail()
    with pytest.raises(OSError, match="Input"):
        errors.syncfs(other)
    os.close(other)
    _, attempt = begun(tmp_path / "out")
    attempt.add_scene(small_scene(1))
    assert attempt.commit().won


def test_with_64_open_files_an_attempt_commits_and_keeps_none_open(tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, limits[1]))
    try:
        before = len(os.listdir("/proc/self/fd"))
        store = LocalStore(tmp_path)
        store.prepare()
        for start in range(100):
            attempt = begin_attempt(store, Span(start=start, stop=start + 1), terms(range_size=1))
            attempt.begin_scene(start)
            if start % 25 == 1:
                attempt.add_scene(small_scene(start))
                assert attempt.commit().won
            elif start % 25:
                attempt.abandon()
            else:
                del attempt  # its process went on without a word
                store = LocalStore(tmp_path)
        del store
        assert len(os.listdir("/proc/self/fd")) <= before + 1
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
