"""Regions of a capture's view: the object by its mask, and the board by the rays that meet it. Pure."""

import numpy as np
from numpy.typing import NDArray

from schemas.job.captures import Board
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_NOTHING, REGION_TABLE
from schemas.scene.view import Camera
from workers.geometry.jit import compiled


def capture_regions(camera: Camera, board: Board, mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """[H, W] uint8: the object where `mask` is, the board where the ray through a pixel's centre meets it, else nothing.

    The camera's pose is in the board frame, so the board is the rectangle z = 0 about the origin, at the print's true
    size. Nothing means neither board nor object: what stands beside the board may have depth there.
    """
    k = camera.intrinsics
    half = 0.5 * board.scale * np.array([board.width_m, board.height_m])
    on_board = _meets_rectangle((k.height, k.width), (k.cx, k.cy, k.fx, k.fy), camera.T_world_cam, half[0], half[1])
    region = np.where(on_board, np.uint8(REGION_TABLE), np.uint8(REGION_NOTHING))
    region[mask] = REGION_FIRST_OBJECT
    return region


@compiled
def _meets_rectangle(
    shape: tuple[int, int],
    k: tuple[float, float, float, float],
    T: NDArray[np.float64],
    half_x: float,
    half_y: float,
) -> NDArray[np.bool_]:
    """[H, W] bool: whether the ray goes from above onto the rectangle |x| <= half_x, |y| <= half_y at z = 0."""
    meets = np.zeros(shape, np.bool_)
    if not T[2, 3] > 0.0:
        return meets
    for row in range(shape[0]):
        ray_y = (row + 0.5 - k[1]) / k[3]
        for column in range(shape[1]):
            ray_x = (column + 0.5 - k[0]) / k[2]
            down = T[2, 0] * ray_x + T[2, 1] * ray_y + T[2, 2]
            if not down < 0.0:
                continue
            z = -T[2, 3] / down
            x = T[0, 3] + z * (T[0, 0] * ray_x + T[0, 1] * ray_y + T[0, 2])
            y = T[1, 3] + z * (T[1, 0] * ray_x + T[1, 1] * ray_y + T[1, 2])
            meets[row, column] = abs(x) <= half_x and abs(y) <= half_y
    return meets
