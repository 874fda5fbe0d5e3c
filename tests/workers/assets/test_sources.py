"""Placing a cleaned shape, and remembering files."""

import pickle

import numpy as np
import pytest
import trimesh

from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from tests.workers.assets.oracles import CUBE, shape_of, welded, write
from workers.assets.sources import (
    UP_AXES,
    Entry,
    Placement,
    SourceFile,
    SourceShape,
    Weights,
    check_unchanged,
    found_in,
    hashed,
    licence_files,
    licence_of,
    mesh_files,
    placed_asset,
)


def place(mesh, placement):
    entry = Entry("id", (SourceFile("a.obj", 1, "0" * 64),), "MIT")
    return placed_asset(
        SourceShape(shape_of(mesh), ()),
        placement,
        entry=entry,
        category="mug",
        source="urdf",
        shareable=False,
        weights=Weights(600.0, 3.0),
    )


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_the_axis_that_points_up_becomes_z_by_a_turn(up):
    axes = UP_AXES[up]
    assert axes @ np.eye(3)["xyz".index(up)] == pytest.approx([0, 0, 1])
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_an_asset_is_centred_and_its_matrix_takes_scaled_source_points_there():
    mesh = trimesh.creation.box((1, 2, 3))
    mesh.apply_translation((7, 8, 9))
    asset = place(mesh, Placement(UP_AXES["y"], 0.1))
    assert asset.shape.bounds == pytest.approx(np.array([[-0.05, -0.15, -0.1], [0.05, 0.15, 0.1]]))
    scaled = np.c_[0.1 * mesh.vertices, np.ones(8)]
    assert (asset.T_source_to_object @ scaled.T).T[:, :3] == pytest.approx(asset.shape.vertices, abs=1e-12)
    assert asset.volume_m3 == pytest.approx(0.006)
    assert asset.mass.mass_kg == pytest.approx(3.6)
    assert welded(asset.shape).volume == pytest.approx(0.006)  # still the right way out


def test_a_diagonal_wins_over_a_scale():
    asset = place(trimesh.creation.box((3, 4, 12)), Placement(np.eye(3), 5.0, 0.26))
    assert float(np.linalg.norm(asset.extents_m)) == pytest.approx(0.26, rel=1e-12)
    assert asset.scale == pytest.approx(0.02)


def test_an_open_mesh_has_no_volume_and_weighs_as_a_shell():
    mesh = trimesh.creation.box((1, 1, 1))
    mesh.update_faces(np.arange(12) > 1)
    asset = place(mesh, Placement(np.eye(3), 1.0))
    assert not asset.watertight
    assert asset.volume_m3 is None
    assert asset.mass.mass_kg == pytest.approx(15.0)


def test_a_file_that_changed_since_is_noticed(tmp_path):
    path = write(tmp_path / "cube.obj", CUBE)
    entry = Entry("id", hashed([path], tmp_path), "MIT")
    check_unchanged(tmp_path, entry)
    write(path, CUBE + "# more\n")
    with pytest.raises(MeshError, match="changed") as changed:
        check_unchanged(tmp_path, entry)
    path.unlink()
    with pytest.raises(MeshError, match="missing") as missing:
        check_unchanged(tmp_path, entry)
    # Neither is a function of job and seed, and it stays so on the way to another process.
    assert {pickle.loads(pickle.dumps(error.value)).kind for error in (changed, missing)} == {"environmental"}


def test_an_obj_comes_with_its_materials_and_their_textures(tmp_path):
    write(tmp_path / "m" / "cube.obj", "mtllib cube.mtl\n" + CUBE)
    write(tmp_path / "m" / "cube.mtl", "newmtl a\nmap_Kd ../t/a.png\nnewmtl b\nmap_Kd none.png\n")
    write(tmp_path / "t" / "a.png", b"png")
    files = mesh_files(tmp_path / "m" / "cube.obj", tmp_path, MeshLimits())
    assert [file.relative_to(tmp_path).as_posix() for file in files] == ["m/cube.obj", "m/cube.mtl", "t/a.png"]


def test_the_nearest_licence_file_is_named_unless_the_user_states_one(tmp_path):
    for path in ("LICENSE", "mug/licence.txt", "mug/a/mug.obj", "bowl/bowl.obj"):
        write(tmp_path / path, "x")
    files = licence_files(tmp_path.rglob("*"))
    assert licence_of(tmp_path / "mug/a/mug.obj", tmp_path, "unknown", files) == "see mug/licence.txt"
    assert licence_of(tmp_path / "bowl/bowl.obj", tmp_path, "unknown", files) == "see LICENSE"
    assert licence_of(tmp_path / "bowl/bowl.obj", tmp_path, "MIT", files) == "MIT"
    assert licence_of(tmp_path / "bowl/bowl.obj", tmp_path, "unknown", []) == "unknown"


def test_a_message_names_the_first_things_of_a_folder(tmp_path):
    assert found_in(tmp_path) == "nothing"
    for name in "gfedcba":
        write(tmp_path / name, "")
    assert found_in(tmp_path) == "a, b, c, d, e and 2 more"
