"""Which parts of a depth image another camera may see, without a look at each pixel.

A block of pixels lies in a frustum of the camera that took it. Where that lies outside of the other camera's view, no point
of the block is in its image.
"""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from workers.geometry.jit import compiled
from workers.geometry.normals import Depth

BLOCK = (16, 32)
"""Rows and columns of a block."""

ROUNDING = 1e-9
"""Of the terms of a sum: what is outside by less may be inside but for rounding, which is 1e-15 of them."""


@compiled
def bound_view(T: Pose, m: tuple[float, float, float, float], reach: int, shape: tuple[int, int]) -> Array:
    """[5, 4]: the planes about a camera's view; the product of each with a point (x, y, z, 1) in front of it is not negative.

    T: from the points' frame to the camera's; m: cx, cy, fx, fy. The image, of `shape` (H, W), is wider by `reach` pixels on
    each side. Planes are in pixels times metres, the last one in metres.
    """
    sides = np.empty((5, 4))
    for n in range(4):
        across, down, ahead = m[2] * T[0, n] + m[0] * T[2, n], m[3] * T[1, n] + m[1] * T[2, n], T[2, n]
        sides[0, n], sides[1, n] = across + reach * ahead, (shape[1] + reach) * ahead - across
        sides[2, n], sides[3, n] = down + reach * ahead, (shape[0] + reach) * ahead - down
        sides[4, n] = ahead
    return sides


@compiled
def columns_in_sight(
    depth: Depth, units_per_m: float, ray_x: NDArray[np.floating], ray_y: NDArray[np.floating], sides: Array
) -> tuple[int, int]:
    """The first column, and one after the last, of the blocks in some rows of a depth image [H, W] that may be in a view.

    ray_x [W] and ray_y [H]: x and y of what a pixel sees, over z; sides: `bound_view` of the camera that looks.
    """
    least, most = _extremes(depth)
    start = stop = 0
    for first in range(0, depth.shape[1], BLOCK[1]):
        last = min(first + BLOCK[1], depth.shape[1])
        near, far = least[first], most[first]
        for column in range(first, last):
            near, far = min(near, least[column]), max(far, most[column])
        rays = (ray_x[first], ray_x[last - 1], ray_y[0], ray_y[-1])
        if far > 0 and not _is_outside(near / units_per_m, far / units_per_m, rays, sides):
            start, stop = start if stop else first, last
    return start, stop


@compiled
def _extremes(depth: Depth) -> tuple[Depth, Depth]:
    """[W] and [W]: the least and the greatest depth in each column of [H, W]; what is nan does not count."""
    least = depth[0].copy()
    for column in range(len(least)):
        if not least[column] > 0:
            least[column] = 0
    most = least.copy()
    for row in range(1, depth.shape[0]):
        here = depth[row]
        for column in range(len(here)):
            z = here[column]
            least[column] = z if z < least[column] else least[column]
            most[column] = z if z > most[column] else most[column]
    return least, most


@compiled
def _is_outside(near: float, far: float, rays: tuple[float, float, float, float], sides: Array) -> bool:
    """Whether one of the planes has a frustum's eight corners outside; near and far: its z; rays: left, right, top, bottom."""
    size = far * (1.0 + max(abs(rays[0]), abs(rays[1])) + max(abs(rays[2]), abs(rays[3])))
    for n in range(len(sides)):
        a, b, c, d = sides[n, 0], sides[n, 1], sides[n, 2], sides[n, 3]
        slope = max(a * rays[0], a * rays[1]) + max(b * rays[2], b * rays[3]) + c
        rounding = ROUNDING * ((abs(a) + abs(b) + abs(c)) * size + abs(d))
        if max(near * slope, far * slope) + d < -rounding:
            return True
    return False
