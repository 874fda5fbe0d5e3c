"""Forward projection against a plain loop; interpolation against planes."""

import math

import numpy as np
import pytest

from schemas.scene.view import Camera, Intrinsics
from workers.geometry.camera import orbit_pose, unproject
from workers.geometry.frames import invert
from workers.geometry.projection import forward_project, sample_inverse_depth
from workers.scene.pairs import mirror_pose

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


def test_of_points_at_one_depth_the_first_source_pixel_wins():
    K1 = Intrinsics(width=4, height=2, fx=1.0, fy=1.0, cx=2.0, cy=1.0)
    camera = Camera(K1, np.eye(4))
    wide = Camera(Intrinsics(width=1, height=1, fx=0.01, fy=0.01, cx=0.5, cy=0.5), np.eye(4))
    assert forward_project(np.ones((2, 4)), camera, wide).source[0, 0] == 0


def test_projection_into_the_same_camera_changes_nothing():
    depth = np.random.default_rng(5).uniform(1, 3, (30, 40))
    depth[3, 4] = 0
    same = forward_project(depth, HERE, HERE)
    assert same.depth_m == pytest.approx(depth, abs=1e-12)
    assert same.source[3, 4] == -1
    assert np.array_equal(same.source[depth > 0], np.flatnonzero(depth))


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


def test_nothing_is_interpolated_across_regions_holes_or_the_border():
    depth, region = np.ones((4, 4)), np.full((4, 4), 2, np.uint8)
    region[0, 0], depth[3, 3] = 3, 0.0
    found = [sample_inverse_depth(depth, region, *at, 1.0) for at in ((1.0, 1.0), (3.0, 3.0), (0.2, 2.0), (2.0, 2.0))]
    assert found == [(0.0, 0), (0.0, 0), (0.0, 0), (1.0, 2)]
