"""The oracle of stable rest poses on bodies of known stability, and settled objects by the oracle."""

import numpy as np
import pytest
import trimesh

from schemas.job.job import Job
from tests.kit.energy_minimum import is_energy_minimum
from tests.physics.settling import settle_single
from workers.assets.catalogue import open_catalogue
from workers.geometry.frames import pose, rotation_about
from workers.scene.chance import SceneChance
from workers.scene.plan import plan_scene

pytestmark = pytest.mark.minute


def ellipsoid(x, y, z):
    return np.asarray(trimesh.creation.icosphere(5, 1.0).vertices) * [x, y, z]


def on_a_face(vertices):
    """A rotation that levels the lowest face of a round hull, as snapping does."""
    hull = trimesh.convex.convex_hull(vertices)
    lowest = int(np.argmin((hull.triangles_center - hull.vertices.mean(axis=0))[:, 2]))
    return pose(trimesh.geometry.align_vectors(hull.face_normals[lowest], [0, 0, -1.0])[:3, :3], np.zeros(3))


def test_a_ball_on_a_facet_and_a_can_on_its_side_are_least_in_energy():
    ball = np.asarray(trimesh.creation.icosphere(4, 0.05).vertices)
    assert is_energy_minimum(ball, on_a_face(ball), np.zeros(3))
    can = np.asarray(trimesh.creation.cylinder(0.03, 0.1, sections=48).vertices)
    quarter = rotation_about(np.array([1.0, 0, 0]), np.pi / 2)
    half_facet = rotation_about(np.array([0.0, 1, 0]), np.pi / 48)
    assert is_energy_minimum(can, pose(half_facet @ quarter, np.zeros(3)), np.zeros(3))
    assert not is_energy_minimum(can, pose(quarter, np.zeros(3)), np.zeros(3)), "on the ridge between two facets"


def test_an_egg_lies_on_its_side_and_does_not_stand_on_its_point():
    egg = ellipsoid(0.03, 0.03, 0.045)
    assert not is_energy_minimum(egg, np.eye(4), np.zeros(3))
    flat = ellipsoid(0.03, 0.03, 0.02)
    assert is_energy_minimum(flat, on_a_face(flat), np.zeros(3))
    weighted = np.array([0.0, 0.0, -0.03])  # a tumbler: centre of mass below the centre of curvature
    assert is_energy_minimum(egg, np.eye(4), weighted) or is_energy_minimum(egg, on_a_face(egg), weighted)


def test_a_cube_stands_on_its_face_and_not_on_its_edge_or_corner():
    cube = np.asarray(trimesh.creation.box((0.1, 0.1, 0.1)).vertices)
    assert is_energy_minimum(cube, np.eye(4), np.zeros(3))
    assert not is_energy_minimum(
        cube, pose(rotation_about(np.array([0.0, 1.0, 0.0]), np.pi / 4), np.zeros(3)), np.zeros(3)
    )
    corner = trimesh.geometry.align_vectors([1, 1, 1], [0, 0, -1.0])[:3, :3]
    assert not is_energy_minimum(cube, pose(corner, np.zeros(3)), np.zeros(3))
    assert not is_energy_minimum(cube, np.eye(4), np.array([0.0501, 0, 0])), "centre of mass beyond the edge"


@pytest.mark.parametrize("scenes", [12, pytest.param(24, marks=pytest.mark.slow)])
@pytest.mark.parametrize("pose_of_start", ["upright", "tumbled"])
def test_what_settles_on_a_level_top_is_least_in_energy(pose_of_start, scenes, tmp_path):
    job = Job.model_validate({"name": "t", "start": {"pose": pose_of_start}})
    catalogue = open_catalogue(job.assets, tmp_path, tuple(job.categories))
    found = []
    for scene_id in range(scenes):
        plan = plan_scene(job, catalogue, SceneChance(job.seed, scene_id))
        start, rest = plan.objects[0], settle_single(plan.objects[0], plan.table, job.physics)
        if rest.support == "flat_top":
            vertices = start.asset.shape.vertices
            found.append(is_energy_minimum(vertices, rest.T_world_obj, start.asset.mass.com))
    assert len(found) >= 0.75 * scenes and all(found)
