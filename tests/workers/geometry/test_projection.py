"""Blocks of a depth image in sight of another camera, against the image coordinates of every pixel by numpy.

Forward projection against a plain loop; interpolation against planes. What two cameras both see of planes, and where
one of them does not.
"""

import math

import numpy as np
import pytest

from schemas.scene.view import Camera, Intrinsics
from tests.kit.planes import HERE as PLANE_HERE
from tests.kit.planes import IMAGES, plane_view
from tests.kit.planes import THERE as PLANE_THERE
from workers.geometry.camera import orbit_pose, unproject
from workers.geometry.frames import invert, pose, uniform_rotation
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
from workers.scene.pairs import mirror_pose

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


def test_a_pixel_that_is_nan_hides_no_other_one():
    depth = np.zeros((HEIGHT, WIDTH))
    depth[3, WIDTH // 2], depth[0], depth[5] = 2.0, np.nan, np.nan
    start, stop = columns_in_sight(depth, 1.0, RAY_X, RAY_Y, bound_view(np.eye(4), TARGET, 0, SHAPE))
    assert start <= WIDTH // 2 < stop <= start + BLOCK[1]


K = Intrinsics(width=40, height=30, fx=33.0, fy=33.0, cx=20.0, cy=15.0)
HERE = Camera(K, orbit_pose(np.zeros(3), 0.8, 0.3, 2.5))
THERE = Camera(K, mirror_pose(HERE.T_world_cam, 2.3))


def plain_projection(depth: np.ndarray, splat: int) -> tuple[np.ndarray, np.ndarray]:
    """The definition, pixel by pixel."""
    out, source = np.zeros(depth.shape), np.full(depth.shape, -1)
    T = invert(THERE.T_world_cam) @ HERE.T_world_cam
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            z = depth[i, j]
            if z == 0:
                continue
            p = T @ [(j + 0.5 - K.cx) / K.fx * z, (i + 0.5 - K.cy) / K.fy * z, z, 1]
            if p[2] <= 0:
                continue
            u, v = math.floor(K.fx * p[0] / p[2] + K.cx), math.floor(K.fy * p[1] / p[2] + K.cy)
            for y in range(v - splat // 2, v + splat // 2 + 1):
                for x in range(u - splat // 2, u + splat // 2 + 1):
                    if 0 <= x < K.width and 0 <= y < K.height and (source[y, x] < 0 or p[2] < out[y, x]):
                        out[y, x], source[y, x] = p[2], i * K.width + j
    return out, source


@pytest.mark.parametrize("splat", [1, 3, 5])
def test_forward_projection_is_its_definition(splat):
    depth = np.random.default_rng(4).uniform(1.5, 3.0, (30, 40))
    depth[::7] = 0.0
    expected, source = plain_projection(depth, splat)
    projected = forward_project(depth, HERE, THERE, splat)
    assert (source >= 0).sum() > 50
    assert np.array_equal(projected.source, source)
    assert projected.depth_m == pytest.approx(expected, abs=1e-12)


def test_interpolation_in_inverse_depth_is_exact_on_a_plane():
    rows, columns = np.mgrid[0:30, 0:40]
    rays = unproject(rows.ravel(), columns.ravel(), np.ones(1200), K)
    normal = np.array([0.3, 0.5, -0.8])
    depth = (-1.6 / (rays @ normal)).reshape(30, 40)
    u, v = np.random.default_rng(6).uniform([1, 1], [39, 29], (100, 2)).T
    ids = np.full((30, 40), 3, np.uint8)
    z, region = zip(*(sample_inverse_depth(depth, ids, *at, 1.0) for at in zip(u, v, strict=True)), strict=True)
    exact = -1.6 / (np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(100)], axis=1) @ normal)
    assert set(region) == {3}
    assert z == pytest.approx(exact, rel=1e-12)


BOUNDS = Bounds(facing=0.1, smooth_m=(0.002, 0.001), hidden_m=0.01)
UNITS = IMAGES.depth_units_per_m


def seen(camera, height_m=0.0, region=3):
    view = plane_view("input", camera, height_m, region)
    return Seen(view.depth, view.region, camera)


def compare(source, target, bounds=BOUNDS):
    everywhere = np.arange(source.depth.size)
    return compare_covisible(source, target, everywhere, bounds, UNITS)


def test_a_difference_is_along_the_targets_axis_and_as_large_as_the_planes_are_apart():
    """Along an axis that meets the planes at an angle they are further apart than along their normal."""
    near, far = (np.median(compare(seen(PLANE_HERE), seen(PLANE_THERE, height_m=-m))[0]) for m in (0.002, 0.004))
    assert near > 0.002
    assert far == pytest.approx(2.0 * near, rel=0.05)


@pytest.mark.parametrize(
    ("source", "target", "bounds"),
    [
        (seen(PLANE_HERE), seen(PLANE_THERE, region=4), BOUNDS),
        (seen(PLANE_HERE), seen(PLANE_THERE, height_m=0.1), BOUNDS),
        (seen(PLANE_HERE), seen(PLANE_THERE), BOUNDS._replace(facing=1.0)),
        (seen(PLANE_HERE), seen(PLANE_THERE), BOUNDS._replace(smooth_m=(0.0, 0.001))),
        (seen(PLANE_HERE), seen(PLANE_THERE), BOUNDS._replace(smooth_m=(0.002, 0.0))),
        (seen(PLANE_HERE)._replace(depth=np.zeros_like(seen(PLANE_HERE).depth)), seen(PLANE_THERE), BOUNDS),
    ],
    ids=["another region", "hidden", "turned away", "rough source", "rough target", "no depth"],
)
def test_nothing_else_is_compared(source, target, bounds):
    difference_m, region = compare(source, target, bounds)
    assert len(difference_m) == len(region) == 0
