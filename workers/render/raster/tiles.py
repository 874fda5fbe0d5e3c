"""Tiles of the pixel grid that a thing covers, inside the image and around it: pure functions."""

import math
from collections.abc import Iterator
from itertools import product

import numpy as np

from schemas.base import Array, Pose
from schemas.scene.camera import Intrinsics
from schemas.scene.shape import Shape
from workers.geometry.camera import project
from workers.geometry.frames import transform
from workers.render.raster.programs import NEAR_M

TILE_PX = 1024
"""Side of a tile, pixels."""


def tiles(shape: Shape, T_cam_shape: Pose, k: Intrinsics) -> Iterator[Intrinsics]:
    """Cameras of at most `TILE_PX` pixels a side that together cover the shape's projected bounding box.

    Each is `k` with its principal point moved by whole pixels, so that pixels coincide. The bounding box ends one width and
    one height of the image outside of it.
    """
    left, top, right, bottom = window(transform(T_cam_shape, shape.vertices), k)
    for y, x in product(range(top, bottom, TILE_PX), range(left, right, TILE_PX)):
        size = {"width": min(TILE_PX, right - x), "height": min(TILE_PX, bottom - y)}
        yield k.model_copy(update={**size, "cx": k.cx - x, "cy": k.cy - y})


def window(vertices: Array, k: Intrinsics) -> tuple[int, int, int, int]:
    """(left, top, right, bottom), whole pixels, right and bottom excluded: the projected bounding box of vertices.

    vertices [V, 3], optical frame. A thing that crosses the near plane gets the whole image and its surroundings; a thing
    behind it gets nothing.
    """
    reach = (-k.width, -k.height, 2 * k.width, 2 * k.height)
    seen = vertices[:, 2] > NEAR_M
    if not seen.any():
        return (0, 0, 0, 0)
    if not seen.all():
        return reach
    u, v = project(vertices, k)
    low = (math.floor(np.clip(u.min(), reach[0], reach[2])), math.floor(np.clip(v.min(), reach[1], reach[3])))
    high = (math.ceil(np.clip(u.max(), reach[0], reach[2])), math.ceil(np.clip(v.max(), reach[1], reach[3])))
    return (*low, *high)
