"""Checks of labels before they are committed: every pair across its two views, a share of scenes by casting rays."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Range
from schemas.errors import LabelError
from schemas.job.job import Check
from schemas.scene.scene import PosedScene
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import Camera, GBuffer, Pair
from workers.geometry.camera import unproject
from workers.geometry.jit import compiled_for
from workers.geometry.raycast import cast_view, edge_distance_px, first_hit

EDGE_PX = 1.0 / 64.0
"""A pixel centre this near a projected edge may be on either side: the rasteriser keeps vertices to 1/256 pixel."""

PLANE_P999_MM = 0.01
OBJECT_MEDIAN_MM = 0.01
OBJECT_P99_MM = 0.05
"""Bounds on depth before quantisation, each a small part of a stored unit (0.2 mm)."""

LEAST_BOUND_MM = min(PLANE_P999_MM, OBJECT_MEDIAN_MM, OBJECT_P99_MM)
"""Errors up to this are within every bound."""

ONE_SURFACE_MM = 0.02
"""Surfaces this near are both right: where two things touch or intersect, no edge marks the line between them."""

TOUCHING_MM = 0.1
"""Half a unit of stored depth. The renderer may show either of two surfaces that touch or intersect within this distance: its
depth bias keeps things apart by some micrometres for each step of their order."""

STEEPEST_COS = math.cos(math.radians(80.0))
"""Beyond 80 degrees of incidence a thousandth of a pixel moves depth by more than the bound."""


def check_against_rays(scene: PosedScene, camera: Camera, buffer: GBuffer, depth_range_m: Range) -> None:
    """Hold depth and regions of one rendered view against cast rays, region by region. Raises LabelError.

    Depth is compared where it would be stored: a floor tens of metres away is stored as 0, and float32 does not resolve
    its depth to the bound.
    """
    depth, region, cosine = cast_view(scene.things, camera)
    bounds = depth_range_m.low, depth_range_m.high, np.float32(STEEPEST_COS)
    differ, compared, count, large = _compare((buffer.depth_m, buffer.region), (depth, region, cosine), bounds)
    if len(differ):
        rows, columns = np.divmod(differ, depth.shape[1])
        away = edge_distance_px(scene.things, camera, np.stack([rows, columns], axis=1))
        wrong = away > EDGE_PX
        if wrong.any():
            wrong[wrong] = ~_intersects(scene, camera, buffer, rows[wrong], columns[wrong])
        worst = int(np.argmax(np.where(wrong, away, -1.0)))
        if wrong[worst]:
            at = rows[worst], columns[worst]
            raise LabelError(
                "mask_disagrees",
                f"pixel ({at[1]}, {at[0]}) is region {buffer.region[at]} in the mask and {region[at]} by ray, "
                f"{away[worst]:.3f} px from the nearest edge",
            )
    to_edge = partial(edge_distance_px, scene.things, camera)
    for region_id in np.flatnonzero(large).tolist():
        # Fewer large errors than lie above the percentile leave it below its bound, and need no sorting.
        if large[region_id] + 1 >= (count[region_id] - 1) * (1.0 - _bounds(region_id)[-1][0] / 100.0):
            pixels = np.argwhere(compared == region_id)
            rows, columns = pixels.T
            error_mm = np.abs(buffer.depth_m[rows, columns].astype(np.float64) - depth[rows, columns]) * 1e3
            _check_depth(region_id, error_mm, pixels, to_edge)


@compiled_for(
    "Tuple((const(f4[:,::1]), const(u1[:,::1]))), Tuple((f8[:,::1], u1[:,::1], f4[:,::1])), Tuple((f8, f8, f4))"
)
def _compare(
    drawn: tuple[NDArray[np.float32], NDArray[np.uint8]],
    cast: tuple[Array, NDArray[np.uint8], NDArray[np.float32]],
    bounds: tuple[float, float, np.float32],
) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]]:
    """(flat numbers of pixels that differ, compared, count, large): a rendered view beside the cast one, in one pass.

    drawn: depth and region [H, W]; cast: depth, region and cosine; bounds: depths that are stored, and `STEEPEST_COS`.
    Pixels differ in region and by more than `ONE_SURFACE_MM`. compared [H, W]: the region where depth is to be compared,
    else 0; count [256]: pixels of a region there; large [256]: those whose depth is off by more than `LEAST_BOUND_MM`.
    """
    (z_drawn, region_drawn), (z_cast, region_cast, cosine), (low, high, steepest) = drawn, cast, bounds
    width = z_cast.shape[1]
    differ, differing = np.empty(z_cast.size, np.int64), 0
    compared = np.zeros(z_cast.shape, np.uint8)
    count, large = np.zeros(256, np.int64), np.zeros(256, np.int64)
    for row in range(z_cast.shape[0]):
        for column in range(width):
            z, region = z_cast[row, column], region_cast[row, column]
            error_mm = abs(np.float64(z_drawn[row, column]) - z) * 1e3
            if region != region_drawn[row, column]:
                if error_mm > ONE_SURFACE_MM:
                    differ[differing] = row * width + column
                    differing += 1
            elif region > 0 and low < z < high and cosine[row, column] > steepest:
                compared[row, column] = region
                count[region] += 1
                large[region] += error_mm > LEAST_BOUND_MM
    return differ[:differing].copy(), compared, count, large


def _intersects(
    scene: PosedScene, camera: Camera, buffer: GBuffer, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """[N] bool: whether a pixel's ray hits the thing that the mask names within `TOUCHING_MM` of its first hit.

    Distances are along the normal of the more slanted surface: along the ray two such surfaces may be far apart. The
    mask's own depth must be that of the thing it names.
    """
    k, R = camera.intrinsics, camera.T_world_cam[:3, :3]
    rays = unproject(rows, columns, np.ones(len(rows)), k) @ R.T
    origins = np.broadcast_to(camera.position, rays.shape)
    nearest, touching = first_hit(scene.things, origins, rays), np.zeros(len(rows), bool)
    named, drawn = buffer.region[rows, columns], buffer.depth_m[rows, columns].astype(np.float64)
    for thing in scene.things:
        pixels = np.flatnonzero(named == thing.region_id)
        hit = first_hit([thing], origins[pixels], rays[pixels])
        met = np.isfinite(hit.distance) & np.isfinite(nearest.distance[pixels])
        pixels, z, cosine = pixels[met], hit.distance[met], hit.incidence_cos[met]
        slant = np.minimum(cosine, nearest.incidence_cos[pixels]) * np.linalg.norm(rays[pixels], axis=1)
        faithful = np.abs(drawn[pixels] - z) * 1e3 * slant < ONE_SURFACE_MM
        touching[pixels] = (np.abs(z - nearest.distance[pixels]) * 1e3 * slant < TOUCHING_MM) & faithful
    return touching


def _bounds(region_id: int) -> list[tuple[float, float]]:
    """(percentile, bound in mm) of a region's errors of depth, ascending."""
    is_object = region_id >= REGION_FIRST_OBJECT
    return [(50.0, OBJECT_MEDIAN_MM), (99.0, OBJECT_P99_MM)] if is_object else [(99.9, PLANE_P999_MM)]


def _check_depth(
    region_id: int, error_mm: Array, pixels: NDArray[np.int64], edge_px: Callable[[NDArray[np.int64]], Array]
) -> None:
    """Bound the errors [N] of a region's depths; `edge_px` measures the distances of pixels [M, 2] from projected edges."""
    bounds = _bounds(region_id)
    large = error_mm > bounds[-1][1]
    if float(np.percentile(error_mm, bounds[-1][0])) > bounds[-1][1]:
        # In a small region one pixel at an edge of the thing itself, which may show either side, is more than 1 %.
        at_edge = large.copy()
        at_edge[large] = edge_px(pixels[large]) <= EDGE_PX
        error_mm = error_mm[~at_edge]
    if len(error_mm) == 0:
        return
    for percentile, bound in bounds:
        error = float(np.percentile(error_mm, percentile))
        if error > bound:
            raise LabelError(
                "depth_disagrees",
                f"region {region_id}: {percentile:g} % of depths are within {error:.4f} mm of the ray's, the bound is {bound} mm",
            )


def check_pair(pair: Pair, check: Check) -> None:
    """Compare a pair's two views as they were before the sensors' effects. Raises LabelError."""
    agreement = pair.exact_agreement
    if agreement is None:  # there is no second view
        return
    for what, median in (("the object", agreement.median_mm), ("the scene", agreement.scene_median_mm)):
        if median is not None and median > check.mirror_agreement_mm:
            raise LabelError(
                "views_disagree",
                f"input depth of {what} carried into the mirror view is off by {median:.3f} mm in the median, "
                f"check.mirror_agreement_mm is {check.mirror_agreement_mm:g}",
            )
