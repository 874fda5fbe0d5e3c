"""Errors of images: depth, masks, mirror pose and projection of scenes whose views have a closed form, off by a known amount;
FLIP by its formula, the part of a picture that is compared, and truth that no setting decides.
"""

import itertools
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from schemas.base import Range, frozen_array
from schemas.job.views import Images
from schemas.scene.scene import Placed, PosedScene
from schemas.scene.shape import Appearance
from schemas.scene.view import Camera, Intrinsics, Pair, View
from services.job.job_file import validate_job
from services.study import images, truths
from services.study.images import Truth, measure_colour, measure_images
from services.study.model import knobs_of, settings_of
from services.study.truths import (
    Crop,
    cast_patch,
    colour_truth_missing,
    converged_colour,
    crop_about,
    crop_camera,
    crop_colour,
    flip_between,
)
from tests.effects.scenes import SMALL, context_of, merged
from tests.kit.shapes import box, shape_of
from workers.geometry.camera import look_at, project
from workers.geometry.frames import invert, rotation_about, transform
from workers.geometry.raycast import cast_view
from workers.scene.make_scene import make_scene
from workers.stopwatch import Stopwatch

UNITS = 5000.0
WIDTH, HEIGHT, F = 160, 120, 500.0
TOP_Z, TABLE_Z = 1.8, 2.0


def camera_above(width=WIDTH, height=HEIGHT, f=F) -> Camera:
    """Two metres above the table at z = 0, looking straight down: image x is the world's x, image y its -y."""
    k = Intrinsics(width=width, height=height, fx=f, fy=f, cx=width / 2, cy=height / 2)
    return Camera(k, frozen_array(look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3))))


def thing(region_id, mesh, T=None) -> Placed:
    return Placed(region_id, shape_of(mesh), frozen_array(np.eye(4) if T is None else T))


def table_and(*meshes, roof=None) -> tuple[Placed, ...]:
    """A table that fills the image, its top at z = 0, with a roof above it, and objects."""
    table = trimesh.util.concatenate([box(4, 4, 0.02, (0, 0, -0.01)), *([] if roof is None else [roof])])
    return (thing(2, table), *(thing(3 + i, mesh) for i, mesh in enumerate(meshes)))


def block(x=0.2, y=0.15, at=(0.0, 0.0)):
    """Its top is 0.2 m above the table: 1.8 m from the camera above."""
    return box(x, y, 0.2, (*at, 0.1))


def seen_of_block(camera, x=0.2, y=0.15, at=(0.0, 0.0)):
    """(depth in metres, region) by formula: from above a block at the axis shows its top alone."""
    k = camera.intrinsics
    u, v = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    across, down = (u - k.cx) / k.fx * TOP_Z - at[0], (v - k.cy) / k.fy * TOP_Z + at[1]
    top = (np.abs(across) < x / 2) & (np.abs(down) < y / 2)
    return np.where(top, TOP_Z, TABLE_Z), np.where(top, 3, 2).astype(np.uint8)


def view(depth_m, region, role="input", camera=None, units=UNITS) -> View:
    stored = np.rint(depth_m * units).astype(np.uint16)
    return View(role, 0, 0, camera or camera_above(), None, stored, region, ())


def scene_of(things, *pairs, scene_id=5):
    posed = PosedScene(things, Appearance((0.0, 0.0, 0.0), (), (0.0, 0.0, 0.0)))
    return SimpleNamespace(plan=SimpleNamespace(scene_id=scene_id), posed=posed, pairs=pairs)


def measure(things, *pairs, units=UNITS):
    scene = scene_of(things, *pairs)
    images = Images(depth_units_per_m=units, depth_range_m=Range(0.2, 2.1))
    return measure_images(SimpleNamespace(job=SimpleNamespace(images=images)), scene, Truth(scene, {}))


def pair_of(first, mirror=None, d_z_m=TOP_Z, aligned=None, projected=None) -> Pair:
    return Pair(d_z_m, first, () if aligned is None else (aligned,), mirror, projected, None, None)


def made(**changes):
    context = context_of(validate_job(merged(SMALL, changes), "a test"))
    return context, make_scene(context, 0, Stopwatch())


@pytest.fixture(scope="module")
def seen():
    """(depth in metres, region) of the block, by formula."""
    return seen_of_block(camera_above())


def test_views_that_are_as_the_formulas_say_have_no_error_and_what_has_no_meaning_is_left_out(seen):
    depth_m, region = seen
    first, mirror, projected = view(*seen), view(*seen, "mirror"), view(depth_m, None, "projected")
    errors = measure(table_and(block()), pair_of(first, mirror, projected=projected))
    assert errors == pytest.approx(dict.fromkeys(errors, 0.0), abs=1e-4)
    labels = {"depth_mm", "mask_share", "between_mm"}
    assert set(errors) == labels | {"mirror_mm", "unfilled_share", "hidden_share"}
    assert set(measure(table_and(block()), pair_of(first))) == labels
    nothing, empty = view(np.full_like(depth_m, TABLE_Z), np.full_like(region, 2)), view(0 * depth_m, None, "projected")
    assert measure(table_and(block(at=(1.5, 0.0))), pair_of(nothing, nothing, projected=empty)) == {}


def test_depth_of_objects_is_off_by_what_was_added_and_the_table_s_does_not_count(seen):
    depth_m, region = seen
    for mine, of, expected in ((3, +7, 1.4), (2, -11, 0.0)):
        errors = measure(table_and(block()), pair_of(view(depth_m + np.where(region == mine, of / UNITS, 0.0), region)))
        assert (errors["depth_mm"], errors["between_mm"]) == pytest.approx((expected, expected), abs=1e-3)


def test_depth_that_one_pixel_in_fifty_has_wrong_counts_and_one_in_two_hundred_or_without_depth_does_not(seen):
    depth_m, region = seen
    rows, columns = np.nonzero(region == 3)
    for every, off, expected in ((50, 0.1, 100.0), (200, 0.1, 0.0), (2, -TOP_Z, 0.0)):
        wrong = depth_m.copy()
        wrong[rows[::every], columns[::every]] += off
        errors = measure(table_and(block()), pair_of(view(wrong, region)))
        assert errors["depth_mm"] == pytest.approx(expected, abs=1e-3)


def test_mask_pixels_that_differ_count_per_pixel_of_the_object(seen):
    depth_m, region = seen
    mine = np.argwhere(region == 3)
    columns = len(mine) / np.count_nonzero((region == 3).any(axis=1))
    far, other = region.copy(), region.copy()
    far[:4, :5], other[tuple(mine[:100].T)] = 3, 4
    for mask, expected in ((np.roll(region, 1, axis=1), 2 / columns), (far, 20 / len(mine)), (other, 100 / len(mine))):
        assert measure(table_and(block()), pair_of(view(depth_m, mask)))["mask_share"] == pytest.approx(expected)
    # Depth counts only where mask and ray name the same object.
    off = view(depth_m + np.where(other == 4, 0.05, 0.0), other)
    assert measure(table_and(block()), pair_of(off))["depth_mm"] == pytest.approx(0.0, abs=1e-3)
    right, wrong = view(*seen), np.where(region == 3, 2, region)
    mirror, aligned = view(depth_m, wrong, "mirror"), view(depth_m, wrong, "aligned")
    for pairs, expected in (
        ([pair_of(right, mirror)], 1 / 2),
        ([pair_of(right, aligned=aligned)], 1 / 2),
        ([pair_of(right, mirror), pair_of(right)], 1 / 3),
    ):
        assert measure(table_and(block()), *pairs)["mask_share"] == pytest.approx(expected)


def test_between_pixels_of_a_slanted_face_depth_is_off_by_its_slope():
    """A face turned by 30 degrees about the image's y axis; at the axis dz/du = tan(30) z / f, and the nearest pixel is a
    quarter of a pixel away in the median. The face is small, so that the slope is the same everywhere to 3 %."""
    angle, T = np.pi / 6, np.eye(4)
    T[:3, :3] = rotation_about(np.array([0.0, 1.0, 0.0]), angle)
    T[2, 3] = 0.2
    plate = trimesh.creation.box((0.12, 0.12, 0.002), T)
    normal = np.array([np.sin(angle), 0.0, -np.cos(angle)])  # in the camera's frame, towards it
    on_face = np.array([0.0, 0.0, 1.8]) + 0.001 * normal
    for scale in (1, 2):
        camera = camera_above(WIDTH * scale, HEIGHT * scale, F * scale)
        k = camera.intrinsics
        u = (np.arange(k.width) + 0.5 - k.cx) / k.fx
        z = np.broadcast_to((normal @ on_face) / (normal[0] * u + normal[2]), (k.height, k.width))
        first = view(z, np.full(z.shape, 3, np.uint8), camera=camera, units=30_000)
        errors = measure(table_and(plate), pair_of(first), units=30_000.0)
        assert errors["between_mm"] == pytest.approx(0.25 / scale * np.tan(angle) * 1.8 / F * 1e3, rel=0.06)


def mirror_mm(d_z_m, *meshes, roof=None):
    first = view(*seen_of_block(camera_above()))
    return measure(table_and(*meshes, roof=roof), pair_of(first, first, d_z_m=d_z_m))["mirror_mm"]


def test_the_mirror_camera_is_off_by_what_d_z_is_off_the_nearest_visible_point():
    ball = trimesh.creation.uv_sphere(radius=0.1, count=(64, 64))
    ball.apply_translation((0.0, 0.0, 0.1))
    assert mirror_mm(1.8 + 0.012, ball) == pytest.approx(12.0, abs=1e-3)
    first = view(*seen_of_block(camera_above()))
    pairs = [pair_of(first, first, TOP_Z + off) for off in (0.001, -0.004, 0.002)]  # of several pairs the worst counts
    assert measure(table_and(block()), *pairs)["mirror_mm"] == pytest.approx(4.0, abs=1e-3)
    needle = trimesh.creation.cone(radius=0.05, height=0.3, sections=7)  # its point is between all rays
    assert mirror_mm(1.7, needle) == pytest.approx(0.0, abs=1e-6)
    beyond = trimesh.util.concatenate([block(), box(0.2, 0.2, 0.6, (0.7, 0.0, 0.3))])  # a taller one beside the picture
    assert mirror_mm(1.8, beyond) == pytest.approx(0.0, abs=1e-6)
    under = trimesh.util.concatenate([block(0.05), box(0.05, 0.05, 0.4, (0.15, 0.0, 0.2))])  # a taller one under a roof
    assert mirror_mm(1.8, under, roof=box(0.2, 0.4, 0.01, (0.15, 0.0, 0.5))) == pytest.approx(0.0, abs=1e-6)


def projected_errors(things, first, depth_m, camera=None):
    return measure(things, pair_of(first, first, projected=view(depth_m, None, "projected", camera)))


def test_pixels_that_the_projection_leaves_empty_are_counted_where_both_cameras_see_the_object(seen):
    depth_m, region = seen
    mine = np.argwhere(region == 3)
    depth = np.where(region == 3, depth_m, 0.0)
    depth[tuple(mine[::3].T)] = 0.0
    errors = projected_errors(table_and(block()), view(*seen), depth)
    assert errors["unfilled_share"] == pytest.approx(len(mine[::3]) / len(mine))
    # A camera on each side of a block, both 45 degrees up: each sees its top and one side.
    k = Intrinsics(width=WIDTH, height=HEIGHT, fx=300.0, fy=300.0, cx=80.0, cy=60.0)
    poses = (look_at(np.array([x, 0.0, 1.1]), np.array([0.0, 0.0, 0.1])) for x in (-1, 1))
    left, right = (Camera(k, frozen_array(T)) for T in poses)
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], axis=-1) @ right.T_world_cam[:3, :3].T
    at = right.position + ((0.2 - right.position[2]) / rays[..., 2])[..., None] * rays
    top = (np.abs(at[..., 0]) < 0.1) & (np.abs(at[..., 1]) < 0.075)
    first = view(0 * depth_m, np.full_like(region, 2), camera=left)
    for filled, expected in ((top, 0.0), (~top, 1.0)):
        errors = projected_errors(table_and(block()), first, np.where(filled, 1.3, 0.0), right)
        assert errors["unfilled_share"] == pytest.approx(expected, abs=2 / np.count_nonzero(top))


def test_a_projected_pixel_behind_the_surface_is_hidden_and_one_before_it_is_not(seen):
    _, region = seen
    drawn = np.where(region == 3, TABLE_Z, 0.0)  # the table, where the block hides it
    drawn[:5], drawn[5:7], drawn[7:8] = 1.0, TABLE_Z + 0.004, TABLE_Z + 0.006
    block_pixels = np.count_nonzero(region == 3)
    errors = projected_errors(table_and(block()), view(*seen), drawn)
    assert errors["hidden_share"] == pytest.approx((block_pixels + WIDTH) / (block_pixels + 8 * WIDTH))
    # Every second column of a large image filled, as a projection fills, and every second of these hidden.
    camera, drawn = camera_above(640, 480, 2000.0), np.zeros((480, 640))
    drawn[:, ::4], drawn[:, 2::4] = TABLE_Z, TABLE_Z + 0.1
    first = view(np.full(drawn.shape, TABLE_Z), np.full(drawn.shape, 2, np.uint8), camera=camera)
    errors = projected_errors(table_and(block(0.01, 0.01)), first, drawn, camera)
    assert errors["hidden_share"] == pytest.approx(1 / 2, abs=4 * np.sqrt(0.25 / 9600))


def test_truth_is_kept_while_the_poses_are_the_same_and_no_longer(seen):
    def copy(placed: Placed) -> Placed:
        meshes = [trimesh.Trimesh(part.vertices, part.faces, process=False) for part in placed.shape.parts]
        return Placed(placed.region_id, shape_of(*meshes), placed.T_world_shape.copy())

    things, moved, kept = table_and(block()), np.eye(4), {}
    moved[2, 3] = 1e-6

    def pixels(placed: Sequence[Placed], scene_id: int = 5) -> object:
        return Truth(scene_of(placed, scene_id=scene_id), kept).pixels(camera_above())

    first = pixels(things)
    assert pixels(tuple(map(copy, things))) is first
    others = ((things[0], thing(3, block(), moved)), table_and(block(0.201)), things[:1], table_and(block(), block()))
    assert not any(pixels(other) is first for other in others) and pixels(things, scene_id=6) is not first


def test_a_made_scene_has_the_errors_that_its_units_and_pixels_leave():
    """99 of 100 of errors that rounding spreads evenly are within 99 % of half a unit. Pixels twice as wide, and nothing
    else changed, have twice the error between them."""
    fine, scene = made()
    kept: dict = {}
    truth = Truth(scene, kept)
    errors = measure_images(fine, scene, truth)
    assert errors["depth_mm"] == pytest.approx(0.99 * 0.1, abs=0.004)
    assert errors["mask_share"] < 0.01
    coarse, rough = made(images={"depth_units_per_m": 500.0, "patch": SMALL["images"]["patch"]})
    again = measure_images(coarse, rough, Truth(rough, kept))
    assert again["depth_mm"] == pytest.approx(0.99, abs=0.04) and again["between_mm"] > errors["between_mm"]
    k = {"width": 320, "height": 240, "fx": 262.5, "fy": 262.5, "cx": 160.0, "cy": 120.0}
    large, larger = made(cameras={"sensor": k})
    twice = measure_images(large, larger, Truth(larger, kept))
    assert errors["between_mm"] / twice["between_mm"] == pytest.approx(2.0, rel=0.25)
    assert abs(errors["mirror_mm"] - twice["mirror_mm"]) < errors["mirror_mm"]
    camera = scene.pairs[0].mirror.camera
    depth_m, region, _ = cast_view(scene.posed.things, camera)
    pixels = truth.pixels(camera)
    for rays in (pixels.box, pixels.spread):
        assert np.array_equal(rays.region, rays.of(region))
        assert rays.depth_m == pytest.approx(rays.of(depth_m), abs=1e-9)
    assert np.count_nonzero(pixels.box.region >= 3) == np.count_nonzero(region >= 3) > 50


# ---------------------------------------------------------------------------------------------- errors of colour

HERE = truths.importlib.util.find_spec("mitsuba") is not None
traced = pytest.mark.skipif(not HERE, reason="Mitsuba is not installed: truth of colour goes untested")


def plain(color, shape=(60, 80)):
    return np.broadcast_to(np.array(color, np.uint8), (*shape, 3))


def noise(scale, seed=3):
    rng = np.random.default_rng(seed)
    return np.clip(128 + scale * rng.standard_normal((60, 80, 3)), 0, 255).astype(np.uint8)


def test_flip_is_0_for_an_image_against_itself_almost_1_for_black_against_white_and_grows_with_noise():
    black, grey, white = (plain((value, value, value)) for value in (0, 128, 255))
    assert flip_between(noise(40), noise(40).copy()) == 0.0 and 0.96 < flip_between(black, white) < 1.0
    assert flip_between(black, grey) == pytest.approx(flip_between(grey, black)) and flip_between(black, grey) > 0.4
    errors = [flip_between(grey, noise(scale)) for scale in (0.0, 2.0, 5.0, 10.0, 20.0, 40.0)]
    assert errors[0] == 0.0 and all(a < 0.8 * b for a, b in itertools.pairwise(errors))


def test_images_of_two_sizes_or_of_another_kind_are_refused_and_end_no_process():
    image = noise(10)
    for other in (image[:-1], image[..., :2], image[..., 0], image.astype(np.float32)):
        for pair in ((image, other), (other, image)):
            with pytest.raises(ValueError, match="uint8 of one size"):
                flip_between(*pair)


def test_points_are_where_the_crop_of_the_image_has_them():
    # 80 pixels wide: a margin of 24, inside the image alone.
    assert crop_about((0.0, 0.5, 0.125, 0.5 + 20 / 480)) == Crop(0, 240 - 24, 80 + 24, 260 + 24)
    k = Intrinsics(width=320, height=360, fx=300.0, fy=280.0, cx=150.0, cy=190.0)
    camera = Camera(k, frozen_array(look_at(np.array([1.0, 1.5, 2.0]), np.zeros(3))))
    cropped = crop_camera(camera, Crop(200, 100, 400, 300))
    points = transform(invert(camera.T_world_cam), np.random.default_rng(1).uniform(-0.2, 0.2, (30, 3)))
    (u, v), (across, down) = project(points, k), project(points, cropped.intrinsics)
    assert across == pytest.approx(u * 640 / 320 - 200) and down == pytest.approx(v * 480 / 360 - 100)
    assert (cropped.intrinsics.width, cropped.intrinsics.height) == (200, 200)


def test_images_of_all_sizes_are_cropped_to_the_same_part_of_the_picture():
    """In the crop red rises evenly across and green down, by 2 and 6 for each of its pixels."""
    across, down = np.arange(100, 180) + 0.5, np.arange(60, 90) + 0.5
    for size in ((480, 640), (240, 320), (960, 1280), (720, 960)):
        v, u = ((np.arange(n) + 0.5) * full / n for n, full in zip(size, (480, 640), strict=True))
        image = np.zeros((*size, 3), np.uint8)
        image[..., 0] = np.rint(np.clip(2 * (u - 80), 0, 255))
        image[..., 1] = np.rint(np.clip(6 * (v - 54), 0, 255))[:, None]
        cut = crop_colour(image, Crop(100, 60, 180, 90)).astype(float)
        assert cut.shape == (30, 80, 3)
        assert np.abs(cut[..., 0] - 2 * (across - 80)).max() <= 1.0
        assert np.abs(cut[..., 1] - 6 * (down - 54)[:, None]).max() <= 1.0


def scene_with(**changes):
    context = context_of(validate_job(merged(SMALL, changes), "a test"))
    scene = make_scene(context, 0, Stopwatch())
    return context, scene, crop_about(cast_patch(scene.posed.things, scene.pairs[0].input.camera).box)


@pytest.mark.minute
@traced
def test_no_setting_of_the_image_decides_its_truth_whose_noise_is_far_below_what_is_measured(monkeypatch):
    """Noise falls by the root of the paths, or nearly: 4 times as many leave at most 0.75 of it."""
    own = scene_with()
    settings = (
        {"render": {"tier": "flat"}},
        {"render": {"rgb": False}},
        {"render": {"samples": 4, "path_samples": 1, "path_bounces": 2}, "sensor": {"exposure": {"stops": [1, 1]}}},
    )
    alike = [converged_colour(*made, 4) for made in (own, *(scene_with(**changes) for changes in settings))]
    assert len({truth.tobytes() for truth in alike}) == 1
    errors, by_seed = [], []
    for paths in (9, 36):
        for seed in (1, 2):
            monkeypatch.setattr(truths, "TRUTH_SEED", seed)
            by_seed.append(converged_colour(*own, paths))
        errors.append(flip_between(by_seed[-2], by_seed[-1]))
    assert 0.0 < errors[1] < 0.75 * errors[0]
    tiers = [scene_with(render={"tier": tier})[1].pairs[0].input.rgb for tier in ("pathtraced", "raster", "flat")]
    by_tier = [flip_between(by_seed[-1], crop_colour(rgb, own[2])) for rgb in tiers]
    assert by_tier == sorted(by_tier) and by_tier[1] > 4 * errors[1]


@pytest.mark.minute
def test_four_samples_are_nearer_to_smooth_edges_than_one_and_flat_light_has_no_edges_to_compare(monkeypatch):
    monkeypatch.setattr(images, "colour_truth_missing", lambda: "not here")
    context = context_of(validate_job({"name": "t", "seed": 2024, "check": {"raycast_share": 0.0}}, "a test"))
    settings, _ = settings_of(context.job, {"colour": knobs_of(context.job)["colour"]})
    settings = [each for each in settings if each.name in ("the job", "colour=raster-4", "colour=flat")]
    for scene_id in (0, 2):
        errors = {name: each["errors"] for name, each in measure_colour(context, settings, scene_id).items()}
        assert errors["colour=raster-4"]["edge_flip"] < 0.8 * errors["the job"]["edge_flip"] < 0.1
        assert errors["colour=flat"] == {}


def test_where_mitsuba_is_missing_the_message_has_the_remedy(monkeypatch):
    assert (colour_truth_missing() is None) == HERE
    monkeypatch.setattr(truths.importlib.util, "find_spec", lambda name: None)
    assert "`./verso extra pathtraced`" in str(colour_truth_missing())
