import numpy as np
import pytest

from schemas.capture import CaptureCamera, Detection
from schemas.job.captures import Board
from tests.workers.capture.depths import DepthErrors, measured_depth
from tests.workers.capture.photographs import HALF, hand_held
from tests.workers.capture.poses.scenes import project
from workers.capture.board.layout import marker_corners
from workers.capture.poses.patches import board_patches, depth_at, fit_patches
from workers.geometry.frames import transform

BOARD, CAMERA = Board(), CaptureCamera(HALF, np.zeros(8))
CORNERS = marker_corners(BOARD)


def detection(T, ids=range(35)):
    ids = np.array(list(ids), np.int64)
    return Detection(0, ids, project(CORNERS[ids].reshape(-1, 3), T, CAMERA).reshape(-1, 4, 2))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_patches_of_an_exact_board_lie_on_its_plane_with_its_normal(seed):
    rng = np.random.default_rng(seed)
    T = hand_held(rng, 1)[0]
    found = board_patches(measured_depth(T, HALF, DepthErrors(), rng, box=False), detection(T), BOARD, CAMERA)
    assert len(found) == 35 + 30 + 28  # markers, gaps beside and below them
    assert np.abs(transform(T, found.ray_z)[:, 2]).max() < 3e-4  # depth is stored in millimetres
    assert (found.normal @ T[:3, :3].T)[:, 2].min() > 0.995
    assert found.ray[:, 2] == pytest.approx(1.0)


def test_averages_are_as_much_better_as_there_are_samples():
    rng = np.random.default_rng(3)
    rays = rng.uniform(-0.02, 0.02, (400, 100, 2)) + np.array([0.2, 0.1])
    z = 1.0 / (0.3 * rays[..., 0] - 0.2 * rays[..., 1] + 1.2)
    noisy = fit_patches(rays, z + rng.normal(0, 0.003, z.shape))
    exact = fit_patches(rays, z)
    assert exact.normal == pytest.approx(np.tile(-np.array([0.3, -0.2, 1.2]) / np.sqrt(1.57), (400, 1)), abs=1e-6)
    assert np.std(noisy.ray_z[:, 2] - exact.ray_z[:, 2]) == pytest.approx(0.0003, rel=0.15)
    assert np.median(noisy.sigma_m) == pytest.approx(0.003, rel=0.1)


def test_flying_pixels_and_missing_ones_do_not_move_a_patch():
    rng = np.random.default_rng(4)
    rays = rng.uniform(-0.02, 0.02, (50, 100, 2))
    z = 1.0 / (0.3 * rays[..., 0] + 1.2) + rng.normal(0, 0.001, (50, 100))
    clean = fit_patches(rays, z)
    z[:, :10] += 0.2
    z[:, 10:40] = 0
    spoilt = fit_patches(rays, z)
    plane = -spoilt.normal / (spoilt.normal * spoilt.ray).sum(axis=1, keepdims=True)
    assert len(spoilt) == len(clean) == 50 and np.isfinite(plane).all()
    middle = (spoilt.ray_z * np.array([0.3, 0, 1.2])).sum(axis=1)
    assert np.abs(middle - 1).max() < 2e-3


def test_a_patch_with_little_depth_is_left_out():
    rays = np.random.default_rng(5).uniform(-0.02, 0.02, (3, 100, 2))
    z = np.ones((3, 100))
    z[0, 20:] = 0
    z[1] = 0
    assert len(fit_patches(rays, z)) == 1
    assert len(fit_patches(rays[:0], z[:0])) == 0


def test_depth_of_a_corner_is_the_median_around_it():
    depth = np.full((20, 20), 800, np.uint16)
    depth[9:12, 9:12] = 0
    depth[8, 8] = 5000
    assert depth_at(depth, np.array([[10.5, 10.5], [0.2, 19.9]]), 1000) == pytest.approx([0.8, 0.8])
    depth[:] = 0
    assert depth_at(depth, np.array([[10.5, 10.5]]), 1000) == [0.0]
    assert depth_at(depth, np.zeros((0, 2)), 1000).shape == (0,)
