"""The truth of a scene is kept while its geometry stays, and alike for images of all sizes."""

import numpy as np
import trimesh
from tests.services.study.label_views import (
    HEIGHT,
    WIDTH,
    F,
    block,
    camera_above,
    measure,
    pair_of,
    scene_of,
    table_and,
    thing,
    view,
)

from schemas.scene.scene import Placed
from services.study.images import Truth, truth_of
from tests.kit.shapes import shape_of


def test_truth_is_kept_while_the_poses_are_the_same_and_no_longer(seen):
    things, first = table_and(block()), view("input", camera_above(), *seen)
    truth = Truth(scene_of(things, pair_of(first)))
    again = tuple(Placed(t.region_id, shape_of(*_meshes(t)), t.T_world_shape.copy()) for t in things)
    assert truth_of(scene_of(again), truth) is truth
    moved = np.eye(4)
    moved[2, 3] = 1e-6
    for other in (
        (things[0], thing(3, block(), moved)),
        table_and(block(0.201)),
        things[:1],
        table_and(block(), block()),
    ):
        assert truth_of(scene_of(other), truth) is not truth
    assert truth_of(scene_of(things, scene_id=6), truth) is not truth
    assert truth_of(scene_of(things)) is not truth
    assert measure(again, pair_of(first), truth=truth) == measure(again, pair_of(first), truth=truth)


def _meshes(placed):
    return [trimesh.Trimesh(part.vertices, part.faces, process=False) for part in placed.shape.parts]


def test_a_scene_s_truth_forgets_the_views_asked_for_longest_ago(seen):
    things = table_and(block())
    truth = Truth(scene_of(things))
    cameras = [camera_above(f=F + i) for i in range(20)]
    first = truth.pixels(cameras[0])
    for camera in cameras[1:]:
        truth.pixels(camera)
        assert truth.pixels(cameras[0]) is first
    for camera in cameras[1:]:
        truth.pixels(camera)
    assert truth.pixels(cameras[0]) is not first


def test_images_of_all_sizes_are_asked_at_the_same_places():
    things = table_and(block())
    truth = Truth(scene_of(things))
    f, scales = 525.3, (0.5, 0.7, 1.1, 1.3, 2.0)
    assert len({f * scale / round(WIDTH * scale) for scale in scales}) > 1, "rounding must not tell them apart"
    for scale in scales:
        camera = camera_above(round(WIDTH * scale), round(HEIGHT * scale), f * scale)
        assert truth.patch(camera, 0) is truth.patch(camera_above(f=f), 0)
    assert truth.patch(camera_above(f=526.0), 0) is not truth.patch(camera_above(f=f), 0)
