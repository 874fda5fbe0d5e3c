import os

from workers.store import durable
from workers.store.local import LocalStore


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
    monkeypatch.setattr(durable, "_trusts_syncfs", lambda folder: False)
    durable.sync_tree(tmp_path / "a")
    assert flushed == {str(path) for path in [*names, tmp_path / "a", tmp_path / "a" / "b", tmp_path]}


def many_names():
    return [f"c{number}/patches/x" for number in range(4)]


def test_names_in_many_folders_are_flushed_by_one_syncfs(tmp_path, monkeypatch):
    store, flushed = LocalStore(tmp_path), []
    monkeypatch.setattr(durable, "_trusts_syncfs", lambda folder: True)
    monkeypatch.setattr(durable, "_syncfs", lambda folder: flushed.append(folder) or True)
    store.sync_folders_of(many_names())
    assert flushed == [tmp_path]


def test_without_syncfs_every_folder_up_to_the_output_folder_is_flushed(tmp_path, monkeypatch):
    store, flushed = LocalStore(tmp_path), []
    monkeypatch.setattr(durable, "_trusts_syncfs", lambda folder: False)
    monkeypatch.setattr(durable, "sync_path", lambda path: flushed.append(path))
    store.sync_folders_of(many_names())
    below = {tmp_path / f"c{number}" for number in range(4)}
    assert set(flushed) == {tmp_path, *below, *(folder / "patches" for folder in below)}
    assert flushed[-1] == tmp_path


def test_an_old_kernel_or_an_unknown_file_system_is_not_trusted_with_syncfs(tmp_path, monkeypatch):
    monkeypatch.setattr(durable, "file_system_of", lambda folder: "fuse.something")
    assert not durable._trusts_syncfs(tmp_path)
    monkeypatch.setattr(durable, "file_system_of", lambda folder: "ext4")
    monkeypatch.setattr(durable, "_kernel", lambda: (4, 18))
    assert not durable._trusts_syncfs(tmp_path)
    monkeypatch.setattr(durable, "_kernel", lambda: (5, 10))
    assert durable._trusts_syncfs(tmp_path)
