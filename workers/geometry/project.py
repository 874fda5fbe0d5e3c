"""Forward projection of a depth image into another camera, and the comparison of two views of one surface."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.camera import Camera, Intrinsics
from workers.geometry.camera import unproject
from workers.geometry.frames import invert, transform
from workers.geometry.loops import compiled


@dataclass(frozen=True, eq=False)
class Projected:
    """What a cloud looks like from another camera.

    depth_m [H, W] float64, z, 0 in holes; source [H, W] int64, the flat index of the source pixel, -1 in holes.
    """

    depth_m: Array
    source: NDArray[np.int64]


def carry_pixels(depth_m: Array, pixels: NDArray[np.int64], source: Camera, target: Camera) -> Array:
    """[N, 3] float64: points in the target's frame of the source's pixels (flat indices [N]).

    depth_m [H, W] float64 is z along the source's axis.
    """
    rows, columns = np.divmod(pixels, depth_m.shape[1])
    points = unproject(rows, columns, depth_m.ravel()[pixels], source.intrinsics)
    return transform(invert(target.T_world_cam) @ source.T_world_cam, points)


def forward_project(depth_m: Array, source: Camera, target: Camera, splat: int = 1) -> Projected:
    """Carry a depth image into another camera.

    The target pixel is the floor of (u, v); nearest z wins, ties to the lowest source index; holes stay 0
    (dataset.md "Projection"). With `splat` n > 1 each point fills a square of n x n pixels.
    """
    m = target.intrinsics
    depth, index = np.zeros((m.height, m.width)), np.full((m.height, m.width), -1, np.int64)
    T = invert(target.T_world_cam) @ source.T_world_cam
    k = source.intrinsics
    _carry(depth_m, (k.cx, k.cy, k.fx, k.fy), T, (m.cx, m.cy, m.fx, m.fy), splat // 2, depth, index)
    return Projected(depth, index)


@compiled
def _carry(
    depth_m: Array,
    k: tuple[float, float, float, float],
    T_target_source: Array,
    m: tuple[float, float, float, float],
    reach: int,
    depth: Array,
    index: NDArray[np.int64],
) -> None:
    """Fill depth and index; k and m: cx, cy, fx, fy of source and target. Sums in the order of `carry_pixels`."""
    height, width = depth.shape
    T = T_target_source
    for i in range(depth_m.shape[0]):
        ray_y = (i + 0.5 - k[1]) / k[3]
        for j in range(depth_m.shape[1]):
            z = depth_m[i, j]
            if not z > 0.0:
                continue
            x, y = (j + 0.5 - k[0]) / k[2] * z, ray_y * z
            Z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if not Z > 0.0:
                continue
            u = m[2] * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / Z + m[0]
            v = m[3] * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / Z + m[1]
            if not (-reach <= u < width + reach and -reach <= v < height + reach):
                continue
            column, row = int(np.floor(u)), int(np.floor(v))
            for at_row in range(max(row - reach, 0), min(row + reach + 1, height)):
                for at in range(max(column - reach, 0), min(column + reach + 1, width)):
                    if index[at_row, at] < 0 or depth[at_row, at] > Z:
                        depth[at_row, at] = Z
                        index[at_row, at] = i * depth_m.shape[1] + j


def sample_inverse_depth(
    depth_m: Array, region: NDArray[np.uint8], u: Array, v: Array
) -> tuple[Array, NDArray[np.uint8]]:
    """Depth at image coordinates (u, v), interpolated bilinearly in 1/z, and the region there.

    Only where the four pixels about the point lie in the image, have depth and share one region; elsewhere depth is 0
    and region 0. On a plane 1/z is linear in the image, so this is exact there. Returns [N] float64 and [N] uint8.
    """
    height, width = depth_m.shape
    if min(height, width) < 2:
        return np.zeros(len(u)), np.zeros(len(u), np.uint8)  # no point has four pixels about it
    x, y = u - 0.5, v - 0.5
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    inside = (column >= 0) & (column < width - 1) & (row >= 0) & (row < height - 1)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    fx, fy = x - column, y - row
    corners = [(row, column), (row, column + 1), (row + 1, column), (row + 1, column + 1)]
    depths = np.stack([depth_m[c] for c in corners])
    regions = np.stack([region[c] for c in corners])
    good = inside & (depths > 0.0).all(axis=0) & (regions == regions[0]).all(axis=0)
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    inverse = (weights / np.where(depths > 0.0, depths, 1.0)).sum(axis=0)
    return np.where(good, 1.0 / np.where(good, inverse, 1.0), 0.0), np.where(good, regions[0], 0).astype(np.uint8)


def in_frame(u: Array, v: Array, intrinsics: Intrinsics) -> NDArray[np.bool_]:
    """[N] bool: whether image coordinates lie inside the image."""
    return (u >= 0) & (u < intrinsics.width) & (v >= 0) & (v < intrinsics.height)
