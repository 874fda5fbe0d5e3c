"""The agreement of two views: input depth carried into the mirror view against mirror depth. Pure."""

import numpy as np
from numpy.typing import NDArray

from schemas.job.images import Images
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.view import Agreement, View
from workers.geometry.projection import Bounds, Seen, compare_covisible
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
    bounds = Bounds(FACING, (SMOOTH_INPUT_M, SMOOTH_MIRROR_M), HIDDEN_M)
    one, other = Seen(source.depth, source.region, source.camera), Seen(mirror.depth, mirror.region, mirror.camera)
    difference_m, own = compare_covisible(one, other, _sample_pixels(source.region), bounds, images.depth_units_per_m)
    difference_mm = difference_m * 1e3
    object_mm = difference_mm[own >= REGION_FIRST_OBJECT]
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
