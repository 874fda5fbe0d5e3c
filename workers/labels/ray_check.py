"""Checks of labels before they are committed: every pair across its two views, a share of scenes by casting rays."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Range
from schemas.errors import LabelError
from schemas.job.run import Check
from schemas.scene.camera import Camera
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.scene import PosedScene
from schemas.scene.view import GBuffer, Pair
from workers.geometry.camera import unproject
from workers.geometry.raycast import cast_view, edge_distance_px, first_hit

EDGE_PX = 1.0 / 64.0
"""A pixel centre this near a projected edge may be on either side: the rasteriser keeps vertices to 1/256 pixel."""

PLANE_P999_MM = 0.01
OBJECT_MEDIAN_MM = 0.01
OBJECT_P99_MM = 0.05
"""Bounds on depth before quantisation, each a small part of a stored unit (0.2 mm)."""

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
    error_mm = np.abs(buffer.depth_m.astype(np.float64) - depth) * 1e3
    rows, columns = np.nonzero((region != buffer.region) & (error_mm > ONE_SURFACE_MM))
    if len(rows):
        away = edge_distance_px(scene.things, camera, np.stack([rows, columns], axis=1))
        wrong = away > EDGE_PX
        wrong[wrong] = ~_intersects(scene, camera, buffer, rows[wrong], columns[wrong])
        worst = int(np.argmax(np.where(wrong, away, -1.0)))
        if wrong[worst]:
            at = rows[worst], columns[worst]
            raise LabelError(
                "mask_disagrees",
                f"pixel ({at[1]}, {at[0]}) is region {buffer.region[at]} in the mask and {region[at]} by ray, "
                f"{away[worst]:.3f} px from the nearest edge",
            )
    stored = (depth > depth_range_m.low) & (depth < depth_range_m.high)
    same = (region == buffer.region) & (region > 0) & stored & (cosine > STEEPEST_COS)
    for region_id in np.unique(region[same]):
        pixels = np.argwhere(same & (region == region_id))
        to_edge = partial(edge_distance_px, scene.things, camera)
        _check_depth(int(region_id), error_mm[tuple(pixels.T)], pixels, to_edge)


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
        own = np.flatnonzero(named == thing.region_id)
        hit = first_hit([thing], origins[own], rays[own])
        met = np.isfinite(hit.distance) & np.isfinite(nearest.distance[own])
        own, z, cosine = own[met], hit.distance[met], hit.incidence_cos[met]
        slant = np.minimum(cosine, nearest.incidence_cos[own]) * np.linalg.norm(rays[own], axis=1)
        faithful = np.abs(drawn[own] - z) * 1e3 * slant < ONE_SURFACE_MM
        touching[own] = (np.abs(z - nearest.distance[own]) * 1e3 * slant < TOUCHING_MM) & faithful
    return touching


def _check_depth(
    region_id: int, error_mm: Array, pixels: NDArray[np.int64], edge_px: Callable[[NDArray[np.int64]], Array]
) -> None:
    """Bound the errors [N] of a region's depths; `edge_px` measures the distances of pixels [M, 2] from projected edges."""
    is_object = region_id >= REGION_FIRST_OBJECT
    bounds = [(50.0, OBJECT_MEDIAN_MM), (99.0, OBJECT_P99_MM)] if is_object else [(99.9, PLANE_P999_MM)]
    large = error_mm > bounds[-1][1]
    if float(np.percentile(error_mm, bounds[-1][0])) > bounds[-1][1]:
        # In a small region one pixel at an edge of the thing itself, which may show either side, is more than 1 %.
        at_edge = large.copy()
        at_edge[large] = edge_px(pixels[large]) <= EDGE_PX
        error_mm = error_mm[~at_edge]
    if len(error_mm) == 0:
        return
    for percentile, bound in bounds:
        found = float(np.percentile(error_mm, percentile))
        if found > bound:
            raise LabelError(
                "depth_disagrees",
                f"region {region_id}: {percentile:g} % of depths are within {found:.4f} mm of the ray's, the bound is {bound} mm",
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
