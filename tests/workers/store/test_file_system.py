"""What only a disk has: flushing, hard links, errors explained, and temporary folders of processes that may die."""

import fcntl
import os
import tempfile
from types import SimpleNamespace

import pytest

from schemas.errors import MachineError, OutputError
from workers.store import file_system
from workers.store.file_system import (
    INNER,
    OWNER,
    explain_disk_errors,
    file_system_of,
    owned_folders,
    temporary_folder,
)
from workers.store.local import LocalStore

MANY = [f"c{number}/patches/x" for number in range(4)]


def test_without_syncfs_every_folder_is_flushed_and_with_it_the_file_system_once(tmp_path, monkeypatch):
    """That each file is flushed then, too, is in tests/chaos/test_crashes.py."""
    flushed: list[str] = []
    monkeypatch.setattr(file_system, "_trusts_syncfs", lambda folder: False)
    monkeypatch.setattr(file_system, "sync_path", lambda path: flushed.append(str(path)))
    LocalStore(tmp_path).sync(MANY)
    below = {f"{tmp_path}/c{number}" for number in range(4)}
    assert set(flushed) == {str(tmp_path), *below, *(f"{folder}/patches" for folder in below)}
    assert flushed[-1] == str(tmp_path)
    flushed.clear()
    monkeypatch.setattr(file_system, "_trusts_syncfs", lambda folder: True)
    monkeypatch.setattr(file_system, "_syncfs", lambda fd: flushed.append(os.readlink(f"/proc/self/fd/{fd}")))
    LocalStore(tmp_path).sync(MANY)
    assert flushed == [str(tmp_path)]


def test_the_kernel_names_a_file_system_and_an_old_or_unknown_one_is_not_trusted_with_syncfs(tmp_path, monkeypatch):
    assert (file_system_of("/proc/self"), file_system_of("/sys/kernel")) == ("proc", "sysfs")
    for kind, kernel, trusted in (("fuse.x", "5.10.0-8", False), ("ext4", "4.18.0", False), ("ext4", "5.10.0-8", True)):
        monkeypatch.setattr(file_system, "file_system_of", lambda folder, kind=kind: kind)
        monkeypatch.setattr(os, "uname", lambda kernel=kernel: SimpleNamespace(release=kernel))
        assert file_system._trusts_syncfs(tmp_path) is trusted


def test_a_file_system_that_is_not_safe_is_refused_by_name_and_a_full_one_is_told_with_what_to_do(
    tmp_path, monkeypatch
):
    def unsupported(source, target):
        raise OSError(1, "Operation not permitted")

    def full(*_):
        raise OSError(28, "No space left on device")

    replaces = lambda source, target: target.write_bytes(source.read_bytes())  # noqa: E731
    kind = file_system_of(tmp_path)
    for link, message in (
        (replaces, rf"type {kind} that fails at refusing a second hard link.*local disk"),
        (unsupported, rf"type {kind} that fails at a hard link \(Operation not permitted\)"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(os, "link", link)
            with pytest.raises(OutputError, match=message):
                LocalStore(tmp_path / "out").prepare()
    store = LocalStore(tmp_path / "out")
    store.prepare()
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(MachineError, match=r"manifest/_commits/a.json.*disk is full.*free some space"):
        store.put_if_absent("manifest/_commits/a.json", b"x")
    with pytest.raises(FileExistsError), explain_disk_errors("a file could not be written"):
        raise FileExistsError(17, "nobody can mend this")


def test_a_temporary_folder_stays_while_another_process_looks_and_goes_where_its_own_is_gone(tmp_path, monkeypatch):
    """It looks in the middle of the making too. How owners die is tested in tests/services/run/test_ray_cluster.py."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / "verso-test-dead" / INNER).mkdir(parents=True)
    (tmp_path / "verso-test-dead" / OWNER).touch()
    lock = fcntl.flock

    def late(file: object, flags: int) -> None:
        if flags == fcntl.LOCK_EX:
            assert not (tmp_path / "verso-test-dead").exists()
            assert owned_folders(tmp_path, "verso-test-") == []
        lock(file, flags)

    monkeypatch.setattr(fcntl, "flock", late)
    with temporary_folder("test") as mine:
        assert mine.is_dir() and owned_folders(tmp_path, "verso-test-") == [mine.parent]
        assert list(tmp_path.iterdir()) == [mine.parent]
    assert list(tmp_path.iterdir()) == []
