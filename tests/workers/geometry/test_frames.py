"""Rigid transforms, against scipy's rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from workers.geometry.frames import (
    cross,
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
def test_the_cross_product_is_numpys_to_the_bit(seed):
    a, b = np.random.default_rng(seed).standard_normal((2, 3))
    assert np.array_equal(cross(a, b), np.cross(a, b))


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


@pytest.mark.parametrize("a", [[1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0]])
def test_opposite_and_equal_directions_have_a_turn_too(a):
    a = np.array(a)
    assert rotation_between(a, -a) @ a == pytest.approx(-a, abs=1e-15)
    assert rotation_between(a, a) == pytest.approx(np.eye(3))


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
