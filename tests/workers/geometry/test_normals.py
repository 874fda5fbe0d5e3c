"""Directions and smoothness of surfaces in depth images of planes."""

import numpy as np
import pytest

from schemas.scene.view import Camera, Intrinsics
from tests.workers.labels.planes import HERE, plane_view
from tests.workers.labels.planes import K as PLANE_K
from workers.geometry.camera import unproject
from workers.geometry.pixels import facing_cosine, is_smooth

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


def test_border_pixels_and_images_without_an_inner_pixel_are_not_smooth():
    assert not any(is_smooth(plane(), ONE, row, column, 1.0, 1.0) for row, column in ((0, 0), (0, 11), (9, 11)))
    flat, ones = np.ones((2, 9)), np.ones((2, 9), np.uint8)
    assert not any(is_smooth(flat, ones, row, column, 1.0, 1.0) for row in range(2) for column in range(9))


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
