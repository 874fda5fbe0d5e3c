"""Which way the surface in a depth image faces."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.camera import Camera
from workers.geometry.camera import unproject


def facing_cosine(
    depth_m: Array, region: NDArray[np.uint8], pixels: NDArray[np.int64], camera: Camera, viewpoint: Array
) -> Array:
    """Cosine between the surface's normal and the direction to `viewpoint` (world), at some pixels; nan where unknown.

    depth_m [H, W] metres, 0 for none; pixels [N] flat indices; returns [N] float64. The normal comes from central
    differences of the unprojected depth, on the side of the camera that took it; it is known where the pixel and its
    four neighbours have depth and belong to one region.
    """
    height, width = depth_m.shape
    if min(height, width) < 3:
        return np.full(len(pixels), np.nan)  # no pixel has four neighbours
    rows, columns = np.divmod(pixels, width)
    inner = (rows > 0) & (rows < height - 1) & (columns > 0) & (columns < width - 1)
    at = np.where(inner, pixels, width + 1)
    flat, ids = depth_m.ravel(), region.ravel()
    known = inner & (flat[at] > 0.0)
    points = []
    for step in (1, -1, width, -width):
        known &= (ids[at + step] == ids[at]) & (flat[at + step] > 0.0)
        points.append(unproject(*np.divmod(at + step, width), flat[at + step], camera.intrinsics))
    # x runs right and y down, so that y across x points towards the camera.
    normal = np.cross(points[2] - points[3], points[0] - points[1])
    here = unproject(*np.divmod(at, width), flat[at], camera.intrinsics)
    towards = camera.T_world_cam[:3, :3].T @ (viewpoint - camera.position) - here
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(towards, axis=1)
    cosine = np.full(len(pixels), np.nan)
    np.divide((normal * towards).sum(axis=1), length, out=cosine, where=known & (length > 0.0))
    return cosine


def is_smooth(
    depth_m: Array, region: NDArray[np.uint8], pixels: NDArray[np.int64], bound_m: float
) -> NDArray[np.bool_]:
    """[N] bool: whether a pixel (flat index) and its four neighbours see one smooth surface of one region.

    On a plane 1/z is linear in the image; what its second differences leave, times z squared, is the step in depth that
    a plane does not explain, and must stay below `bound_m` along rows and along columns.
    """
    height, width = depth_m.shape
    if min(height, width) < 3:
        return np.zeros(len(pixels), bool)
    rows, columns = np.divmod(pixels, width)
    inner = (rows > 0) & (rows < height - 1) & (columns > 0) & (columns < width - 1)
    at = np.where(inner, pixels, width + 1)
    flat, ids = depth_m.ravel(), region.ravel()
    smooth = inner & (flat[at] > 0.0)
    z = np.where(smooth, flat[at], 1.0)
    for step in (1, width):
        a, b = flat[at + step], flat[at - step]
        smooth &= (a > 0.0) & (b > 0.0) & (ids[at + step] == ids[at]) & (ids[at - step] == ids[at])
        bend = 1.0 / np.where(a > 0.0, a, 1.0) + 1.0 / np.where(b > 0.0, b, 1.0) - 2.0 / z
        smooth &= np.abs(bend) * z * z < bound_m
    return smooth
