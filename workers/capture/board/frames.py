"""Frames that others give board poses in, and how they lie in ours: origin at the grid's centre, y up the print, z out."""

import numpy as np

from schemas.base import Pose
from schemas.job.captures import Board, BoardFrame
from workers.geometry.frames import invert, pose


def frame_in_board(board: Board, frame: BoardFrame) -> Pose:
    """T_board_frame [4, 4]: takes coordinates of the other frame to ours.

    `opencv`: OpenCV 4.6 and later, origin at the top left of the grid, y down, z into the board; `opencv_old`: before, origin
    at the bottom left, y up, z out of the board.
    """
    width, height = (
        board.scale * (count * (board.marker_m + board.gap_m) - board.gap_m) for count in (board.columns, board.rows)
    )
    if frame == "opencv":
        return pose(np.diag([1.0, -1.0, -1.0]), np.array([-width / 2, height / 2, 0.0]))
    if frame == "opencv_old":
        return pose(np.eye(3), np.array([-width / 2, -height / 2, 0.0]))
    return np.eye(4)


def in_board(T_frame_cam: Pose, board: Board, frame: BoardFrame) -> Pose:
    """T_board_cam of a pose that is given in another frame of the board."""
    return frame_in_board(board, frame) @ T_frame_cam


def correction_in_board(correction: Pose, board: Board, frame: BoardFrame) -> Pose:
    """The correction of poses in our frame that does what `correction` does to poses in the other."""
    T = frame_in_board(board, frame)
    return T @ correction @ invert(T)
