"""The agreement of two views: input depth carried into the mirror view against mirror depth. Pure."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.job.images import Images
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.view import Agreement, View
from workers.geometry.camera import project
from workers.geometry.normals import facing_cosine, is_smooth
from workers.geometry.projection import in_frame, reproject_pixels, sample_inverse_depth
from workers.labels.projected_view import HIDDEN_M

FEWEST_POINTS = 50
"""An agreement of fewer co-visible pixels is not given."""

FACING = 0.1
"""A surface whose normal is more than 84 degrees from the mirror camera counts as turned away."""

SMOOTH_INPUT_M = 0.002
SMOOTH_MIRROR_M = 0.001
"""Depth that bends by more from one pixel to the next (some 4.8 mm apart in the input view, 2.5 mm in the mirror's) has an
edge there: a sphere of 35 mm bends by 0.7 and 0.2 mm."""

SCENE_STRIDE = 8
"""Of floor and table one pixel in this many along each axis is compared: they have hundreds of times the pixels that their
median needs."""


def compare_views(source: View, mirror: View, images: Images, bound_mm: float) -> Agreement:
    """Carry the stored input depth into the mirror view and compare it with the stored mirror depth.

    The mirror depth is interpolated bilinearly in 1/z among four pixels. A pixel of the input is compared where it is
    co-visible: its surface faces the mirror camera too, the mirror view has the same region there, and it does not lie
    `HIDDEN_M` behind what the mirror camera sees. Both images must show one smooth surface there, each by its own depth:
    across the rim of a mug, a pixel or two wide, there is nothing to interpolate.
    Every pixel of an object is compared, and of the rest one in `SCENE_STRIDE` squared.
    """
    assert source.region is not None and mirror.region is not None
    units = images.depth_units_per_m
    pixels = _sample_pixels(source.region)
    facing = facing_cosine(source.depth, source.region, pixels, source.camera, mirror.camera.position, units)
    index = pixels[facing > FACING]  # false where it is nan
    index = index[is_smooth(source.depth, source.region, index, SMOOTH_INPUT_M, units)]
    points = reproject_pixels(source.depth, index, source.camera, mirror.camera, units)
    keep = points[:, 2] > 0.0
    points, index = points[keep], index[keep]
    u, v = project(points, mirror.camera.intrinsics)
    inside = in_frame(u, v, mirror.camera.intrinsics)
    points, index, u, v = points[inside], index[inside], u[inside], v[inside]
    seen, region = sample_inverse_depth(mirror.depth, mirror.region, u, v, units)
    own = source.region.ravel()[index]
    both = np.flatnonzero((seen > 0.0) & (region == own) & (points[:, 2] < seen + HIDDEN_M))
    both = both[_smooth_around(mirror.depth, mirror.region, u[both], v[both], units)]
    difference_mm = np.abs(points[both, 2] - seen[both]) * 1e3
    object_mm = difference_mm[own[both] >= REGION_FIRST_OBJECT]
    enough = len(object_mm) >= FEWEST_POINTS
    return Agreement(
        median_mm=float(np.median(object_mm)) if enough else None,
        share=float((object_mm <= bound_mm).mean()) if enough else None,
        points=len(object_mm),
        scene_median_mm=float(np.median(difference_mm)) if len(difference_mm) >= FEWEST_POINTS else None,
    )


def _sample_pixels(region: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Flat indices, ascending: every pixel of an object, and a grid over everything else."""
    chosen = region >= REGION_FIRST_OBJECT
    chosen[::SCENE_STRIDE, ::SCENE_STRIDE] = True
    return np.flatnonzero(chosen)


def _smooth_around(
    depth: NDArray[np.uint16], region: NDArray[np.uint8], u: Array, v: Array, units_per_m: float
) -> NDArray[np.bool_]:
    """[N] bool: whether the four pixels about each image coordinate see one smooth surface."""
    height, width = depth.shape
    column = np.clip(np.floor(u - 0.5).astype(np.int64), 0, width - 2)
    row = np.clip(np.floor(v - 0.5).astype(np.int64), 0, height - 2)
    corners = (row * width + column)[:, None] + np.array([0, 1, width, width + 1])
    smooth = is_smooth(depth, region, corners.ravel(), SMOOTH_MIRROR_M, units_per_m).reshape(-1, 4)
    return smooth[:, 0] & smooth[:, 1] & smooth[:, 2] & smooth[:, 3]
