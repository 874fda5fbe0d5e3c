"""What a thing covers of the pixel grid, and what is known of a floor before it is drawn.

Where a level floor of one colour fills the image, its plane alone gives z at its pixels, so that z is computed after the image is
read and the floor is drawn with one output less. That saves a tenth of the time of drawing in tier flat, and nothing in tier
raster.
"""

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from schemas.base import Pose
from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_FLOOR, Shape
from schemas.scene.view import Intrinsics
from workers.geometry.camera import NEAR_M, corner_rays, project_bounds
from workers.geometry.colour import decode_srgb
from workers.geometry.frames import transform
from workers.geometry.jit import compiled_for
from workers.geometry.mesh import bounds_of
from workers.render.raster.draw_calls import RenderPass, is_plain
from workers.render.raster.shaders import GRAZING, SRGB_CURVE

TILE_PX = 1024
"""Side of a tile, pixels."""

Float32 = NDArray[np.float32]


def tiles(shape: Shape, T_cam_shape: Pose, k: Intrinsics) -> Iterator[Intrinsics]:
    """Cameras of at most `TILE_PX` pixels a side that together cover the shape's projected bounding box.

    Each is `k` with its principal point moved by whole pixels, so that pixels coincide. The bounding box ends one width and
    one height of the image outside of it: there for a shape that crosses the near plane. None of one behind that.
    """
    vertices, reach = transform(T_cam_shape, shape.vertices), (-k.width, -k.height, 2 * k.width, 2 * k.height)
    beyond = vertices[:, 2] > NEAR_M
    if not beyond.any():
        return
    bounds = project_bounds(vertices, k, NEAR_M) if beyond.all() else reach
    left, top, right, bottom = (min(max(bounds[n], reach[n % 2]), reach[n % 2 + 2]) for n in range(4))
    rows = range(math.floor(top), math.ceil(bottom), TILE_PX)
    columns = range(math.floor(left), math.ceil(right), TILE_PX)
    for y, x in product(rows, columns):
        size = {"width": min(TILE_PX, columns.stop - x), "height": min(TILE_PX, rows.stop - y)}
        yield k.model_copy(update={**size, "cx": k.cx - x, "cy": k.cy - y})


def find_ground(things: Sequence[Placed], view: RenderPass) -> Float32 | None:
    """[4]: the plane (n, n . p), in the optical frame, of a floor in one colour of which z need not be drawn.

    None where the floor's colour varies, and where it is not one level plane that fills the image.
    """
    floors = [thing for thing in things if thing.region_id == REGION_FLOOR]
    if len(floors) != 1 or not view.effects.runs("floor") or (view.color and not is_plain(floors[0].shape, view)):
        return None
    T_cam_floor = view.T_cam_world @ floors[0].T_world_shape
    return level_plane(floors[0].shape, T_cam_floor) if fills_image(floors[0].shape, T_cam_floor, view.k) else None


def fills_image(shape: Shape, T_cam_shape: Pose, k: Intrinsics) -> bool:
    """Whether a shape covers every pixel, seen from either side, at a cosine of incidence above `GRAZING`.

    True only where the shape is two triangles that make a rectangle along x and y of its frame, and only where that reaches
    beyond the image by `camera.MARGIN_PX` on all sides, twice as far away as the near plane. The cosine, which a renderer
    computes in float32, is at least twice `GRAZING`: it is bounded by the least slope and the greatest length of the rays
    through the image's corners, between which both lie.
    """
    if shape.closed or not _is_rectangle(shape):
        return False
    low, high = bounds_of(shape.vertices)
    rays, eye = corner_rays(k) @ T_cam_shape[:3, :3], -T_cam_shape[:3, 3] @ T_cam_shape[:3, :3]
    fall = rays[:, 2] * np.sign(low[2] - eye[2])
    if fall.min() <= 2.0 * GRAZING * np.sqrt((rays * rays).sum(axis=1).max()):
        return False
    away = abs(low[2] - eye[2]) / fall
    met = eye[:2] + away[:, None] * rays[:, :2]
    return bool(away.min() > 2.0 * NEAR_M and ((low[:2] < met) & (met < high[:2])).all())


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


def level_plane(shape: Shape, T_cam_shape: Pose) -> Float32:
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
