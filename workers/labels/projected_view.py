"""The projected view: the stored input cloud as the mirror camera sees it. Pure."""

import numpy as np
from numpy.typing import NDArray

from schemas.job.images import Images
from schemas.job.sensor import Distortion
from schemas.scene.camera import Camera, Intrinsics
from schemas.scene.effects import EffectPlan
from schemas.scene.view import View
from workers.geometry.distortion import distort
from workers.geometry.pixels import count_filled, facing_cosine, gather_colours, quantise_depth
from workers.geometry.projection import Projected, forward_project, in_frame

HIDDEN_M = 0.01
"""A projected point this far behind what the mirror camera sees is hidden."""


def derive_projected(
    source: View, mirror: Camera, images: Images, lens: Distortion | None, effects: EffectPlan
) -> tuple[NDArray[np.uint8] | None, NDArray[np.uint16]]:
    """RGB [H, W, 3] uint8 and depth [H, W] uint16 of the stored input cloud seen from the mirror camera; holes 0.

    RGB is None where the source has none. `lens` is the one that the source's RGB was drawn through.
    """
    projected = carry_depth(source, mirror, images, effects)
    depth = quantise_depth(projected.depth_m, images)
    pixels: NDArray[np.integer] = projected.source
    if source.rgb is None:
        return None, depth
    if lens is not None and effects.runs("sensor_distortion"):
        pixels = pixels_behind(lens, pixels, source.camera.intrinsics)
    return gather_colours(source.rgb, pixels), depth


def pixels_behind(lens: Distortion, pixels: NDArray[np.integer], k: Intrinsics) -> NDArray[np.int64]:
    """Flat indices of the RGB pixels, drawn through a lens, that the centres of depth pixels (flat indices) fall in.

    -1 where it falls outside the image, and for -1.
    """
    rows, columns = np.divmod(pixels, k.width)
    u, v = distort(columns + 0.5, rows + 0.5, lens, k)
    inside = (pixels >= 0) & in_frame(u, v, k)
    return np.where(inside, np.floor(v) * k.width + np.floor(u), -1).astype(np.int64)


def carry_depth(source: View, target: Camera, images: Images, effects: EffectPlan) -> Projected:
    """The stored input cloud in another camera, with splat and hidden-point removal where the plan has them."""
    depth, units = source.depth, images.depth_units_per_m
    if effects.runs("hidden_point_removal") and source.region is not None:
        # A point whose surface faces away from the new camera is the back of something nearer to it.
        everywhere = np.arange(depth.size)
        facing = facing_cosine(depth, source.region, everywhere, source.camera, target.position, units)
        depth = np.where(np.nan_to_num(facing, nan=-1.0).reshape(depth.shape) > 0.0, depth, np.uint16(0))
    splat = images.projection.splat if effects.runs("splat") else 1
    return forward_project(depth, source.camera, target, splat, units)


def projection_shares(projected: NDArray[np.uint16], mirror: NDArray[np.uint16], images: Images) -> tuple[float, float]:
    """Share of pixels that the projection fills, and of those the share that lies behind what the mirror camera sees."""
    filled, hidden = count_filled(projected, mirror, HIDDEN_M * images.depth_units_per_m)
    return filled / projected.size, hidden / max(1, filled)
