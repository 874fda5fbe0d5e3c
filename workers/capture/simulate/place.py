"""Where the object of a simulated capture stands, and the board as it was really printed."""

import math

import numpy as np

from schemas.base import Pose, frozen_array
from schemas.job.captures import Board, Simulate
from schemas.scene.shape import Asset
from workers.geometry.frames import UP, pose, rotation_about


def place_object(asset: Asset, rng: np.random.Generator) -> Pose:
    """T_board_obj [4, 4]: upright in the middle of the board, at any angle, its lowest point at exactly z = 0."""
    yaw = rng.uniform(-math.pi, math.pi)
    lowest = float(asset.shape.vertices[:, 2].min())
    return frozen_array(pose(rotation_about(UP, yaw), np.array([0.0, 0.0, -lowest])))


def true_board(board: Board, simulate: Simulate) -> Board:
    """The board as large as it was printed: nominal sizes times `print_scale`, whatever a ruler is said to show."""
    scale = 1.0 if simulate.print_scale is None else simulate.print_scale
    return board.model_copy(update={"measured_ruler_m": scale * board.ruler_m})
