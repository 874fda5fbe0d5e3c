"""Where the cameras of a pair stand: the mirror's properties, with roll, to 1e-9; the article's product at zero roll."""

import math

import numpy as np
import pytest

from schemas.errors import ViewError
from schemas.job.job import Job
from schemas.scene.view import Camera, Intrinsics
from workers.geometry.camera import inclination, look_at, orbit_pose
from workers.geometry.frames import half_turn, pose, rotation_about, translation
from workers.scene.pairs import front_distance, mirror_pose, object_distance, place_beside, place_mirror_camera

JOB = Job(name="t")
CAMERA = Camera(Intrinsics.of(JOB.cameras.sensor), orbit_pose(np.array([0, 0, 0.7]), 0.8, 1.0, 2.5))
X_AXIS = np.array([1.0, 0.0, 0.0])
Y_AXIS = np.array([0.0, 1.0, 0.0])


def article_product(T_world_cam: np.ndarray, d_z_m: float, T_z_m: float = 1.3) -> np.ndarray:
    """The article's product of transforms, [4, 4] float64, for a zero-roll camera.

    T_in Trans_z(d_z) Rot_x(phi) Rot_y(pi) Rot_x(-phi) Trans_z(-T_z), with phi the angle of the axis below the
    horizontal.
    """
    phi = inclination(T_world_cam)
    turn = rotation_about(X_AXIS, phi) @ half_turn(Y_AXIS) @ rotation_about(X_AXIS, -phi)
    return T_world_cam @ translation(0, 0, d_z_m) @ pose(turn, np.zeros(3)) @ translation(0, 0, -T_z_m)


def random_camera(seed: int, roll: bool) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = look_at(rng.uniform((-3, -3, 1), (3, 3, 7)), rng.uniform(-0.5, 0.5, 3))
    if roll:
        T = T @ pose(rotation_about(np.array([0.0, 0.0, 1.0]), rng.uniform(-3, 3)), np.zeros(3))
    return T


CASES = [(seed, roll) for seed in range(20) for roll in (False, True)]


@pytest.mark.parametrize(("seed", "roll"), CASES)
def test_mirror_camera_looks_at_the_pivot_from_exactly_T_z(seed, roll):
    T, d_z = random_camera(seed, roll), 0.7 + 0.1 * seed
    mirror = mirror_pose(T, d_z, 1.3)
    pivot = T[:3, 3] + d_z * T[:3, 2]
    assert mirror[:3, 3] + 1.3 * mirror[:3, 2] == pytest.approx(pivot, abs=1e-9)
    assert np.linalg.norm(mirror[:3, 3] - pivot) == pytest.approx(1.3, abs=1e-9)


@pytest.mark.parametrize(("seed", "roll"), CASES)
def test_mirror_camera_is_a_rigid_pose_with_the_same_inclination_and_the_opposite_heading(seed, roll):
    T = random_camera(seed, roll)
    mirror = mirror_pose(T, 2.0)
    assert mirror[:3, :3].T @ mirror[:3, :3] == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(mirror[:3, :3]) == pytest.approx(1.0, abs=1e-9)
    assert inclination(mirror) == pytest.approx(inclination(T), abs=1e-9)
    assert mirror[:2, 2] == pytest.approx(-T[:2, 2], abs=1e-9)


@pytest.mark.parametrize(("seed", "roll"), CASES)
def test_mirror_camera_is_lower_by_the_difference_of_the_distances(seed, roll):
    T, d_z = random_camera(seed, roll), 2.1
    lower = T[2, 3] - mirror_pose(T, d_z, 1.3)[2, 3]
    assert lower == pytest.approx((d_z - 1.3) * math.sin(inclination(T)), abs=1e-9)


@pytest.mark.parametrize(("seed", "roll"), CASES)
def test_the_mirror_of_the_mirror_at_equal_distances_is_the_camera_itself(seed, roll):
    T = random_camera(seed, roll)
    assert mirror_pose(mirror_pose(T, 1.3, 1.3), 1.3, 1.3) == pytest.approx(T, abs=1e-9)


@pytest.mark.parametrize("seed", range(40))
def test_at_zero_roll_the_mirror_pose_is_the_articles_product(seed):
    rng = np.random.default_rng(seed)
    T = orbit_pose(np.array([0, 0, 0.7]), rng.uniform(0.7, 0.9), rng.uniform(-math.pi, math.pi), 2.5)
    d_z = rng.uniform(2.0, 2.6)
    assert mirror_pose(T, d_z, 1.3) == pytest.approx(article_product(T, d_z, 1.3), abs=1e-9)


def test_with_roll_the_articles_product_is_another_pose():
    T = random_camera(3, roll=True)
    assert np.abs(mirror_pose(T, 2.0) - article_product(T, 2.0)).max() > 0.1


def test_the_depth_camera_stands_off_in_the_rgb_cameras_own_axes():
    aligned = place_beside(CAMERA, JOB)["aligned"]
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
