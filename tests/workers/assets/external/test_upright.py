"""The axis that is up, judged by how a shape stands: built-in shapes, whose axis is known, and bodies turned on purpose."""

import numpy as np
import pytest
import trimesh
from shapely import Polygon

from schemas.job.assets import CATEGORIES, TABLE, ProceduralSource
from tests.workers.assets.oracles import support_margin
from workers.assets.builtin.make import make_asset
from workers.assets.external.placement import UP_AXES, Upright, find_upright, measure_stand
from workers.geometry.hull import convex_hull

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
