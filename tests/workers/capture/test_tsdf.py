"""The distance field, held against distances from a plane."""

import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.scene.view import Camera, Intrinsics
from workers.capture.surface.tsdf import BACK_VOXELS, FRONT_VOXELS, empty_volume, fit_depth, integrate, sample_inverse
from workers.geometry.camera import look_at

K = Intrinsics(width=160, height=120, fx=300.0, fy=300.0, cx=80.0, cy=60.0)
VOXEL = 0.002


def board_seen_from(position, height_m=0.0):
    """A camera that looks at the origin, and exact depth of the plane z = height."""
    T = look_at(np.array(position), np.zeros(3))
    rows, columns = np.mgrid[0 : K.height, 0 : K.width]
    rays = np.stack([(columns + 0.5 - K.cx) / K.fx, (rows + 0.5 - K.cy) / K.fy, np.ones(rows.shape)], axis=-1)
    depth = (height_m - T[2, 3]) / (rays @ T[:3, :3].T)[..., 2]
    return Camera(K, frozen_array(T)), depth.astype(np.float32)


def volume_of(*seen):
    volume = empty_volume(np.array([-0.03, -0.03, -0.01]), np.array([0.03, 0.03, 0.03]), VOXEL)
    for camera, depth in seen:
        integrate(volume, fit_depth(depth, K, 80.0), camera)
    return volume


@pytest.mark.parametrize("position", [(0.01, 0, 0.5), (0.4, 0.1, 0.3), (0.0, -0.5, 0.2)])
def test_voxels_hold_the_distance_along_the_normal_at_every_angle(position):
    volume = volume_of(board_seen_from(position))
    z = volume.origin[2] + VOXEL * np.arange(volume.weight.shape[2])
    seen = (z > -0.7 * BACK_VOXELS * VOXEL) & (z < FRONT_VOXELS * VOXEL)
    assert (volume.weight[:, :, seen] > 0).all()
    assert np.abs(volume.distance_m[:, :, seen] - z[seen]).max() < 2e-5
    assert np.allclose(volume.distance_m[:, :, z > FRONT_VOXELS * VOXEL + 1e-4], FRONT_VOXELS * VOXEL)
    assert not volume.weight[:, :, z < -BACK_VOXELS * VOXEL - 1e-4].any()


def test_views_weigh_by_the_inverse_of_the_fourth_power_of_their_distance():
    near, far = board_seen_from((0, 0.001, 0.4), 0.001), board_seen_from((0, 0.001, 0.8), -0.0005)
    volume = volume_of(near, far)
    level = 5  # z = 0
    expected = (16 * (0 - 0.001) + 1 * (0 + 0.0005)) / 17
    assert volume.distance_m[15, 15, level] == pytest.approx(expected, abs=2e-5)


def test_what_no_pixel_sees_has_no_weight():
    camera, depth = board_seen_from((0, 0.001, 0.5))
    depth[:, 80:] = 0.0
    volume = volume_of((camera, depth))
    left = int(np.argmax(volume.weight[:, 15, 8] > 0)) == 0
    half = volume.weight[:10, 15, 8] if left else volume.weight[-10:, 15, 8]
    other = volume.weight[-10:, 15, 8] if left else volume.weight[:10, 15, 8]
    assert (half > 0).all() and not other.any()


def test_samples_are_bilinear_on_a_surface_and_the_nearest_at_its_edge():
    inverse = np.array([[1.0, 1.004], [1.002, 1.006]], np.float32)
    assert sample_inverse(inverse, 0.25, 0.5) == pytest.approx(1.002, abs=1e-6)
    inverse[1, 1] = 0.5
    assert sample_inverse(inverse, 0.25, 0.4) == pytest.approx(1.0)
    inverse[0, 0] = 0.0
    assert sample_inverse(inverse, 0.25, 0.4) == 0.0
    assert sample_inverse(inverse, -0.6, 0.0) == 0.0 and sample_inverse(inverse, 0.0, 1.5) == 0.0
