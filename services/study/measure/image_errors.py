"""Errors of a made scene's depth, masks, mirror pose and projection against rays. Pure.

The rays are cast from the scene's own cameras at its own poses: through pixels' centres or, for errors that depend on the
size of pixels, through places that do not depend on it. Views of all pairs count together.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.job.views import Images
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_TABLE
from schemas.scene.view import Pair, View
from services.study.measure.rays import Patch, Pixels, Seen
from services.study.measure.truth import Truth
from workers.geometry.pixels import dequantise_depth
from workers.scene.context import WorkerContext
from workers.scene.make_scene import Scene

PERCENTILE = 99.0
"""Percentile of pixels: leaves out the few where a ray grazes an edge."""

HIDDEN_M = 0.005
"""A projected pixel this far behind the surface that the mirror camera sees shows a hidden surface."""


def measure_images(context: WorkerContext, scene: Scene, truth: Truth) -> dict[str, float]:
    """The errors of a made scene by names of `ERRORS`; an error without meaning there is left out.

    Over the input, aligned and mirror views of all pairs, and over pixels of objects unless stated:

    - depth_mm: the 99th percentile of |stored depth - ray's z| of pixels whose mask and ray name the same object. It
      includes quantisation and the sensor's effects. Pixels without depth, stored as 0, are not counted.
    - table_depth_mm: the same for the table, at pixels evenly over the image (`SPREAD_PIXELS`).
    - mask_share: pixels whose mask and ray differ where either names an object, per object pixel by ray. It can exceed 1.
    - between_mm: over `BETWEEN` random rays in the box about the objects' visible part in the input view: the median
      of |stored depth of the pixel that the ray crosses - ray's z|, where mask and ray name the same object.
    - outline_share: the share of these rays whose region differs from that of the pixel they cross.
    - mirror_mm: |d_z - z of the objects' nearest point that the input camera sees|, the largest of all pairs.
      `mirror_pose` sets the mirror camera T_z_m away from the point d_z ahead of the input camera, and turns it by the input
      pose alone. So the camera is off by exactly this, along the input camera's optical axis, and is not turned.
    - agreement_mm: the stored input depth projected into the mirror view against the stored mirror depth, the median
      (workers/scene/labels.py), the largest of all pairs; it needs no rays.
    - unfilled_share: of the mirror view's object pixels by ray whose point the input camera sees too, the share that the
      projected depth leaves empty.
    - hidden_share: of the projected depth's filled pixels, of objects and all else, evenly over the image: the share that
      lies more than 5 mm behind what the mirror camera's ray meets.
    """
    images = context.job.images
    views = [view for pair in scene.pairs for view in (pair.input, pair.aligned, pair.mirror) if view is not None]
    patches = [truth.patch(pair.input.camera, number) for number, pair in enumerate(scene.pairs)]
    projected = [pair for pair in scene.pairs if pair.projected is not None]
    return (
        _of_labels([(view, truth.pixels(view.camera)) for view in views], images)
        | _of_patches(list(zip(scene.pairs, patches, strict=True)), images)
        | _of_mirrors(list(zip(scene.pairs, patches, strict=True)))
        | _of_projections(projected, truth, images)
    )


def _of_labels(views: Sequence[tuple[View, Pixels]], images: Images) -> dict[str, float]:
    """Stored views against rays at their pixels' centres."""
    objects_mm: list[Array] = []
    table_mm: list[Array] = []
    differ = pixels = 0
    for view, truth in views:
        assert view.region is not None
        mask, by_ray = truth.box.of(view.region), truth.box.region >= REGION_FIRST_OBJECT
        by_mask = mask >= REGION_FIRST_OBJECT
        outside = np.count_nonzero(view.region >= REGION_FIRST_OBJECT) - np.count_nonzero(by_mask)
        differ += int(np.count_nonzero((mask != truth.box.region) & (by_ray | by_mask)) + outside)
        pixels += int(np.count_nonzero(by_ray))
        table = truth.spread.region == REGION_TABLE
        for found, seen, chosen in ((objects_mm, truth.box, by_ray), (table_mm, truth.spread, table)):
            found.append(_off_mm(seen.of(view.depth), seen.of(view.region), seen, chosen, images))
    return {
        **_percentile("depth_mm", objects_mm, PERCENTILE),
        **_percentile("table_depth_mm", table_mm, PERCENTILE),
        **({"mask_share": differ / pixels} if pixels else {}),
    }


def _of_patches(pairs: Sequence[tuple[Pair, Patch]], images: Images) -> dict[str, float]:
    off_mm, wrong = [], []
    for pair, patch in pairs:
        region, k = pair.input.region, pair.input.camera.intrinsics
        assert region is not None
        column, row = np.minimum((patch.at * (k.width, k.height)).astype(np.int64), (k.width - 1, k.height - 1)).T
        mask, objects = region[row, column], patch.region >= REGION_FIRST_OBJECT
        off_mm.append(_off_mm(pair.input.depth[row, column], mask, patch, objects, images))
        wrong.append(mask != patch.region)
    return _percentile("between_mm", off_mm, 50.0) | _mean("outline_share", wrong)


def _of_mirrors(pairs: Sequence[tuple[Pair, Patch]]) -> dict[str, float]:
    off = [
        abs(pair.d_z_m - patch.front_m) * 1e3
        for pair, patch in pairs
        if pair.mirror is not None and patch.box is not None
    ]
    medians = [pair.agreement.median_mm for pair, _ in pairs if pair.agreement is not None]
    known = [median for median in medians if median is not None]
    return {name: max(values) for name, values in (("mirror_mm", off), ("agreement_mm", known)) if values}


def _of_projections(pairs: Sequence[Pair], truth: Truth, images: Images) -> dict[str, float]:
    empty, hidden = [], []
    for pair in pairs:
        assert pair.projected is not None
        camera, depth = pair.projected.camera, pair.projected.depth
        seen = truth.pixels(camera)
        empty.append(seen.box.of(depth)[truth.both(camera, pair.input.camera)] == 0)
        drawn, z = seen.spread.of(depth), seen.spread.depth_m
        hidden.append(((z > 0.0) & (dequantise_depth(drawn, images) > z + HIDDEN_M))[drawn > 0])
    return _mean("unfilled_share", empty) | _mean("hidden_share", hidden)


def _off_mm(
    stored: NDArray[np.uint16], mask: NDArray[np.uint8], seen: Seen | Patch, chosen: NDArray[np.bool_], images: Images
) -> Array:
    """[N] |stored depth - ray's z| of the chosen pixels that have depth and whose mask is the ray's region."""
    same = chosen & (mask == seen.region) & (stored > 0)
    return np.abs(dequantise_depth(stored[same], images) - seen.depth_m[same]) * 1e3


def _percentile(name: str, errors: Iterable[Array], percent: float) -> dict[str, float]:
    """The figure by its name, or none for no values."""
    values = np.concatenate([np.empty(0), *errors])
    return {name: float(np.percentile(values, percent))} if len(values) else {}


def _mean(name: str, flags: Iterable[NDArray[np.bool_]]) -> dict[str, float]:
    """The share of true flags by its name, or none for no flags."""
    values = np.concatenate([np.empty(0, bool), *flags])
    return {name: float(values.mean())} if len(values) else {}
