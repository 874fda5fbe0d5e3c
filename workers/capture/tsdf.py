"""A truncated signed distance field: the mean, weighted by inverse variance, of every view's distance to its surface.

Curless and Levoy 1996, with the distance along the surface's normal in place of the distance along the ray, because the
latter grows with the angle of incidence.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.view import Camera
from workers.capture.depth_fit import FittedDepth
from workers.geometry.frames import invert
from workers.geometry.jit import compiled

FRONT_VOXELS = 3.0
"""Distances in front of the surface are cut off here: above the noise of a view after its fit, which is about 1 mm."""

BACK_VOXELS = 2.0
"""Behind the surface nothing is known from here on: short, so that the two sides of a thin wall hardly touch."""


@dataclass(frozen=True, eq=False)
class Volume:
    """Voxel centres at origin + voxel_m * (i, j, k), board frame; distance_m and weight [X, Y, Z] float32, near [X, Y, Z] uint16.

    distance_m is positive outside; weight is 0 where no view has seen the voxel. near counts the views that have their surface
    within the truncation.
    """

    origin: Array
    voxel_m: float
    distance_m: NDArray[np.float32]
    weight: NDArray[np.float32]
    near: NDArray[np.uint16]


def empty_volume(low: Array, high: Array, voxel_m: float) -> Volume:
    """A volume without views that reaches from corner to corner, board frame, metres."""
    shape = np.maximum(np.ceil((high - low) / voxel_m).astype(np.int64) + 1, 2)
    distance_m, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    return Volume(np.array(low), voxel_m, distance_m, weight, np.zeros(shape, np.uint16))


def views_near(volume: Volume, points: Array) -> NDArray[np.int32]:
    """[N] views that have a surface near points [N, 3] on the edges between voxels: the more of an edge's two ends."""
    at = (points - volume.origin) / volume.voxel_m
    last = np.array(volume.near.shape) - 1
    ends = [np.clip(turn(at).astype(np.int64), 0, last) for turn in (np.floor, np.ceil)]
    return np.maximum(*(volume.near[end[:, 0], end[:, 1], end[:, 2]] for end in ends)).astype(np.int32)


def integrate(volume: Volume, fitted: FittedDepth, camera: Camera) -> None:
    """Adds one view's depth to the volume."""
    k = camera.intrinsics
    _integrate(
        volume.distance_m,
        volume.weight,
        volume.near,
        volume.origin,
        volume.voxel_m,
        invert(camera.T_world_cam),
        (k.fx, k.fy, k.cx - fitted.left - 0.5, k.cy - fitted.top - 0.5),
        fitted.inverse,
        fitted.facing,
    )


@compiled
def sample_inverse(inverse: NDArray[np.float32], x: float, y: float) -> float:
    """1/z at (x, y), pixel centres on integers, 0 where there is none.

    Bilinear where all four pixels are of one surface, else the nearest pixel's.
    """
    height, width = inverse.shape
    near_column, near_row = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
    if near_column < 0 or near_row < 0 or near_column >= width or near_row >= height:
        return 0.0
    nearest = inverse[near_row, near_column]
    column, row = int(np.floor(x)), int(np.floor(y))
    if nearest == 0.0 or column < 0 or row < 0 or column + 1 >= width or row + 1 >= height:
        return nearest
    a, b = inverse[row, column], inverse[row, column + 1]
    c, d = inverse[row + 1, column], inverse[row + 1, column + 1]
    least, most = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    if not least > 0.988 * most:
        return nearest
    s, t = x - column, y - row
    return (a * (1.0 - s) + b * s) * (1.0 - t) + (c * (1.0 - s) + d * s) * t


@compiled
def _integrate(
    distance_m: NDArray[np.float32],
    weight: NDArray[np.float32],
    near: NDArray[np.uint16],
    origin: Array,
    voxel_m: float,
    T: Array,
    k: tuple[float, float, float, float],
    inverse: NDArray[np.float32],
    facing: NDArray[np.float32],
) -> None:
    """T: board to camera; k: fx, fy, cx, cy of the window with pixel centres on integers."""
    front, back, full = FRONT_VOXELS * voxel_m, BACK_VOXELS * voxel_m, 0.5 * BACK_VOXELS * voxel_m
    height, width = inverse.shape
    for i in range(distance_m.shape[0]):
        for j in range(distance_m.shape[1]):
            bx, by = origin[0] + i * voxel_m, origin[1] + j * voxel_m
            for n in range(distance_m.shape[2]):
                bz = origin[2] + n * voxel_m
                z = T[2, 0] * bx + T[2, 1] * by + T[2, 2] * bz + T[2, 3]
                if not z > 0.05:
                    continue
                x = k[0] * (T[0, 0] * bx + T[0, 1] * by + T[0, 2] * bz + T[0, 3]) / z + k[2]
                y = k[1] * (T[1, 0] * bx + T[1, 1] * by + T[1, 2] * bz + T[1, 3]) / z + k[3]
                if not (-0.5 < x < width - 0.5 and -0.5 < y < height - 0.5):
                    continue
                q = sample_inverse(inverse, x, y)
                if q == 0.0:
                    continue
                slope = facing[int(np.floor(y + 0.5)), int(np.floor(x + 0.5))]
                s = (1.0 / q - z) * slope
                if s <= -back:
                    continue
                # Depth's standard deviation grows with z^2 and with 1 / cosine.
                w = slope * slope * q * q * q * q
                if s < -full:
                    w *= (back + s) / (back - full)
                total = weight[i, j, n] + w
                if s > front:
                    s = front
                else:
                    near[i, j, n] += 1
                distance_m[i, j, n] = (distance_m[i, j, n] * weight[i, j, n] + s * w) / total
                weight[i, j, n] = total
