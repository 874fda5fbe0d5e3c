"""All randomness of a scene."""

import math

import numpy as np
import pytest

from schemas.errors import StartError
from schemas.job.job import Job
from tests.kit.shapes import asset_of, box, table
from workers.geometry.camera import inclination, yaw
from workers.geometry.frames import pose, rotation_about, transform, translation
from workers.geometry.hull import hull_of
from workers.physics.support import place_table
from workers.scene.plan import SceneChance, choose_category, draw_scene, stands_on

BOX = asset_of(box(0.1, 0.08, 0.2))
TABLE = table()


def job(**changes) -> Job:
    return Job.model_validate({"name": "t", "seed": 5, **changes})


def test_categories_come_with_their_weights():
    weighted = job(categories={"mug": 3.0, "bowl": 1.0})
    draws = [choose_category(weighted, SceneChance(5, scene)) for scene in range(2000)]
    share = draws.count("mug") / len(draws)
    assert set(draws) == {"mug", "bowl"}
    assert abs(share - 0.75) < 4 * math.sqrt(0.75 * 0.25 / 2000)


def test_more_pairs_move_neither_the_object_nor_the_earlier_cameras():
    one, three = (draw_scene(job(pairs_per_scene=n), SceneChance(5, 3), TABLE, BOX) for n in (1, 3))
    assert np.array_equal(one.objects[0].T_world_obj, three.objects[0].T_world_obj)
    assert np.array_equal(one.input_cameras[0].T_world_cam, three.input_cameras[0].T_world_cam)
    assert len({camera.T_world_cam.tobytes() for camera in three.input_cameras}) == 3


def test_starts_and_cameras_fill_their_ranges_and_never_leave_them():
    plans = [draw_scene(job(), SceneChance(5, scene), TABLE, BOX) for scene in range(300)]
    height = plans[0].table.top.height_m
    starts = np.stack([plan.objects[0].T_world_obj for plan in plans])
    lowest = np.array([transform(T, BOX.shape.vertices)[:, 2].min() for T in starts]) - height
    angles = np.array([[inclination(c.T_world_cam), yaw(c.T_world_cam)] for plan in plans for c in plan.input_cameras])
    for values, low, high in (
        (starts[:, 0, 3], -0.25, 0.25),
        (starts[:, 1, 3], -0.25, 0.25),
        (lowest, 0.005, 0.05),
        (angles[:, 0], 0.7, 0.9),
        (angles[:, 1], -math.pi, math.pi),
    ):
        assert values.min() >= low - 1e-9
        assert values.max() <= high + 1e-9
        # Kolmogorov-Smirnov at the 0.1 % level for 300 uniform draws.
        sorted_share = np.sort((values - low) / (high - low))
        assert np.abs(sorted_share - (np.arange(300) + 0.5) / 300).max() < 1.95 / math.sqrt(300)
    distances = [np.linalg.norm(p.input_cameras[0].position - [0, 0, height]) for p in plans]
    assert distances == pytest.approx([2.5] * 300)


def test_upright_objects_stand_and_tumbled_ones_do_not():
    upright = draw_scene(job(), SceneChance(5, 1), TABLE, BOX).objects[0].T_world_obj
    assert upright[2, 2] == 1.0
    tumbled = [
        draw_scene(job(start={"pose": "tumbled"}), SceneChance(5, s), TABLE, BOX).objects[0].T_world_obj[2, 2]
        for s in range(200)
    ]
    assert abs(np.mean(tumbled)) < 4 / math.sqrt(3 * 200)


def test_a_placed_object_touches_the_table_and_needs_no_drop():
    start = draw_scene(job(start={"pose": "placed"}), SceneChance(5, 2), TABLE, BOX).objects[0]
    assert start.placed
    assert transform(start.T_world_obj, BOX.shape.vertices)[:, 2].min() == pytest.approx(0.7, abs=1e-12)


def test_a_box_stands_on_a_face_within_reach_of_the_table_and_on_no_edge():
    hull, com, top_m = hull_of(BOX.shape), BOX.mass.com, place_table(TABLE).top.height_m
    flat = translation(0.0, 0.0, top_m + 0.1)
    on_edge = pose(rotation_about(np.array([1.0, 0.0, 0.0]), math.atan(0.08 / 0.2)), np.array([0.0, 0.0, top_m]))
    on_edge[2, 3] -= (transform(on_edge, hull.vertices)[:, 2] - top_m).min()
    tables = place_table(TABLE).mesh
    assert stands_on(flat, hull, com, tables)
    assert not stands_on(translation(0.0, 0.0, 6e-5) @ flat, hull, com, tables)
    assert not stands_on(on_edge, hull, com, tables)


def test_a_placed_object_that_would_tip_is_dropped_instead():
    leaning = asset_of(box(0.05, 0.05, 0.02, (0, 0, -0.1)), box(0.04, 0.04, 0.18, (0.06, 0, 0)))
    assert not draw_scene(job(start={"pose": "placed"}), SceneChance(5, 2), TABLE, leaning).objects[0].placed


def test_a_position_off_the_table_is_redrawn_and_counted():
    small = table(side_m=0.3)
    starts = [draw_scene(job(), SceneChance(5, scene), small, BOX).objects[0] for scene in range(60)]
    assert all(np.abs(start.T_world_obj[:2, 3]).max() <= 0.15 for start in starts)
    redraws = [start.redraws for start in starts]
    # A square of half the side of the range is hit with probability 0.36.
    assert abs(np.mean(redraws) - (1 / 0.36 - 1)) < 4 * math.sqrt(0.64 / 0.36**2 / 60)


def test_no_position_over_the_table_is_a_failure_with_its_reason():
    with pytest.raises(StartError, match="offset_m") as caught:
        draw_scene(job(start={"offset_m": [0.9, 1.0]}), SceneChance(5, 0), TABLE, BOX)
    assert caught.value.reason == "no_table_below"
