"""Rigid transforms, against scipy's rotations.

The pinhole camera, against OpenCV and arithmetic. Clouds outside all images are found, and no point inside an image
is ever called outside.
"""

import math

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from schemas.scene.view import Camera, Intrinsics
from workers.geometry.camera import (
    inclination,
    is_outside_views,
    orbit_pose,
    project,
    project_bounds,
    spread_evenly,
    unproject,
    yaw,
)
from workers.geometry.frames import (
    half_turn,
    invert,
    pose,
    rotation_about,
    rotation_between,
    rotation_from_quaternion,
    transform,
    uniform_rotation,
)


def random_unit(rng: np.random.Generator) -> np.ndarray:
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


@pytest.mark.parametrize("seed", range(5))
def test_turns_agree_with_scipy(seed):
    rng = np.random.default_rng(seed)
    axis, angle = random_unit(rng), rng.uniform(-3, 3)
    assert rotation_about(axis, angle) == pytest.approx(Rotation.from_rotvec(angle * axis).as_matrix(), abs=1e-12)
    assert half_turn(axis) == pytest.approx(Rotation.from_rotvec(np.pi * axis).as_matrix(), abs=1e-12)
    q = rng.standard_normal(4)
    assert rotation_from_quaternion(q) == pytest.approx(Rotation.from_quat(q).as_matrix(), abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_the_turn_between_two_directions_takes_one_to_the_other_by_the_smallest_angle(seed):
    rng = np.random.default_rng(seed)
    a, b = random_unit(rng), random_unit(rng)
    R = rotation_between(a, b)
    assert R @ a == pytest.approx(b, abs=1e-12)
    assert Rotation.from_matrix(R).magnitude() == pytest.approx(np.arccos(a @ b), abs=1e-7)


def test_an_inverse_undoes_its_transform():
    rng = np.random.default_rng(1)
    T = pose(uniform_rotation(rng), rng.standard_normal(3))
    points = rng.standard_normal((20, 3))
    assert transform(invert(T), transform(T, points)) == pytest.approx(points, abs=1e-14)
    assert transform(T, points) == pytest.approx((T @ np.c_[points, np.ones(20)].T).T[:, :3], abs=1e-14)


def test_uniform_rotations_have_no_favourite_direction():
    rng = np.random.default_rng(2)
    images = np.stack([uniform_rotation(rng)[:, 0] for _ in range(4000)])
    # Each coordinate of a uniform direction is uniform on [-1, 1]: mean 0, variance 1/3, four standard errors.
    assert np.abs(images.mean(axis=0)).max() < 4 / np.sqrt(3 * 4000)
    assert images.var(axis=0) == pytest.approx(1 / 3, abs=4 * np.sqrt(4 / 45 / 4000))


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


def test_projected_bounds_reach_beyond_the_image_and_are_the_images_where_a_point_is_too_near():
    points = np.array([(0.0, 0.0, 1.0), (-1.0, 0.5, 1.0), (0.1, -0.2, 2.0)])
    assert project_bounds(points, K, 0.05) == pytest.approx((320.0 - 525.0, 240.0 - 52.0, 320.0 + 26.25, 240.0 + 260.0))
    assert project_bounds(np.array([(0.0, 0.0, 1.0), (0.0, 0.0, 0.05)]), K, 0.05) == (0.0, 0.0, 640.0, 480.0)


NARROW = Intrinsics(width=64, height=48, fx=60.0, fy=55.0, cx=30.0, cy=26.0)


def test_no_camera_on_the_way_sees_a_point_of_what_is_outside():
    rng = np.random.default_rng(4)
    outside = 0
    for _ in range(3_000):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = uniform_rotation(rng), rng.normal(size=3)
        ahead = T.copy()
        ahead[:3, 3] += rng.normal() * T[:3, 2]
        points = rng.normal(size=3) * 2.0 + rng.uniform(0.01, 1.0) * rng.normal(size=(6, 3))
        if not is_outside_views(points, [Camera(NARROW, T), Camera(NARROW, ahead)]):
            continue
        outside += 1
        inner = rng.dirichlet(np.ones(6), 50) @ points
        for share in (0.0, 0.3, 0.7, 1.0):
            between = T.copy()
            between[:3, 3] = (1.0 - share) * T[:3, 3] + share * ahead[:3, 3]
            seen = transform(invert(between), np.concatenate([points, inner]))
            u, v = project(seen[seen[:, 2] > 0.0], NARROW)
            assert not ((u > 0.0) & (u < NARROW.width) & (v > 0.0) & (v < NARROW.height)).any()
    assert outside > 1_000


def test_of_many_views_the_first_the_last_and_others_evenly_between_are_chosen():
    assert [spread_evenly(count, 4).tolist() for count in (0, 2, 10)] == [[], [0, 1], [0, 3, 6, 9]]
    for most, count in ((2, 7), (3, 100), (40, 199)):
        gaps = np.diff(spread_evenly(count, most))
        assert len(gaps) == most - 1 and gaps.min() > 0 and np.ptp(gaps) <= 1
