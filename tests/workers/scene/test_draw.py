"""The draw of a scene: named streams, ranges that are filled and never left, and objects that begin without touching."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
import trimesh

import workers.scene.draw.plan as planning
from schemas.errors import StartError, ViewError
from schemas.job.job import Job
from schemas.scene.scene import ObjectStart, ScenePlan
from schemas.scene.shape import Asset
from tests.kit.shapes import asset_of, box, table
from workers.assets.catalogue import open_catalogue
from workers.geometry.camera import inclination, project, yaw
from workers.geometry.frames import invert, pose, rotation_about, transform, translation
from workers.geometry.hull import hull_of
from workers.physics.support import APART_M, columns_apart, place_table
from workers.scene.cameras import frame_cameras
from workers.scene.chance import SceneChance, Stream
from workers.scene.draw.plan import choose_assets, choose_category, count_objects, draw_scene, stands_on
from workers.scene.effects import is_raycast_scene

BOX = asset_of(box(0.1, 0.08, 0.2))
TABLE = table()
SMALL = asset_of(box(0.08, 0.05, 0.1), category="box")
CAN = asset_of(trimesh.creation.cylinder(0.04, 0.12), category="can")
BIG = asset_of(box(0.2, 0.12, 0.1), category="mug")


def job(**changes) -> Job:
    return Job.model_validate({"name": "t", "seed": 5, **changes})


def plan(scene: int, *assets: Asset, on: Asset = TABLE, pairs: int = 1, **start) -> ScenePlan:
    drawn = job(pairs_per_scene=pairs, objects_per_scene=len(assets), start=start)
    return draw_scene(drawn, SceneChance(drawn.seed, scene), on, *assets)


def mesh_of(start: ObjectStart) -> trimesh.Trimesh:
    shape = start.asset.shape
    return trimesh.Trimesh(transform(start.T_world_obj, shape.vertices), shape.faces)


def is_share(share: float, expected: float, count: int) -> bool:
    """Within four standard deviations."""
    return abs(share - expected) < 4 * math.sqrt(expected * (1 - expected) / count)


# ---------------------------------------------------------------------------------------------- chance


def test_a_stream_is_a_function_of_seed_scene_step_and_object():
    chance = SceneChance(5, 7)
    draw = chance.stream(Stream.CAMERA).random(4)
    assert np.array_equal(draw, SceneChance(5, 7).stream(Stream.CAMERA).random(4))
    for seed, scene_id, name in ((6, 7, Stream.CAMERA), (5, 8, Stream.CAMERA), (5, 7, Stream.START)):
        assert not np.array_equal(draw, SceneChance(seed, scene_id).stream(name).random(4))
    draws = [chance.object_stream(Stream.START, number).random() for number in range(4)]
    assert draws[0] == chance.stream(Stream.START).random() and len(set(draws)) == 4
    sensors = [chance.sensor_stream(name, 3) for name in ("exposure", "vignetting", "blur")]
    assert sensors[0].random() == chance.stream(Stream.SENSOR_EXPOSURE, 3).random()
    assert sensors[1].random() != sensors[2].random() != chance.stream(Stream.SENSOR, 3).random()
    names = "CATEGORY OBJECT TABLE START REDRAW CAMERA APPEARANCE RAYCAST_CHECK SENSOR_DEPTH SENSOR_RGB SENSOR_EXPOSURE"
    names += " PATHS COUNT HIDDEN_MARKERS MOTION HELD_OUT LOST SENSOR ORBIT MORE MIRROR"
    names += " LIGHTS ENVIRONMENT SURROUNDINGS CLUTTER"  # append-only: numbers are in datasets
    numbers = dict(zip(names.split(), range(25), strict=True)) | {"GIVEN": 27}
    assert {stream.name: int(stream) for stream in Stream} == numbers


def test_categories_counts_and_checked_scenes_come_with_their_shares():
    weighted = job(categories={"mug": 3.0, "bowl": 1.0})
    draws = [choose_category(weighted, SceneChance(5, scene)) for scene in range(2000)]
    assert set(draws) == {"mug", "bowl"} and is_share(draws.count("mug") / 2000, 0.75, 2000)
    assert len({choose_category(job(), SceneChance(5, 0), number) for number in range(20)}) > 4
    counts = [count_objects(job(objects_per_scene=[2, 5]), SceneChance(5, scene)) for scene in range(1000)]
    assert set(counts) == {2, 3, 4, 5}
    assert all(is_share(counts.count(n) / 1000, 0.25, 1000) for n in (2, 3, 4, 5))
    assert {count_objects(job(), SceneChance(0, scene)) for scene in range(50)} == {1}
    for share in (0.1, 1.0):
        check = job(check={"raycast_share": share}).check
        chosen = [is_raycast_scene(check, SceneChance(5, scene)) for scene in range(3000)]
        assert is_share(np.mean(chosen), share, 3000) or all(chosen)
        assert chosen[:50] == [is_raycast_scene(check, SceneChance(5, scene)) for scene in range(50)]


def test_a_scene_of_named_splits_has_objects_of_one_of_them_alone_and_none_without_a_name():
    named = {"train": ["mug-0-000001", "can-0-000002"], "test": ["mug-0-000003", "can-0-000004"]}
    named["unseen"] = ["bowl-*"]
    objects = [{"source": "procedural", "instances": 8}]
    drawn = {"categories": ["mug", "can", "bowl"], "objects_per_scene": [1, 3]}
    split = job(**drawn, assets={"objects": objects, "split": {"named": named}})
    catalogue = open_catalogue(split.assets, Path(), split.categories)
    there, sizes = set(), set()
    for scene in range(300):
        chance = SceneChance(5, scene)
        names = [ref.instance_id for ref in choose_assets(split, catalogue, chance)[0]]
        splits = {split.assets.split.of(name) for name in names}
        assert len(splits) == 1 and len(names) == count_objects(split, chance)
        assert names[0].startswith(choose_category(split, chance))  # a scene is named after it before it is drawn
        there |= splits
        sizes |= {(len(names), *splits)}
    assert there == {"train", "test", "unseen"} and len(sizes) == 9
    assert split.assets.split.of("mug-0-000005") == "none"
    few = job(**drawn, assets={"objects": objects, "split": {"named": {"train": ["mug-0-000009", "can-*", "bowl-*"]}}})
    catalogue = open_catalogue(few.assets, Path(), few.categories)
    mugs = next(chance for n in range(40) if choose_category(few, chance := SceneChance(5, n)) == "mug")
    with pytest.raises(StartError, match=r"the last of mug.*assets\.split\.named"):
        choose_assets(few, catalogue, mugs)
    with pytest.raises(ValueError, match="names bowl-\\* twice"):
        job(assets={"split": {"named": {"train": ["bowl-*"], "test": ["bowl-*"]}}})


def test_more_pairs_and_objects_move_neither_the_earlier_ones_nor_cameras_table_and_look():
    single, three = (plan(3, BOX, pairs=n) for n in (1, 3))
    assert np.array_equal(single.objects[0].T_world_obj, three.objects[0].T_world_obj)
    assert np.array_equal(single.input_cameras[0].T_world_cam, three.input_cameras[0].T_world_cam)
    assert len({camera.T_world_cam.tobytes() for camera in three.input_cameras}) == 3
    for arrange in ("spread", "pile"):
        plans = [plan(7, *[SMALL, CAN, BIG, CAN, SMALL][:n], arrange=arrange) for n in (1, 3, 5)]
        for fewer, more in pairwise(plans):
            for a, b in zip(fewer.objects, more.objects, strict=False):
                assert a.T_world_obj.tobytes() == b.T_world_obj.tobytes() and a.redraws == b.redraws
            assert fewer.input_cameras[0].T_world_cam.tobytes() == more.input_cameras[0].T_world_cam.tobytes()
            assert fewer.appearance.background == more.appearance.background
            assert fewer.category == more.category == "box"
    assert len({start.T_world_obj.tobytes() for start in plan(3, SMALL, SMALL, SMALL).objects}) == 3


# ---------------------------------------------------------------------------------------------- one object


def test_starts_and_cameras_fill_their_ranges_and_never_leave_them():
    plans = [plan(scene, BOX) for scene in range(300)]
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
        assert values.min() >= low - 1e-9 and values.max() <= high + 1e-9
        # Kolmogorov-Smirnov at the 0.1 % level for 300 uniform draws.
        sorted_share = np.sort((values - low) / (high - low))
        assert np.abs(sorted_share - (np.arange(300) + 0.5) / 300).max() < 1.95 / math.sqrt(300)
    distances = [np.linalg.norm(p.input_cameras[0].position - [0, 0, height]) for p in plans]
    assert distances == pytest.approx([2.5] * 300)


def framed(*objects, radius_m="fit", at=(0.3, -0.2), **changes):
    """(camera, points [N, 3] of the hulls as the camera has them) of objects that rest side by side there."""
    drawn = job(cameras={"orbit": {"radius_m": radius_m}}, **changes)
    planned = draw_scene(drawn, SceneChance(5, 3), TABLE, objects[0])
    starts = [replace(planned.objects[0], asset=asset, hull=hull_of(asset.shape)) for asset in objects]
    poses = [translation(at[0] + 0.1 * k, at[1], 0.9) for k in range(len(objects))]
    rests = [SimpleNamespace(T_world_obj=T) for T in poses]
    (camera,) = frame_cameras(
        drawn, replace(planned, objects=tuple(starts)), [rest.T_world_obj for rest in rests]
    ).input_cameras
    before = planned.input_cameras[0]
    assert np.array_equal(camera.T_world_cam[:3, :3], before.T_world_cam[:3, :3]), "the direction that was drawn"
    points = np.concatenate([transform(T, start.hull.vertices) for start, T in zip(starts, poses, strict=True)])
    return camera, transform(invert(camera.T_world_cam), points), before


NEAR_DEPTH = {"images": {"depth_range_m": [0.05, 8.0]}}


def test_framed_objects_cover_their_share_wherever_they_rest_unless_the_edges_or_the_range_of_depth_forbid_it():
    picture = 640 * 480
    for radius, text, share in (
        (0.015, "fit", 0.06),
        (0.1, "fit", 0.06),
        (0.1, "3%", 0.03),
        (0.6, "10 %", 0.1),
        (0.1, "30%", 0.3),
    ):
        camera, seen, _ = framed(asset_of(trimesh.creation.icosphere(4, radius)), radius_m=text, **NEAR_DEPTH)
        u, v = project(seen, camera.intrinsics)
        middle = 0.5 * (
            transform(camera.T_world_cam, seen).min(axis=0) + transform(camera.T_world_cam, seen).max(axis=0)
        )
        distance = np.linalg.norm(camera.position - middle)
        covers = math.pi * 525.0**2 * radius**2 / (distance**2 - radius**2)  # a ball on the optical axis is a disc
        assert (camera.T_world_cam[:3, 2] @ (middle - camera.position)) == pytest.approx(distance)
        assert covers / picture == pytest.approx(share, rel=0.01 if radius > 0.02 else 0.25), (
            "the depth camera sees it too"
        )
        assert abs(u.mean() - 320) < 2 and abs(v.mean() - 240) < 2
    for objects, changes in (
        ([asset_of(box(0.3, 0.004, 0.004))], NEAR_DEPTH),  # so long that it would be cut off
        ([asset_of(box(0.02, 0.02, 0.02))], {}),  # so small that it would have no depth
        ([SMALL, CAN, SMALL, CAN, BIG], NEAR_DEPTH),
    ):
        camera, seen, _ = framed(*objects, **changes)
        u, v = project(seen, camera.intrinsics)
        inside = max(np.abs(u / 320 - 1).max(), np.abs(v / 240 - 1).max())
        assert inside <= 0.95 + 1e-9 and seen[:, 2].min() >= (0.2 if not changes else 0.05)
        assert shapely.MultiPoint(np.stack([u, v], axis=1)).convex_hull.area / picture < 0.12
    camera, _, before = framed(BOX, radius_m=2.5)
    assert camera.T_world_cam.tobytes() == before.T_world_cam.tobytes(), "a distance that is given stays"


def test_a_scene_that_cannot_be_framed_is_refused_before_it_is_drawn():
    for side, radius, words in (
        (13.0, "fit", "do not see|does not see"),
        (13.0, 2.5, "22.5 m across"),
        (2.0, 1.5, "radius_m: fit"),
    ):
        with pytest.raises(ViewError, match=words) as caught:
            framed(asset_of(box(side, side, side)), radius_m=radius)
        assert caught.value.reason == "not_framed"


def test_upright_objects_stand_tumbled_ones_do_not_and_placed_ones_touch_the_table_unless_they_would_tip():
    assert plan(1, BOX).objects[0].T_world_obj[2, 2] == 1.0
    tumbled = [plan(scene, BOX, pose="tumbled").objects[0].T_world_obj[2, 2] for scene in range(200)]
    assert abs(np.mean(tumbled)) < 4 / math.sqrt(3 * 200)
    placed = plan(2, BOX, pose="placed").objects[0]
    assert placed.placed
    assert transform(placed.T_world_obj, BOX.shape.vertices)[:, 2].min() == pytest.approx(0.7, abs=1e-12)
    leaning = asset_of(box(0.05, 0.05, 0.02, (0, 0, -0.1)), box(0.04, 0.04, 0.18, (0.06, 0, 0)))
    assert not plan(2, leaning, pose="placed").objects[0].placed
    hull, com, top_m = hull_of(BOX.shape), BOX.mass.com, place_table(TABLE).top.height_m
    flat = translation(0.0, 0.0, top_m + 0.1)
    on_edge = pose(rotation_about(np.array([1.0, 0.0, 0.0]), math.atan(0.08 / 0.2)), np.array([0.0, 0.0, top_m]))
    on_edge[2, 3] -= (transform(on_edge, hull.vertices)[:, 2] - top_m).min()
    for T, stands in ((flat, True), (translation(0.0, 0.0, 6e-5) @ flat, False), (on_edge, False)):
        assert stands_on(T, hull, com, place_table(TABLE).mesh) is stands


def test_a_position_off_the_table_or_taken_is_redrawn_and_counted():
    small = table(side_m=0.3)
    starts = [plan(scene, BOX, on=small).objects[0] for scene in range(60)]
    assert all(np.abs(start.T_world_obj[:2, 3]).max() <= 0.15 for start in starts)
    # A square of half the side of the range is hit with probability 0.36.
    redraws = np.mean([start.redraws for start in starts])
    assert abs(redraws - (1 / 0.36 - 1)) < 4 * math.sqrt(0.64 / 0.36**2 / 60)
    # Discs of 0.2 m side by side in a square of 0.5 m: the second is refused where the centres are nearer than that.
    # P(distance of two uniform points in a square of side a is below r), r <= a, with x = r / a: pi x^2 - 8/3 x^3 + x^4/2.
    disc = asset_of(trimesh.creation.cylinder(0.1, 0.02, sections=128))
    first_try = [plan(scene, disc, disc).objects[1].redraws == 0 for scene in range(200)]
    x = 0.2 / 0.5
    assert is_share(np.mean(first_try), 1 - (math.pi * x**2 - 8 / 3 * x**3 + x**4 / 2), 200)


def test_no_valid_position_is_a_failure_with_its_reason_and_the_remedy():
    wide = asset_of(box(0.4, 0.4, 0.05))
    for assets, start, reason, words in (
        ((BOX,), {"offset_m": [0.9, 1.0]}, "no_table_below", "offset_m"),
        ((wide, wide), {}, "no_room", r"object 2 .*start\.arrange: pile"),
    ):
        with pytest.raises(StartError, match=words) as caught:
            plan(0, *assets, **start)
        assert caught.value.reason == reason
    assert len(plan(0, wide, wide, arrange="pile").objects) == 2


# ---------------------------------------------------------------------------------------------- several objects


def test_columns_are_apart_where_a_vertical_plane_stands_between_them_and_only_there():
    """Rotated boxes: the true gap of their footprints is known by turning one into the other's frame."""
    square = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (0.0, 0.1)])
    for degrees in range(0, 90, 7):
        R = rotation_about(np.array([0.0, 0.0, 1.0]), math.radians(degrees))
        for gap, apart in ((-0.001, False), (0.0, False), (0.006, True), (0.1, True)):
            other = square + np.array([0.1 + gap, 0.02, 5.0])
            assert columns_apart(square @ R.T, other @ R.T) is apart, (degrees, gap)
    assert not columns_apart(square, square * 0.1)  # one inside the other


def test_spread_objects_have_disjoint_footprints(monkeypatch):
    """Held by Shapely's exact polygons, which the plan does not use."""
    monkeypatch.setattr(planning, "MOST_REDRAWS", 100)
    for scene in range(20):
        for start_pose in ("upright", "tumbled", "placed"):
            starts = plan(scene, SMALL, CAN, BIG, SMALL, CAN, pose=start_pose).objects
            assert [start.region_id for start in starts] == [3, 4, 5, 6, 7]
            feet = [shapely.MultiPoint(mesh_of(start).vertices[:, :2]).convex_hull for start in starts]
            assert min(feet[i].distance(feet[j]) for i in range(5) for j in range(i)) >= APART_M - 1e-9
            assert np.abs([start.T_world_obj[:2, 3] for start in starts]).max() <= 0.25


def test_a_pile_begins_above_one_another_about_the_first_with_air_in_between():
    for scene in range(20):
        for start_pose in ("upright", "tumbled", "placed"):
            more = {"arrange": "pile", "pose": start_pose, "clearance_m": [0.005, 0.05]}
            starts = plan(scene, SMALL, CAN, BIG, CAN, **more).objects
            spans = [mesh_of(start).bounds[:, 2] for start in starts]
            for below, above in pairwise(spans):
                assert 0.005 - 1e-9 <= above[0] - max(below[1], spans[0][1]) <= 0.05 + 1e-9
            spots = np.array([start.T_world_obj[:2, 3] for start in starts])
            assert np.abs(spots - spots[0]).max() <= 0.03 and len({tuple(spot) for spot in spots}) == 4
            assert not any(start.placed for start in starts[1:])
