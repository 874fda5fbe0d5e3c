"""Labels of rendered views: regions, the projected view, the agreement of two views, shares of patches. Pure."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.job.views import Distortion, Images, Patch
from schemas.scene.scene import EffectPlan, Placed, PosedScene, ScenePlan
from schemas.scene.shape import REGION_TABLE, is_object
from schemas.scene.view import Agreement, Camera, Intrinsics, ObjectLabel, View, crop_box
from workers.geometry.camera import image_coordinates
from workers.geometry.frames import invert
from workers.geometry.pixels import (
    Extent,
    count_filled,
    distort,
    facing_cosine,
    gather_colours,
    measure_regions,
    quantise_depth,
)
from workers.geometry.projection import Bounds, Projected, Seen, compare_covisible, forward_project, in_frame
from workers.geometry.zbuffer import count_covered

CountPixels = Callable[[Sequence[Placed], Camera], list[int]]
"""Counts, for each thing, the pixels of that thing alone, also outside the frame."""


def label_regions(
    plan: ScenePlan,
    posed: PosedScene,
    camera: Camera,
    region: NDArray[np.uint8],
    count_unoccluded: CountPixels,
) -> tuple[ObjectLabel, ...]:
    """Labels of the table and of every object in a mask [H, W], in order of region id."""
    names = {} if plan.ground is None else {REGION_TABLE: ("table", plan.table.asset.instance_id)}
    names.update({start.region_id: (start.asset.category, start.asset.instance_id) for start in plan.shown})
    things = [thing for thing in posed.things if thing.region_id in names]
    if len(posed.things) == 1 and not any(edge.any() for edge in (region[0], region[-1], region[:, 0], region[:, -1])):
        pixels = int(np.count_nonzero(region))  # what stands alone within the image hides behind nothing
        return label_things(things, names, camera, region, lambda *_: [pixels])
    return label_things(things, names, camera, region, count_unoccluded)


def label_things(
    things: Sequence[Placed],
    names: Mapping[int, tuple[str, str]],
    camera: Camera,
    region: NDArray[np.uint8],
    count_unoccluded: CountPixels,
) -> tuple[ObjectLabel, ...]:
    """Labels of things in a mask [H, W]; names: (category, instance id) by region id.

    Unoccluded pixels are counted of the things that are seen, of all of them at once.
    """
    extents = measure_regions(region)
    seen = [thing for thing in things if extents[thing.region_id].pixels]
    counts = dict(zip(map(id, seen), count_unoccluded(seen, camera), strict=True)) if seen else {}
    return tuple(
        label_region(thing, names[thing.region_id], camera, extents[thing.region_id], counts.get(id(thing), 0))
        for thing in things
    )


def count_unoccluded(things: Sequence[Placed], camera: Camera, count_drawn: CountPixels) -> list[int]:
    """Pixels that each thing covers by itself, also outside the image; `count_drawn` counts what is too near or too large.

    A count by the processor takes a quarter of the time of a renderer's, which is waited for, and does not depend on the
    device.
    """
    T_cam_world = invert(camera.T_world_cam)
    counts = [count_covered(thing.shape, T_cam_world @ thing.T_world_shape, camera.intrinsics) for thing in things]
    others = [thing for thing, count in zip(things, counts, strict=True) if count is None]
    drawn = iter(count_drawn(others, camera) if others else ())
    return [next(drawn) if count is None else count for count in counts]


def label_region(thing: Placed, name: tuple[str, str], camera: Camera, extent: Extent, unoccluded: int) -> ObjectLabel:
    """The label of one thing in one view, `name` (category, instance id), which alone covers `unoccluded` pixels."""
    T_cam_obj = invert(camera.T_world_cam) @ thing.T_world_shape
    u, v = image_coordinates(T_cam_obj, camera.intrinsics)
    pixels = extent.pixels
    share = pixels / max(unoccluded, pixels, 1)
    return ObjectLabel(thing.region_id, *name, T_cam_obj, u, v, extent.bbox_xywh, pixels, share)


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
    here, there = Seen(source.depth, source.region, source.camera), Seen(mirror.depth, mirror.region, mirror.camera)
    chosen = is_object(source.region)
    chosen[::SCENE_STRIDE, ::SCENE_STRIDE] = True
    difference_m, regions = compare_covisible(here, there, np.flatnonzero(chosen), bounds, images.depth_units_per_m)
    difference_mm = difference_m * 1e3
    object_mm = difference_mm[is_object(regions)]
    enough = len(object_mm) >= FEWEST_POINTS
    return Agreement(
        median_mm=float(np.median(object_mm)) if enough else None,
        share=float((object_mm <= bound_mm).mean()) if enough else None,
        points=len(object_mm),
        scene_median_mm=float(np.median(difference_mm)) if len(difference_mm) >= FEWEST_POINTS else None,
    )


def patch_object_fraction(view: View, label: ObjectLabel, patch: Patch) -> float | None:
    """Share of an object's patch that is the object; None where there is no patch, as in views of named cameras."""
    box = crop_box(label, view.camera, patch)
    if box is None or view.region is None or view.number is not None:
        return None
    region = view.region[box]
    return float(np.count_nonzero(region == label.region_id) / region.size)
