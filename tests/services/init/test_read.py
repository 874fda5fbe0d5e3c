"""A folder of meshes, read: what is one and the same, what is a part of another, what cannot be read."""

import pytest
import trimesh

from services.init.collection import Candidate, drop_doubles, read_folder, walk_folder
from tests.own_meshes import cup, mixed_folder, write_mesh
from tests.services.init.test_guess import item


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
