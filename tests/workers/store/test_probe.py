import os
import subprocess

import pytest

from schemas.dataset.layout import TEMPORARY
from schemas.errors import OutputError
from workers.store import probe
from workers.store.local import LocalStore
from workers.store.mounts import file_system_of
from workers.store.sweep import sweep


@pytest.fixture
def store(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    return store


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
