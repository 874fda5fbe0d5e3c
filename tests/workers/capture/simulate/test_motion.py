"""The camera's motion during an exposure."""

import math

import numpy as np
import pytest

from schemas.job.captures import MotionBlur
from workers.capture.simulate.camera import AT_REST, draw_motion, pose_at
from workers.geometry.frames import angle_between, pose, uniform_rotation

BLUR = MotionBlur(exposure_s=0.02, speed_m_s=0.3, turn_deg_s=10.0)


def test_the_true_pose_is_that_of_the_exposures_middle():
    T = pose(uniform_rotation(np.random.default_rng(1)), np.array([1.0, 2.0, 3.0]))
    motion = draw_motion(BLUR, np.random.default_rng(2))
    assert np.array_equal(pose_at(T, motion, 0.0), T)
    for moment in (-0.5, 0.3):
        assert np.array_equal(pose_at(T, AT_REST, moment), T)


def test_way_and_turn_are_speed_times_exposure():
    T = pose(uniform_rotation(np.random.default_rng(3)), np.zeros(3))
    for seed in range(10):
        motion = draw_motion(BLUR, np.random.default_rng(seed))
        first, last = pose_at(T, motion, -0.5), pose_at(T, motion, 0.5)
        assert np.linalg.norm(last[:3, 3] - first[:3, 3]) == pytest.approx(0.3 * 0.02)
        assert angle_between(first[:3, :3], last[:3, :3]) == pytest.approx(math.radians(10.0 * 0.02))


def test_no_direction_is_preferred():
    ways = [draw_motion(BLUR, np.random.default_rng(seed)).way / 0.006 for seed in range(2000)]
    assert np.abs(np.mean(ways, axis=0)).max() < 0.05
    assert np.allclose(np.cov(np.transpose(ways)), np.eye(3) / 3.0, atol=0.03)
