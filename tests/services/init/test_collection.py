"""The files of a folder that may be objects: found, read, and what is left out."""

import os

import pytest
import trimesh

from schemas.errors import AssetSourceError
from services.init import collection as walk
from services.init.collection import Candidate, drop_doubles, read_folder, walk_folder
from tests.own_meshes import cup, mixed_folder, write_mesh
from tests.services.init.test_guess import item
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


def read(folder):
    told = []
    candidates = [Candidate(path, "c") for path in walk_folder(folder).paths]
    return read_folder(folder, candidates, lambda what, done, asked: told.append((what, done, asked))), told


def test_every_file_is_an_object_or_is_left_out_with_its_reason(tmp_path):
    reading, told = read(mixed_folder(tmp_path))
    assert [item.path for item in reading.items] == [
        *(
            "002_can/copy/textured.obj",
            "bottles/bottle 0.stl",
            "bottles/bottle 1.stl",
            "gltf cup/model.gltf",
            "huge.stl",
        ),
        *(f"mugs/mug_{k}.glb" for k in range(3)),
        *("robot/model.urdf", "standing.glb", "table/1.stl"),
    ]
    left = {one.path: (one.reason, one.why) for one in reading.left_out}
    assert {path: reason for path, (reason, _) in left.items()} == {
        "002_can/google_16k/nontextured.ply": "double",
        "002_can/google_16k/textured.obj": "double",
        "broken.obj": "index_out_of_range",
        "robot/collision.obj": "part",
        "robot/textured.obj": "part",
        "torn.gltf": "missing",
    }
    assert left["002_can/google_16k/nontextured.ply"][1] == "is 002_can/google_16k/textured.obj in another format"
    assert left["002_can/google_16k/textured.obj"][1] == "has the content of 002_can/copy/textured.obj"
    assert left["robot/collision.obj"][1] == "is a part of robot/model.urdf"
    assert left["torn.gltf"][1] == "its buffer gone.bin is missing"
    assert reading.refused == {"broken.obj", "torn.gltf"}
    assert ("meshes read", 15, 15) in told


def test_what_was_measured_is_what_another_library_measures(tmp_path):
    mesh = cup(0.12, 0.03)
    write_mesh(tmp_path / "a.glb", mesh, turned=True, scale=1000)
    ((one,), _) = ((reading := read(tmp_path)[0]).items, reading.left_out)
    theirs = trimesh.load_mesh(tmp_path / "a.glb")
    assert one.measured.extents == pytest.approx(tuple(theirs.extents))
    assert (one.measured.faces, one.measured.watertight) == (len(theirs.faces), theirs.is_watertight)
    assert (one.measured.up, one.measured.confidence) == ("y", "sure")
    assert one.diagonal == pytest.approx(float((theirs.extents**2).sum() ** 0.5))


def test_of_one_mesh_in_several_formats_the_first_stays_and_different_names_are_different_meshes():
    items = [item(f"a/m{suffix}") for suffix in (".stl", ".obj", ".glb")] + [item("a/n.obj"), item("b/m.obj")]
    kept, left_out = drop_doubles(items)
    assert [one.path for one in kept] == ["a/m.glb", "a/n.obj", "b/m.obj"]
    assert {one.path for one in left_out} == {"a/m.stl", "a/m.obj"}
