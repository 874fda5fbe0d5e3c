"""Compiled loops over pixels, against numpy.

Stored depth against its definition: units to the nearest, 0 outside the stored range. Directions and smoothness of
surfaces in depth images of planes. sRGB against the values of IEC 61966-2-1, and codes against decimals. Textures
with holes and without.
"""

import numpy as np
import pytest

from schemas.scene.view import Camera, Intrinsics
from tests.kit.planes import HERE, plane_view
from tests.kit.planes import K as PLANE_K
from workers.geometry.camera import unproject
from workers.geometry.colour import SRGB_STEPS, decode_codes, encode_codes, encode_srgb
from workers.geometry.pixels import (
    count_filled,
    facing_cosine,
    fill_plane_depth,
    gather_colours,
    is_smooth,
    measure_regions,
    round_depth,
)


@pytest.mark.parametrize("width", [70, 72])
def test_every_region_is_counted_and_boxed(width):
    """Also where eight pixels make a word."""
    rng = np.random.default_rng(1)
    region = rng.integers(0, 6, (50, width)).astype(np.uint8)
    region[:, 40:] = 2
    region[20, 40:] = 3
    region[4:9, 3:30] = 255
    region[30] = 4
    region[31, 8:], region[31, :8] = 5, 4
    region[32, :-1], region[32, -1] = 1, 0
    extents = measure_regions(region)
    assert len(extents) == 256
    for region_id, (pixels, (x, y, width, height)) in enumerate(extents):
        rows, columns = np.nonzero(region == region_id)
        assert pixels == len(rows)
        if pixels:
            assert (x, y) == (columns.min(), rows.min())
            assert (x + width, y + height) == (columns.max() + 1, rows.max() + 1)
        else:
            assert (x, y, width, height) == (0, 0, 0, 0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_depth_is_rounded_to_the_nearest_unit_and_is_zero_outside_the_open_range(dtype):
    depth = np.array([[0.0, 0.2, 0.2001, 1.00005, 1.0003, 7.9999, 8.0, np.nan, np.inf, -1.0]], dtype)
    exact = depth.astype(np.float64)
    expected = np.where((exact > 0.2) & (exact < 8.0), np.rint(exact * 5000.0), 0.0)
    assert round_depth(depth, 0.2, 8.0, 5000.0).tolist() == expected.astype(int).tolist()
    halves = np.array([[0.5, 1.5, 2.5]], dtype)
    assert round_depth(halves, 0.0, 9.0, 1.0).tolist() == [[0, 2, 2]], "ties go to even"


def test_colours_come_from_where_the_source_says_and_holes_are_black():
    rgb = np.random.default_rng(2).integers(0, 256, (4, 5, 3)).astype(np.uint8)
    source = np.array([[19, -1], [0, 7]])
    assert gather_colours(rgb, source).tolist() == [
        [rgb[3, 4].tolist(), [0, 0, 0]],
        [rgb[0, 0].tolist(), rgb[1, 2].tolist()],
    ]


@pytest.mark.parametrize("behind", [0, 50, 50.0, 50.5])
def test_counts_are_those_of_the_definition_in_whole_units_and_in_parts_of_them(behind):
    rng = np.random.default_rng(3)
    projected, seen = rng.integers(0, 200, (2, 37, 53)).astype(np.uint16)
    projected[5, 5:9], seen[5, 5:9] = (65535, 51, 50, 101), (65535, 1, 0, 50)
    drawn, shown = projected.astype(float), seen.astype(float)
    expected = (drawn > 0).sum(), ((drawn > 0) & (shown > 0) & (drawn > shown + behind)).sum()
    assert count_filled(projected, seen, behind) == expected


def test_depth_of_a_plane_is_where_the_ray_of_each_of_its_pixels_meets_it():
    rng, k = np.random.default_rng(11), Intrinsics(width=70, height=48, fx=60.5, fy=61.25, cx=34.5, cy=25.0)
    x, y = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    rays = np.stack([(x - k.cx) / k.fx, (y - k.cy) / k.fy, np.ones_like(x)], -1)
    for _ in range(20):
        normal = np.array([*rng.uniform(-0.4, 0.4, 2), 1.0])
        plane = np.append(normal / np.linalg.norm(normal), rng.uniform(0.5, 3.0)).astype(np.float32)
        region = rng.integers(0, 4, (k.height, k.width)).astype(np.uint8)
        before = rng.uniform(0.5, 3.0, region.shape).astype(np.float32)
        depth = before.copy()
        fill_plane_depth(depth, region, 1, plane, k)
        np.testing.assert_array_equal(depth[region != 1], before[region != 1])
        met = float(plane[3]) / (rays @ plane[:3].astype(float))
        np.testing.assert_allclose(depth[region == 1], met[region == 1], rtol=2e-6)


K = Intrinsics(width=12, height=10, fx=20.0, fy=21.0, cx=6.0, cy=5.0)
CAMERA = Camera(K, np.eye(4))
NORMAL = np.array([0.2, -0.3, -1.0]) / np.linalg.norm([0.2, -0.3, -1.0])
ONE = np.ones((10, 12), np.uint8)
MIDDLE = np.array([5 * 12 + 6])


def rays() -> np.ndarray:
    v, u = np.mgrid[0:10, 0:12] + 0.5
    return np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones_like(u)], axis=2)


def plane() -> np.ndarray:
    """[H, W] depth of the plane through (0, 0, 2) with the normal."""
    return 2.0 * NORMAL[2] / (rays() @ NORMAL)


def test_the_cosine_is_that_of_the_planes_normal():
    everywhere = np.arange(ONE.size)
    found = facing_cosine(plane(), ONE, everywhere, CAMERA, np.zeros(3)).reshape(10, 12)
    expected = -(rays() @ NORMAL) / np.linalg.norm(rays(), axis=2)
    assert found[1:-1, 1:-1] == pytest.approx(expected[1:-1, 1:-1], abs=1e-9)
    assert np.isnan(found[[0, -1]]).all() and np.isnan(found[:, [0, -1]]).all()


def test_units_change_nothing_and_a_hole_or_another_region_beside_a_pixel_does():
    in_units = facing_cosine(1000.0 * plane(), ONE, MIDDLE, CAMERA, np.zeros(3), 1000.0)
    assert in_units == pytest.approx(facing_cosine(plane(), ONE, MIDDLE, CAMERA, np.zeros(3)), abs=1e-12)
    hole, other = plane(), ONE.copy()
    hole[5, 7], other[4, 6] = 0.0, 2
    assert np.isnan(facing_cosine(hole, ONE, MIDDLE, CAMERA, np.zeros(3))).all()
    assert np.isnan(facing_cosine(plane(), other, MIDDLE, CAMERA, np.zeros(3))).all()


def test_a_plane_is_smooth_and_a_step_is_not():
    assert is_smooth(plane(), ONE, 5, 6, 1e-9, 1.0)
    step = plane()
    step[5, 7:] += 0.01
    assert not is_smooth(step, ONE, 5, 6, 5e-3, 1.0)
    assert is_smooth(step, ONE, 5, 6, 2e-2, 1.0)


def test_a_surface_faces_the_side_it_is_seen_from():
    view = plane_view("input", HERE)
    depth = view.depth / 5000
    everywhere = np.arange(depth.size)
    above = facing_cosine(depth, view.region, everywhere, HERE, HERE.position + np.array([0, 0, 3.0])).reshape(120, 160)
    below = facing_cosine(depth, view.region, everywhere, HERE, np.array([0.3, 0.2, -2.0]))
    assert np.nanmin(above) > 0.3
    assert np.nanmax(below) < 0
    rows, columns = 60, 80
    p = (
        HERE.position
        + HERE.T_world_cam[:3, :3]
        @ unproject(np.array([rows]), np.array([columns]), depth[rows : rows + 1, columns], PLANE_K)[0]
    )
    towards = HERE.position + np.array([0, 0, 3.0]) - p
    assert above[rows, columns] == pytest.approx(towards[2] / np.linalg.norm(towards), abs=2e-3)
    assert np.isnan(above[0, 0])


def test_every_code_comes_back_and_light_between_two_codes_goes_to_the_nearest():
    codes = np.arange(256, dtype=np.uint8)
    assert (encode_codes(decode_codes(codes)) == codes).all()
    light = np.random.default_rng(0).uniform(-0.1, 1.1, 2000)
    assert (encode_codes(light) == np.rint(255.0 * encode_srgb(light))).all()
    assert SRGB_STEPS.shape == (256,)
