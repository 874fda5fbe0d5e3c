"""A check that cannot fail is none: labels that are wrong by little are found."""

import contextlib
import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from schemas.base import Range
from schemas.errors import LabelError
from schemas.job.job import Job
from schemas.scene.scene import Placed, PosedScene
from schemas.scene.view import Agreement, Camera, GBuffer, Intrinsics
from tests.kit.shapes import asset_of, box, shape_of, table
from tests.physics.settling import settle_single
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import UP, pose, rotation_about, translation
from workers.geometry.raycast import cast_view, edge_distance_px
from workers.scene.chance import SceneChance
from workers.scene.make_scene import pose_scene
from workers.scene.plan import draw_scene
from workers.scene.ray_check import STEEPEST_COS, check_against_rays, check_pair

STORED = Range(0.2, 8.0)
CAMERA = Camera(
    Intrinsics(width=160, height=120, fx=262.0, fy=262.0, cx=80.0, cy=60.0),
    orbit_pose(np.array([0, 0, 0.7]), 0.8, 1.0, 2.5),
)


def buffer(depth, region) -> GBuffer:
    return GBuffer(np.zeros((120, 160, 3), np.uint8), depth.astype(np.float32), region)


@pytest.fixture(scope="module")
def scene() -> PosedScene:
    job = Job.model_validate({"name": "t", "start": {"offset_m": [0, 0]}})
    plan = draw_scene(job, SceneChance(0, 0), table(), asset_of(box(0.2, 0.2, 0.25)))
    return pose_scene(plan, (settle_single(plan.objects[0], plan.table, Job(name="t").physics),))


@pytest.fixture(scope="module")
def truth(scene) -> GBuffer:
    """What a perfect renderer would have made."""
    return buffer(*cast_view(scene.things, CAMERA)[:2])


def test_depth_is_held_to_its_percentiles_to_the_pixel(scene):
    """Around the number of wrong pixels from which numpy's percentile exceeds the bound."""
    depth, region, cosine = cast_view(scene.things, CAMERA)
    for region_id, share, error_mm in ((1, 0.001, 0.02), (3, 0.01, 0.1), (3, 0.5, 0.02)):
        compared = (region == region_id) & (depth < STORED.high) & (cosine > STEEPEST_COS)
        pixels, verdicts = np.argwhere(compared), set()
        pixels = pixels[np.argsort(-edge_distance_px(scene.things, CAMERA, pixels))]
        for count in range(math.floor(share * len(pixels)) - 3, math.floor(share * len(pixels)) + 4):
            wrong = depth.copy()
            wrong[tuple(pixels[:count].T)] += error_mm / 1e3
            seen = buffer(wrong, region)
            off = np.abs(seen.depth_m.astype(np.float64) - depth)[compared] * 1e3
            bounds = [(99.9, 0.01)] if region_id < 3 else [(50.0, 0.01), (99.0, 0.05)]
            fails = any(np.percentile(off, percentile) > bound for percentile, bound in bounds)
            with pytest.raises(LabelError, match=f"region {region_id}: ") if fails else contextlib.nullcontext():
                check_against_rays(scene, CAMERA, seen, STORED)
            verdicts.add(fails)
        assert verdicts == {True, False}


def test_twenty_micrometres_half_a_pixel_and_one_wrong_pixel_are_found(scene, truth):
    for region_id in (1, 2, 3):
        wrong = truth.depth_m + np.where(truth.region == region_id, np.float32(2e-5), np.float32(0))
        with pytest.raises(LabelError, match=f"region {region_id}"):
            check_against_rays(scene, CAMERA, dataclasses.replace(truth, depth_m=wrong), STORED)
    shifted = Camera(CAMERA.intrinsics.model_copy(update={"cx": 79.5}), CAMERA.T_world_cam)
    with pytest.raises(LabelError):
        check_against_rays(scene, CAMERA, buffer(*cast_view(scene.things, shifted)[:2]), STORED)
    region, depth = truth.region.copy(), truth.depth_m.copy()
    row, column = (int(np.median(index)) for index in np.nonzero(region == 3))
    region[row, column] = 2
    depth[row, column] += 0.01
    with pytest.raises(LabelError, match=rf"pixel \({column}, {row}\) is region 2 in the mask and 3 by ray"):
        check_against_rays(scene, CAMERA, buffer(depth, region), STORED)


def test_a_pixel_at_an_edge_of_a_small_thing_may_show_either_side_and_one_amid_it_may_not(scene):
    """A post before a slab, one region of fewer than a hundred pixels: one wrong depth is more than 1 % of them."""
    shape = shape_of(box(0.01, 0.06, 0.12), box(0.012, 0.012, 0.12, (0.06, 0.0, 0.0)))
    thing = Placed(3, shape, pose(rotation_about(UP, 1.0), np.array([0.0, 0.0, 0.76])))
    scene = dataclasses.replace(scene, things=(*scene.things[:2], thing))
    cases = []
    for step in range(400):
        k = CAMERA.intrinsics.model_copy(update={"cx": 80.0 + 0.011 * step})
        views = [
            cast_view(scene.things, Camera(k.model_copy(update={"cx": k.cx + shift}), CAMERA.T_world_cam))
            for shift in (0.0, 0.01)
        ]
        (depth, region, cosine), (moved, moved_region, _) = views
        flips = (region == 3) & (moved_region == 3) & (np.abs(depth - moved) > 0.01) & (cosine > 0.3)
        cases += [(k, tuple(at), depth, moved, region) for at in np.argwhere(flips)]
        if cases:
            break
    k, at, depth, moved, region = cases[0]
    assert (region == 3).sum() < 100
    camera = Camera(k, CAMERA.T_world_cam)
    other = depth.copy()
    other[at] = moved[at]
    check_against_rays(scene, camera, buffer(other, region), STORED)
    amid = depth.copy()
    inside = np.argwhere((region == 3) & (np.abs(np.indices(region.shape)[1] - at[1]) > 1))
    away = edge_distance_px(scene.things, camera, inside)
    amid[tuple(inside[int(np.argmax(away))])] += 0.01
    with pytest.raises(LabelError, match="region 3: 99 %"):
        check_against_rays(scene, camera, buffer(amid, region), STORED)


def test_where_two_things_cut_through_one_another_either_may_be_shown_within_a_tenth_of_a_millimetre(scene):
    """Two slabs that cross at a third of a degree, one of them drawn as if it stood so much higher, with its true depth."""
    slab = shape_of(box(0.3, 0.3, 0.02))
    level = translation(0.0, 0.0, 0.8)
    tilted = level @ pose(rotation_about(np.array([0.0, 1.0, 0.0]), math.radians(0.3)), np.zeros(3))
    things = (*scene.things[:2], Placed(3, slab, level), Placed(4, slab, tilted))
    alone = {t.region_id: cast_view([t], CAMERA)[0] for t in things}
    _, right, _ = cast_view(things, CAMERA)
    for apart_mm, passes in ((0.04, True), (0.5, False)):
        raised = (*things[:3], Placed(4, slab, translation(0.0, 0.0, apart_mm / 1e3) @ tilted))
        _, region, _ = cast_view(raised, CAMERA)
        assert ((region != right) & (region == 4)).sum() > 5
        region = np.where((region == 4) & (alone[4] > 0), region, right).astype(np.uint8)
        seen = buffer(np.select([region == k for k in alone], list(alone.values())), region)
        with contextlib.nullcontext() if passes else pytest.raises(LabelError, match="4 in the mask and 3 by ray"):
            check_against_rays(dataclasses.replace(scene, things=things), CAMERA, seen, STORED)


def test_views_that_disagree_are_a_failure_that_says_by_how_much():
    """`check_pair` looks at nothing but the agreement."""
    check = Job(name="t").check
    for object_mm, scene_mm, what in (
        (1.5, 0.1, "the object"),
        (0.1, 1.5, "the scene"),
        (0.1, 0.1, ""),
        (None, None, ""),
    ):
        pair = SimpleNamespace(exact_agreement=Agreement(object_mm, 1.0, 100, scene_mm))
        words = f"of {what} carried into the mirror view is off by 1.500 mm"
        with pytest.raises(LabelError, match=words) if what else contextlib.nullcontext():
            check_pair(pair, check)
