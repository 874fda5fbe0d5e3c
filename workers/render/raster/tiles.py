"""Tiles of the pixel grid that a thing covers, inside the image and around it: pure functions."""

import math
from collections.abc import Iterator
from itertools import product

import numpy as np

from schemas.base import Array, Pose
from schemas.scene.camera import Intrinsics
from schemas.scene.shape import Shape
from workers.geometry.frames import transform
from workers.geometry.jit import compiled
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
    seen, *bounds = _projected_bounds(np.ascontiguousarray(vertices), (k.fx, k.fy, k.cx, k.cy), NEAR_M)
    if not seen:
        return (0, 0, 0, 0)
    if seen < len(vertices):
        return reach
    left, top, right, bottom = (min(max(bounds[n], reach[n % 2]), reach[n % 2 + 2]) for n in range(4))
    return (math.floor(left), math.floor(top), math.ceil(right), math.ceil(bottom))


@compiled
def _projected_bounds(
    vertices: Array, k: tuple[float, float, float, float], near_m: float
) -> tuple[int, float, float, float, float]:
    """(number of vertices [V, 3] beyond the near plane, their left, top, right and bottom in pixels)."""
    seen, left, top, right, bottom = 0, np.inf, np.inf, -np.inf, -np.inf
    for n in range(len(vertices)):
        z = vertices[n, 2]
        if z > near_m:
            u, v = k[0] * vertices[n, 0] / z + k[2], k[1] * vertices[n, 1] / z + k[3]
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
            seen += 1
    return seen, left, top, right, bottom
