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
from workers.scene.draw.plan import plan_scene

pytestmark = pytest.mark.minute


def test_a_can_lies_on_a_facet_of_its_side_and_not_on_the_ridge_between_two():
    can = np.asarray(trimesh.creation.cylinder(0.03, 0.1, sections=48).vertices)
    quarter = rotation_about(np.array([1.0, 0, 0]), np.pi / 2)
    half_facet = rotation_about(np.array([0.0, 1, 0]), np.pi / 48)
    assert is_energy_minimum(can, pose(half_facet @ quarter, np.zeros(3)), np.zeros(3))
    assert not is_energy_minimum(can, pose(quarter, np.zeros(3)), np.zeros(3))


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
