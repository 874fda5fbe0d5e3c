"""Whatever is no part of the dataset is named, wherever it lies; what writers keep beside it is not."""

import os
import shutil

import pytest

from tests.datasets import faults_of
from workers.store.local import LocalStore


@pytest.mark.parametrize(
    "path",
    [
        *("notes.txt", ".hidden", "box/RGB00099.png", "box/patches/x", "box/0000000009.tar", "new/a/b.txt"),
        *("assets/x.glb", "assets/box/x.glb", "manifest/x", "manifest/_commits/x.json", "manifest/_commits/00.json"),
        *(
            "manifest/_ranges/x",
            "manifest/_ranges/0000000000/more.parquet",
            "manifest/_ranges/0000000009/views.parquet",
        ),
        *("manifest/views/category=box/part-00001.parquet", "manifest/views/x.parquet", "_SUCCESS~", "_staged"),
    ],
)
def test_a_stray_file_is_named(copy, path):
    (copy / path).parent.mkdir(parents=True, exist_ok=True)
    (copy / path).write_bytes(b"x")
    (fault,) = faults_of(LocalStore(copy))
    assert fault.startswith(f"{path}: is in no commit")


def test_folders_links_and_devices_are_named(copy):
    (copy / "empty/inner").mkdir(parents=True)
    image = next(copy.glob("*/RGB0*.png"))
    shutil.move(image, copy.parent / "elsewhere.png")
    image.symlink_to(copy.parent / "elsewhere.png")
    (copy / "linked").symlink_to(copy.parent)
    os.mkfifo(copy / "pipe")
    table = copy / "manifest/_ranges/0000000001/timings.parquet"
    table.unlink()
    table.mkdir()
    assert sorted(fault.partition(": ")[2].partition(":")[0] for fault in faults_of(LocalStore(copy))) == [
        "is a symbolic link",
        "is a symbolic link",
        "is an empty folder",
        "is committed and is a folder, where a file should be",
        "is neither a file nor a folder",
    ]


def test_what_writers_keep_is_free(copy):
    for path in ("_logs/a/b.jsonl", "_staging/0000000000/r0-x/y", "_lock.json"):
        (copy / path).parent.mkdir(parents=True, exist_ok=True)
        (copy / path).touch()
    assert faults_of(LocalStore(copy)) == []


def test_tables_of_a_retry_whose_commit_is_gone_name_the_commit(copy):
    shutil.copytree(copy / "manifest/_ranges/0000000000", copy / "manifest/_ranges/0000000000.retry-1")
    faults = faults_of(LocalStore(copy))
    assert len(faults) == 6
    assert all("manifest/_commits/0000000000.retry-1.json is missing" in fault for fault in faults)
