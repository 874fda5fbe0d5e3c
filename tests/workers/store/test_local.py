import os
import subprocess
import sys
import threading

import pytest

from schemas.dataset.layout import TEMPORARY
from schemas.errors import MachineError, OutputError
from workers.store import durable, probe
from workers.store.local import LocalStore
from workers.store.mounts import file_system_of
from workers.store.opening import open_store
from workers.store.sweep import sweep


@pytest.fixture
def store(tmp_path):
    store = LocalStore(tmp_path / "out")
    store.prepare()
    return store


def test_the_first_put_stands_and_the_second_is_refused(store):
    assert store.put_if_absent("manifest/_commits/a.json", b"first")
    assert not store.put_if_absent("manifest/_commits/a.json", b"second")
    assert store.read("manifest/_commits/a.json") == b"first"
    assert not list(store.files(TEMPORARY))


def test_of_many_threads_that_put_one_key_exactly_one_wins(store):
    won = []
    gate = threading.Barrier(8)

    def put(number):
        gate.wait()
        for key in range(20):
            if store.put_if_absent(f"manifest/_commits/{key}", str(number).encode()):
                won.append((key, number))

    threads = [threading.Thread(target=put, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(key for key, _ in won) == list(range(20))
    assert all(store.read(f"manifest/_commits/{key}") == str(number).encode() for key, number in won)


def test_a_temporary_file_that_is_swept_away_is_written_again(store, monkeypatch):
    real = os.link
    swept = []

    def link(source, target):
        if not swept:
            swept.append(source)
            os.unlink(source)
        real(source, target)

    monkeypatch.setattr(os, "link", link)
    assert store.put_if_absent("manifest/_commits/a.json", b"data")
    assert store.read("manifest/_commits/a.json") == b"data"


def test_a_swept_attempt_can_neither_write_nor_put(store):
    store.open_staging("_staging/0/a")
    store.write_staged("_staging/0/a", "mug/x.png", b"x")
    assert store.fence("_staging/0/a") == "_staging/0/a.fenced"
    for path in ("y.png", "mug/y.png", "deep/er/y.png"):
        with pytest.raises(FileNotFoundError):
            store.write_staged("_staging/0/a", path, b"y")
    with pytest.raises(FileNotFoundError):
        store.put_if_absent("manifest/_commits/a.json", b"record", "_staging/0/a")
    assert store.children("_staging/0") == ["a.fenced"]
    assert store.size("manifest/_commits/a.json") is None
    assert store.fence("_staging/0/nobody") is None


def test_files_are_listed_with_sizes_in_order_and_folders_one_level_deep(store):
    for key in ("mug/b.png", "mug/a.png", "mug/patches/a.png"):
        store.write_whole(key, b"12")
    assert list(store.files("mug")) == [("mug/a.png", 2), ("mug/b.png", 2), ("mug/patches/a.png", 2)]
    assert store.children("mug") == ["patches"]
    assert list(store.files("nothing")) == []
    assert store.children("nothing") == []


def test_a_rename_makes_the_folder_it_needs_and_says_when_its_source_is_gone(store):
    store.write_whole("a", b"1")
    store.rename("a", "new/folder/b")
    assert store.read("new/folder/b") == b"1"
    with pytest.raises(FileNotFoundError):
        store.rename("a", "new/folder/b")
    assert store.read("new/folder/b") == b"1"


def test_a_full_disk_is_told_with_what_to_do(store, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    store.open_staging("_staging/0/a")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(MachineError, match=r"manifest/_commits/a.json.*disk is full.*free some space"):
        store.put_if_absent("manifest/_commits/a.json", b"x")


def test_a_folder_that_cannot_be_made_is_an_error_of_the_command_line(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="file/out cannot be written"):
        LocalStore(tmp_path / "file" / "out").prepare()


def test_a_file_system_whose_links_replace_is_refused_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "link", lambda source, target: target.write_bytes(source.read_bytes()))
    kind = file_system_of(tmp_path)
    with pytest.raises(OutputError, match=rf"type {kind} that fails at refusing a second hard link.*local disk"):
        LocalStore(tmp_path / "out").prepare()


def test_a_file_system_without_links_is_refused_by_name(tmp_path, monkeypatch):
    def unsupported(source, target):
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", unsupported)
    monkeypatch.setattr(probe, "file_system_of", lambda folder: "vfat")
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


def test_opening_a_folder_loads_no_object_store(tmp_path):
    code = (
        "import sys; from workers.store.opening import open_store; "
        f"open_store({str(tmp_path)!r}); sys.exit('obstore' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert isinstance(open_store(str(tmp_path)), LocalStore)
    assert not list(tmp_path.iterdir())


def test_a_probe_whose_files_are_swept_by_a_coordinator_at_work_is_made_again(tmp_path, monkeypatch):
    store = LocalStore(tmp_path)
    store.prepare()
    real, swept = os.link, []

    def link(source, target):
        if not swept:
            swept.append(sweep(store))
        real(source, target)

    monkeypatch.setattr(os, "link", link)
    store.prepare()
    assert swept
