import cv2
import numpy as np
import pytest

from schemas.job.captures import Board
from tests.workers.capture.photographs import hand_held
from workers.capture.board.layout import correction_in_board, frame_in_board, in_board, marker_corners, open_dictionary
from workers.geometry.frames import invert, pose, rotation_about, transform

BOARD = Board(columns=4, rows=3)


def test_opencvs_own_board_lies_on_ours():
    grid = cv2.aruco.GridBoard((4, 3), BOARD.marker_m, BOARD.gap_m, open_dictionary(BOARD))
    theirs = np.array(grid.getObjPoints(), dtype=np.float64).reshape(-1, 3)
    assert transform(frame_in_board(BOARD, "opencv"), theirs) == pytest.approx(
        marker_corners(BOARD).reshape(-1, 3), abs=1e-7
    )


def test_the_frame_before_4_6_has_its_origin_at_the_bottom_left_and_z_out():
    T = frame_in_board(BOARD, "opencv_old")
    bottom_left = marker_corners(BOARD).reshape(-1, 3).min(axis=0)
    assert T[:3, 3] == pytest.approx(bottom_left) and np.array_equal(T[:3, :3], np.eye(3))


def test_ours_is_ours():
    assert np.array_equal(frame_in_board(BOARD, "centre"), np.eye(4))


@pytest.mark.parametrize("frame", ["centre", "opencv", "opencv_old"])
def test_a_correction_in_another_frame_is_the_same_correction(frame):
    T = hand_held(np.random.default_rng(0), 1)[0]
    theirs = invert(frame_in_board(BOARD, frame)) @ T
    correction = pose(rotation_about(np.array([0.0, 0, 1]), 0.1), np.array([0.01, 0.02, 0.03]))
    ours = correction_in_board(correction, BOARD, frame) @ in_board(theirs, BOARD, frame)
    assert ours == pytest.approx(in_board(correction @ theirs, BOARD, frame))
