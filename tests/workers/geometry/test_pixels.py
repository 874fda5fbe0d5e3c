"""Compiled loops over pixels, against numpy."""

import numpy as np
import pytest

from schemas.scene.camera import Intrinsics
from workers.geometry.pixels import (
    Extent,
    count_filled,
    fill_plane_depth,
    gather_colours,
    measure_regions,
    round_depth,
    split_samples,
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


def test_the_box_of_one_pixel_is_one_pixel():
    region = np.zeros((5, 7), np.uint8)
    region[4, 6] = 9
    assert measure_regions(region)[9] == Extent(1, (6, 4, 1, 1))


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


def test_what_is_filled_and_what_lies_behind_is_counted():
    projected = np.array([[0, 10, 20, 65535, 30]], np.uint16)
    seen = np.array([[5, 0, 14, 65500, 30]], np.uint16)
    assert count_filled(projected, seen, 5.5) == (4, 2)


@pytest.mark.parametrize("behind", [0, 50, 50.0, 50.5])
def test_counts_are_those_of_the_definition_in_whole_units_and_in_parts_of_them(behind):
    rng = np.random.default_rng(3)
    projected, seen = rng.integers(0, 200, (2, 37, 53)).astype(np.uint16)
    projected[5, 5:9], seen[5, 5:9] = (65535, 51, 50, 101), (65535, 1, 0, 50)
    drawn, shown = projected.astype(float), seen.astype(float)
    expected = (drawn > 0).sum(), ((drawn > 0) & (shown > 0) & (drawn > shown + behind)).sum()
    assert count_filled(projected, seen, behind) == expected


def test_samples_are_split_into_bytes_with_the_high_one_first():
    pixels = np.array([[0x1234, 0x00FF, 0xFF00], [0, 0xFFFF, 0x0102]], np.uint16)
    assert split_samples(pixels).tolist() == [[0, 0x12, 0x34, 0, 0xFF, 0xFF, 0], [0, 0, 0, 0xFF, 0xFF, 1, 2]]


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
