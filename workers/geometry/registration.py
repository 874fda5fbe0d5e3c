"""Registration of a depth image to the colour camera beside it."""

import math

import numpy as np

from schemas.base import Array
from schemas.capture.depth_camera import DepthCamera
from schemas.scene.camera import Intrinsics
from workers.geometry.jit import compiled
from workers.geometry.rational_lens import pixel_rays, project_points

STEEPEST = math.tan(math.radians(84.0))
"""Neighbouring pixels whose depth differs as on a surface seen at a larger angle of incidence lie on two surfaces.

At 1 m the Azure Kinect's narrow mode then has a step of 19 mm per pixel, some ten times its noise.
"""

ON_EDGE = 1e-9
"""A pixel centre so near to a triangle's edge, pixels or shares of its area, is inside: rounding leaves no cracks."""


def register_depth(
    depth_m: Array,
    camera: DepthCamera,
    color: Intrinsics,
    color_lens: Array | None = None,
    max_step: float | None = None,
) -> Array:
    """[H, W] float64, metres: z at the pixel centres of the colour camera, 0 where nothing was measured.

    depth_m [h, w] is z at the pixel centres of the depth camera, 0 (or anything not positive and finite) for none. Each square
    of four neighbouring depth pixels becomes two triangles, which are drawn into the colour image; 1 / z is interpolated, so
    that planes stay planes, and the nearest surface wins. Squares whose depths differ by more than `max_step` times the nearest
    one lie across an edge and are left out, and so are squares with a corner without depth. The default `max_step` follows from
    `STEEPEST`. `color_lens` (OpenCV's order, [8]) is the lens of the colour image as stored; None for a pinhole.

    Raises ValueError where the image is not of the depth camera's size.
    """
    k = camera.intrinsics
    if depth_m.shape != (k.height, k.width):
        raise ValueError(f"the depth image is {depth_m.shape}, and its camera has {(k.height, k.width)}")
    step = STEEPEST / min(k.fx, k.fy) if max_step is None else max_step
    depth = np.ascontiguousarray(depth_m, np.float64)
    points = _lift(depth, pixel_rays(k, camera.lens), camera.T_color_depth)
    pixels = project_points(points, color, np.zeros(8) if color_lens is None else color_lens)
    return _draw(pixels, points, depth, step, color.height, color.width)


@compiled
def _lift(depth_m: Array, rays: Array, T_color_depth: Array) -> Array:
    """[h * w, 3] float64: the depth image's points in the colour camera's frame; (0, 0, -1), behind it, where there is none."""
    T = T_color_depth
    points = np.empty((depth_m.size, 3))
    for i in range(depth_m.shape[0]):
        for j in range(depth_m.shape[1]):
            n, z = i * depth_m.shape[1] + j, depth_m[i, j]
            if z > 0.0 and math.isfinite(z) and math.isfinite(rays[i, j, 0]):
                x, y = rays[i, j, 0] * z, rays[i, j, 1] * z
                for axis in range(3):
                    points[n, axis] = T[axis, 0] * x + T[axis, 1] * y + T[axis, 2] * z + T[axis, 3]
            else:
                points[n, 0], points[n, 1], points[n, 2] = 0.0, 0.0, -1.0
    return points


@compiled
def _draw(pixels: Array, points: Array, depth_m: Array, max_step: float, height: int, width: int) -> Array:
    """The z-buffer [height, width] of the squares between four points, which are drawn at `pixels` (nan: nowhere)."""
    inverse = np.zeros((height, width))
    columns = depth_m.shape[1]
    for i in range(depth_m.shape[0] - 1):
        for j in range(columns - 1):
            a, d = i * columns + j, (i + 1) * columns + j
            if math.isnan(pixels[a, 0] + pixels[a + 1, 0] + pixels[d, 0] + pixels[d + 1, 0]):
                continue
            z0, z1, z2, z3 = depth_m[i, j], depth_m[i, j + 1], depth_m[i + 1, j + 1], depth_m[i + 1, j]
            nearest = min(min(z0, z1), min(z2, z3))
            if max(max(z0, z1), max(z2, z3)) - nearest > max_step * nearest:
                continue
            for b, c in ((a + 1, d + 1), (d + 1, d)):
                _draw_triangle(
                    inverse, pixels[a], pixels[b], pixels[c], 1 / points[a, 2], 1 / points[b, 2], 1 / points[c, 2]
                )
    for i in range(height):
        for j in range(width):
            if inverse[i, j] > 0.0:
                inverse[i, j] = 1.0 / inverse[i, j]
    return inverse


@compiled
def _draw_triangle(
    inverse: Array, a: Array, b: Array, c: Array, inverse_a: float, inverse_b: float, inverse_c: float
) -> None:
    """Puts 1 / z of a triangle at the pixel centres inside it, edges included, where it is nearer than what is there."""
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if not area > 0.0:
        return  # seen from behind, or edge-on
    left = max(math.ceil(min(min(a[0], b[0]), c[0]) - 0.5 - ON_EDGE), 0)
    right = min(math.floor(max(max(a[0], b[0]), c[0]) - 0.5 + ON_EDGE), inverse.shape[1] - 1)
    top = max(math.ceil(min(min(a[1], b[1]), c[1]) - 0.5 - ON_EDGE), 0)
    bottom = min(math.floor(max(max(a[1], b[1]), c[1]) - 0.5 + ON_EDGE), inverse.shape[0] - 1)
    outside = -ON_EDGE * area
    for row in range(top, bottom + 1):
        v = row + 0.5
        for column in range(left, right + 1):
            u = column + 0.5
            in_a = (c[0] - b[0]) * (v - b[1]) - (c[1] - b[1]) * (u - b[0])
            in_b = (a[0] - c[0]) * (v - c[1]) - (a[1] - c[1]) * (u - c[0])
            in_c = (b[0] - a[0]) * (v - a[1]) - (b[1] - a[1]) * (u - a[0])
            if in_a >= outside and in_b >= outside and in_c >= outside:
                at = (in_a * inverse_a + in_b * inverse_b + in_c * inverse_c) / (in_a + in_b + in_c)
                if at > inverse[row, column]:
                    inverse[row, column] = at
