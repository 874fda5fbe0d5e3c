"""Errors of labels: made-up stored images of scenes whose views have a closed form, off by what is known."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from schemas.base import Range, frozen_array
from schemas.job.images import Images
from schemas.scene.appearance import Appearance
from schemas.scene.camera import Camera, Intrinsics
from schemas.scene.scene import Placed, PosedScene
from schemas.scene.view import Agreement, Pair, View
from services.job.read import validate_job
from services.study.measure.image_errors import measure_images
from services.study.measure.truth import Truth, truth_of
from tests.effects.scenes import SMALL, context_of, merged
from tests.shapes import box, shape_of
from workers.cameras.mirror import mirror_pose
from workers.geometry.camera import look_at
from workers.geometry.frames import rotation_about
from workers.geometry.raycast import cast_view
from workers.pipeline.make_scene import Stopwatch, make_scene

UNITS = 5000.0
WIDTH, HEIGHT, F = 160, 120, 500.0
TOP_Z, TABLE_Z = 1.8, 2.0
ABOVE = np.array([0.0, 0.0, 2.0])
DARK = Appearance((0.0, 0.0, 0.0), (), (0.0, 0.0, 0.0))


def camera_above(width=WIDTH, height=HEIGHT, f=F) -> Camera:
    """Two metres above the table at z = 0, looking straight down: image x is the world's x, image y its -y."""
    k = Intrinsics(width=width, height=height, fx=f, fy=f, cx=width / 2, cy=height / 2)
    return Camera(k, frozen_array(look_at(ABOVE, np.zeros(3))))


def thing(region_id, mesh, T=None) -> Placed:
    return Placed(region_id, shape_of(mesh), frozen_array(np.eye(4) if T is None else T))


def table_and(*meshes) -> tuple[Placed, ...]:
    """A table that fills the image, its top at z = 0, and objects."""
    return (thing(2, box(4, 4, 0.02, (0, 0, -0.01))), *(thing(3 + i, mesh) for i, mesh in enumerate(meshes)))


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


def view(role, camera, depth_m, region) -> View:
    return View(role, 0, 0, camera, None, np.rint(depth_m * UNITS).astype(np.uint16), region, ())


def scene_of(things, *pairs, scene_id=5):
    plan = SimpleNamespace(scene_id=scene_id)
    return SimpleNamespace(plan=plan, posed=PosedScene(things, DARK), pairs=pairs)


def measure(things, *pairs, truth=None, units=UNITS):
    scene = scene_of(things, *pairs)
    context = SimpleNamespace(
        job=SimpleNamespace(images=Images(depth_units_per_m=units, depth_range_m=Range(0.2, 2.1)))
    )
    return measure_images(context, scene, truth or Truth(scene))


def pair_of(first, mirror=None, d_z_m=TOP_Z, aligned=None, projected=None, agreement=None) -> Pair:
    return Pair(d_z_m, first, aligned, mirror, projected, agreement, agreement)


@pytest.fixture(scope="module")
def seen():
    return seen_of_block(camera_above())


# ---------------------------------------------------------------------------------------------- depth and masks


def test_views_that_are_as_the_formulas_say_have_no_error(seen):
    camera = camera_above()
    first = view("input", camera, *seen)
    mirror, projected = view("mirror", camera, *seen), view("projected", camera, seen[0], None)
    found = measure(
        table_and(block()), pair_of(first, mirror, projected=projected, agreement=Agreement(0.0, 1, 900, 0))
    )
    assert found.pop("outline_share") < 0.02  # the one that pixels bound: the outline runs through pixels
    assert found == pytest.approx(dict.fromkeys(found, 0.0), abs=1e-4)
    names = "depth_mm table_depth_mm mask_share between_mm mirror_mm agreement_mm unfilled_share hidden_share"
    assert set(found) == set(names.split())


def test_depth_off_by_seven_units_is_off_by_1_4_mm(seen):
    depth_m, region = seen
    first = view("input", camera_above(), depth_m + np.where(region == 3, 7 / UNITS, 0.0), region)
    found = measure(table_and(block()), pair_of(first))
    assert found["depth_mm"] == pytest.approx(1.4, abs=1e-3)
    assert found["between_mm"] == pytest.approx(1.4, abs=1e-3)
    assert found["table_depth_mm"] == pytest.approx(0.0, abs=1e-3)


def test_the_table_s_depth_is_told_apart_from_the_object_s(seen):
    depth_m, region = seen
    first = view("input", camera_above(), depth_m - np.where(region == 2, 11 / UNITS, 0.0), region)
    found = measure(table_and(block()), pair_of(first))
    assert found["depth_mm"] == pytest.approx(0.0, abs=1e-3)
    assert found["table_depth_mm"] == pytest.approx(2.2, abs=1e-3)


def test_the_coarser_unit_of_stored_depth_is_in_the_error():
    """1.8 m in units of 1/7 m is 12.6 and is stored as 13; the table's 14 is exact."""
    camera = camera_above()
    depth_m, region = seen_of_block(camera)
    first = View("input", 0, 0, camera, None, np.rint(depth_m * 7).astype(np.uint16), region, ())
    found = measure(table_and(block()), pair_of(first), units=7.0)
    assert found["depth_mm"] == pytest.approx((13 / 7 - 1.8) * 1e3)
    assert found["table_depth_mm"] == pytest.approx(0.0, abs=1e-6)


def test_depth_that_one_pixel_in_fifty_has_wrong_counts_and_one_in_two_hundred_does_not(seen):
    depth_m, region = seen
    rows, columns = np.nonzero(region == 3)
    for every, expected in ((50, 100.0), (200, 0.0)):
        wrong = depth_m.copy()
        wrong[rows[::every], columns[::every]] += 0.1
        found = measure(table_and(block()), pair_of(view("input", camera_above(), wrong, region)))
        assert found["depth_mm"] == pytest.approx(expected, abs=1e-3)


def test_pixels_without_depth_are_not_in_the_error_of_depth(seen):
    depth_m, region = (image.copy() for image in seen)
    depth_m[np.arange(HEIGHT) % 3 > 0] = 0.0
    found = measure(table_and(block()), pair_of(view("input", camera_above(), depth_m, region)))
    assert max(found["depth_mm"], found["table_depth_mm"], found["between_mm"]) == pytest.approx(0.0, abs=1e-3)


def test_a_mask_one_column_off_differs_by_two_columns_of_the_object_s(seen):
    depth_m, region = seen
    columns = np.count_nonzero(region == 3) / np.count_nonzero((region == 3).any(axis=1))
    moved = np.roll(region, 1, axis=1)
    found = measure(table_and(block()), pair_of(view("input", camera_above(), depth_m, moved)))
    assert found["mask_share"] == pytest.approx(2 / columns)


def seen_of_two_plates():
    """(things, depth, region): one object of two thin plates 0.2 m above the table, 20 pixels wide, with 40 between."""
    wide, middle = 20 * TOP_Z / F, 30 * TOP_Z / F
    plates = [box(wide, 0.15, 2e-4, (x, 0.0, 0.2 - 1e-4)) for x in (-middle, middle)]
    views = [seen_of_block(camera_above(), wide, 0.15, (x, 0.0)) for x in (-middle, middle)]
    depth_m, region = np.minimum(views[0][0], views[1][0]), np.maximum(views[0][1], views[1][1])
    return table_and(trimesh.util.concatenate(plates)), depth_m, region


def test_mask_pixels_between_an_object_s_parts_are_wrong():
    things, depth_m, region = seen_of_two_plates()
    assert measure(things, pair_of(view("input", camera_above(), depth_m, region)))["mask_share"] == 0.0
    filled = region.copy()
    filled[(region == 3).any(axis=1), 60:100] = 3
    found = measure(things, pair_of(view("input", camera_above(), depth_m, filled)))
    assert found["mask_share"] == pytest.approx(40 / 40)


def test_between_pixels_only_the_object_s_depth_counts():
    things, depth_m, region = seen_of_two_plates()
    off = depth_m + np.where(region == 2, 0.05, 0.0)
    found = measure(things, pair_of(view("input", camera_above(), off, region)))
    assert found["between_mm"] == pytest.approx(0.0, abs=1e-3)
    assert found["table_depth_mm"] == pytest.approx(50.0, abs=1e-3)


def test_mask_pixels_far_from_the_object_count_too(seen):
    depth_m, region = seen[0], seen[1].copy()
    region[:4, :5] = 3
    found = measure(table_and(block()), pair_of(view("input", camera_above(), depth_m, region)))
    assert found["mask_share"] == pytest.approx(20 / np.count_nonzero(seen[1] == 3))


def test_pixels_of_another_object_are_wrong(seen):
    depth_m, region = seen[0], seen[1].copy()
    mine = np.argwhere(region == 3)
    region[tuple(mine[:100].T)] = 4
    found = measure(table_and(block()), pair_of(view("input", camera_above(), depth_m, region)))
    assert found["mask_share"] == pytest.approx(100 / len(mine))


def test_pixels_of_all_views_and_pairs_count_together(seen):
    depth_m, region = seen
    right, wrong = view("input", camera_above(), *seen), region.copy()
    wrong[region == 3] = 2
    mirror = view("mirror", camera_above(), depth_m, wrong)
    aligned = view("aligned", camera_above(), depth_m, wrong)
    things = table_and(block())
    assert measure(things, pair_of(right, mirror))["mask_share"] == pytest.approx(1 / 2)
    assert measure(things, pair_of(right, aligned=aligned))["mask_share"] == pytest.approx(1 / 2)
    assert measure(things, pair_of(right, mirror), pair_of(right))["mask_share"] == pytest.approx(1 / 3)


# ---------------------------------------------------------------------------------------------- between pixels


@pytest.mark.parametrize(("scale", "share"), [(1, 0.25), (2, 0.125)])
def test_between_pixels_of_a_slanted_face_depth_is_off_by_its_slope(scale, share):
    """A face turned by 30 degrees about the image's y axis; at the axis dz/du = tan(30) z / f, and the nearest pixel is a
    quarter of a pixel away in the median. The face is small, so that the slope is the same everywhere to 3 %."""
    camera = camera_above(WIDTH * scale, HEIGHT * scale, F * scale)
    k, angle = camera.intrinsics, np.pi / 6
    plate = trimesh.creation.box((0.12, 0.12, 0.002), rotation_4x4(np.array([0.0, 1.0, 0.0]), angle))
    plate.apply_translation((0.0, 0.0, 0.2))
    normal = np.array([np.sin(angle), 0.0, -np.cos(angle)])  # in the camera's frame, towards it
    on_face = np.array([0.0, 0.0, 1.8]) + 0.001 * normal
    u = (np.arange(k.width) + 0.5 - k.cx) / k.fx
    z = np.broadcast_to((normal @ on_face) / (normal[0] * u + normal[2]), (k.height, k.width))
    region = np.full(z.shape, 3, np.uint8)
    first = View("input", 0, 0, camera, None, np.rint(z * 30_000).astype(np.uint16), region, ())
    found = measure(table_and(plate), pair_of(first), units=30_000.0)
    expected_mm = share * np.tan(angle) * 1.8 / F * 1e3
    assert found["between_mm"] == pytest.approx(expected_mm, rel=0.06)


def rotation_4x4(axis, angle):
    T = np.eye(4)
    T[:3, :3] = rotation_about(axis, angle)
    return T


def test_rays_by_a_straight_outline_are_wrong_by_the_strip_that_no_pixel_s_centre_is_in():
    """A top from 52.2 to 107.8 across: pixels 52 to 107 have their centres in it, and no ray of its box crosses another. One
    from 52.6 to 107.4 has 0.4 on each side in pixels whose centres are not in it. Down it is from 39.7 to 80.3, and has 0.3."""
    camera = camera_above()
    for pixels, wrong in ((55.6, 0.0), (54.8, 0.8)):
        x, y = pixels * TOP_Z / F, 40.6 * TOP_Z / F
        first = view("input", camera, *seen_of_block(camera, x, y))
        found = measure(table_and(block(x, y)), pair_of(first))
        expected = 1 - (1 - wrong / pixels) * (1 - 0.6 / 40.6)
        assert found["outline_share"] == pytest.approx(expected, abs=4 * np.sqrt(expected / 4096))


def test_images_of_all_sizes_are_asked_at_the_same_places():
    things = table_and(block())
    truth = Truth(scene_of(things))
    f, scales = 525.3, (0.5, 0.7, 1.1, 1.3, 2.0)
    assert len({f * scale / round(WIDTH * scale) for scale in scales}) > 1, "rounding must not tell them apart"
    for scale in scales:
        camera = camera_above(round(WIDTH * scale), round(HEIGHT * scale), f * scale)
        assert truth.patch(camera, 0) is truth.patch(camera_above(f=f), 0)
    assert truth.patch(camera_above(f=526.0), 0) is not truth.patch(camera_above(f=f), 0)


def test_the_patch_is_the_box_about_what_is_seen_of_the_object():
    """And not about its foot, which the top hides, nor about what another thing hides."""
    half = np.array([0.1, 0.075]) * F / TOP_Z
    patch = Truth(scene_of(table_and(block()))).patch(camera_above(), 0)
    expected = np.array([80 - half[0], 60 - half[1], 80 + half[0], 60 + half[1]])
    assert np.array(patch.box) * (WIDTH, HEIGHT, WIDTH, HEIGHT) == pytest.approx(expected, abs=0.3)
    roof = box(0.4, 0.4, 0.01, (0.2, 0.0, 0.205))  # its near edge is at the axis
    things = (thing(2, trimesh.util.concatenate([box(4, 4, 0.02, (0, 0, -0.01)), roof])), thing(3, block()))
    assert Truth(scene_of(things)).patch(camera_above(), 0).box[2] * WIDTH == pytest.approx(80.0, abs=0.3)


# ---------------------------------------------------------------------------------------------- the mirror pose


def ball(radius=0.1, at=(0.0, 0.0)):
    """Its nearest point to the camera above is a vertex, at 2 m less twice the radius."""
    mesh = trimesh.creation.uv_sphere(radius=radius, count=(64, 64))
    mesh.apply_translation((*at, radius))
    return mesh


def test_d_z_12_mm_behind_a_ball_s_front_sets_the_mirror_camera_12_mm_off(seen):
    first = view("input", camera_above(), *seen)
    found = measure(table_and(ball()), pair_of(first, first, d_z_m=1.8 + 0.012))
    assert found["mirror_mm"] == pytest.approx(12.0, abs=1e-3)
    found = measure(table_and(ball()), pair_of(first, first, d_z_m=1.8 - 0.003))
    assert found["mirror_mm"] == pytest.approx(3.0, abs=1e-3)


def test_the_front_is_a_corner_between_all_rays():
    """A needle's point."""
    needle = trimesh.creation.cone(radius=0.05, height=0.3, sections=7)
    first = view("input", camera_above(), *seen_of_block(camera_above()))
    found = measure(table_and(needle), pair_of(first, first, d_z_m=1.7))
    assert found["mirror_mm"] == pytest.approx(0.0, abs=1e-6)


def test_what_is_outside_the_picture_or_hidden_is_not_the_front():
    """A taller block beside the picture; and a block whose nearest part stands under a wide table."""
    first = view("input", camera_above(), *seen_of_block(camera_above()))
    beyond = box(0.2, 0.2, 0.6, (0.7, 0.0, 0.3))
    both = trimesh.util.concatenate([block(), beyond])
    assert measure(table_and(both), pair_of(first, first, d_z_m=1.8))["mirror_mm"] == pytest.approx(0.0, abs=1e-6)
    roof = box(0.2, 0.4, 0.01, (0.15, 0.0, 0.5))
    under = trimesh.util.concatenate([block(0.05), box(0.05, 0.05, 0.4, (0.15, 0.0, 0.2))])
    things = (thing(2, trimesh.util.concatenate([box(4, 4, 0.02, (0, 0, -0.01)), roof])), thing(3, under))
    assert measure(things, pair_of(first, first, d_z_m=1.8))["mirror_mm"] == pytest.approx(0.0, abs=1e-6)


def test_the_mirror_camera_moves_along_the_input_s_axis_by_what_d_z_is_off():
    T = look_at(np.array([1.2, -0.7, 1.9]), np.zeros(3))
    right, off = mirror_pose(T, 2.0), mirror_pose(T, 2.0125)
    assert off[:3, 3] - right[:3, 3] == pytest.approx(0.0125 * T[:3, 2])
    assert np.array_equal(off[:3, :3], right[:3, :3])


def test_of_several_pairs_the_worst_is_told(seen):
    first = view("input", camera_above(), *seen)
    pairs = [
        pair_of(first, first, d_z_m=TOP_Z + off, agreement=Agreement(median, 1.0, 900, 0.0))
        for off, median in ((0.001, 0.3), (-0.004, 0.2), (0.002, None))
    ]
    found = measure(table_and(block()), *pairs)
    assert found["mirror_mm"] == pytest.approx(4.0, abs=1e-3)
    assert found["agreement_mm"] == 0.3


# ---------------------------------------------------------------------------------------------- the projection


def test_pixels_that_the_projection_leaves_empty_are_counted_on_the_object_alone(seen):
    depth_m, region = seen
    mine = np.argwhere(region == 3)
    depth = np.where(region == 3, depth_m, 0.0)
    depth[tuple(mine[::3].T)] = 0.0
    first = view("input", camera_above(), *seen)
    projected = view("projected", camera_above(), depth, None)
    found = measure(table_and(block()), pair_of(first, first, projected=projected))
    assert found["unfilled_share"] == pytest.approx(len(mine[::3]) / len(mine))


def oblique_views():
    """A camera on each side of a block, both 45 degrees up; each sees its top and one side. (things, input, mirror, whether
    the mirror's ray meets the top, by formula)."""
    k = Intrinsics(width=WIDTH, height=HEIGHT, fx=300.0, fy=300.0, cx=80.0, cy=60.0)
    left, right = (
        Camera(k, frozen_array(look_at(np.array([x, 0.0, 1.1]), np.array([0.0, 0.0, 0.1])))) for x in (-1, 1)
    )
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], axis=-1) @ right.T_world_cam[:3, :3].T
    z = (0.2 - right.position[2]) / rays[..., 2]
    at = right.position + z[..., None] * rays
    return table_and(block()), left, right, (np.abs(at[..., 0]) < 0.1) & (np.abs(at[..., 1]) < 0.075)


def test_only_what_both_cameras_see_has_to_be_filled():
    things, left, right, top = oblique_views()
    empty = np.zeros((HEIGHT, WIDTH))
    region = np.full(empty.shape, 2, np.uint8)
    first, mirror = view("input", left, empty, region), view("mirror", right, empty, region)
    for filled, expected in ((top, 0.0), (~top, 1.0)):
        projected = view("projected", right, np.where(filled, 1.3, 0.0), None)
        found = measure(things, pair_of(first, mirror, projected=projected))
        assert found["unfilled_share"] == pytest.approx(expected, abs=2 / np.count_nonzero(top))


def test_a_projected_pixel_behind_the_surface_is_hidden_and_one_before_it_is_not(seen):
    _, region = seen
    drawn = np.where(region == 3, TABLE_Z, 0.0)  # the table, where the block hides it
    drawn[:5] = 1.0  # before the table
    drawn[5:7] = TABLE_Z + 0.004
    drawn[7:8] = TABLE_Z + 0.006
    first = view("input", camera_above(), *seen)
    found = measure(table_and(block()), pair_of(first, first, projected=view("projected", camera_above(), drawn, None)))
    block_pixels = np.count_nonzero(region == 3)
    assert found["hidden_share"] == pytest.approx((block_pixels + WIDTH) / (block_pixels + 8 * WIDTH))


def test_a_sample_of_a_large_image_tells_what_is_hidden_in_all_of_it():
    """Filled in a pattern of every second column, as a projection fills; every second of these is hidden."""
    camera = camera_above(640, 480, 2000.0)
    drawn = np.zeros((480, 640))
    drawn[:, ::4], drawn[:, 2::4] = TABLE_Z, TABLE_Z + 0.1
    first = view("input", camera, np.full(drawn.shape, TABLE_Z), np.full(drawn.shape, 2, np.uint8))
    found = measure(
        table_and(block(0.01, 0.01)), pair_of(first, first, projected=view("projected", camera, drawn, None))
    )
    assert found["hidden_share"] == pytest.approx(1 / 2, abs=4 * np.sqrt(0.25 / 9600))


# ---------------------------------------------------------------------------------------------- what is missing; the cache


def test_what_has_no_meaning_is_left_out():
    """No mirror view, no projection; and an object that nobody sees."""
    camera = camera_above()
    first = view("input", camera, *seen_of_block(camera))
    assert set(measure(table_and(block()), pair_of(first))) == {
        "depth_mm", "table_depth_mm", "mask_share", "between_mm", "outline_share"
    }  # fmt: skip
    nothing = view("input", camera, np.full((HEIGHT, WIDTH), TABLE_Z), np.full((HEIGHT, WIDTH), 2, np.uint8))
    away = table_and(block(at=(1.5, 0.0)))
    found = measure(
        away, pair_of(nothing, nothing, projected=view("projected", camera, np.zeros((HEIGHT, WIDTH)), None))
    )
    assert found == {"table_depth_mm": pytest.approx(0.0, abs=1e-6)}
    no_agreement = pair_of(first, first, agreement=Agreement(None, None, 3, None))
    assert "agreement_mm" not in measure(table_and(block()), no_agreement)


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


# ---------------------------------------------------------------------------------------------- scenes as they are made


def made(**changes):
    context = context_of(validate_job(merged(SMALL, changes), "a test"))
    return context, make_scene(context, 0, Stopwatch())


def test_a_made_scene_has_the_errors_that_its_units_and_pixels_leave():
    """99 of 100 of errors that rounding spreads evenly are within 99 % of half a unit. Pixels twice as wide, and nothing
    else changed, have twice the error between them, in as many more places along the outline."""
    fine, scene = made()
    truth = truth_of(scene)
    found = measure_images(fine, scene, truth)
    assert found["depth_mm"] == pytest.approx(0.99 * 0.1, abs=0.004)
    assert found["table_depth_mm"] == pytest.approx(0.99 * 0.1, abs=0.002)
    assert found["mask_share"] < 0.01
    coarse, rough = made(images={"depth_units_per_m": 500.0, "patch": SMALL["images"]["patch"]})
    again = measure_images(coarse, rough, truth_of(rough, truth))
    assert again["depth_mm"] == pytest.approx(0.99, abs=0.04)
    assert again["outline_share"] == found["outline_share"]
    k = {"width": 320, "height": 240, "fx": 262.5, "fy": 262.5, "cx": 160.0, "cy": 120.0}
    large, larger = made(cameras={"sensor": k})
    twice = measure_images(large, larger, truth_of(larger, truth))
    assert found["between_mm"] / twice["between_mm"] == pytest.approx(2.0, rel=0.25)
    assert found["outline_share"] / twice["outline_share"] == pytest.approx(2.0, rel=0.3)
    assert abs(found["mirror_mm"] - twice["mirror_mm"]) < found["mirror_mm"]


def test_rays_through_pixels_are_those_of_the_ray_caster_s_own_view():
    _, scene = made()
    camera = scene.pairs[0].mirror.camera
    depth_m, region, _ = cast_view(scene.posed.things, camera)
    pixels = truth_of(scene).pixels(camera)
    for seen in (pixels.box, pixels.spread):
        assert np.array_equal(seen.region, seen.of(region)) and seen.depth_m == pytest.approx(
            seen.of(depth_m), abs=1e-9
        )
    objects = np.count_nonzero(region >= 3)
    assert np.count_nonzero(pixels.box.region >= 3) == objects > 50
