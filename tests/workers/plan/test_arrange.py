"""Several objects begin without touching, whatever the table, the rotation and the arrangement."""

import math
from itertools import pairwise

import numpy as np
import pytest
import shapely
import trimesh

from schemas.errors import StartError
from schemas.job.job import Job
from schemas.scene.scene import ObjectStart, ScenePlan
from schemas.scene.shape import Asset
from tests.kit.shapes import asset_of, box, table
from workers.geometry.frames import transform
from workers.scene.plan import APART_M, SceneChance, choose_category, columns_apart, count_objects, draw_scene

TABLE = table()
SMALL = asset_of(box(0.08, 0.05, 0.1), category="box")
CAN = asset_of(trimesh.creation.cylinder(0.04, 0.12), category="can")
BIG = asset_of(box(0.2, 0.12, 0.1), category="mug")


def plan(scene: int, *assets: Asset, **start) -> ScenePlan:
    job = Job.model_validate({"name": "t", "seed": 5, "objects_per_scene": len(assets), "start": start})
    return draw_scene(job, SceneChance(job.seed, scene), TABLE, *assets)


def mesh_of(start: ObjectStart) -> trimesh.Trimesh:
    shape = start.asset.shape
    return trimesh.Trimesh(transform(start.T_world_obj, shape.vertices), shape.faces)


def test_columns_are_apart_where_a_vertical_plane_stands_between_them_and_only_there():
    """Rotated boxes: the true gap of their footprints is known by turning one into the other's frame."""
    square = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (0.0, 0.1)])
    for degrees in range(0, 90, 7):
        turn = math.radians(degrees)
        R = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
        for gap, apart in ((-0.001, False), (0.0, False), (0.006, True), (0.1, True)):
            other = square + np.array([0.1 + gap, 0.02, 5.0])
            assert columns_apart(square @ R.T, other @ R.T) is apart, (degrees, gap)
    assert not columns_apart(square, square * 0.1)  # one inside the other


@pytest.mark.parametrize("pose", ["upright", "tumbled", "placed"])
def test_spread_objects_have_disjoint_footprints(pose):
    """Held by Shapely's exact polygons, which the plan does not use."""
    for scene in range(20):
        starts = plan(scene, SMALL, CAN, BIG, SMALL, CAN, pose=pose, max_redraws=100).objects
        assert [start.region_id for start in starts] == [3, 4, 5, 6, 7]
        feet = [shapely.MultiPoint(mesh_of(start).vertices[:, :2]).convex_hull for start in starts]
        gaps = [feet[i].distance(feet[j]) for i in range(5) for j in range(i)]
        assert min(gaps) >= APART_M - 1e-9
        spots = np.array([start.T_world_obj[:2, 3] for start in starts])
        assert np.abs(spots).max() <= 0.25


@pytest.mark.parametrize("pose", ["upright", "tumbled", "placed"])
def test_a_pile_begins_above_one_another_about_the_first_with_air_in_between(pose):
    for scene in range(20):
        starts = plan(scene, SMALL, CAN, BIG, CAN, arrange="pile", pose=pose, clearance_m=[0.005, 0.05]).objects
        spans = [mesh_of(start).bounds[:, 2] for start in starts]
        for below, above in pairwise(spans):
            assert 0.005 - 1e-9 <= above[0] - max(below[1], spans[0][1]) <= 0.05 + 1e-9
        spots = np.array([start.T_world_obj[:2, 3] for start in starts])
        assert np.abs(spots - spots[0]).max() <= 0.03
        assert len({tuple(spot) for spot in spots}) == 4
        assert not any(start.placed for start in starts[1:])


def test_more_objects_move_neither_the_earlier_ones_nor_cameras_table_and_look():
    for arrange in ("spread", "pile"):
        one, three, five = (plan(7, *[SMALL, CAN, BIG, CAN, SMALL][:n], arrange=arrange) for n in (1, 3, 5))
        for fewer, more in ((one, three), (three, five)):
            for a, b in zip(fewer.objects, more.objects, strict=False):
                assert a.T_world_obj.tobytes() == b.T_world_obj.tobytes() and a.redraws == b.redraws
            assert fewer.input_cameras[0].T_world_cam.tobytes() == more.input_cameras[0].T_world_cam.tobytes()
            assert fewer.appearance.background == more.appearance.background
            assert fewer.category == more.category == "box"


def test_every_object_has_chances_of_its_own():
    starts = plan(3, SMALL, SMALL, SMALL).objects
    assert len({start.T_world_obj.tobytes() for start in starts}) == 3
    job = Job.model_validate({"name": "t", "seed": 5, "objects_per_scene": 20})
    assert len({choose_category(job, SceneChance(5, 0), number) for number in range(20)}) > 4


def test_counts_are_drawn_alike_from_their_range():
    job = Job.model_validate({"name": "t", "seed": 5, "objects_per_scene": [2, 5]})
    counts = [count_objects(job, SceneChance(5, scene)) for scene in range(1000)]
    assert set(counts) == {2, 3, 4, 5}
    assert all(abs(counts.count(n) - 250) < 4 * math.sqrt(1000 * 0.25 * 0.75) for n in (2, 3, 4, 5))
    assert {count_objects(Job(name="t"), SceneChance(0, scene)) for scene in range(50)} == {1}


def test_a_place_that_is_taken_is_drawn_again_and_counted():
    """Discs of 0.2 m side by side in a square of 0.5 m: the second is refused where the centres are nearer than that."""
    disc = asset_of(trimesh.creation.cylinder(0.1, 0.02, sections=128))
    seconds = [plan(scene, disc, disc).objects[1] for scene in range(200)]
    # P(distance of two uniform points in a square of side a is below r), r <= a, with x = r / a: pi x^2 - 8/3 x^3 + x^4/2.
    x = 0.2 / 0.5
    taken = math.pi * x**2 - 8 / 3 * x**3 + x**4 / 2
    first_try = np.mean([start.redraws == 0 for start in seconds])
    assert abs(first_try - (1 - taken)) < 4 * math.sqrt(taken * (1 - taken) / 200)


def test_no_room_is_a_failure_with_the_object_and_the_remedy():
    wide = asset_of(box(0.4, 0.4, 0.05))
    with pytest.raises(StartError, match=r"object 2 .*max_redraws.*start\.arrange: pile") as caught:
        plan(0, wide, wide)
    assert caught.value.reason == "no_room"
    assert len(plan(0, wide, wide, arrange="pile").objects) == 2


def test_off_the_table_is_still_told_as_that():
    with pytest.raises(StartError) as caught:
        plan(0, SMALL, SMALL, offset_m=[0.9, 1.0])
    assert caught.value.reason == "no_table_below"
