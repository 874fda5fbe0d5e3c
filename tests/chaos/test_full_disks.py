"""A disk without room for one more byte or file, at many points of a run or at its end: one line, and nothing is lost."""

import contextlib
import gc
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.errors import VersoError
from tests.kit.made_up_runs import broken_promises, contents, leftovers, make_dataset
from workers.store.local import LocalStore

pytestmark = [
    pytest.mark.root,
    pytest.mark.usefixtures("unflushed"),
    pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning"),
]

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


def widen(place: Path) -> None:
    subprocess.run(["mount", "-o", "remount,size=64m,nr_inodes=100000", str(place)], check=True)


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
            widen(place)
            assert make_dataset(LocalStore(place / "out"), layout).digest == digest, share
            assert contents(place / "out") == expected
            assert not leftovers(place / "out")
        shutil.rmtree(place)
    print(f"{layout}, {lack}: {refused} of {points} points met a full disk")
    record_figure(f"full disks, {lack}, {layout}", "passed", refused)
    assert refused > points * 0.7
