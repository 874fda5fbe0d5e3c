import cv2
import numpy as np
import pytest

from schemas.errors import CaptureError
from schemas.job.captures import Board
from workers.capture.board.layout import marker_corners, open_dictionary


def test_grid_is_centred_and_z_points_out_of_the_print():
    corners = marker_corners(Board())
    assert corners.shape == (35, 4, 3)
    assert np.abs(corners.mean(axis=(0, 1))).max() < 1e-12
    across, down = corners[0, 1] - corners[0, 0], corners[0, 3] - corners[0, 0]
    np.testing.assert_allclose(np.cross(across, down) / 0.06**2, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(corners[0, 0], [-0.27, 0.19, 0.0], atol=1e-12)


def test_opencv_has_the_same_corners_in_its_own_frame():
    board = Board(columns=4, rows=3, marker_m=0.05, gap_m=0.01)
    theirs = np.array(
        cv2.aruco.GridBoard((4, 3), 0.05, 0.01, open_dictionary(board)).getObjPoints(), dtype=np.float64
    )  # origin at the top left, y down, z into the board
    ours = marker_corners(board)
    np.testing.assert_allclose(ours - ours[0, 0], theirs * [1, -1, -1], atol=1e-7)


def test_measured_ruler_scales_every_length():
    np.testing.assert_allclose(marker_corners(Board(measured_ruler_m=0.204)), marker_corners(Board()) * 1.02)


def test_dictionary_that_does_not_exist_or_is_too_small_is_refused():
    with pytest.raises(CaptureError, match="neither one of OpenCV's"):
        open_dictionary(Board(dictionary="DICT_9X9"))
    with pytest.raises(CaptureError, match="has 50 markers, and the board needs 70"):
        open_dictionary(Board(columns=10, rows=7, width_m=1.0, height_m=1.0))
