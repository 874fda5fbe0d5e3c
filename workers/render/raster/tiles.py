"""What a thing covers of the pixel grid, inside the image and around it, and how steeply it is seen: pure functions."""

import math
from collections.abc import Iterator
from functools import lru_cache
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
    nearest_m, left, bottom, right, top, _ = _meet_level(T_cam_shape, _corners(k), low[2])
    inside = left > low[0] and bottom > low[1] and right < high[0] and top < high[1]
    return bool(nearest_m > 2.0 * NEAR_M and inside)


def is_steep(shape: Shape, T_cam_shape: Pose, k: Intrinsics) -> bool:
    """Whether a shape is one level plane of its frame, and the rays of all pixels meet it at a cosine above `GRAZING`.

    The cosine, computed by a renderer in float32, is at least twice that. It is bounded by the least slope and the greatest
    length of the rays through the image's corners, between which both lie.
    """
    low, high = bounds_of(shape.vertices)
    return bool(low[2] == high[2] and _meet_level(T_cam_shape, _corners(k), low[2])[5] > 2.0 * GRAZING)


def _corners(k: Intrinsics) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of the rays through corners `BORDER_PX` beyond the image, 1 long along the optical axis."""
    left, right = (-BORDER_PX - k.cx) / k.fx, (k.width + BORDER_PX - k.cx) / k.fx
    return left, (-BORDER_PX - k.cy) / k.fy, right, (k.height + BORDER_PX - k.cy) / k.fy


@compiled
def _meet_level(
    T_cam_shape: Pose, corners: tuple[float, float, float, float], z: float
) -> tuple[float, float, float, float, float, float]:
    """Where the rays through four corners meet the level z of a shape's frame.

    (least distance along the optical axis, least x and y, greatest x and y, metres; least cosine that a ray between them has
    with the level's normal). The first is 0 where a ray meets nothing, the last where one runs the other way.
    """
    x = y = eye_z = 0.0  # the eye in the shape's frame
    for i in range(3):
        x -= T_cam_shape[i, 3] * T_cam_shape[i, 0]
        y -= T_cam_shape[i, 3] * T_cam_shape[i, 1]
        eye_z -= T_cam_shape[i, 3] * T_cam_shape[i, 2]
    fall = z - eye_z
    nearest, left, bottom, right, top = np.inf, np.inf, np.inf, -np.inf, -np.inf
    low, high, length2 = np.inf, -np.inf, 0.0
    for u in (corners[0], corners[2]):
        for v in (corners[1], corners[3]):
            ray_x = u * T_cam_shape[0, 0] + v * T_cam_shape[1, 0] + T_cam_shape[2, 0]
            ray_y = u * T_cam_shape[0, 1] + v * T_cam_shape[1, 1] + T_cam_shape[2, 1]
            ray_z = u * T_cam_shape[0, 2] + v * T_cam_shape[1, 2] + T_cam_shape[2, 2]
            low, high, length2 = min(low, ray_z), max(high, ray_z), max(length2, u * u + v * v + 1.0)
            away = fall / ray_z if ray_z * fall > 0.0 else 0.0
            nearest = min(nearest, away)
            left, right = min(left, x + away * ray_x), max(right, x + away * ray_x)
            bottom, top = min(bottom, y + away * ray_y), max(top, y + away * ray_y)
    return nearest, left, bottom, right, top, max(low, -high, 0.0) / np.sqrt(length2)


@lru_cache(maxsize=1)  # the views of one scene ask about one floor
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
