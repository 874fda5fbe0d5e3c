"""Writes that fail: after they were accepted, where another program is told of it first, no attempt commits them; and on a disk
without room for one more byte or file, at many points of a run or at its end, a run says one line and loses nothing.
"""

import contextlib
import gc
import os
import resource
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.dataset.commit import Span
from schemas.errors import MachineError, VersoError
from tests.kit.made_up_runs import broken_promises, contents, leftovers, make_dataset
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


# ---------------------------------------------------------------------------------------------- full disks

POINTS = {"ci": 6, "all": 120}
BLOCK = 4096


@contextlib.contextmanager
def small_disk(place: Path, blocks: int, files: int) -> Iterator[None]:
    """A disk in memory that holds so many blocks of 4 kB and so many files and folders."""
    place.mkdir()
    options = f"size={blocks * BLOCK},nr_inodes={files}"
    try:
        subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(place)], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no tmpfs can be mounted here: {error}")
    try:
        yield
    finally:
        gc.collect()  # closes what a run that failed had open, as the end of its process does
        subprocess.run(["umount", "-l", str(place)], check=True)


def needed(place: Path, layout: str) -> tuple[int, int]:
    """The most blocks and files that a run has at once, at least those that it has in the end."""
    with small_disk(place, 16384, 100000):
        make_dataset(LocalStore(place / "out"), layout)
        disk = os.statvfs(place)
        return disk.f_blocks - disk.f_bfree, disk.f_files - disk.f_ffree


def told_by_a_run(out: Path, layout: str) -> list[str]:
    """What a run says that meets a full disk: one line, or nothing where there was room."""
    try:
        make_dataset(LocalStore(out), layout)
    except VersoError as error:
        line = str(error)
    else:
        return []
    assert "\n" not in line
    assert any(word in line for word in ("disk is full", "No space left on device")), line
    return [line]


@pytest.mark.root
@pytest.mark.usefixtures("unflushed")
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("layout", ["files", "tar"])
@pytest.mark.parametrize("lack", ["bytes", "files"])
def test_a_run_that_meets_a_full_disk_says_so_in_a_line_and_ends_once_there_is_room(
    lack, layout, tmp_path, request, record_figure
):
    digest = make_dataset(LocalStore(tmp_path / "once"), layout).digest
    expected = contents(tmp_path / "once")
    blocks, files = needed(tmp_path / "whole", layout)
    points = POINTS[request.config.getoption("--scope")]
    refused = 0
    for point in range(points):
        place = tmp_path / "disk"
        share = point / points
        room = (2 + int(blocks * share), 100000) if lack == "bytes" else (16384, 2 + int(files * share))
        with small_disk(place, *room):
            refused += len(told_by_a_run(place / "out", layout))
            if (place / "out").exists():
                assert not broken_promises(place / "out")
            subprocess.run(["mount", "-o", "remount,size=64m,nr_inodes=100000", str(place)], check=True)
            assert make_dataset(LocalStore(place / "out"), layout).digest == digest, share
            assert contents(place / "out") == expected
            assert not leftovers(place / "out")
        shutil.rmtree(place)
    print(f"{layout}, {lack}: {refused} of {points} points met a full disk")
    record_figure(f"full disks, {lack}, {layout}", "passed", refused)
    assert refused > points * 0.7
