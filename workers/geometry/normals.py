"""Direction and smoothness of the surfaces in a depth image."""

import math

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.camera import Camera
from workers.geometry.jit import compiled

Depth = NDArray[np.floating] | NDArray[np.uint16]
"""[H, W] z along the optical axis, in units of 1 / `units_per_m` metres; 0 where there is none."""


def facing_cosine(
    depth: Depth,
    region: NDArray[np.uint8],
    pixels: NDArray[np.int64],
    camera: Camera,
    viewpoint: Array,
    units_per_m: float = 1.0,
) -> Array:
    """Cosine between the surface's normal and the direction to `viewpoint` (world), at some pixels; nan where unknown.

    pixels [N] flat indices; returns [N] float64. The normal comes from central differences of the unprojected depth, on
    the side of the camera that took it; it is known where the pixel and its four neighbours have depth and belong to one
    region.
    """
    k = camera.intrinsics
    eye = camera.T_world_cam[:3, :3].T @ (viewpoint - camera.position)
    return _facing_cosine(depth, units_per_m, region, pixels, (k.cx, k.cy, k.fx, k.fy), eye)


Point = tuple[float, float, float]


@compiled
def _point(depth: Depth, units_per_m: float, row: int, column: int, k: tuple[float, float, float, float]) -> Point:
    """What a pixel sees, metres, in the camera's frame; k: cx, cy, fx, fy."""
    z = depth[row, column] / units_per_m
    return (column + 0.5 - k[0]) / k[2] * z, (row + 0.5 - k[1]) / k[3] * z, z


@compiled
def _between(a: Point, b: Point) -> Point:
    """A minus b: tuples, because numba allocates an array for each difference of arrays."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def _facing_cosine(
    depth: Depth,
    units_per_m: float,
    region: NDArray[np.uint8],
    pixels: NDArray[np.int64],
    k: tuple[float, float, float, float],
    eye: Array,
) -> Array:
    """k: cx, cy, fx, fy."""
    cosine = np.full(len(pixels), np.nan)
    for n in range(len(pixels)):
        row, column = pixels[n] // depth.shape[1], pixels[n] % depth.shape[1]
        cosine[n] = facing_at(depth, units_per_m, region, row, column, k, (eye[0], eye[1], eye[2]))
    return cosine


@compiled
def facing_at(
    depth: Depth,
    units_per_m: float,
    region: NDArray[np.uint8],
    row: int,
    column: int,
    k: tuple[float, float, float, float],
    eye: Point,
) -> float:
    """The cosine of `facing_cosine` at one pixel; k: cx, cy, fx, fy; eye: the viewpoint in the camera's frame.

    In that frame x runs right and y down, so that y across x points towards the camera.
    """
    if row == 0 or column == 0 or row == depth.shape[0] - 1 or column == depth.shape[1] - 1:
        return np.nan
    known = True
    for dy, dx in ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0)):
        alike = region[row + dy, column + dx] == region[row, column]
        known = known and alike and depth[row + dy, column + dx] > 0
    if not known:
        return np.nan
    a = _between(_point(depth, units_per_m, row + 1, column, k), _point(depth, units_per_m, row - 1, column, k))
    b = _between(_point(depth, units_per_m, row, column + 1, k), _point(depth, units_per_m, row, column - 1, k))
    normal = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    towards = _between(eye, _point(depth, units_per_m, row, column, k))
    along = normal[0] * towards[0] + normal[1] * towards[1] + normal[2] * towards[2]
    length2 = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
    away2 = towards[0] * towards[0] + towards[1] * towards[1] + towards[2] * towards[2]
    if length2 > 0.0 and away2 > 0.0:
        return along / (math.sqrt(length2) * math.sqrt(away2))
    return np.nan


@compiled
def is_smooth(
    depth: Depth, region: NDArray[np.uint8], row: int, column: int, bound_m: float, units_per_m: float
) -> bool:
    """Whether a pixel and its four neighbours see one smooth surface of one region.

    On a plane 1/z is linear in the image; its second differences, times z squared, are the step in depth that
    a plane does not explain, and must stay below `bound_m` along rows and along columns.
    """
    height, width = depth.shape
    z = depth[row, column] / units_per_m
    good = 0 < row < height - 1 and 0 < column < width - 1 and z > 0.0
    for dy, dx in ((0, 1), (1, 0)):
        if good:
            a, b = depth[row + dy, column + dx] / units_per_m, depth[row - dy, column - dx] / units_per_m
            alike = region[row + dy, column + dx] == region[row, column] == region[row - dy, column - dx]
            good = alike and a > 0.0 and b > 0.0 and abs(1.0 / a + 1.0 / b - 2.0 / z) * z * z < bound_m
    return good
