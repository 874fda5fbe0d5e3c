import numpy as np

from schemas.capture import Detection
from schemas.job.captures import Board, Estimation
from tests.workers.capture.photographs import hand_held
from tests.workers.capture.poses.captures import CAMERA, Virtual, one_view
from tests.workers.capture.poses.scenes import errors
from workers.capture.poses.observation import Setup
from workers.capture.poses.patches import observe_view

SETUP = Setup(CAMERA, Board(), Estimation())


def test_a_view_comes_to_corners_pose_and_samples_of_depth():
    rng = np.random.default_rng(0)
    T = hand_held(rng, 1)[0]
    seen, found = one_view(4, T, Virtual(), SETUP, rng)
    assert seen.number == found.number == 4 and seen.has_depth
    assert (seen.corners.depth_m > 0).all() and len(seen.board_patches) > 20 and len(seen.object_patches) > 10
    assert errors(found.fit.T_board_cam, T)[0] < 1.5


def test_a_view_without_depth_or_markers_has_neither():
    nothing = Detection(2, np.zeros(0, np.int64), np.zeros((0, 4, 2)))
    for depth in (None, np.zeros((270, 480), np.uint16)):
        seen, found = observe_view(nothing, depth, SETUP)
        assert found.fit is None and seen.markers == 0 and not len(seen.board_patches) + len(seen.object_patches)
        assert seen.has_depth == (depth is not None)
