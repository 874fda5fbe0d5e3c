"""Placing a cleaned shape in the object frame."""

import numpy as np
import pytest
import trimesh

from schemas.job.assets import Assets, FolderSource
from tests.workers.assets.oracles import shape_of, welded, write
from workers.assets.catalogue import open_catalogue
from workers.assets.external.listing import Entry, SourceFile
from workers.assets.external.mesh import LoadedMesh
from workers.assets.external.placement import UP_AXES, place_asset


def place(mesh, **placement):
    entry = Entry("id", (SourceFile("a.obj", 1, "0" * 64),), "MIT")
    settings, assets = (
        FolderSource(source="urdf", folder=".", **placement),
        Assets(density_kg_m3=600.0, shell_kg_m2=3.0),
    )
    return place_asset(LoadedMesh(shape_of(mesh), ()), entry, "mug", settings, assets)


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_the_axis_that_points_up_becomes_z_by_a_turn(up):
    axes = UP_AXES[up]
    assert axes @ np.eye(3)["xyz".index(up)] == pytest.approx([0, 0, 1])
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_an_asset_is_centred_and_its_matrix_takes_scaled_source_points_there():
    mesh = trimesh.creation.box((1, 2, 3))
    mesh.apply_translation((7, 8, 9))
    asset = place(mesh, up="y", scale=0.1)
    assert asset.shape.bounds == pytest.approx(np.array([[-0.05, -0.15, -0.1], [0.05, 0.15, 0.1]]))
    scaled = np.c_[0.1 * mesh.vertices, np.ones(8)]
    assert (asset.T_source_to_object @ scaled.T).T[:, :3] == pytest.approx(asset.shape.vertices, abs=1e-12)
    assert asset.volume_m3 == pytest.approx(0.006)
    assert asset.mass.mass_kg == pytest.approx(3.6)
    assert welded(asset.shape).volume == pytest.approx(0.006)  # still the right way out


def test_a_diagonal_wins_over_a_scale():
    asset = place(trimesh.creation.box((3, 4, 12)), scale=5.0, diagonal_m=0.26)
    assert float(np.linalg.norm(asset.extents_m)) == pytest.approx(0.26, rel=1e-12)
    assert asset.scale == pytest.approx(0.02)


def test_an_open_mesh_has_no_volume_and_weighs_as_a_shell():
    mesh = trimesh.creation.box((1, 1, 1))
    mesh.update_faces(np.arange(12) > 1)
    asset = place(mesh)
    assert not asset.watertight
    assert asset.volume_m3 is None
    assert asset.mass.mass_kg == pytest.approx(15.0)


@pytest.mark.parametrize(
    ("up", "doubt"), [("y", None), ("z", "y"), ("x", "y"), ({"*.stl": "y"}, None), ({"*.stl": "z"}, "y")]
)
def test_a_can_that_lies_as_the_job_has_it_names_the_axis_of_its_file_that_it_stands_on(tmp_path, up, doubt):
    can = trimesh.creation.cylinder(0.04, 0.1, sections=48)
    can.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    write(tmp_path / "can.stl", can.export(file_type="stl"))
    source = FolderSource(source="urdf", folder=str(tmp_path), category_map={"*.stl": "can"}, up=up)
    catalogue = open_catalogue(Assets(objects=(source,)), tmp_path, ("can",))
    assert dict(catalogue.objects[0].doubts) == ({"can.stl": doubt} if doubt else {})
    asset = catalogue.load(catalogue.refer(0, "can", 0))
    stands = asset.extents_m[2] == pytest.approx(0.1)
    assert stands == (doubt is None)
    assert (
        open_catalogue(Assets(objects=(source,)), tmp_path, ("can",)).objects[0].doubts == catalogue.objects[0].doubts
    )
