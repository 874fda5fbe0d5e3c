"""The pinhole camera, against OpenCV and arithmetic."""

import math

import cv2
import numpy as np
import pytest

from schemas.scene.view import Intrinsics
from workers.geometry.camera import (
    image_coordinates,
    inclination,
    look_at,
    orbit_pose,
    project,
    project_bounds,
    unproject,
    yaw,
)
from workers.geometry.frames import translation

K = Intrinsics(width=640, height=480, fx=525.0, fy=520.0, cx=320.0, cy=240.0)


def test_projection_agrees_with_opencv_in_its_own_convention():
    points = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 3], (50, 3))
    matrix = np.array([[K.fx, 0, K.cx_opencv], [0, K.fy, K.cy_opencv], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, None)
    u, v = project(points, K)
    # OpenCV's pixel (i, j) is centred on (i, j); ours on (i + 0.5, j + 0.5).
    assert np.stack([u, v], axis=1) - 0.5 == pytest.approx(expected[:, 0], abs=1e-9)


def test_unprojecting_a_pixel_and_projecting_it_again_lands_on_its_centre():
    rows, columns = np.array([0, 17, 479]), np.array([0, 333, 639])
    u, v = project(unproject(rows, columns, np.array([0.5, 2.0, 7.0]), K), K)
    assert u == pytest.approx(columns + 0.5)
    assert v == pytest.approx(rows + 0.5)


@pytest.mark.parametrize("angle", [-math.pi, -2.0, 0.0, 1.0, math.pi])
def test_orbit_camera_looks_at_its_centre_at_its_inclination_and_yaw_without_roll(angle):
    centre = np.array([0.1, -0.2, 0.7])
    T = orbit_pose(centre, 0.8, angle, 2.5)
    assert T[:3, 3] + 2.5 * T[:3, 2] == pytest.approx(centre, abs=1e-12)
    assert inclination(T) == pytest.approx(0.8, abs=1e-12)
    assert math.cos(yaw(T) - angle) == pytest.approx(1.0, abs=1e-12)
    assert T[2, 0] == pytest.approx(0.0, abs=1e-12)  # the image's x axis is level
    assert T[2, 1] < 0  # and its y axis points down


def test_a_camera_straight_above_has_a_pose():
    T = look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3))
    assert T[:3, :3].T @ T[:3, :3] == pytest.approx(np.eye(3), abs=1e-12)
    assert inclination(T) == pytest.approx(math.pi / 2)


def test_image_coordinates_are_whole_pixels_and_minus_one_outside_and_behind():
    assert image_coordinates(translation(0.0, 0.0, 1.0), K) == (320, 240)
    assert image_coordinates(translation(-320.0 / 525.0 + 1e-6, 0.0, 1.0), K) == (0, 240)
    assert image_coordinates(translation(-320.0 / 525.0 - 1e-6, 0.0, 1.0), K) == (-1, -1)
    assert image_coordinates(translation(0.0, 0.0, -1.0), K) == (-1, -1)


def test_projected_bounds_reach_beyond_the_image_and_are_the_images_where_a_point_is_too_near():
    points = np.array([(0.0, 0.0, 1.0), (-1.0, 0.5, 1.0), (0.1, -0.2, 2.0)])
    assert project_bounds(points, K, 0.05) == pytest.approx((320.0 - 525.0, 240.0 - 52.0, 320.0 + 26.25, 240.0 + 260.0))
    assert project_bounds(np.array([(0.0, 0.0, 1.0), (0.0, 0.0, 0.05)]), K, 0.05) == (0.0, 0.0, 640.0, 480.0)
