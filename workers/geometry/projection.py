"""A depth image as another camera sees it: forward projection, sampling between pixels, and comparison of two depth images.

Forward projection looks at blocks of pixels first. A block lies in a frustum of the camera that took it; where that lies outside
of the other camera's view, no point of the block is in its image.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.scene.view import Camera, Intrinsics
from workers.geometry.frames import invert
from workers.geometry.jit import compiled, compiled_for
from workers.geometry.pixels import Depth, facing_at, is_smooth

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


@dataclass(frozen=True, eq=False)
class Projected:
    """A cloud as seen by another camera.

    depth_m [H, W] float64, z, 0 in holes; source [H, W] int32, the flat index of the source pixel, -1 in holes.
    """

    depth_m: Array
    source: NDArray[np.int32]


def forward_project(
    depth: Depth, source: Camera, target: Camera, splat: int = 1, units_per_m: float = 1.0
) -> Projected:
    """The cloud of a depth image as seen by another camera.

    The target pixel is the floor of (u, v); nearest z wins, ties to the lowest source index; holes stay 0
    (dataset.md "Projection"). With `splat` n > 1 each point fills a square of n x n pixels.
    """
    m = target.intrinsics
    T = invert(target.T_world_cam) @ source.T_world_cam
    k = source.intrinsics
    source_k, target_k = (k.cx, k.cy, k.fx, k.fy), (m.cx, m.cy, m.fx, m.fy)
    return Projected(*_splat(depth, units_per_m, source_k, T, target_k, splat // 2, (m.height, m.width)))


@compiled_for("u2[:,::1], f8, UniTuple(f8, 4), f8[:,::1], UniTuple(f8, 4), i8, UniTuple(i8, 2)")
def _splat(
    depth: Depth,
    units_per_m: float,
    k: tuple[float, float, float, float],
    T_target_source: Array,
    m: tuple[float, float, float, float],
    reach: int,
    shape: tuple[int, int],
) -> tuple[Array, NDArray[np.int32]]:
    """(depth, source index); k and m: cx, cy, fx, fy of source and target.

    Each row of the source is carried over first, as far as it may be in sight, in a loop without branches that is vectorised,
    and drawn then.
    """
    (height, width), (cx, cy, fx, fy) = shape, m
    nearest, index = np.zeros(shape), np.full(shape, -1, np.int32)
    all_nearest, all_index = nearest.ravel(), index.ravel()
    (xx, xy, xz, x0), (yx, yy, yz, y0), (zx, zy, zz, z0) = _rows(T_target_source)
    ray_x = (np.arange(depth.shape[1]) + 0.5 - k[0]) / k[2]
    ray_y = (np.arange(depth.shape[0]) + 0.5 - k[1]) / k[3]
    at_column, at_row, at_Z = np.empty(ray_x.shape, np.int32), np.empty(ray_x.shape, np.int32), np.empty(ray_x.shape)
    low, right, bottom = -float(reach), float(width + reach), float(height + reach)
    sides = bound_view(T_target_source, m, reach, shape)
    start = stop = 0
    for i in range(depth.shape[0]):
        if i % BLOCK[0] == 0:
            rows = slice(i, i + BLOCK[0])
            start, stop = columns_in_sight(depth[rows], units_per_m, ray_x, ray_y[rows], sides)
        source, rays = depth[i, start:stop], ray_x[start:stop]
        for j in range(len(source)):
            z = source[j] / units_per_m
            x, y = rays[j] * z, ray_y[i] * z
            Z = zx * x + zy * y + zz * z + z0
            u = fx * (xx * x + xy * y + xz * z + x0) / Z + cx
            v = fy * (yx * x + yy * y + yz * z + y0) / Z + cy
            seen = (source[j] > 0) & (Z > 0.0) & (u >= low) & (u < right) & (v >= low) & (v < bottom)
            at_column[j], at_row[j] = np.int32(np.floor(u) if seen else 0.0), np.int32(np.floor(v) if seen else 0.0)
            at_Z[j] = Z if seen else 0.0
        for j in range(len(source)):
            Z = at_Z[j]
            if Z == 0.0:
                continue
            pixel = i * depth.shape[1] + start + j
            if reach > 0:
                _draw_square((nearest, index), at_row[j], at_column[j], reach, Z, pixel)
                continue
            at = np.uint64(at_row[j] * width + at_column[j])  # a signed index is tested for counting from the end
            if all_index[at] < 0 or all_nearest[at] > Z:
                all_nearest[at], all_index[at] = Z, pixel
    return nearest, index


@compiled
def _draw_square(
    target: tuple[Array, NDArray[np.int32]], at_row: int, at_column: int, reach: int, Z: float, pixel: int
) -> None:
    """Draws a point over the pixels of the target (depth, source index) up to `reach` from one, which may lie outside."""
    nearest, index = target
    for row in range(max(at_row - reach, 0), min(at_row + reach + 1, nearest.shape[0])):
        for column in range(max(at_column - reach, 0), min(at_column + reach + 1, nearest.shape[1])):
            if index[row, column] < 0 or nearest[row, column] > Z:
                nearest[row, column], index[row, column] = Z, pixel


@compiled
def _rows(T: Array) -> tuple[tuple[float, float, float, float], ...]:
    """The upper three rows of T [4, 4] as numbers, which a loop keeps in registers."""
    return (
        (T[0, 0], T[0, 1], T[0, 2], T[0, 3]),
        (T[1, 0], T[1, 1], T[1, 2], T[1, 3]),
        (T[2, 0], T[2, 1], T[2, 2], T[2, 3]),
    )


@compiled
def sample_inverse_depth(
    depth: Depth, region: NDArray[np.uint8], u: float, v: float, units_per_m: float
) -> tuple[float, int]:
    """Depth in metres at image coordinates (u, v), interpolated bilinearly in 1/z, and the region there.

    Only where the four pixels about the point lie in the image, have depth and share one region; elsewhere depth is 0
    and region 0. On a plane 1/z is linear in the image, so this is exact there.
    """
    height, width = depth.shape
    x, y = u - 0.5, v - 0.5
    if not (0.0 <= x < width - 1 and 0.0 <= y < height - 1):
        return 0.0, 0
    column, row = int(np.floor(x)), int(np.floor(y))
    inverse, good = 0.0, True
    for dy in range(2):
        for dx in range(2):
            z = depth[row + dy, column + dx] / units_per_m
            good = good and z > 0.0 and region[row + dy, column + dx] == region[row, column]
            share = abs(1 - dx - (x - column)) * abs(1 - dy - (y - row))
            if z > 0.0:
                inverse += share / z
    return (1.0 / inverse, int(region[row, column])) if good else (0.0, 0)


def in_frame(u: Array, v: Array, intrinsics: Intrinsics) -> NDArray[np.bool_]:
    """[N] bool: whether image coordinates lie inside the image."""
    return (u >= 0) & (u < intrinsics.width) & (v >= 0) & (v < intrinsics.height)


Images = tuple[Depth, NDArray[np.uint8]]
Pinhole = tuple[float, float, float, float]


class Seen(NamedTuple):
    """A camera's depth image [H, W] and its regions [H, W]."""

    depth: Depth
    region: NDArray[np.uint8]
    camera: Camera


class Bounds(NamedTuple):
    """What counts as seen by both.

    `facing`: least cosine between the normal and the direction to the other camera; `smooth_m` of source and target, see
    `is_smooth`; `hidden_m`: how far a point may lie behind what the target sees.
    """

    facing: float
    smooth_m: tuple[float, float]
    hidden_m: float


def compare_covisible(
    source: Seen, target: Seen, pixels: NDArray[np.int64], bounds: Bounds, units_per_m: float
) -> tuple[Array, NDArray[np.uint8]]:
    """(differences [N] of depth, metres; regions [N]) at those pixels of the source (flat indices) that the target sees too.

    The source's depth is carried into the target, and compared with the target's, interpolated bilinearly in 1/z.
    """
    s, t = source.camera, target.camera
    eye = s.T_world_cam[:3, :3].T @ (t.position - s.position)
    T_target_source = invert(t.T_world_cam) @ s.T_world_cam
    k = _pinhole(s), _pinhole(t)
    return _compare(
        (source.depth, source.region),
        (target.depth, target.region),
        pixels,
        (eye[0], eye[1], eye[2]),
        T_target_source,
        k,
        (bounds.facing, bounds.smooth_m, bounds.hidden_m),
        units_per_m,
    )


def _pinhole(camera: Camera) -> Pinhole:
    k = camera.intrinsics
    return k.cx, k.cy, k.fx, k.fy


@compiled_for(
    "Tuple((u2[:,::1], const(u1[:,::1]))), Tuple((u2[:,::1], const(u1[:,::1]))), i8[::1], UniTuple(f8, 3), f8[:,::1], "
    "UniTuple(UniTuple(f8, 4), 2), Tuple((f8, UniTuple(f8, 2), f8)), f8"
)
def _compare(
    source: Images,
    target: Images,
    pixels: NDArray[np.int64],
    eye: tuple[float, float, float],
    T: Pose,
    k: tuple[Pinhole, Pinhole],
    bounds: tuple[float, tuple[float, float], float],
    units_per_m: float,
) -> tuple[Array, NDArray[np.uint8]]:
    """eye: the target's position as the source's camera sees it; k: cx, cy, fx, fy of source and target; bounds: as `Bounds`.

    All conditions must hold; those that take longest come last, as most pixels fail one before.
    """
    (depth, region), (cx, cy, fx, fy), (mx, my, gx, gy) = source, k[0], k[1]
    height, width = target[0].shape
    facing, smooth_m, hidden_m = bounds
    differences, regions, count = np.empty(len(pixels)), np.empty(len(pixels), np.uint8), 0
    for n in range(len(pixels)):
        row, column = pixels[n] // depth.shape[1], pixels[n] % depth.shape[1]
        z = depth[row, column] / units_per_m
        x, y = (column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z
        Z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if not Z > 0.0:
            continue
        u = gx * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / Z + mx
        v = gy * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / Z + my
        if not (0.0 <= u < width and 0.0 <= v < height):
            continue
        seen_m, seen_region = sample_inverse_depth(target[0], target[1], u, v, units_per_m)
        if not (seen_m > 0.0 and seen_region == region[row, column] and seen_m + hidden_m > Z):
            continue
        if not is_smooth(depth, region, row, column, smooth_m[0], units_per_m):
            continue
        if not facing_at(depth, units_per_m, region, row, column, k[0], eye) > facing:  # true where it is nan
            continue
        if _is_smooth_around(target, u, v, smooth_m[1], units_per_m):
            differences[count], regions[count] = abs(Z - seen_m), region[row, column]
            count += 1
    return differences[:count], regions[:count]


@compiled
def _is_smooth_around(images: Images, u: float, v: float, bound_m: float, units_per_m: float) -> bool:
    """Whether the four pixels about image coordinates see one smooth surface."""
    depth, region = images
    row = min(max(int(np.floor(v - 0.5)), 0), depth.shape[0] - 2)
    column = min(max(int(np.floor(u - 0.5)), 0), depth.shape[1] - 2)
    smooth = True
    for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
        smooth = smooth and is_smooth(depth, region, row + dy, column + dx, bound_m, units_per_m)
    return smooth
