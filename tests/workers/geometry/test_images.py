"""Loops over pixels, colours and projections between two views, against numpy, planes and plain definitions; lenses against
OpenCV, which puts pixel centres on integers.
"""

import math

import cv2
import numpy as np
import pytest

from schemas.job.views import Distortion
from schemas.scene.view import Camera, Intrinsics
from tests.kit.planes import HERE as PLANE_HERE
from tests.kit.planes import IMAGES, plane_view
from tests.kit.planes import THERE as PLANE_THERE
from tests.workers.geometry.made_up_kinect import COLOR, COLOR_LENS, DEPTH, DEPTH_LENS, opencv_rays, smaller
from workers.geometry.camera import orbit_pose, project, unproject
from workers.geometry.colour import decode_codes, encode_codes, encode_srgb
from workers.geometry.frames import invert, pose, transform, uniform_rotation
from workers.geometry.pixels import (
    WIDEST,
    count_filled,
    distort,
    facing_cosine,
    fill_plane_depth,
    is_smooth,
    measure_regions,
    opencv_lens,
    opencv_matrix,
    pixel_rays,
    project_points,
    round_depth,
    undistort,
    usable_radius,
)
from workers.geometry.projection import (
    BLOCK,
    Bounds,
    Seen,
    bound_view,
    columns_in_sight,
    compare_covisible,
    forward_project,
    sample_inverse_depth,
)
from workers.scene.cameras import mirror_pose


def rays(k: Intrinsics) -> np.ndarray:
    """[H, W, 3] rays of z 1 through the centres of pixels."""
    v, u = np.mgrid[0 : k.height, 0 : k.width] + 0.5
    return np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], axis=2)


def test_every_region_is_counted_and_boxed():
    """Also where eight pixels make a word."""
    for width in (70, 72):
        region = np.random.default_rng(1).integers(0, 6, (50, width)).astype(np.uint8)
        region[:, 40:] = 2
        region[20, 40:] = 3
        region[4:9, 3:30] = 255
        region[30] = 4
        region[31, 8:], region[31, :8] = 5, 4
        region[32, :-1], region[32, -1] = 1, 0
        extents = measure_regions(region)
        assert len(extents) == 256
        for region_id, (pixels, box) in enumerate(extents):
            rows, columns = np.nonzero(region == region_id)
            assert pixels == len(rows)
            where = columns.min(initial=999), rows.min(initial=999), np.ptp(columns) + 1 if pixels else 0
            assert box == ((*where, np.ptp(rows) + 1) if pixels else (0, 0, 0, 0))


def test_depth_is_rounded_to_the_nearest_unit_and_is_zero_outside_the_open_range():
    for dtype in (np.float32, np.float64):
        depth = np.array([[0.0, 0.2, 0.2001, 1.00005, 1.0003, 7.9999, 8.0, np.nan, np.inf, -1.0]], dtype)
        exact = depth.astype(np.float64)
        expected = np.where((exact > 0.2) & (exact < 8.0), np.rint(exact * 5000.0), 0.0)
        assert round_depth(depth, 0.2, 8.0, 5000.0).tolist() == expected.astype(int).tolist()
        halves = np.array([[0.5, 1.5, 2.5]], dtype)
        assert round_depth(halves, 0.0, 9.0, 1.0).tolist() == [[0, 2, 2]], "ties go to even"


def test_every_code_comes_back_and_light_between_two_codes_goes_to_the_nearest():
    codes = np.arange(256, dtype=np.uint8)
    assert (encode_codes(decode_codes(codes)) == codes).all()
    light = np.random.default_rng(0).uniform(-0.1, 1.1, 2000)
    assert (encode_codes(light) == np.rint(255.0 * encode_srgb(light))).all()


def test_counts_are_those_of_the_definition_in_whole_units_and_in_parts_of_them():
    projected, seen = np.random.default_rng(3).integers(0, 200, (2, 37, 53)).astype(np.uint16)
    projected[5, 5:9], seen[5, 5:9] = (65535, 51, 50, 101), (65535, 1, 0, 50)
    drawn, shown = projected.astype(float), seen.astype(float)
    for behind in (0, 50, 50.0, 50.5):
        expected = (drawn > 0).sum(), ((drawn > 0) & (shown > 0) & (drawn > shown + behind)).sum()
        assert count_filled(projected, seen, behind) == expected


def test_depth_of_a_plane_is_where_the_ray_of_each_of_its_pixels_meets_it():
    rng, k = np.random.default_rng(11), Intrinsics(width=70, height=48, fx=60.5, fy=61.25, cx=34.5, cy=25.0)
    for _ in range(20):
        normal = np.array([*rng.uniform(-0.4, 0.4, 2), 1.0])
        plane = np.append(normal / np.linalg.norm(normal), rng.uniform(0.5, 3.0)).astype(np.float32)
        region = rng.integers(0, 4, (k.height, k.width)).astype(np.uint8)
        before = rng.uniform(0.5, 3.0, region.shape).astype(np.float32)
        depth = before.copy()
        fill_plane_depth(depth, region, 1, plane, k)
        np.testing.assert_array_equal(depth[region != 1], before[region != 1])
        met = float(plane[3]) / (rays(k) @ plane[:3].astype(float))
        np.testing.assert_allclose(depth[region == 1], met[region == 1], rtol=2e-6)


# ---------------------------------------------------------------------------------------------- surfaces

K = Intrinsics(width=12, height=10, fx=20.0, fy=21.0, cx=6.0, cy=5.0)
NORMAL = np.array([0.2, -0.3, -1.0]) / np.linalg.norm([0.2, -0.3, -1.0])
PLANE = 2.0 * NORMAL[2] / (rays(K) @ NORMAL)
"""[H, W] depth of the plane through (0, 0, 2) with the normal."""
ONE = np.ones((10, 12), np.uint8)


def facing(depth, region=ONE, at=(5 * 12 + 6,), units=1.0):
    return facing_cosine(depth, region, np.array(at), Camera(K, np.eye(4)), np.zeros(3), units)


def test_the_cosine_is_that_of_the_planes_normal_and_nan_beside_a_hole_or_another_region():
    found = facing(PLANE, at=range(ONE.size)).reshape(10, 12)
    expected = -(rays(K) @ NORMAL) / np.linalg.norm(rays(K), axis=2)
    assert found[1:-1, 1:-1] == pytest.approx(expected[1:-1, 1:-1], abs=1e-9)
    assert np.isnan(found[[0, -1]]).all() and np.isnan(found[:, [0, -1]]).all()
    assert facing(1000.0 * PLANE, units=1000.0) == pytest.approx(facing(PLANE), abs=1e-12)
    hole, other = PLANE.copy(), ONE.copy()
    hole[5, 7], other[4, 6] = 0.0, 2
    assert np.isnan(facing(hole)).all() and np.isnan(facing(PLANE, other)).all()
    view = plane_view("input", PLANE_HERE)
    depth, every, eye = view.depth / 5000, np.arange(view.depth.size), PLANE_HERE.position
    above, below = (
        facing_cosine(depth, view.region, every, PLANE_HERE, at)
        for at in (eye + np.array([0, 0, 3.0]), np.array([0.3, 0.2, -2.0]))
    )
    assert np.nanmin(above) > 0.3 and np.nanmax(below) < 0, "it faces the side that it is seen from"


def test_a_plane_is_smooth_and_a_step_is_not():
    assert is_smooth(PLANE, ONE, 5, 6, 1e-9, 1.0)
    step = PLANE.copy()
    step[5, 7:] += 0.01
    assert not is_smooth(step, ONE, 5, 6, 5e-3, 1.0)
    assert is_smooth(step, ONE, 5, 6, 2e-2, 1.0)


# ---------------------------------------------------------------------------------------------- two views

HEIGHT, WIDTH, FOCAL_PX = BLOCK[0], 5 * BLOCK[1] + 7, 90.0
WIDE = Intrinsics(width=WIDTH, height=HEIGHT, fx=FOCAL_PX, fy=FOCAL_PX, cx=WIDTH / 2, cy=HEIGHT / 2)
RAY_X, RAY_Y = rays(WIDE)[0, :, 0].copy(), rays(WIDE)[:, 0, 1].copy()
TARGET = Intrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=31.0, cy=23.0)


def in_sight(depth: np.ndarray, units: float, T: np.ndarray, reach: int) -> tuple[int, int]:
    k = TARGET
    return columns_in_sight(
        depth, units, RAY_X, RAY_Y, bound_view(T, (k.cx, k.cy, k.fx, k.fy), reach, (k.height, k.width))
    )


def columns_seen(depth_m: np.ndarray, T: np.ndarray, reach: int) -> np.ndarray:
    """Columns with a point in the target's image, which is wider by `reach` pixels on each side."""
    points = transform(T, (rays(WIDE) * depth_m[..., None]).reshape(-1, 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = project(points, TARGET)
    inside = (u >= -reach) & (u < TARGET.width + reach) & (v >= -reach) & (v < TARGET.height + reach)
    return np.flatnonzero(((inside & (points[:, 2] > 0)).reshape(depth_m.shape) & (depth_m > 0)).any(axis=0))


def test_every_column_that_is_seen_is_in_sight_and_few_others():
    for reach in (0, 2):
        rng, seen_blocks, blocks_in_sight = np.random.default_rng(1), 0, 0
        for _ in range(300):
            depth = rng.integers(9000, 11000, (HEIGHT, WIDTH)).astype(np.uint16)
            depth[rng.random(depth.shape) < 0.05] = 0
            T = pose(uniform_rotation(rng), rng.normal(scale=2.0, size=3))
            (start, stop), seen = in_sight(depth, 5000.0, T, reach), columns_seen(depth / 5000.0, T, reach)
            assert len(seen) == 0 or start <= seen[0] <= seen[-1] < stop
            seen_blocks += len(np.unique(seen // BLOCK[1]))
            blocks_in_sight += -(-(stop - start) // BLOCK[1])
        assert 100 < seen_blocks <= blocks_in_sight < 2 * seen_blocks


def test_a_pixel_that_is_nan_hides_no_other_one():
    depth = np.zeros((HEIGHT, WIDTH))
    depth[3, WIDTH // 2], depth[0], depth[5] = 2.0, np.nan, np.nan
    start, stop = in_sight(depth, 1.0, np.eye(4), 0)
    assert start <= WIDTH // 2 < stop <= start + BLOCK[1]


SMALL = Intrinsics(width=40, height=30, fx=33.0, fy=33.0, cx=20.0, cy=15.0)
HERE = Camera(SMALL, orbit_pose(np.zeros(3), 0.8, 0.3, 2.5))
THERE = Camera(SMALL, mirror_pose(HERE.T_world_cam, 2.3))


def plain_projection(depth: np.ndarray, splat: int) -> tuple[np.ndarray, np.ndarray]:
    """The definition, pixel by pixel."""
    out, source, k = np.zeros(depth.shape), np.full(depth.shape, -1), SMALL
    T = invert(THERE.T_world_cam) @ HERE.T_world_cam
    for i, j in np.argwhere(depth > 0).tolist():
        x, y, z, _ = T @ [(j + 0.5 - k.cx) / k.fx * depth[i, j], (i + 0.5 - k.cy) / k.fy * depth[i, j], depth[i, j], 1]
        if z <= 0:
            continue
        u, v = math.floor(k.fx * x / z + k.cx), math.floor(k.fy * y / z + k.cy)
        for row in range(max(v - splat // 2, 0), min(v + splat // 2 + 1, k.height)):
            for column in range(max(u - splat // 2, 0), min(u + splat // 2 + 1, k.width)):
                if source[row, column] < 0 or z < out[row, column]:
                    out[row, column], source[row, column] = z, i * k.width + j
    return out, source


def test_forward_projection_is_its_definition():
    depth = np.random.default_rng(4).uniform(1.5, 3.0, (30, 40))
    depth[::7] = 0.0
    for splat in (1, 3, 5):
        expected, source = plain_projection(depth, splat)
        projected = forward_project(depth, HERE, THERE, splat)
        assert (source >= 0).sum() > 50
        assert np.array_equal(projected.source, source)
        assert projected.depth_m == pytest.approx(expected, abs=1e-12)


def test_interpolation_in_inverse_depth_is_exact_on_a_plane():
    normal = np.array([0.3, 0.5, -0.8])
    depth, ids = -1.6 / (rays(SMALL) @ normal), np.full((30, 40), 3, np.uint8)
    at = np.random.default_rng(6).uniform([1, 1], [39, 29], (100, 2))
    z, region = zip(*(sample_inverse_depth(depth, ids, u, v, 1.0) for u, v in at), strict=True)
    exact = -1.6 / (unproject(at[:, 1] - 0.5, at[:, 0] - 0.5, np.ones(100), SMALL) @ normal)
    assert set(region) == {3}
    assert z == pytest.approx(exact, rel=1e-12)


BOUNDS = Bounds(facing=0.1, smooth_m=(0.002, 0.001), hidden_m=0.01)


def seen(camera, height_m=0.0, region=3):
    view = plane_view("input", camera, height_m, region)
    return Seen(view.depth, view.region, camera)


def compare(source, target, bounds=BOUNDS):
    return compare_covisible(source, target, np.arange(source.depth.size), bounds, IMAGES.depth_units_per_m)


def test_a_difference_is_along_the_targets_axis_and_as_large_as_the_planes_are_apart():
    """Along an axis that meets the planes at an angle they are further apart than along their normal."""
    near, far = (np.median(compare(seen(PLANE_HERE), seen(PLANE_THERE, height_m=-m))[0]) for m in (0.002, 0.004))
    assert near > 0.002
    assert far == pytest.approx(2.0 * near, rel=0.05)


def test_nothing_else_is_compared():
    here, there = seen(PLANE_HERE), seen(PLANE_THERE)
    for why, source, target, bounds in (
        ("another region", here, seen(PLANE_THERE, region=4), BOUNDS),
        ("hidden", here, seen(PLANE_THERE, height_m=0.1), BOUNDS),
        ("turned away", here, there, BOUNDS._replace(facing=1.0)),
        ("rough source", here, there, BOUNDS._replace(smooth_m=(0.0, 0.001))),
        ("rough target", here, there, BOUNDS._replace(smooth_m=(0.002, 0.0))),
        ("no depth", here._replace(depth=np.zeros_like(here.depth)), there, BOUNDS),
    ):
        difference_m, region = compare(source, target, bounds)
        assert len(difference_m) == len(region) == 0, why


# ---------------------------------------------------------------------------------------------- lenses

PAIRS = [(smaller(COLOR, 0.1), COLOR_LENS), (smaller(DEPTH, 0.2), DEPTH_LENS)]
VGA = Intrinsics(width=640, height=480, fx=525.0, fy=520.0, cx=322.0, cy=239.0)


def test_points_are_drawn_where_opencv_draws_them_and_rays_lead_back():
    for k, lens in PAIRS:
        points = np.random.default_rng(1).uniform([-0.5, -0.4, 0.9], [0.5, 0.4, 2.0], (500, 3))
        theirs, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), opencv_matrix(k), np.asarray(lens))
        assert project_points(points, k, lens) - 0.5 == pytest.approx(theirs[:, 0], abs=1e-9)
        rays = pixel_rays(k, lens)
        assert rays == pytest.approx(opencv_rays(k, lens)[:, :, :2], abs=1e-9)
        u, v = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
        at = project_points(np.column_stack([rays.reshape(-1, 2), np.ones(u.size)]) * 0.7, k, lens)
        assert at == pytest.approx(np.stack([u.ravel(), v.ravel()], axis=1), abs=1e-8)
    assert opencv_matrix(VGA)[0, 2] == VGA.cx - 0.5


def test_the_lens_of_a_scene_agrees_with_opencv_both_ways():
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(0.5, 639.5, 33), np.linspace(0.5, 479.5, 25)))
    rays = np.stack([(u - VGA.cx) / VGA.fx, (v - VGA.cy) / VGA.fy, np.ones_like(u)], axis=1)
    for lens in (
        Distortion(k1=-0.25, k2=0.06, p1=0.001, p2=-0.002, k3=0.01),
        Distortion(k1=0.1, k2=-0.2, p1=0.001, p2=0.0005, k3=0.1),
        Distortion(p1=0.01),
        Distortion(p2=0.01),
        Distortion(k1=0.5),
    ):
        theirs, _ = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), opencv_matrix(VGA), opencv_lens(lens))
        assert np.stack(distort(u, v, lens, VGA), axis=1) - 0.5 == pytest.approx(theirs[:, 0], abs=1e-9)
        straight = undistort(u, v, lens, VGA)
        assert np.stack(distort(*straight, lens, VGA)) == pytest.approx(np.stack([u, v]), abs=1e-6)


def test_a_lens_is_used_up_to_its_fold_and_no_farther():
    lens = np.array([-0.3, 0, 0, 0, 0, 0, 0, 0])  # r (1 - 0.3 r2) rises up to r = 1 / sqrt(0.9)
    assert usable_radius(lens) == pytest.approx(1 / np.sqrt(0.9), abs=2e-3) and usable_radius(np.zeros(8)) == WIDEST
    inside, beyond, behind, within = project_points(
        np.array([[1.0, 0, 1.0], [1.2, 0, 1.0], [0, 0, -1.0], [0, 0, 0.0]]), VGA, lens
    )
    assert np.isfinite(inside).all() and np.isnan([beyond, behind, within]).all()


def test_pixels_that_the_lens_does_not_reach_have_no_ray_wherever_they_lie():
    """r (1 - r^2) is at most 0.385: farther out nothing is drawn, and the axis's other side is none of a pixel's rays."""
    folding = Distortion(k1=-1.0)
    v, u = np.mgrid[0 : VGA.height : 7, 0 : VGA.width : 7] + 0.5
    radius = np.hypot((u - VGA.cx) / VGA.fx, (v - VGA.cy) / VGA.fy)
    x, y = undistort(u, v, folding, VGA)
    assert np.isnan(x[radius > 0.386]).all() and np.isfinite(x[radius < 0.383]).all()
    found = radius < 0.383
    assert ((x - VGA.cx) * (u - VGA.cx) >= 0)[found].all() and ((y - VGA.cy) * (v - VGA.cy) >= 0)[found].all()
    rays = pixel_rays(smaller(DEPTH, 0.2), np.array([-0.6, 0, 0, 0, 0, 0, 0, 0]))
    assert np.isnan(rays[0, 0]).all() and np.isfinite(rays[68, 64]).all()
