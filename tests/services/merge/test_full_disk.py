"""Disks that are full at any point of a merge: one line says so, and the same command finishes later."""

import contextlib
import errno
import os
import resource
import subprocess
import tempfile
from pathlib import Path

import pytest

from schemas.dataset.layout import STAGING
from schemas.errors import MachineError
from services.merge.merge import merge
from tests.kit.faults import disk
from tests.made_up_datasets import FIRST, STOP, dataset_at

pytestmark = pytest.mark.usefixtures("unflushed")


@contextlib.contextmanager
def largest_file(limit: int):
    """Writes beyond so many bytes of a file fail, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def failed(store) -> str:
    """What a merge said; empty where it had room."""
    told = ""
    try:
        merge(store, FIRST, STOP)
    except MachineError as error:
        told = str(error)
    assert "\n" not in told
    assert not told or "could not write" in told or "could not be written" in told
    return told


def test_a_merge_without_room_at_any_point_says_so_and_can_be_done_again(merged, tmp_path):
    store = dataset_at(tmp_path)
    told = []
    limit = 64
    while True:
        with largest_file(limit):
            told.append(failed(store))
        if not told[-1]:
            break
        assert not list(store.files(STAGING)), limit
        limit = limit * 8 // 5
    assert len(told) > 12
    assert merge(store, FIRST, STOP) == merged[1]


def test_a_step_on_the_disk_that_finds_no_room_says_so_and_can_be_done_again(merged, tmp_path):
    def no_room():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    store = dataset_at(tmp_path)
    told, step = [], 0
    while True:
        with disk(at=step, then=no_room) as watched:
            told.append(failed(store))
        if watched.steps <= step:
            break
        (tmp_path / "_SUCCESS").unlink(missing_ok=True)
        step += 15
    assert sum(map(bool, told)) > len(told) // 3  # what cleans up may fail without a word
    assert merge(store, FIRST, STOP) == merged[1]
    assert not list(store.files(STAGING))


@pytest.fixture
def small_disk():
    """A file system of 8 MiB and 4,096 files."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m,nr_inodes=4096", "tmpfs", folder], check=True)
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", folder], check=True)


@pytest.mark.root
@pytest.mark.parametrize("what", ["bytes", "files"])
def test_a_disk_that_is_full_says_so_and_the_merge_can_be_done_when_it_has_room(merged, small_disk, what):
    store = dataset_at(small_disk / "out")
    filler = small_disk / "filler"
    filler.mkdir()
    told = []
    for left in (0, 1, 2, 4, 8, 16, 24, 32, 48, 64, 96, 128, 256, 512):
        found = os.statvfs(small_disk)
        if what == "bytes":
            (filler / "a").write_bytes(bytes(max(0, found.f_bavail * found.f_frsize - left * 4096)))
        else:
            for number in range(found.f_favail - left):
                (filler / str(number)).touch()
        told.append(failed(store))
        (small_disk / "out/_SUCCESS").unlink(missing_ok=True)
        for path in filler.iterdir():
            path.unlink()
        assert not list(store.files(STAGING)), left
    assert all(told[:4])
    assert not told[-1]
    assert merge(store, FIRST, STOP) == merged[1]
