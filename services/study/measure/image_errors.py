"""Errors of a made scene's depth, masks, mirror pose and projection against rays. Pure.

The rays are cast from the scene's own cameras at its own poses: through pixels' centres or, for errors that depend on the
size of pixels, through places that do not depend on it. Views of all pairs count together.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.job.images import Images
from schemas.scene.region import REGION_FIRST_OBJECT, REGION_TABLE
from schemas.scene.view import Pair, View
from services.study.measure.rays import Patch, Pixels, Seen
from services.study.measure.truth import Truth
from workers.geometry.stored_depth import dequantise_depth
from workers.pipeline.context import WorkerContext
from workers.pipeline.make_scene import Scene

PERCENTILE = 99.0
"""Percentile of pixels: leaves out the few where a ray grazes an edge."""

HIDDEN_M = 0.005
"""A projected pixel this far behind the surface that the mirror camera sees shows a hidden surface."""


@dataclass(frozen=True, eq=False)
class LabelErrors:
    """A view's depth errors, mm, [N] of objects and [M] of the table; `differ` of its `pixels` of objects have a wrong mask."""

    object_mm: Array
    table_mm: Array
    differ: int
    pixels: int


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
      (workers/labels/agreement.py), the largest of all pairs; it needs no rays.
    - unfilled_share: of the mirror view's object pixels by ray whose point the input camera sees too, the share that the
      projected depth leaves empty.
    - hidden_share: of the projected depth's filled pixels, of objects and all else, evenly over the image: the share that
      lies more than 5 mm behind what the mirror camera's ray meets.
    """
    images = context.job.images
    views = [
        (view, truth.pixels(view.camera))
        for pair in scene.pairs
        for view in (pair.input, pair.aligned, pair.mirror)
        if view is not None
    ]
    found = _of_labels([compare_labels(view, pixels, images) for view, pixels in views])
    patches = [truth.patch(pair.input.camera, number) for number, pair in enumerate(scene.pairs)]
    found |= _of_patches(scene.pairs, patches, images)
    found |= _of_mirrors(scene.pairs, patches)
    found |= _of_projections(scene.pairs, truth, images)
    return found


def compare_labels(view: View, truth: Pixels, images: Images) -> LabelErrors:
    """A stored view against rays at its pixels' centres."""
    assert view.region is not None
    mask = truth.box.of(view.region)
    by_ray = truth.box.region >= REGION_FIRST_OBJECT
    by_mask = mask >= REGION_FIRST_OBJECT
    differ = int(np.count_nonzero((mask != truth.box.region) & (by_ray | by_mask)))
    outside = int(np.count_nonzero(view.region >= REGION_FIRST_OBJECT) - np.count_nonzero(by_mask))
    table = truth.spread.region == REGION_TABLE
    return LabelErrors(
        _depth_mm(view, truth.box, by_ray, images),
        _depth_mm(view, truth.spread, table, images),
        differ + outside,
        int(np.count_nonzero(by_ray)),
    )


def _depth_mm(view: View, seen: Seen, chosen: NDArray[np.bool_], images: Images) -> Array:
    """[N] |stored depth - ray's z| of the chosen pixels that have depth and whose mask is the ray's region."""
    assert view.region is not None
    depth = seen.of(view.depth)
    same = chosen & (seen.of(view.region) == seen.region) & (depth > 0)
    return np.abs(dequantise_depth(depth[same], images) - seen.depth_m[same]) * 1e3


def _of_labels(errors: Sequence[LabelErrors]) -> dict[str, float]:
    pixels = sum(one.pixels for one in errors)
    return {
        **_percentile("depth_mm", [one.object_mm for one in errors], PERCENTILE),
        **_percentile("table_depth_mm", [one.table_mm for one in errors], PERCENTILE),
        **_share("mask_share", sum(one.differ for one in errors), pixels),
    }


def _of_patches(pairs: Sequence[Pair], patches: Sequence[Patch], images: Images) -> dict[str, float]:
    off_mm, wrong, rays = [], 0, 0
    for pair, patch in zip(pairs, patches, strict=True):
        region, k = pair.input.region, pair.input.camera.intrinsics
        assert region is not None
        column = np.minimum((patch.at[:, 0] * k.width).astype(np.int64), k.width - 1)
        row = np.minimum((patch.at[:, 1] * k.height).astype(np.int64), k.height - 1)
        mask, depth = region[row, column], pair.input.depth[row, column]
        same = (mask == patch.region) & (mask >= REGION_FIRST_OBJECT) & (depth > 0)
        off_mm.append(np.abs(dequantise_depth(depth[same], images) - patch.depth_m[same]) * 1e3)
        wrong += int(np.count_nonzero(mask != patch.region))
        rays += len(mask)
    return {**_percentile("between_mm", off_mm, 50.0), **_share("outline_share", wrong, rays)}


def _of_mirrors(pairs: Sequence[Pair], patches: Sequence[Patch]) -> dict[str, float]:
    off = [
        abs(pair.d_z_m - patch.front_m) * 1e3
        for pair, patch in zip(pairs, patches, strict=True)
        if pair.mirror is not None and patch.box is not None
    ]
    medians = [pair.agreement.median_mm for pair in pairs if pair.agreement is not None]
    known = [median for median in medians if median is not None]
    return {name: max(values) for name, values in (("mirror_mm", off), ("agreement_mm", known)) if values}


def _of_projections(pairs: Sequence[Pair], truth: Truth, images: Images) -> dict[str, float]:
    empty = both = hidden = filled = 0
    for pair in pairs:
        if pair.projected is None:
            continue
        camera, depth = pair.projected.camera, pair.projected.depth
        seen = truth.pixels(camera)
        shared = truth.both(camera, pair.input.camera)
        empty += int(np.count_nonzero(shared & (seen.box.of(depth) == 0)))
        both += int(np.count_nonzero(shared))
        drawn, z = seen.spread.of(depth), seen.spread.depth_m
        behind = (drawn > 0) & (z > 0.0) & (dequantise_depth(drawn, images) > z + HIDDEN_M)
        hidden += int(np.count_nonzero(behind))
        filled += int(np.count_nonzero(drawn))
    return {**_share("unfilled_share", empty, both), **_share("hidden_share", hidden, filled)}


def _percentile(name: str, errors: Iterable[Array], percent: float) -> dict[str, float]:
    """The figure by its name, or none for no values."""
    values = np.concatenate([np.empty(0), *errors])
    return {name: float(np.percentile(values, percent))} if len(values) else {}


def _share(name: str, part: int, whole: int) -> dict[str, float]:
    return {name: part / whole} if whole else {}
