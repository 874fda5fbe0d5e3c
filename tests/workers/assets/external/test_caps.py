"""What a mesh file declares, counted before anything is parsed."""

import pytest
import trimesh

from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from tests.workers.assets.oracles import CUBE
from workers.assets.external.caps import check_counts, declared_counts


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
