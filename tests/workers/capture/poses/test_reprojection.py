import numpy as np
import pytest

from tests.workers.capture.photographs import hand_held
from tests.workers.capture.poses.scenes import LENS, errors, observe
from workers.capture.poses.markers import FAR, fit_pose, moved, residuals_of, spread

FOCAL = np.array([912.37, 912.25])


def test_derivatives_equal_finite_differences():
    rng = np.random.default_rng(0)
    T = hand_held(rng, 1)[0]
    seen = observe(T, rng).corners
    start = moved(T, np.array([0.01, -0.02, 0.01, 0.02, 0.01, -0.03]))
    _, jacobian = residuals_of(start, seen.board, seen.rays, FOCAL)
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        ahead, back = (residuals_of(moved(start, s), seen.board, seen.rays, FOCAL)[0] for s in (step, -step))
        assert jacobian[:, :, axis] == pytest.approx((ahead - back) / 2e-6, abs=2e-4)


def test_a_fit_without_noise_is_the_truth_through_a_lens_too():
    rng = np.random.default_rng(1)
    for T in hand_held(rng, 5):
        seen = observe(T, rng, corner_px=0, camera=LENS).corners
        found = fit_pose(moved(T, rng.normal(0, 0.02, 6)), seen.board, seen.rays, FOCAL, 0.02)
        assert max(errors(found.T_board_cam, T)) < 1e-3


def test_five_wrong_corners_of_a_hundred_move_the_pose_by_little():
    rng = np.random.default_rng(2)
    for T in hand_held(rng, 5):
        seen = observe(T, rng).corners
        rays = seen.rays.copy()
        rays[rng.choice(len(rays), len(rays) // 20, replace=False)] += 30 / 912
        clean = fit_pose(T, seen.board, seen.rays, FOCAL, 0.02)
        found = fit_pose(moved(T, rng.normal(0, 0.02, 6)), seen.board, rays, FOCAL, 0.02)
        mm, degrees = errors(found.T_board_cam, clean.T_board_cam)
        assert mm < 0.3 and degrees < 0.03


def test_points_behind_the_camera_do_not_end_in_nan():
    rng = np.random.default_rng(3)
    T = hand_held(rng, 1)[0]
    seen = observe(T, rng).corners
    turned = moved(T, np.array([0, 0, 0, 0, np.pi * 0.99, 0]))
    residuals, jacobian = residuals_of(turned, seen.board, seen.rays, FOCAL)
    assert (residuals == FAR).all() and not jacobian.any()
    assert np.isfinite(fit_pose(turned, seen.board, seen.rays, FOCAL, 0.02).T_board_cam).all()


def test_the_spread_of_normal_noise_is_its_sigma():
    noise = np.random.default_rng(4).normal(0, 0.3, (20000, 2))
    assert spread(noise, 0.01) == pytest.approx(0.3, rel=0.02)
    assert spread(np.zeros((0, 2)), 0.01) == 0.01
