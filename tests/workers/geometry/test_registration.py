"""Registered depth against planes and spheres whose depth in the colour camera is known exactly."""

import dataclasses

import numpy as np
import pytest

from schemas.base import frozen_array
from tests.workers.geometry.made_up_kinect import (
    CAMERA,
    COLOR,
    COLOR_LENS,
    DEPTH,
    DEPTH_LENS,
    T_COLOR_DEPTH,
    opencv_rays,
    plane_depth,
    plane_in_depth_camera,
    smaller,
    sphere_depth,
)
from workers.geometry.frames import pose, rotation_about
from workers.geometry.rational_lens import project_points
from workers.geometry.zbuffer import register_depth

SMALL_COLOR = smaller(COLOR, 0.25)
SMALL = dataclasses.replace(CAMERA, intrinsics=smaller(DEPTH, 0.25))
DEPTH_RAYS = opencv_rays(SMALL.intrinsics, DEPTH_LENS)
PLANE_MM = 0.2
"""The lens of the colour image is taken as straight over a triangle; its error falls with the square of the resolution."""


def unit(x: float, y: float, z: float) -> np.ndarray:
    return np.array([x, y, z]) / np.linalg.norm([x, y, z])


@pytest.mark.parametrize("lens", [COLOR_LENS, None], ids=["stored with its lens", "pinhole"])
@pytest.mark.parametrize("normal", [unit(0, 0, 1), unit(0.5, -0.3, 1), unit(0, 1.5, 1)])
def test_a_plane_stays_the_plane(normal, lens):
    depth = plane_depth(DEPTH_RAYS, *plane_in_depth_camera(T_COLOR_DEPTH, normal, 0.7))
    seen = register_depth(depth, SMALL, SMALL_COLOR, lens)
    true = plane_depth(opencv_rays(SMALL_COLOR, np.zeros(8) if lens is None else lens), normal, 0.7)
    filled = seen > 0
    assert np.abs(seen - true)[filled].max() * 1e3 < PLANE_MM
    assert filled.mean() > 0.4
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    middle = filled[rows[0] + 30 : rows[-1] - 29, columns[0] + 40 : columns[-1] - 39]
    assert middle.all(), "no holes and no cracks"


def test_a_plane_at_full_size_is_within_a_hundredth_of_a_millimetre():
    normal = unit(0.5, -0.3, 1)
    depth = plane_depth(opencv_rays(DEPTH, DEPTH_LENS), *plane_in_depth_camera(T_COLOR_DEPTH, normal, 0.7))
    seen = register_depth(depth, CAMERA, COLOR, COLOR_LENS)
    filled = seen > 0
    true = plane_depth(opencv_rays(COLOR, COLOR_LENS), normal, 0.7)
    assert filled.mean() > 0.4
    assert np.abs(seen - true)[filled].max() * 1e3 < 0.01


@pytest.mark.parametrize("seed", range(3))
def test_a_sphere_before_a_wall_hides_it(seed):
    """The nearest wins; what neither camera's edge touches is exact to the sag of a triangle."""
    rng = np.random.default_rng(seed)
    centre, radius = rng.uniform([-0.1, -0.1, 0.6], [0.1, 0.1, 0.8]), 0.12
    wall = unit(0.1, 0.1, 1)
    R, t = T_COLOR_DEPTH[:3, :3], T_COLOR_DEPTH[:3, 3]
    near = sphere_depth(DEPTH_RAYS, R.T @ (centre - t), radius)
    far = plane_depth(DEPTH_RAYS, *plane_in_depth_camera(T_COLOR_DEPTH, wall, 1.2))
    seen = register_depth(np.where(near > 0, near, far), SMALL, SMALL_COLOR, COLOR_LENS)
    rays = opencv_rays(SMALL_COLOR, COLOR_LENS)
    ball, plane = sphere_depth(rays, centre, radius), plane_depth(rays, wall, 1.2)
    points = ball[:, :, None] * rays
    core = ball > 0
    for camera_at in (np.zeros(3), t):  # both cameras see it at less than 60 degrees
        to_camera = camera_at - points
        core &= ((points - centre) * to_camera).sum(axis=2) > 0.5 * radius * np.linalg.norm(to_camera, axis=2)
    u, v = np.moveaxis(
        project_points((points.reshape(-1, 3) - t) @ R, SMALL.intrinsics, DEPTH_LENS).reshape(*ball.shape, 2), 2, 0
    )
    core &= (abs(u - 80) < 79) & (abs(v - 72) < 71)
    assert core.sum() > 1000
    sag_mm = (
        (0.8 / SMALL.intrinsics.fx / 0.5) ** 2 / (4 * radius) / 0.5 * 1e3
    )  # a diagonal's square over 8 r, over the slant
    assert np.abs(seen - ball)[core].max() * 1e3 < sag_mm
    filled = seen > 0
    wrong = filled & (np.abs(seen - ball) > 0.01) & (np.abs(seen - plane) > 1e-5)
    assert wrong.sum() < 0.02 * (ball > 0).sum(), "nothing floats between the sphere and the wall"


def test_the_wall_behind_does_not_shine_through():
    """A near square, moved by the parallax over the wall, hides it although the wall is drawn later."""
    k = SMALL.intrinsics
    camera = dataclasses.replace(
        SMALL, lens=np.zeros(8), T_color_depth=frozen_array(pose(np.eye(3), np.array([0.1, 0.0, 0.0])))
    )
    depth = np.full((k.height, k.width), 2.0)
    depth[40:100, 40:80] = 0.5
    seen = register_depth(depth, camera, k)
    shift = 0.1 * k.fx * (1 / 0.5 - 1 / 2.0)
    left = round(40 + 0.1 * k.fx / 0.5)
    assert seen[50:90, left + 2 : left + 37] == pytest.approx(0.5, abs=1e-9)
    assert (seen[50:90, left + 2 - round(shift) + 1 : left - 2] != 0.5).all()


def test_a_square_across_an_edge_is_left_out_and_a_steep_plane_is_not():
    k = SMALL.intrinsics
    camera = dataclasses.replace(SMALL, lens=np.zeros(8), T_color_depth=frozen_array(np.eye(4)))
    depth = np.full((k.height, k.width), 0.7)
    depth[:, 80:] = 0.8
    turned = pose(np.eye(3), np.array([-0.05, 0.0, 0.0]))
    seen = register_depth(depth, dataclasses.replace(camera, T_color_depth=frozen_array(turned)), k)
    assert np.unique(seen[seen > 0].round(9)).tolist() == [0.7, 0.8]
    slanted = rotation_about(np.array([0.0, 1.0, 0.0]), np.radians(80)) @ np.array([0.0, 0.0, 1.0])
    rays = opencv_rays(k, np.zeros(8))
    steep = plane_depth(rays, slanted, 0.12)
    assert (register_depth(steep, camera, k)[:, 80:] > 0).mean() > 0.95


def test_the_same_camera_gives_the_same_image():
    k = SMALL.intrinsics
    camera = dataclasses.replace(SMALL, lens=np.zeros(8), T_color_depth=frozen_array(np.eye(4)))
    depth = np.random.default_rng(3).uniform(0.70, 0.71, (k.height, k.width))
    assert register_depth(depth, camera, k) == pytest.approx(depth, abs=1e-9)


@pytest.mark.parametrize("nothing", [0.0, np.nan, np.inf, -1.0])
def test_what_is_no_depth_makes_a_hole_and_no_number(nothing):
    k = SMALL.intrinsics
    camera = dataclasses.replace(SMALL, lens=np.zeros(8), T_color_depth=frozen_array(np.eye(4)))
    depth = np.full((k.height, k.width), 0.7)
    depth[70, 60] = nothing
    seen = register_depth(depth, camera, k)
    assert np.isfinite(seen).all()
    assert (seen == 0).sum() == 1 and seen[70, 60] == 0


def test_no_depth_at_all_is_an_empty_image():
    assert not register_depth(np.zeros((144, 160)), SMALL, SMALL_COLOR).any()


def test_another_size_is_refused():
    with pytest.raises(ValueError, match="depth image"):
        register_depth(np.zeros((144, 161)), SMALL, SMALL_COLOR)
