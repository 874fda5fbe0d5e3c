import numpy as np
import pytest

from schemas.capture import CaptureCamera
from schemas.job.captures import Board, Estimation
from tests.workers.capture.depths import BOX, DepthErrors, measured_depth
from tests.workers.capture.photographs import HALF, hand_held
from workers.capture.poses.observation import Setup, no_patches
from workers.capture.poses.patches import MOST, object_patches
from workers.geometry.frames import transform

SETUP = Setup(CaptureCamera(HALF, np.zeros(8)), Board(), Estimation())


def patches(seed, wrong, T=None, box=True):
    rng = np.random.default_rng(seed)
    T = hand_held(rng, 1)[0] if T is None else T
    depth = measured_depth(T, HALF, wrong, rng, box=box)
    return T, object_patches(depth, T, no_patches(), SETUP)


@pytest.mark.parametrize("seed", range(4))
def test_patches_lie_on_the_faces_of_the_box_and_face_the_camera(seed):
    T, found = patches(seed, DepthErrors(sigma_m=0.001))
    points = transform(T, found.ray_z)
    beyond = np.maximum(BOX[0] - points, points - BOX[1]).max(axis=1)
    assert 30 < len(found) <= MOST
    assert np.median(np.abs(beyond)) < 5e-4 and np.abs(beyond).max() < 6e-3
    assert ((found.normal * found.ray).sum(axis=1) < 0).all()


def test_an_empty_board_has_none_and_neither_has_an_image_without_depth():
    assert len(patches(0, DepthErrors(sigma_m=0.002), box=False)[1]) == 0
    T = hand_held(np.random.default_rng(0), 1)[0]
    assert len(object_patches(np.zeros((540, 960), np.uint16), T, no_patches(), SETUP)) == 0


def test_a_camera_that_looks_away_sees_none():
    T = hand_held(np.random.default_rng(0), 1)[0]
    away = T.copy()
    away[:3, :3] = T[:3, :3] @ np.diag([1.0, -1, -1])
    assert len(object_patches(np.full((540, 960), 700, np.uint16), away, no_patches(), SETUP)) == 0
