"""Forward projection of a depth image into another camera, and the comparison of two views of one surface."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.camera import Camera, Intrinsics
from workers.geometry.camera import unproject
from workers.geometry.frames import invert, transform

ROWS = 32
"""Rows of an image that are worked on at once, so that what is in between stays in the processor's cache."""


@dataclass(frozen=True, eq=False)
class Projected:
    """What a cloud looks like from another camera.

    depth_m [H, W] float64, z, 0 in holes; source [H, W] int64, the flat index of the source pixel, -1 in holes.
    """

    depth_m: Array
    source: NDArray[np.int64]


def cloud_in_camera(depth_m: Array, source: Camera, target: Camera) -> tuple[Array, NDArray[np.int64]]:
    """Points [N, 3] float64 in the target's frame, and the flat source index [N] of each, in ascending order.

    depth_m [H, W] float64 is z along the source's axis, 0 where there is none.
    """
    index = np.flatnonzero(depth_m)
    rows, columns = np.divmod(index, depth_m.shape[1])
    points = unproject(rows, columns, depth_m.ravel()[index], source.intrinsics)
    T_target_source = invert(target.T_world_cam) @ source.T_world_cam
    return transform(T_target_source, points), index


def forward_project(depth_m: Array, source: Camera, target: Camera, splat: int = 1) -> Projected:
    """Carry a depth image into another camera.

    The target pixel is the floor of (u, v); nearest z wins, ties to the lowest source index; holes stay 0
    (dataset.md "Projection"). With `splat` n > 1 each point fills a square of n x n pixels.
    """
    height, width = target.intrinsics.height, target.intrinsics.width
    reach = splat // 2
    T = invert(target.T_world_cam) @ source.T_world_cam
    strips = [
        _carry_strip(depth_m[first : first + ROWS], first, (source.intrinsics, target.intrinsics, T), reach)
        for first in range(0, len(depth_m), ROWS)
    ]
    column, row, z, index = (np.concatenate(part) for part in zip(*strips, strict=True))
    if reach:
        dy, dx = (d.ravel() for d in np.mgrid[-reach : reach + 1, -reach : reach + 1])
        column, row = (column[:, None] + dx).ravel(), (row[:, None] + dy).ravel()
        z, index = np.repeat(z, splat * splat), np.repeat(index, splat * splat)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row, z, index = column[inside], row[inside], z[inside], index[inside]
    return _nearest(row * width + column, z, index, (height, width))


def _carry_strip(
    depth_m: Array, first: int, cameras: tuple[Intrinsics, Intrinsics, Array], reach: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, NDArray[np.int64]]:
    """(column, row, z, source index), each [N], of the points of some rows from `first` on that fall near the target.

    `cameras`: source, target, and T_target_source. The same sums as `cloud_in_camera`, in the same order, over all
    pixels of the rows: gathering the points first costs three times as much as the arithmetic on those that have none.
    """
    k, m, T = cameras
    x = (np.arange(k.width) + 0.5 - k.cx) / k.fx * depth_m
    y = ((np.arange(first, first + len(depth_m)) + 0.5 - k.cy) / k.fy)[:, None] * depth_m
    X, Y, Z = (T[i, 0] * x + T[i, 1] * y + T[i, 2] * depth_m + T[i, 3] for i in range(3))
    ahead = np.where(Z > 0.0, Z, 1.0)
    u, v = m.fx * X / ahead + m.cx, m.fy * Y / ahead + m.cy
    near = (Z > 0.0) & (u >= -reach) & (u < m.width + reach) & (v >= -reach) & (v < m.height + reach)
    index = np.flatnonzero(near & (depth_m > 0.0))
    column, row = (np.floor(c.ravel()[index]).astype(np.int64) for c in (u, v))
    return column, row, Z.ravel()[index], index + first * k.width


def _nearest(pixel: NDArray[np.int64], z: Array, index: NDArray[np.int64], shape: tuple[int, int]) -> Projected:
    """Of the points that fall on one pixel keep the nearest, then the lowest index.

    `index` ascends, so writing from the far end of a stable order by z leaves the winner; no sort of all keys is
    needed: the smallest z of each pixel first, then the smallest index among those that have it.
    """
    depth = np.full(shape[0] * shape[1], np.inf)
    np.minimum.at(depth, pixel, z)
    winner = z == depth[pixel]
    source = np.full(depth.shape, np.iinfo(np.int64).max)
    np.minimum.at(source, pixel[winner], index[winner])
    hole = np.isinf(depth)
    depth[hole] = 0.0
    source[hole] = -1
    return Projected(depth.reshape(shape), source.reshape(shape))


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
