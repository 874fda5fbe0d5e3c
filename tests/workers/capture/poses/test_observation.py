import numpy as np
import pytest

from schemas.capture import CaptureCamera, Detection
from schemas.job.captures import Board
from tests.workers.capture.photographs import KINECT, hand_held
from tests.workers.capture.poses.scenes import PINHOLE, project
from workers.capture.board.layout import marker_corners
from workers.capture.poses.observation import Observation, corners_of, no_patches

BOARD = Board(first_id=5, measured_ruler_m=0.202)
T = hand_held(np.random.default_rng(0), 1)[0]
POINTS = marker_corners(BOARD)
PIXELS = project(POINTS.reshape(-1, 3), T, PINHOLE).reshape(-1, 4, 2)


def test_corners_are_paired_with_their_place_on_the_board_by_id():
    corners = corners_of(Detection(0, np.array([6, 30]), PIXELS[[1, 25]]), BOARD, PINHOLE)
    assert corners.board == pytest.approx(POINTS[[1, 25]].reshape(-1, 3))
    assert list(corners.markers) == [6] * 4 + [30] * 4
    assert Observation(0, corners).markers == 2 and not corners.depth_m.any()


def test_a_marker_where_the_lens_cannot_be_inverted_is_left_out():
    folding = CaptureCamera(KINECT, np.array([-0.6, 0, 0, 0, 0, 0, 0, 0]))
    centre, edge = (
        np.array([[950, 530], [970, 530], [970, 550], [950, 550.0]]),
        np.array([[1, 1], [9, 1], [9, 9], [1, 9.0]]),
    )
    corners = corners_of(Detection(0, np.array([5, 6]), np.stack([centre, edge])), BOARD, folding)
    assert list(corners.markers) == [5] * 4


def test_no_patches_are_none():
    assert len(no_patches()) == 0
