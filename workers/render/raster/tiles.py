"""What a thing covers of the pixel grid, inside the image and around it, and how steeply it is seen: pure functions."""

import math
from collections.abc import Iterator
from itertools import product

import numpy as np

from schemas.base import Array, Pose
from schemas.scene.camera import Intrinsics
from schemas.scene.shape import Shape
from workers.geometry.bounds import bounds_of
from workers.geometry.frames import transform
from workers.geometry.jit import compiled
from workers.render.raster.programs import NEAR_M
from workers.render.raster.shaders import GRAZING

TILE_PX = 1024
"""Side of a tile, pixels."""

BORDER_PX = 1.0
"""A rasteriser moves edges by at most 1/256 of a pixel."""


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


def fills_image(shape: Shape, T_cam_shape: Pose, k: Intrinsics) -> bool:
    """Whether a shape covers every pixel of the image, seen from either side: of rectangles that are floors alone.

    True only where the shape is two triangles that make a rectangle along x and y of its frame, and only where that reaches
    beyond the image by `BORDER_PX` on all sides, twice as far away as the near plane.
    """
    if shape.closed or not _is_rectangle(shape):
        return False
    low, high = bounds_of(shape.vertices)
    rays = _corner_rays(T_cam_shape, k)
    eye = -T_cam_shape[:3, 3] @ T_cam_shape[:3, :3]
    fall = float(low[2] - eye[2])
    if not (rays[:, 2] * fall > 0.0).all():
        return False
    away_m = fall / rays[:, 2]  # along the optical axis, as rays are of that length
    met = eye[:2] + away_m[:, None] * rays[:, :2]
    return bool((away_m > 2.0 * NEAR_M).all() and (met > low[:2]).all() and (met < high[:2]).all())


def is_steep(shape: Shape, T_cam_shape: Pose, k: Intrinsics) -> bool:
    """Whether a shape is one level plane of its frame, and the rays of all pixels meet it at a cosine above `GRAZING`.

    The cosine, computed by a renderer in float32, is at least twice that. It is bounded by the least slope and the greatest
    length of the rays through the image's corners, between which both lie.
    """
    low, high = bounds_of(shape.vertices)
    if low[2] != high[2]:
        return False
    rays = _corner_rays(T_cam_shape, k)
    slopes = rays[:, 2] if rays[0, 2] > 0.0 else -rays[:, 2]
    return bool(slopes.min() > 2.0 * GRAZING * np.sqrt((rays * rays).sum(axis=1).max()))


def _corner_rays(T_cam_shape: Pose, k: Intrinsics) -> Array:
    """[4, 3]: rays through corners `BORDER_PX` beyond the image, 1 long along the optical axis, in the shape's frame."""
    x, y = (-BORDER_PX, k.width + BORDER_PX), (-BORDER_PX, k.height + BORDER_PX)
    rays: Array = (
        np.array([((u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0) for u, v in product(x, y)]) @ T_cam_shape[:3, :3]
    )
    return rays


def _is_rectangle(shape: Shape) -> bool:
    """Whether a shape is a rectangle along x and y at one z: four corners, and two triangles on either side of a diagonal."""
    if len(shape.vertices) != 4 or len(shape.faces) != 2:
        return False
    vertices, faces = shape.vertices.tolist(), shape.faces.tolist()
    x, y, z = ({vertex[axis] for vertex in vertices} for axis in range(3))
    if len({tuple(vertex) for vertex in vertices}) != 4 or [len(x), len(y), len(z)] != [2, 2, 1]:
        return False
    if any(len(set(face)) != 3 for face in faces):
        return False
    first, second = (vertices[6 - sum(face)] for face in faces)  # the corner that a face lacks
    return first[0] != second[0] and first[1] != second[1]
