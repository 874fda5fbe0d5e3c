"""What a thing covers of the pixel grid, and what is known of a floor before it is drawn.

Where a level floor fills the image, its plane alone gives z at its pixels, so that z is computed after the image is read and
the floor is drawn with one output less. Where it also has one colour, the framebuffer is cleared to that, and the floor is
drawn only where something comes so near to it that the depth test has to decide.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_FLOOR, Shape
from schemas.scene.view import Intrinsics
from workers.geometry.camera import project_bounds
from workers.geometry.colour import decode_srgb
from workers.geometry.frames import transform
from workers.geometry.jit import compiled_for
from workers.geometry.mesh import bounds_of
from workers.render.raster.buffers import UploadedShape
from workers.render.raster.draw_calls import DEPTH_BIAS, FLOOR_BIAS, NEAR_M, RenderPass, is_plain
from workers.render.raster.shaders import GRAZING, SRGB_CURVE

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
    beyond = vertices[:, 2] > NEAR_M
    if not beyond.any():
        return (0, 0, 0, 0)
    if not beyond.all():
        return reach
    bounds = project_bounds(vertices, k, NEAR_M)
    left, top, right, bottom = (min(max(bounds[n], reach[n % 2]), reach[n % 2 + 2]) for n in range(4))
    return (math.floor(left), math.floor(top), math.ceil(right), math.ceil(bottom))


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


@compiled_for("f8[:,::1], UniTuple(f8, 4), f8")
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


ROUNDING = 1e-5
"""Share of a distance by which the depths that the rasteriser compares may be off; they are exact to 3e-6."""

MARGIN_PX = 1
"""Pixels around that are drawn too: a rasteriser moves edges by at most 1/256 of one."""

Float32 = NDArray[np.float32]

Window = tuple[int, int, int, int]
"""Left, top, right and bottom of a part of the image, right and bottom excluded; nothing where it has no area."""


@dataclass(frozen=True, eq=False)
class Ground:
    """A level floor that fills the image.

    plane [4] float32: (n, n . p) in the optical frame. cleared [4] float32: sRGB and region id / 255 of every pixel of it, or
    None where its colour varies. `window`: outside of it nothing can hide behind the floor; the whole image where its colour
    varies.
    """

    plane: NDArray[np.float32]
    cleared: NDArray[np.float32] | None
    window: Window


def find_ground(
    things: Sequence[Placed], view: RenderPass, ranks: Mapping[int, int], fetch: Callable[[Shape], UploadedShape]
) -> Ground | None:
    """What is known of the floor of a pass that draws labels; None where it is not one level plane that fills the image.

    `ranks`: of `rank_regions`.
    """
    floors = [thing for thing in things if thing.region_id == REGION_FLOOR]
    if len(floors) != 1 or not view.effects.runs("floor"):
        return None
    shape, T_cam_floor = floors[0].shape, view.T_cam_world @ floors[0].T_world_shape
    if not fills_image(shape, T_cam_floor, view.k) or not is_steep(shape, T_cam_floor, view.k):
        return None
    plane = level_plane(shape, T_cam_floor)
    if view.color and not is_plain(shape, view):
        return Ground(plane, None, (0, 0, view.k.width, view.k.height))
    srgb = plain_srgb(shape, view, plane) if view.color else np.zeros(3, np.float32)
    others = [thing for thing in things if thing.region_id != REGION_FLOOR]
    window = near_window(floors[0], others, view, max(ranks.values()), fetch)
    return Ground(plane, np.append(srgb, np.float32(REGION_FLOOR / 255.0)), window)


def level_plane(shape: Shape, T_cam_shape: Pose) -> NDArray[np.float32]:
    """[4]: the plane of a level shape as (n, n . p) in the optical frame, rounded as a vertex shader does."""
    T = T_cam_shape.astype(np.float32)
    product = T[:3, 2] * T[:3, 3]
    return np.append(T[:3, 2], np.float32(shape.vertices[0, 2]) + (product[0] + product[1] + product[2]))


def plain_srgb(shape: Shape, view: RenderPass, plane: Float32) -> Float32:
    """[3] sRGB, in whole steps of 255, of a level that is plain in tier flat and lies in a plane (n, n . p).

    Lambert's law for distant lights, and the share of the ambient light that a dielectric mirrors.
    """
    (part,), lights = shape.parts, view.lights
    normal = -plane[:3] if plane[3] > 0.0 else plane[:3]  # towards the eye
    albedo = decode_srgb(np.array(part.material.base_color[:3])).astype(np.float32)
    return _plain_srgb(normal, albedo, np.array(lights.ambient, np.float32), lights.towards, lights.color)


@compiled_for("f4[::1], f4[::1], f4[::1], f4[:,::1], f4[:,::1]")
def _plain_srgb(normal: Float32, albedo: Float32, ambient: Float32, towards: Float32, color: Float32) -> Float32:
    """The colour of a level by its normal [3], and lights [N, 3], encoded as shaders do."""
    srgb = np.empty(3, np.float32)
    for channel in range(3):
        around = ambient[channel]
        for i in range(len(towards)):
            cosine = normal[0] * towards[i, 0] + normal[1] * towards[i, 1] + normal[2] * towards[i, 2]
            around += color[i, channel] * max(cosine, np.float32(0.0))
        light = albedo[channel] * around + np.float32(0.04) * ambient[channel]
        c = min(max(light, np.float32(0.0)), np.float32(1.0))
        root = np.sqrt(c)
        curve = SRGB_CURVE[0] * root + SRGB_CURVE[1] * np.sqrt(root) - SRGB_CURVE[2] * c - SRGB_CURVE[3]
        srgb[channel] = np.rint(255.0 * (curve if c >= 0.0031308 else 12.92 * c)) / 255.0
    return srgb


def near_window(
    floor: Placed,
    others: Sequence[Placed],
    view: RenderPass,
    highest_rank: int,
    fetch: Callable[[Shape], UploadedShape],
) -> Window:
    """Where the floor may hide a part of another thing, or a part comes so near to it that the depth test has to decide.

    Elsewhere all parts are in front of the floor by more than the test's biases and rounding can take away. A ray that passes
    a point at the height h above the floor, from an eye at the height H, goes on for h / (H - h) of its way to the floor.
    """
    k, T_cam_floor = view.k, view.T_cam_world @ floor.T_world_shape
    up, whole = T_cam_floor[:3, 2], (0, 0, view.k.width, view.k.height)
    level_m = floor.shape.vertices[0, 2] + up @ T_cam_floor[:3, 3]  # of the floor along `up`, from the eye
    share = FLOOR_BIAS + ROUNDING + DEPTH_BIAS * highest_rank / GRAZING
    low_m = 2.0 * share * -level_m
    if low_m <= 0.0:
        return whole
    low = [np.empty((0, 3))]
    for thing in others:
        T_cam_shape = view.T_cam_world @ thing.T_world_shape
        height = up @ T_cam_shape[:3]
        height[3] -= level_m
        if (fetch(thing.shape).corners @ height[:3]).min() + height[3] < low_m:
            low.append(transform(T_cam_shape, _low_points(thing.shape.vertices, thing.shape.faces, height, low_m)))
    points = np.concatenate(low)
    if not len(points):
        return 0, 0, 0, 0
    left, top, right, bottom = window(points, k)
    return (
        max(left - MARGIN_PX, 0),
        max(top - MARGIN_PX, 0),
        min(right + MARGIN_PX, k.width),
        min(bottom + MARGIN_PX, k.height),
    )


def _low_points(vertices: Array, faces: NDArray[np.int32], up: Array, low_m: float) -> Array:
    """[N, 3]: the corners of what a mesh has below `low_m`, in its frame, in no order.

    up [4]: (a, b, c, d) with the height a x + b y + c z + d, metres.
    """
    height = up[0] * vertices[:, 0] + up[1] * vertices[:, 1] + up[2] * vertices[:, 2] + up[3]
    ends, others = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    leaves = (height[ends] < low_m) != (height[others] < low_m)  # the edge leaves what is low
    i, j = ends[leaves], others[leaves]
    share = (low_m - height[i]) / (height[j] - height[i])
    crossings = vertices[i] + share[:, None] * (vertices[j] - vertices[i])
    return np.concatenate([vertices[ends[height[ends] < low_m]], crossings])
