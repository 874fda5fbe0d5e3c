"""Clouds outside all images are found, and no point inside an image is ever called outside."""

import numpy as np

from schemas.scene.view import Camera, Intrinsics
from workers.geometry.camera import is_outside_views, orbit_pose, project
from workers.geometry.frames import invert, transform, uniform_rotation

K = Intrinsics(width=64, height=48, fx=60.0, fy=55.0, cx=30.0, cy=26.0)
AHEAD = Camera(K, np.eye(4))


def cluster(x: float, y: float, z: float) -> np.ndarray:
    """The corners of a box of 2 cm."""
    return np.array([x, y, z]) + 0.01 * np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T


def test_each_side_of_the_picture_and_what_is_behind():
    assert not is_outside_views(cluster(0.0, 0.0, 1.0), [AHEAD])
    assert not is_outside_views(cluster((64.0 - 30.0) / 60.0, 0.0, 1.0), [AHEAD])
    for u, v in ((-5.0, 24.0), (69.0, 24.0), (32.0, -5.0), (32.0, 53.0)):
        assert is_outside_views(cluster((u - 30.0) / 60.0, (v - 26.0) / 55.0, 1.0), [AHEAD])
    assert is_outside_views(cluster(0.0, 0.0, -1.0), [AHEAD])
    around = np.array([[-9.0, 0.0, 1.0], [9.0, 0.0, 1.0]])  # both ends beyond a side, and the middle in the picture
    assert not is_outside_views(around, [AHEAD])


def test_what_lies_below_cameras_that_look_up_is_outside_however_far_it_reaches():
    k = K.model_copy(update={"cy": 60.0})
    level = [Camera(k, orbit_pose(np.array([0.0, 0.0, 1.0]), 0.0, 0.3, r)) for r in (0.1, 3.0)]
    ground = np.array([[x, y, 0.99] for x in (-9.0, 9.0) for y in (-9.0, 9.0)])
    assert is_outside_views(ground, level)
    assert not is_outside_views(ground + np.array([0.0, 0.0, 0.02]), level)
    assert not is_outside_views(ground, [Camera(K, level[0].T_world_cam)])


def test_no_camera_on_the_way_sees_a_point_of_what_is_outside():
    rng = np.random.default_rng(4)
    outside = 0
    for _ in range(3_000):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = uniform_rotation(rng), rng.normal(size=3)
        ahead = T.copy()
        ahead[:3, 3] += rng.normal() * T[:3, 2]
        points = rng.normal(size=3) * 2.0 + rng.uniform(0.01, 1.0) * rng.normal(size=(6, 3))
        if not is_outside_views(points, [Camera(K, T), Camera(K, ahead)]):
            continue
        outside += 1
        inner = rng.dirichlet(np.ones(6), 50) @ points
        for share in (0.0, 0.3, 0.7, 1.0):
            between = T.copy()
            between[:3, 3] = (1.0 - share) * T[:3, 3] + share * ahead[:3, 3]
            seen = transform(invert(between), np.concatenate([points, inner]))
            u, v = project(seen[seen[:, 2] > 0.0], K)
            assert not ((u > 0.0) & (u < K.width) & (v > 0.0) & (v < K.height)).any()
    assert outside > 1_000
