"""Blocks of a depth image in sight of another camera, against the image coordinates of every pixel by numpy."""

import numpy as np
import pytest

from workers.geometry.frames import pose, uniform_rotation
from workers.geometry.projection import BLOCK, bound_view, columns_in_sight

HEIGHT, WIDTH, FOCAL_PX = BLOCK[0], 5 * BLOCK[1] + 7, 90.0
RAY_X, RAY_Y = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL_PX, (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL_PX
TARGET, SHAPE = (31.0, 23.0, 60.0, 60.0), (48, 64)


def columns_seen(depth_m: np.ndarray, T: np.ndarray, reach: int) -> np.ndarray:
    """Columns with a point in the target's image, which is wider by `reach` pixels on each side."""
    points = np.stack([RAY_X * depth_m, RAY_Y[:, None] * depth_m, depth_m], axis=-1) @ T[:3, :3].T + T[:3, 3]
    x, y, z = np.moveaxis(points, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = TARGET[2] * x / z + TARGET[0], TARGET[3] * y / z + TARGET[1]
    inside = (u >= -reach) & (u < SHAPE[1] + reach) & (v >= -reach) & (v < SHAPE[0] + reach)
    return np.flatnonzero((inside & (z > 0) & (depth_m > 0)).any(axis=0))


@pytest.mark.parametrize("reach", [0, 2])
def test_every_column_that_is_seen_is_in_sight_and_few_others(reach):
    rng, units, seen_blocks, blocks_in_sight = np.random.default_rng(1), 5000.0, 0, 0
    for _ in range(300):
        depth = rng.integers(9000, 11000, (HEIGHT, WIDTH)).astype(np.uint16)
        depth[rng.random(depth.shape) < 0.05] = 0
        T = pose(uniform_rotation(rng), rng.normal(scale=2.0, size=3))
        start, stop = columns_in_sight(depth, units, RAY_X, RAY_Y, bound_view(T, TARGET, reach, SHAPE))
        seen = columns_seen(depth / units, T, reach)
        assert len(seen) == 0 or start <= seen[0] <= seen[-1] < stop
        seen_blocks += len(np.unique(seen // BLOCK[1]))
        blocks_in_sight += -(-(stop - start) // BLOCK[1])
    assert 100 < seen_blocks <= blocks_in_sight < 2 * seen_blocks


def test_a_camera_that_is_turned_aside_has_only_the_columns_of_that_side_in_sight():
    angle, depth = 0.8, np.full((HEIGHT, WIDTH), 5000, np.uint16)
    R = np.array([[np.cos(angle), 0.0, -np.sin(angle)], [0.0, 1.0, 0.0], [np.sin(angle), 0.0, np.cos(angle)]])
    T = pose(R, np.zeros(3))
    start, stop = columns_in_sight(depth, 5000.0, RAY_X, RAY_Y, bound_view(T, TARGET, 0, SHAPE))
    seen = columns_seen(depth / 5000.0, T, 0)
    assert start > WIDTH // 2
    assert seen[0] - BLOCK[1] < start <= seen[0] <= seen[-1] < stop < seen[-1] + 1 + BLOCK[1]


def test_nothing_is_in_sight_without_depth_or_behind_the_other_camera():
    ahead, behind = np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0])
    depth = np.full((HEIGHT, WIDTH), 2.0)
    assert columns_in_sight(depth, 1.0, RAY_X, RAY_Y, bound_view(ahead, TARGET, 0, SHAPE)) != (0, 0)
    assert columns_in_sight(depth, 1.0, RAY_X, RAY_Y, bound_view(behind, TARGET, 0, SHAPE)) == (0, 0)
    assert columns_in_sight(0.0 * depth, 1.0, RAY_X, RAY_Y, bound_view(ahead, TARGET, 0, SHAPE)) == (0, 0)


def test_a_pixel_that_is_nan_hides_no_other_one():
    depth = np.zeros((HEIGHT, WIDTH))
    depth[3, WIDTH // 2], depth[0], depth[5] = 2.0, np.nan, np.nan
    start, stop = columns_in_sight(depth, 1.0, RAY_X, RAY_Y, bound_view(np.eye(4), TARGET, 0, SHAPE))
    assert start <= WIDTH // 2 < stop <= start + BLOCK[1]
