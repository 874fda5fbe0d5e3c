"""Placing a cleaned shape in the object frame, and the axis that is up by how a shape stands."""

import numpy as np
import pytest
import trimesh
from shapely import Polygon

from schemas.job.assets import CATEGORIES, TABLE, Assets, FolderSource, ProceduralSource
from tests.workers.assets.oracles import shape_of, support_margin, welded, write
from workers.assets.builtin.make import make_asset
from workers.assets.catalogue import open_catalogue
from workers.assets.external.listing import Entry, SourceFile
from workers.assets.external.mesh import LoadedMesh
from workers.assets.external.placement import UP_AXES, Upright, find_upright, measure_stand, place_asset
from workers.geometry.hull import convex_hull


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


SEEDS = 12


def upright(mesh, up="z"):
    """The answer on a mesh with z up, turned so that `up` of its file is."""
    turn = np.asarray(UP_AXES[up])
    return find_upright(mesh.convex_hull.vertices @ turn, mesh.center_mass @ turn)


def turned(category, index, up):
    """The answer on a built-in shape whose file has this axis up."""
    asset = make_asset(category, ProceduralSource(source="procedural", seed=5), index, 600.0)
    turn = np.asarray(UP_AXES[up])
    return find_upright(convex_hull(asset.shape.vertices).vertices @ turn, asset.mass.com @ turn)


def test_who_is_sure_is_right_and_who_finds_it_likely_is_so_nine_times_in_ten():
    likely, sure = [], dict.fromkeys((*CATEGORIES, TABLE), 0)
    for category in sure:
        for index in range(SEEDS):
            for up in "xyz":
                found = turned(category, index, up)
                if found is not None and found.confidence == "sure":
                    assert found.axis == up, f"{category} {index}"
                    sure[category] += 1
                elif found is not None:
                    likely.append(found.axis == up)
    assert sum(likely) >= 0.9 * len(likely) > 10
    assert all(sure[name] >= 0.6 * 3 * SEEDS for name in ("mug", "bowl", "jar", "bottle", "can", TABLE)), sure


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_a_round_body_stands_on_its_flat_end_and_says_so(up):
    cup = trimesh.creation.cylinder(0.04, 0.1, sections=64)
    assert upright(cup, up) == Upright(up, "sure")


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.box((0.2, 0.1, 0.3)),
        trimesh.creation.box((0.1, 0.1, 0.1)),
        trimesh.creation.icosphere(3, 0.1),
        trimesh.creation.capsule(0.2, 0.05),
        trimesh.creation.torus(0.1, 0.03),
    ],
    ids=["box", "cube", "sphere", "capsule", "ring"],
)
def test_nothing_is_said_of_what_stands_on_any_side_or_on_none(mesh):
    found = upright(mesh)
    assert found is None or (found.axis, found.confidence) == ("z", "sure")  # a ring lies flat
    assert found is None or mesh.euler_number == 0


def test_a_bowl_that_stands_upside_down_alone_still_tells_its_axis():
    dome = trimesh.creation.icosphere(4, 0.1).slice_plane((0, 0, 0), (0, 0, 1), cap=True)
    assert upright(dome) == Upright("z", "sure")


def test_a_wedge_is_likely_to_stand_on_its_wide_side():
    prism = trimesh.creation.extrude_polygon(Polygon([(0, 0), (3, 0), (1.5, 1.2)]), 2.0)
    prism.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    assert upright(prism) == Upright("z", "likely")


def test_the_angle_of_tipping_is_that_of_the_foot_and_the_centre_of_mass():
    cone = trimesh.creation.cone(0.05, 0.2, sections=256)
    stand = measure_stand(cone.convex_hull.vertices, cone.center_mass, "z")
    assert stand.smooth_deg == pytest.approx(np.degrees(np.arctan2(support_margin(cone), 0.05)), rel=1e-3)
    assert stand.smooth == pytest.approx(1.0, abs=1e-6) and stand.verdict == "stands"
    assert measure_stand(cone.convex_hull.vertices, cone.center_mass, "-z").verdict == "rolls"
