"""Which files of a folder are looked at."""

import os

import pytest

from schemas.errors import AssetSourceError
from services.init import collection as walk
from services.init.collection import walk_folder
from tests.workers.assets.oracles import write


def test_meshes_and_urdfs_are_found_at_any_depth_and_hidden_ones_are_left_aside(tmp_path):
    for name in ("b.obj", "a/b/c.GLB", "a/x.urdf", ".h/a.obj", "a/.b.obj", "__MACOSX/a.obj", "a/skin.png", "a/m.mtl"):
        write(tmp_path / name, "")
    found = walk_folder(tmp_path)
    assert (found.paths, found.left_out) == (("a/b/c.GLB", "a/x.urdf", "b.obj"), ())


def test_what_cannot_be_used_is_named_with_the_remedy(tmp_path):
    write(tmp_path / "in/scene.dae", "")
    write(tmp_path / "out.obj", "")
    (tmp_path / "in/link.obj").symlink_to(tmp_path / "out.obj")
    (tmp_path / "in/dead.obj").symlink_to(tmp_path / "in/none.obj")
    (tmp_path / "in/inner.obj").symlink_to("real.obj")
    write(tmp_path / "in/real.obj", "")
    (tmp_path / "in/bad\nname.obj").touch()
    (tmp_path / "in" / os.fsdecode(b"bad\xff.obj")).touch()
    found = walk_folder(tmp_path / "in")
    assert found.paths == ("real.obj",)
    assert sorted((one.path, one.reason) for one in found.left_out) == [
        ("bad\\nname.obj", "name"),
        ("bad\\udcff.obj", "name"),
        ("dead.obj", "missing"),
        ("link.obj", "link"),
        ("scene.dae", "format"),
    ]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("none", "is not there"),
        ("file", "is a file"),
        ("empty", "is empty"),
        ("other", "has no mesh"),
        ("bad\nname", "bad"),
    ],
)
def test_a_folder_without_meshes_is_told_in_one_line(tmp_path, name, says):
    (tmp_path / "empty").mkdir()
    write(tmp_path / "file", "")
    write(tmp_path / "other/readme.txt", "")
    with pytest.raises(AssetSourceError, match=says) as caught:
        walk_folder(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_folder_or_a_file_without_permission_is_told(tmp_path, monkeypatch):
    """The system is asked through `os`, because root may read everything."""
    write(tmp_path / "a.obj", "")
    write(tmp_path / "b.obj", "")
    monkeypatch.setattr(walk.os, "access", lambda path, how: "a.obj" not in str(path))
    (one,) = walk_folder(tmp_path).left_out
    assert (one.path, one.reason) == ("a.obj", "permission")

    def deny(self):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(walk.Path, "iterdir", deny)
    with pytest.raises(AssetSourceError, match="cannot be listed: Permission denied"):
        walk_folder(tmp_path)


def test_too_many_files_are_no_folder_of_meshes(tmp_path, monkeypatch):
    monkeypatch.setattr(walk, "MOST_FILES", 3)
    for number in range(4):
        write(tmp_path / f"{number}.obj", "")
    with pytest.raises(AssetSourceError, match="over 3 meshes"):
        walk_folder(tmp_path)
