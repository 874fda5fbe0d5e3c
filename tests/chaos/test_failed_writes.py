"""Writes that fail after they were accepted, where another program is told of it first: no attempt commits them."""

import contextlib
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.dataset.commit import Span
from schemas.dataset.layout import staging_path
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
    file_system.sync_tree(tmp_path / "out")  # a descriptor that is opened now hears nothing
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


def test_without_syncfs_every_file_is_flushed_before_it_is_closed(tmp_path, monkeypatch):
    monkeypatch.setattr(file_system, "_trusts_syncfs", lambda folder: False)
    store, attempt = begun(tmp_path)
    attempt.add_scene(small_scene(1))
    flushed = set()
    real = os.fsync

    def fsync(descriptor: int) -> None:
        if os.get_inheritable(descriptor) is False and os.path.isfile(
            path := os.readlink(f"/proc/self/fd/{descriptor}")
        ):
            flags = Path(f"/proc/self/fdinfo/{descriptor}").read_text().split("flags:")[1].split()[0]
            if int(flags, 8) & os.O_ACCMODE:  # the descriptor that wrote it
                flushed.add(Path(path).name)
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    again = begin_attempt(store, Span(start=2, stop=4), terms(range_size=2))
    for scene_id in (2, 3):
        again.add_scene(small_scene(scene_id))
    record = again.commit().record
    assert {Path(entry.path).name for entry in record.files} <= flushed


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


@contextlib.contextmanager
def disk_that_loses_writes(folder: Path) -> Iterator[tuple[Path, Path]]:
    """(an ext4 of 64 MB on a device that can hold 12 MB, the mount below it that may be made larger)."""
    below, mounted = folder / "below", folder / "mounted"
    commands = [
        ["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", str(below)],
        ["truncate", "-s", "64M", str(below / "image")],
        ["mkfs.ext4", "-q", "-F", "-O", "^has_journal", str(below / "image")],
        ["mount", "-o", "loop,errors=continue", str(below / "image"), str(mounted)],
    ]
    with contextlib.ExitStack() as stack:
        for place in (below, mounted):
            place.mkdir()
        for command in commands:
            try:
                subprocess.run(command, check=True, capture_output=True)
            except (OSError, subprocess.CalledProcessError) as error:
                pytest.skip(f"no ext4 can be mounted here: {error}")
            if command[0] == "mount":
                stack.callback(subprocess.run, ["umount", command[-1]], check=True)
        yield mounted, below


@pytest.mark.root
def test_on_a_real_disk_that_loses_writes_the_kernel_tells_the_attempt_and_no_late_descriptor(tmp_path):
    with disk_that_loses_writes(tmp_path) as (mounted, below):
        store = LocalStore(mounted / "out")
        store.prepare()
        staging = staging_path(0, "r0-mine")
        stage = store.stage(staging)
        other = "import os, sys; descriptor = os.open(sys.argv[1], os.O_RDONLY); input(); os.sync()\n"
        other += "import ctypes; sys.exit(ctypes.CDLL(None).syncfs(descriptor) != 0)"
        with subprocess.Popen([sys.executable, "-c", other, str(mounted)], stdin=subprocess.PIPE) as program:
            stage.write("mug/big.png", os.urandom(30 << 20))
            program.communicate(b"\n")
            assert program.returncode == 1, "the other program was told"
        subprocess.run(["mount", "-o", "remount,size=80m", str(below)], check=True)
        file_system.sync_tree(store.path(staging))  # the old order: a descriptor that is opened now hears nothing
        with pytest.raises(MachineError, match="disk"):
            stage.flush()
