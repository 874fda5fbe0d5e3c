"""Labels of a view, cameras that follow from another, the projected view, and the agreement of two, in closed form; labels that
are wrong by little are found, for a check that cannot fail is none.
"""

import contextlib
import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from schemas.base import Range
from schemas.errors import LabelError, ViewError
from schemas.job.job import Job
from schemas.job.views import Distortion, Patch, Projection, Targets
from schemas.scene.scene import EffectPlan, Placed, PosedScene
from schemas.scene.view import Agreement, Camera, GBuffer, Intrinsics, ObjectLabel
from tests.kit.planes import HERE, IMAGES, THERE, K, plane_view
from tests.kit.shapes import asset_of, box, shape_of, table
from tests.physics.settling import settle_single
from workers.geometry.camera import inclination, look_at, orbit_pose, unproject
from workers.geometry.frames import UP, half_turn, invert, pose, rotation_about, transform, translation
from workers.geometry.pixels import Extent, distort
from workers.geometry.raycast import cast_view, edge_distance_px
from workers.scene.cameras import mirror_pose
from workers.scene.chance import SceneChance
from workers.scene.draw.plan import draw_scene
from workers.scene.labels import (
    carry_depth,
    compare_views,
    count_unoccluded,
    derive_projected,
    label_region,
    label_regions,
    label_things,
    patch_object_fraction,
    pixels_behind,
    projection_shares,
)
from workers.scene.make_scene import pose_scene
from workers.scene.pairs import object_distance
from workers.scene.ray_check import STEEPEST_COS, check_against_rays, check_pair
from workers.stopwatch import Stopwatch
from workers.targets.targets import Sight, draw_targets

JOB = Job(name="t")
X_AXIS, Y_AXIS, Z_AXIS = np.eye(3)
CUBE = asset_of(box(0.1, 0.1, 0.1), category="box")
SOURCE = plane_view("input", HERE)


# ---------------------------------------------------------------------------------------------- cameras


def article_product(T_world_cam: np.ndarray, d_z_m: float, T_z_m: float = 1.3) -> np.ndarray:
    """The article's product of transforms, [4, 4] float64, for a zero-roll camera.

    T_in Trans_z(d_z) Rot_x(phi) Rot_y(pi) Rot_x(-phi) Trans_z(-T_z), with phi the angle of the axis below the
    horizontal.
    """
    phi = inclination(T_world_cam)
    turn = rotation_about(X_AXIS, phi) @ half_turn(Y_AXIS) @ rotation_about(X_AXIS, -phi)
    return T_world_cam @ translation(0, 0, d_z_m) @ pose(turn, np.zeros(3)) @ translation(0, 0, -T_z_m)


def test_the_mirror_pose_is_the_articles_product_at_zero_roll_and_another_with_roll():
    for seed in range(40):
        rng = np.random.default_rng(seed)
        T = orbit_pose(np.array([0, 0, 0.7]), rng.uniform(0.7, 0.9), rng.uniform(-math.pi, math.pi), 2.5)
        d_z = rng.uniform(2.0, 2.6)
        assert mirror_pose(T, d_z, 1.3) == pytest.approx(article_product(T, d_z, 1.3), abs=1e-9)
    rng = np.random.default_rng(3)
    T = look_at(rng.uniform((-3, -3, 1), (3, 3, 7)), rng.uniform(-0.5, 0.5, 3))
    T = T @ pose(rotation_about(Z_AXIS, 1.0), np.zeros(3))
    assert np.abs(mirror_pose(T, 2.0) - article_product(T, 2.0)).max() > 0.1


def test_the_front_distance_is_read_from_the_depth_of_whichever_object_is_seen():
    mirror = JOB.cameras.mirror
    region = np.full((10, 10), 1, np.uint8)  # the first object is hidden, the second stands at 2 m, the third at 3 m
    region[2:4], region[6:8] = 4, 5
    depth = np.where(region == 4, 10_000, np.where(region == 5, 15_000, 5_000)).astype(np.uint16)
    depth[2, 0] = 0  # the pixel has no depth and must not count as nearest
    assert object_distance(depth, region, JOB.images, mirror) == pytest.approx(2.0)
    region[region == 4] = 2
    assert object_distance(depth, region, JOB.images, mirror) == pytest.approx(3.0)
    with pytest.raises(ViewError, match="no depth pixel") as caught:
        object_distance(depth, np.minimum(region, 2), JOB.images, mirror)
    assert caught.value.reason == "object_not_seen"


# ---------------------------------------------------------------------------------------------- regions and patches


def nothing_left(things, camera):
    pytest.fail("nothing is left to count")


def test_a_label_counts_boxes_and_shares_its_own_pixels():
    thing = Placed(3, CUBE.shape, HERE.T_world_cam @ translation(0.001, 0.001, 2.0))
    made = label_region(thing, ("mug", "m"), HERE, Extent(50, (30, 10, 5, 10)), 100)
    assert (made.region_id, made.category, made.instance_id, made.u, made.v) == (3, "mug", "m", 80, 60)
    assert (made.bbox_xywh, made.pixels, made.visible_fraction) == ((30, 10, 5, 10), 50, 0.5)
    unseen = label_region(thing, ("mug", "m"), HERE, Extent(0, (0, 0, 0, 0)), 0)
    assert (unseen.pixels, unseen.visible_fraction, unseen.bbox_xywh) == (0, 0.0, (0, 0, 0, 0))


def test_table_and_objects_are_labelled_in_order_the_floor_is_not_and_only_what_is_seen_is_counted():
    plan = draw_scene(JOB, SceneChance(0, 0), table(), CUBE)
    start = plan.objects[0]
    placed = ((1, plan.floor, np.eye(4)), (2, plan.table.asset.shape, plan.table.T_world_table))
    things = tuple(Placed(*thing) for thing in (*placed, (3, CUBE.shape, start.T_world_obj)))
    region = np.ones((K.height, K.width), np.uint8)
    region[40:80, 40:120], region[50:60, 60:70] = 2, 3
    posed = PosedScene(things, plan.appearance)
    labels = label_regions(plan, posed, HERE, region, lambda seen, camera: [200 for _ in seen])
    assert [(label.region_id, label.category, label.pixels) for label in labels] == [
        (2, "table", 3100),
        (3, "box", 100),
    ]
    assert (labels[1].bbox_xywh, labels[1].visible_fraction) == ((60, 50, 10, 10), 0.5)
    assert np.allclose(HERE.T_world_cam @ labels[1].T_cam_obj, start.T_world_obj)
    things = [Placed(region_id, CUBE.shape, np.eye(4)) for region_id in (2, 3, 4)]
    region = np.zeros((K.height, K.width), np.uint8)
    region[0, :5], region[1, :8] = 2, 4
    names, counts = dict.fromkeys((2, 3, 4), ("box", "b")), {2: 10, 4: 32}
    labels = label_things(things, names, HERE, region, lambda seen, camera: [counts[thing.region_id] for thing in seen])
    assert [label.visible_fraction for label in labels] == [0.5, 0.0, 0.25]
    nothing = label_things(things, names, HERE, np.zeros_like(region), nothing_left)
    assert [label.pixels for label in nothing] == [0, 0, 0]


def test_what_stands_alone_within_the_image_hides_behind_nothing_and_is_not_counted_again():
    plan = dataclasses.replace(draw_scene(JOB, SceneChance(0, 0), table(), CUBE), ground=None)
    posed = PosedScene((Placed(3, CUBE.shape, plan.objects[0].T_world_obj),), plan.appearance)
    region = np.zeros((K.height, K.width), np.uint8)
    region[50:60, 60:70] = 3
    (label,) = label_regions(plan, posed, HERE, region, nothing_left)
    assert (label.pixels, label.visible_fraction) == (100, 1.0)
    for edge in (np.s_[0, 5], np.s_[-1, 5], np.s_[5, 0], np.s_[5, -1]):  # beyond which it goes on
        cut = region.copy()
        cut[edge] = 3
        (label,) = label_regions(plan, posed, HERE, cut, lambda *_: [202])
        assert (label.pixels, label.visible_fraction) == (101, 0.5)


def test_what_the_processor_cannot_count_is_counted_by_the_renderer():
    near, far = (Placed(n, CUBE.shape, HERE.T_world_cam @ translation(0, 0, n)) for n in (0, 2))
    asked = []
    counts = count_unoccluded(
        [far, near, far], HERE, lambda things, camera: [asked.append(thing) or 77 for thing in things]
    )
    assert counts == [36, 77, 36] and asked == [near]  # its side is 6.7 pixels
    assert count_unoccluded([far], HERE, nothing_left) == [36]


def test_a_patch_is_left_out_where_it_would_leave_the_image_and_filled_by_the_share_of_its_object():
    region = np.full_like(SOURCE.region, 2)
    region[:60] = 3
    view, patch = dataclasses.replace(SOURCE, region=region), Patch(width=32, height=24)
    seen, hidden = ((80, 60, 0.5), (80, 40, 1.0), (16, 60, 0.5), (15, 60, None)), ((80, 60, None),)
    for u, v, share, pixels in (*((*place, 1) for place in seen), *((*place, 0) for place in hidden)):
        label = ObjectLabel(3, "mug", "m", np.eye(4), u, v, (0, 0, 0, 0), pixels, 1.0)
        assert patch_object_fraction(view, label, patch) == share
        assert patch_object_fraction(dataclasses.replace(view, region=None), label, patch) is None


# ---------------------------------------------------------------------------------------------- two views


def test_two_views_of_one_plane_agree_to_the_quantisation_and_of_two_disagree_by_their_distance():
    same = compare_views(SOURCE, plane_view("mirror", THERE), IMAGES, 1.0)
    # Each stored depth is off by up to 0.1 mm, evenly: the median of the difference of the two stays below that.
    assert same.points > 3000 and same.median_mm < 0.1 and same.share == 1.0
    apart = compare_views(SOURCE, plane_view("mirror", THERE, -0.003), IMAGES, 1.0)
    assert apart.median_mm > 2.0 and apart.share == 0.0
    few = compare_views(plane_view("input", HERE, region=2), plane_view("mirror", THERE, region=2), IMAGES, 1.0)
    assert few.median_mm is None and few.points == 0 and few.scene_median_mm < 0.1


def test_the_shares_are_of_what_is_filled_and_of_what_is_hidden():
    near = np.array([[0, 5000, 5100, 5040]], np.uint16)
    assert projection_shares(near, np.full_like(near, 5000), IMAGES) == (0.75, pytest.approx(1 / 3))


def test_hidden_points_splats_and_the_lens_are_as_the_plan_has_them():
    def carried(target, images=IMAGES, *effects):
        return carry_depth(SOURCE, target, images, EffectPlan(effects, {})).source >= 0

    below = Camera(K, orbit_pose(np.zeros(3), -0.8, 0.7, 2.5))
    assert carried(below).any() and not carried(below, IMAGES, "hidden_point_removal").any()
    assert carried(THERE, IMAGES, "hidden_point_removal").sum() > 2000
    wide, plain = IMAGES.model_copy(update={"projection": Projection(splat=3)}), carried(THERE)
    splatted = carried(THERE, wide, "splat")
    assert np.array_equal(carried(THERE, wide), plain)
    assert (plain <= splatted).all() and splatted.sum() > 1.2 * plain.sum()
    lens = Distortion(k1=-0.2)
    plain, left_out, drawn = (
        derive_projected(SOURCE, THERE, IMAGES, used, EffectPlan(effects, {}))[0]
        for used, effects in ((None, ()), (lens, ()), (lens, ("sensor_distortion",)))
    )
    assert np.array_equal(left_out, plain) and not np.array_equal(drawn, plain)


def test_behind_a_lens_a_depth_pixel_has_the_colour_of_the_pixel_that_its_centre_is_drawn_in():
    """A radial lens leaves the centre of the image where it is, moves the corner, and may move it out of the image."""
    centre = K.height // 2 * K.width + K.width // 2
    pixels = pixels_behind(Distortion(k1=-0.2), np.array([centre, 0, -1]), K)
    u, v = distort(np.array([0.5]), np.array([0.5]), Distortion(k1=-0.2), K)
    assert pixels.tolist() == [centre, int(v[0]) * K.width + int(u[0]), -1]
    assert pixels[1] > K.width
    assert pixels_behind(Distortion(k1=0.2), np.array([0]), K).tolist() == [-1]


# ---------------------------------------------------------------------------------------------- targets


@pytest.mark.parametrize("side_m", [0.4, 40.0])
def test_what_reaches_behind_the_camera_is_cut_at_the_near_plane_and_has_its_normal_everywhere(side_m):
    """A floor; the second derivation holds all other targets (tests/judge/test_targets.py)."""
    T_world_cam = look_at(np.array([0.5, 0.3, 0.4]), np.zeros(3))
    floor = Placed(1, shape_of(box(side_m, side_m, 0.01, (0, 0, -0.005))), np.eye(4))
    rows, columns = np.divmod(np.arange(K.height * K.width), K.width)
    rays = unproject(rows, columns, np.ones(len(rows)), K) @ T_world_cam[:3, :3].T
    z = -T_world_cam[2, 3] / rays[:, 2]
    hit = T_world_cam[:3, 3] + z[:, None] * rays
    region = (
        ((np.abs(hit[:, :2]) < side_m / 2 - 0.01).all(axis=1) & (z > 0)).astype(np.uint8).reshape(K.height, K.width)
    )
    plan, job = EffectPlan(("normals",), {}), Job(name="t", targets=Targets(views=("normals",)))
    drawn = draw_targets([floor], Camera(K, T_world_cam), region, job, plan, Stopwatch())["normals"][region > 0]
    assert len(drawn) > 500 and np.abs(drawn - np.rint((T_world_cam[2, :3] + 1.0) / 2.0 * 65535.0)).max() <= 1.0


def test_the_input_camera_sees_what_no_box_is_before_inside_its_image_and_from_its_side():
    """A post's shadow on a wall, the post's own far sides, and a sheet of no thickness: by where lines enter and leave boxes."""
    boxes = {3: ((0.5, 0.02, 0.4), (0, 0, 0)), 4: ((0.07, 0.05, 0.2), (0.03, -0.15, 0.05))}
    things = [Placed(region, shape_of(box(*sides, at)), np.eye(4)) for region, (sides, at) in boxes.items()]
    corners = np.array([[-0.4, -0.1, -0.05], [-0.3, -0.1, -0.05], [-0.3, -0.1, 0.05], [-0.4, -0.1, 0.05]])
    things.append(Placed(5, shape_of(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)), np.eye(4)))
    view = Camera(K, look_at(np.array([-0.7, -0.6, 0.2]), np.zeros(3)))
    for place, cx in (((0.2, -0.7, 0.3), 40.0), ((0.3, -0.7, 0.3), 100.0), ((-0.3, 0.7, 0.1), 40.0)):
        source = Camera(
            K.model_copy(update={"fx": 180.0, "fy": 250.0, "cx": cx}), look_at(np.array(place), np.zeros(3))
        )
        depth, region, _ = cast_view(things, view)
        plan, job = EffectPlan(("covisible",), {}), Job(name="t", targets=Targets(views=("covisible",)))
        drawn = draw_targets(things, view, region, job, plan, Stopwatch(), Sight(things, source))["covisible"]
        rows, columns = np.nonzero(region)
        points = transform(view.T_world_cam, unproject(rows, columns, depth[rows, columns], K))
        x, y, z = transform(invert(source.T_world_cam), points).T
        u, v = 180.0 * x / z + cx, 250.0 * y / z + K.cy
        expected = (u >= 0) & (u < K.width) & (v >= 0) & (v < K.height)
        for sides, at in boxes.values():
            with np.errstate(divide="ignore", invalid="ignore"):
                ends = [(np.array(at) + sign * np.array(sides) / 2 - place) / (points - place) for sign in (-1, 1)]
            enters, leaves = np.minimum(*ends).max(axis=1), np.maximum(*ends).min(axis=1)
            expected &= ~((enters < 1 - 1e-9) & (leaves >= enters - 1e-9))
        expected &= (region[rows, columns] != 5) | (place[1] < -0.1)
        assert np.array_equal(drawn[rows, columns], 255 * expected) and not drawn[region == 0].any()
        share = {number: expected[region[rows, columns] == number].mean() for number in (3, 4, 5)}
        assert all(0.1 < share[number] < 0.9 for number in (3, 4)) if place[1] < 0 else share[5] == 0, share


# ---------------------------------------------------------------------------------------------- the check by rays

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
