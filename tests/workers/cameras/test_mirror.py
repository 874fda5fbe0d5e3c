"""The mirror camera's properties, with roll, to 1e-9; and the article's product at zero roll."""

import math

import numpy as np
import pytest

from workers.cameras.mirror import mirror_pose
from workers.geometry.camera import inclination, look_at, orbit_pose
from workers.geometry.frames import half_turn, pose, rotation_about, translation

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
