import os
import subprocess

import pytest

from schemas.dataset.layout import TEMPORARY
from schemas.errors import MachineError, OutputError
from workers.store import file_system
from workers.store.file_system import explain_disk_errors, file_system_of
from workers.store.local import LocalStore


@pytest.fixture
def store(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    return store


def test_the_file_system_of_a_folder_is_what_the_kernel_says():
    assert file_system_of("/proc/self") == "proc"
    assert file_system_of("/sys/kernel") == "sysfs"


def test_without_syncfs_every_file_and_folder_is_flushed_one_by_one(tmp_path, monkeypatch):
    (tmp_path / "a" / "b").mkdir(parents=True)
    names = [tmp_path / "a" / "x", tmp_path / "a" / "b" / "y"]
    for name in names:
        name.write_bytes(b"1")
    flushed = set()
    real = os.fsync

    def fsync(descriptor):
        flushed.add(os.readlink(f"/proc/self/fd/{descriptor}"))
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(file_system, "_trusts_syncfs", lambda folder: False)
    file_system.sync_tree(tmp_path / "a")
    assert flushed == {str(path) for path in [*names, tmp_path / "a", tmp_path / "a" / "b", tmp_path]}


def many_names():
    return [f"c{number}/patches/x" for number in range(4)]


def test_names_in_many_folders_are_flushed_by_one_syncfs(tmp_path, monkeypatch):
    store, flushed = LocalStore(tmp_path), []
    monkeypatch.setattr(file_system, "_trusts_syncfs", lambda folder: True)
    monkeypatch.setattr(
        file_system, "_syncfs", lambda descriptor: flushed.append(os.readlink(f"/proc/self/fd/{descriptor}"))
    )
    store.sync(many_names())
    assert flushed == [str(tmp_path)]


def test_without_syncfs_every_folder_up_to_the_output_folder_is_flushed(tmp_path, monkeypatch):
    store, flushed = LocalStore(tmp_path), []
    monkeypatch.setattr(file_system, "_trusts_syncfs", lambda folder: False)
    monkeypatch.setattr(file_system, "sync_path", lambda path: flushed.append(path))
    store.sync(many_names())
    below = {tmp_path / f"c{number}" for number in range(4)}
    assert set(flushed) == {tmp_path, *below, *(folder / "patches" for folder in below)}
    assert flushed[-1] == tmp_path


def test_an_old_kernel_or_an_unknown_file_system_is_not_trusted_with_syncfs(tmp_path, monkeypatch):
    monkeypatch.setattr(file_system, "file_system_of", lambda folder: "fuse.something")
    assert not file_system._trusts_syncfs(tmp_path)
    monkeypatch.setattr(file_system, "file_system_of", lambda folder: "ext4")
    monkeypatch.setattr(file_system, "_kernel", lambda: (4, 18))
    assert not file_system._trusts_syncfs(tmp_path)
    monkeypatch.setattr(file_system, "_kernel", lambda: (5, 10))
    assert file_system._trusts_syncfs(tmp_path)


def test_a_file_system_whose_links_replace_is_refused_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "link", lambda source, target: target.write_bytes(source.read_bytes()))
    kind = file_system_of(tmp_path)
    with pytest.raises(OutputError, match=rf"type {kind} that fails at refusing a second hard link.*local disk"):
        LocalStore(tmp_path / "out").prepare()


def test_a_file_system_without_links_is_refused_by_name(tmp_path, monkeypatch):
    def unsupported(source, target):
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", unsupported)
    monkeypatch.setattr(file_system, "file_system_of", lambda folder: "vfat")
    with pytest.raises(OutputError, match=r"type vfat that fails at a hard link \(Operation not permitted\)"):
        LocalStore(tmp_path / "out").prepare()


def test_a_probe_leaves_nothing_behind(store):
    assert not list(store.files("manifest"))
    assert not list(store.files(TEMPORARY))


@pytest.mark.root
def test_a_real_vfat_is_refused(tmp_path):
    image, mount = tmp_path / "image", tmp_path / "mount"
    mount.mkdir()
    image.write_bytes(bytes(8 << 20))
    made = [["mkfs.vfat", str(image)], ["mount", "-o", "loop", str(image), str(mount)]]
    try:
        for command in made:
            subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no vfat can be mounted here: {error}")
    try:
        with pytest.raises(OutputError, match=r"vfat.*hard link"):
            LocalStore(mount / "out").prepare()
    finally:
        subprocess.run(["umount", str(mount)], check=True)


def test_a_full_disk_is_told_with_what_to_do(store, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    store.stage("_staging/0/a")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(MachineError, match=r"manifest/_commits/a.json.*disk is full.*free some space"):
        store.put_if_absent("manifest/_commits/a.json", b"x")


def test_an_error_that_nobody_can_mend_stays_as_it_is():
    with pytest.raises(FileExistsError), explain_disk_errors("a file could not be written"):
        raise FileExistsError(17, "File exists")
