"""One surface in two depth images: where both cameras see it, and by how much they differ there."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.scene.camera import Camera
from workers.geometry.frames import invert
from workers.geometry.jit import compiled
from workers.geometry.normals import Depth, facing_at, is_smooth
from workers.geometry.projection import sample_inverse_depth

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


@compiled
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
