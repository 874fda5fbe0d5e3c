"""What is known of a floor before it is drawn.

Where a level floor fills the image, its plane alone gives z at its pixels, so that z is computed after the image is read and
the floor is drawn with one output less. Where it also has one colour, the framebuffer is cleared to that, and the floor is
drawn only where something comes so near to it that the depth test has to decide.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.scene.region import REGION_FLOOR
from schemas.scene.scene import Placed
from schemas.scene.shape import Shape
from workers.geometry.frames import transform
from workers.geometry.jit import compiled
from workers.geometry.srgb import decode_srgb
from workers.render.raster.buffers import UploadedShape
from workers.render.raster.draw_calls import DEPTH_BIAS, FLOOR_BIAS, RenderPass, is_plain
from workers.render.raster.shaders import GRAZING, SRGB_CURVE
from workers.render.raster.tiles import fills_image, is_steep, window

ROUNDING = 1e-5
"""Share of a distance by which the depths that the rasteriser compares may be off; they are exact to 3e-6."""

BORDER_PX = 1
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


@compiled
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
        max(left - BORDER_PX, 0),
        max(top - BORDER_PX, 0),
        min(right + BORDER_PX, k.width),
        min(bottom + BORDER_PX, k.height),
    )


@compiled
def _low_points(vertices: Array, faces: NDArray[np.int32], up: Array, low_m: float) -> Array:
    """[N, 3]: the corners of what a mesh has below `low_m`, in its frame.

    up [4]: (a, b, c, d) with the height a x + b y + c z + d, metres.
    """
    height = np.empty(len(vertices))
    for n in range(len(vertices)):
        height[n] = up[0] * vertices[n, 0] + up[1] * vertices[n, 1] + up[2] * vertices[n, 2] + up[3]
    points, count = np.empty((6 * len(faces), 3)), 0
    for face in range(len(faces)):
        for corner in range(3):
            i, j = faces[face, corner], faces[face, (corner + 1) % 3]
            if height[i] < low_m:
                points[count] = vertices[i]
                count += 1
            if (height[i] < low_m) != (height[j] < low_m):  # the edge leaves what is low
                share = (low_m - height[i]) / (height[j] - height[i])
                points[count] = vertices[i] + share * (vertices[j] - vertices[i])
                count += 1
    return points[:count].copy()
