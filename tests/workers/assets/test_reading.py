"""What is read before anything is parsed."""

import numpy as np
import pytest
import trimesh

from schemas.errors import MeshError
from schemas.job import MeshLimits
from tests.workers.assets.oracles import CUBE, write
from workers.assets.reading import FolderResolver, check_counts, declared_counts, material_files, picture_fault


@pytest.mark.parametrize("suffix", [".stl", ".ply"])
def test_the_counts_that_a_file_declares_are_those_that_it_holds(suffix):
    mesh = trimesh.creation.icosphere(2)
    vertices, faces = declared_counts(suffix, mesh.export(file_type=suffix[1:]))
    assert faces == len(mesh.faces)
    assert vertices in (len(mesh.vertices), 3 * len(mesh.faces))


def test_an_obj_is_counted_by_its_lines():
    assert declared_counts(".obj", CUBE.encode()) == (8, 6)


def test_ascii_stl_is_counted_by_its_facets():
    text = trimesh.creation.box((1, 1, 1)).export(file_type="stl_ascii")
    assert declared_counts(".stl", text.encode())[1] == 12


def test_a_count_over_its_cap_names_the_cap(tmp_path):
    with pytest.raises(MeshError, match="6 faces, over max_faces = 5"):
        check_counts(tmp_path / "x.obj", 8, 6, MeshLimits(max_faces=5))


def test_material_files_are_found_wherever_they_are_named():
    assert material_files(b"# x\r\nmtllib a b.mtl\r\nv 0 0 0\nmtllib c.mtl\n") == ["a b.mtl", "c.mtl"]


def test_names_with_backslashes_and_folders_that_do_not_exist_are_found_beside_the_mesh(tmp_path):
    write(tmp_path / "mesh" / "skin.png", b"\x89PNG")
    resolver = FolderResolver(tmp_path / "mesh" / "a.obj", tmp_path, MeshLimits())
    for name in ("skin.png", ".\\skin.png", "C:\\home\\skin.png", "/abs/skin.png"):
        assert resolver.find(name) == tmp_path / "mesh" / "skin.png"
    assert resolver.find("../../etc/passwd") is None
    assert resolver.find("bad\0name") is None


def test_a_picture_that_cannot_be_read_says_why():
    assert "not a PNG or JPEG" in str(picture_fault(b"BM123", MeshLimits()))
    assert "cannot be opened" in str(picture_fault(b"\x89PNG\r\n\x1a\n" + bytes(np.zeros(9, np.uint8)), MeshLimits()))
