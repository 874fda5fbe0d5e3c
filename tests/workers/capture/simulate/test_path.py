"""Hand-held paths: where the camera stands, what it looks at, and how it rolls."""

import math

import numpy as np
import pytest

from schemas.base import Range
from schemas.job.captures import Simulate
from workers.capture.simulate.simulate import plan_path

TARGET = np.array([0.0, 0.0, 0.1])
SEEDS = range(20)


def path_of(seed, **keys):
    return plan_path(Simulate(**keys), TARGET, np.random.default_rng(seed))


@pytest.mark.parametrize("views", [1, 2, 24, 60])
def test_poses_are_rigid(views):
    poses = path_of(3, views=views)
    assert poses.shape == (views, 4, 4)
    R = poses[:, :3, :3]
    assert np.allclose(R @ R.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(R), 1.0)


def test_distance_and_inclination_stay_within_their_intervals():
    for seed in SEEDS:
        poses = path_of(seed, views=40, distance_m=Range(0.6, 1.0), inclination_rad=Range(0.5, 1.2))
        away = np.linalg.norm(poses[:, :3, 3] - TARGET, axis=1)
        assert (away > 0.6 - 0.1).all()  # the aim moves by some centimetres
        assert (away < 1.0 + 0.1).all()
        below = np.arcsin(-poses[:, 2, 2])
        assert (below > 0.5 - 1e-9).all()
        assert (below < 1.2 + 1e-9).all()


def test_the_object_stays_near_the_middle_of_the_image():
    for seed in SEEDS:
        poses = path_of(seed, views=40)
        towards = TARGET - poses[:, :3, 3]
        cosine = (towards * poses[:, :3, 2]).sum(axis=1) / np.linalg.norm(towards, axis=1)
        assert np.degrees(np.arccos(cosine)).max() < 10.0  # the image ends 30 degrees off its middle


def test_the_path_goes_around_the_object_at_several_heights():
    for seed in SEEDS:
        poses = path_of(seed, views=42)
        yaw = np.arctan2(poses[:, 1, 3], poses[:, 0, 3])
        bins = np.histogram(yaw, bins=12, range=(-math.pi, math.pi))[0]
        assert bins.min() >= 1
        height = poses[:, 2, 3]
        low, middle, high = (np.median(third) for third in np.array_split(height, 3))
        assert low < middle < high
        steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        assert steps.max() < 0.7  # no jump across the object


def test_the_roll_has_the_standard_deviation_that_is_asked_for():
    rolls = []
    for seed in range(200):
        for T in path_of(seed, views=24, roll_deg=12.0):
            rolls.append(math.degrees(math.atan2(T[2, 0], -T[2, 1])))
    assert np.std(rolls) == pytest.approx(12.0, rel=0.1)
    assert abs(np.mean(rolls)) < 1.0
    level = path_of(0, views=24, roll_deg=0.0)
    assert np.abs(level[:, 2, 0]).max() < 1e-12
