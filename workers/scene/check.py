"""Labels are checked before they are committed: every pair across its two views, a share of scenes by casting rays."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Range
from schemas.camera import Camera
from schemas.errors import LabelError
from schemas.job import Check, Job
from schemas.scene import REGION_FIRST_OBJECT, GBuffer, Pair, PosedScene
from workers.geometry.raycast import cast_view, edge_distance_px
from workers.scene.randomness import Stream, stream

EDGE_PX = 1.0 / 64.0
"""A pixel centre this near a projected edge may fall to either side: the rasteriser keeps vertices to 1/256 pixel."""

PLANE_P999_MM = 0.01
OBJECT_MEDIAN_MM = 0.01
OBJECT_P99_MM = 0.05
"""Bounds on depth before quantisation, each a small part of a stored unit (0.2 mm)."""

ONE_SURFACE_MM = 0.02
"""Where two things touch or cut through one another no edge marks the line, and surfaces this near are both the answer."""

STEEPEST_COS = math.cos(math.radians(80.0))
"""Beyond 80 degrees of incidence a thousandth of a pixel moves depth by more than the bound."""


def is_raycast_scene(job: Job, scene_id: int) -> bool:
    """Whether this scene belongs to the share that is checked against the ray caster: a function of seed and id."""
    return bool(stream(job.seed, scene_id, Stream.RAYCAST_CHECK).random() < job.check.raycast_share)


def check_against_rays(scene: PosedScene, camera: Camera, buffer: GBuffer, depth_range_m: Range) -> None:
    """Hold depth and regions of one rendered view against cast rays, region by region. Raises LabelError.

    Depth is compared where it would be stored: a floor tens of metres away is seen in a wide view, is stored as 0, and
    is beyond what float32 resolves to the bound.
    """
    depth, region, cosine = cast_view(scene.things, camera)
    error_mm = np.abs(buffer.depth_m.astype(np.float64) - depth) * 1e3
    rows, columns = np.nonzero((region != buffer.region) & (error_mm > ONE_SURFACE_MM))
    if len(rows):
        away = edge_distance_px(scene.things, camera, np.stack([rows, columns], axis=1))
        worst = int(np.argmax(away))
        if away[worst] > EDGE_PX:
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


def _check_depth(
    region_id: int, error_mm: Array, pixels: NDArray[np.int64], edge_px: Callable[[NDArray[np.int64]], Array]
) -> None:
    """Bounds on the errors [N] of a region's depths; `edge_px` tells how far pixels [M, 2] lie from a projected edge."""
    is_object = region_id >= REGION_FIRST_OBJECT
    bounds = [(50.0, OBJECT_MEDIAN_MM), (99.0, OBJECT_P99_MM)] if is_object else [(99.9, PLANE_P999_MM)]
    large = error_mm > bounds[-1][1]
    if float(np.percentile(error_mm, bounds[-1][0])) > bounds[-1][1]:
        # Of few pixels, one at an edge of the thing itself, where it may show either side, is more than 1 %.
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
    """Hold a pair's two views, as they were before the sensors' effects, against each other. Raises LabelError."""
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
