"""Where the cameras of a pair stand, and what depth becomes when it is stored."""

import numpy as np
import pytest

from schemas.errors import ViewError
from schemas.job.job import Job
from schemas.scene.camera import Camera, Intrinsics
from workers.cameras.pivot_depth import front_distance, object_distance
from workers.cameras.placement import place_aligned_camera, place_mirror_camera
from workers.geometry.camera import orbit_pose
from workers.geometry.stored_depth import dequantise_depth, quantise_depth

JOB = Job(name="t")
CAMERA = Camera(Intrinsics.of(JOB.cameras.sensor), orbit_pose(np.array([0, 0, 0.7]), 0.8, 1.0, 2.5))


def test_depth_is_rounded_to_the_nearest_unit_and_zero_outside_the_range():
    depth = np.array([[0.0, 0.2, 0.2001, 1.00009, 1.00011, 7.9999, 8.0, 9.0]])
    assert quantise_depth(depth, JOB.images).tolist() == [[0, 0, 1000, 5000, 5001, 40000, 0, 0]]
    assert quantise_depth(depth, JOB.images).dtype == np.uint16


def test_stored_depth_is_off_by_at_most_half_a_unit():
    depth = np.random.default_rng(0).uniform(0.3, 7.9, (50, 50))
    assert np.abs(dequantise_depth(quantise_depth(depth, JOB.images), JOB.images) - depth).max() <= 1e-4 + 1e-12


def test_the_depth_camera_stands_off_in_the_rgb_cameras_own_axes():
    aligned = place_aligned_camera(CAMERA, JOB.cameras.depth)
    R = CAMERA.T_world_cam[:3, :3]
    assert R.T @ (aligned.position - CAMERA.position) == pytest.approx([-0.051, 0.001, -0.001])
    assert np.array_equal(aligned.T_world_cam[:3, :3], R)


@pytest.mark.parametrize(("estimator", "expected"), [("percentile", 1.02), ("median", 1.5), ("nearest", 1.0)])
def test_the_front_distance_is_read_from_the_objects_own_depth(estimator, expected):
    depth = np.concatenate([np.linspace(1.0, 2.0, 101), np.full(500, 0.3), [0.0]])[None, :]
    mask = np.zeros(depth.shape, bool)
    mask[0, :101] = mask[0, -1] = True  # the last pixel has no depth and must not count as nearest
    mirror = JOB.cameras.mirror.model_copy(update={"pivot_depth": estimator})
    assert front_distance(depth, mask, mirror) == pytest.approx(expected)


def test_an_object_without_a_depth_pixel_is_a_failure_with_its_reason():
    with pytest.raises(ViewError) as caught:
        front_distance(np.zeros((4, 4)), np.ones((4, 4), bool), JOB.cameras.mirror)
    assert caught.value.reason == "object_not_seen"


@pytest.mark.parametrize("pixels", [1, 2])
def test_one_or_two_pixels_are_enough_for_a_front_distance(pixels):
    depth = np.zeros((4, 4))
    depth[0, :pixels] = [2.0, 2.1][:pixels]
    assert 2.0 <= front_distance(depth, depth > 0, JOB.cameras.mirror) <= 2.1


def test_the_mirror_camera_keeps_the_intrinsics():
    mirror = place_mirror_camera(CAMERA, 2.2, JOB.cameras.mirror)
    assert mirror.intrinsics == CAMERA.intrinsics
    pivot = CAMERA.position + 2.2 * CAMERA.T_world_cam[:3, 2]
    assert np.linalg.norm(mirror.position - pivot) == pytest.approx(1.3)


def test_d_z_is_read_from_all_objects_and_from_whichever_is_seen():
    """The first object is hidden, the second stands at 2 m, the third at 3 m."""
    images = JOB.images.model_copy(update={"depth_units_per_m": 5000.0})
    region = np.full((10, 10), 1, np.uint8)
    region[2:4], region[6:8] = 4, 5
    depth = np.where(region == 4, 10_000, np.where(region == 5, 15_000, 5_000)).astype(np.uint16)
    assert object_distance(depth, region, images, JOB.cameras.mirror) == pytest.approx(2.0)
    region[region == 4] = 2
    assert object_distance(depth, region, images, JOB.cameras.mirror) == pytest.approx(3.0)
    with pytest.raises(ViewError, match="no depth pixel"):
        object_distance(depth, np.minimum(region, 2), images, JOB.cameras.mirror)
