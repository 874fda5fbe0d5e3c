"""Where a thing falls on the pixel grid, inside the image and around it: pure functions."""

import math
from collections.abc import Iterator
from itertools import product

import numpy as np

from schemas.base import Array, Pose
from schemas.scene.camera import Intrinsics
from schemas.scene.shape import Shape
from workers.geometry.frames import transform
from workers.render.raster.programs import NEAR_M

TILE_PX = 1024
"""Side of the square of pixels that is counted at a time."""


def tiles(shape: Shape, T_cam_shape: Pose, k: Intrinsics) -> Iterator[Intrinsics]:
    """Cameras of at most `TILE_PX` pixels a side which together see all that `k`, widened on all sides, would see.

    Each is `k` with its principal point moved by whole pixels, so that its pixels are `k`'s; together they cover the
    shape's projected bounding box within the image and one width and one height of it around.
    """
    left, top, right, bottom = window(transform(T_cam_shape, shape.vertices), k)
    for y, x in product(range(top, bottom, TILE_PX), range(left, right, TILE_PX)):
        size = {"width": min(TILE_PX, right - x), "height": min(TILE_PX, bottom - y)}
        yield k.model_copy(update={**size, "cx": k.cx - x, "cy": k.cy - y})


def window(vertices: Array, k: Intrinsics) -> tuple[int, int, int, int]:
    """(left, top, right, bottom), whole pixels, right and bottom excluded: the bounding box of what is seen.

    vertices [V, 3] are in the optical frame. What reaches behind the near plane has no bounding box, and gets all of
    the image and its surroundings; what lies behind it altogether gets none of it.
    """
    reach = (-k.width, -k.height, 2 * k.width, 2 * k.height)
    seen = vertices[:, 2] > NEAR_M
    if not seen.any():
        return (0, 0, 0, 0)
    if not seen.all():
        return reach
    u = k.fx * vertices[:, 0] / vertices[:, 2] + k.cx
    v = k.fy * vertices[:, 1] / vertices[:, 2] + k.cy
    low = (math.floor(np.clip(u.min(), reach[0], reach[2])), math.floor(np.clip(v.min(), reach[1], reach[3])))
    high = (math.ceil(np.clip(u.max(), reach[0], reach[2])), math.ceil(np.clip(v.max(), reach[1], reach[3])))
    return (*low, *high)
