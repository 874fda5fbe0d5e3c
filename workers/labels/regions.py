"""The label of each region of a rendered view, from its mask and the poses. Pure."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.scene.camera import Camera
from schemas.scene.plan import ScenePlan
from schemas.scene.region import REGION_TABLE
from schemas.scene.scene import Placed, PosedScene
from schemas.scene.view import ObjectLabel
from workers.geometry.camera import image_coordinates
from workers.geometry.frames import invert
from workers.geometry.pixels import Extent, measure_regions
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
    names = {REGION_TABLE: ("table", plan.table.asset.instance_id)}
    names.update({start.region_id: (start.asset.category, start.asset.instance_id) for start in plan.objects})
    things = [thing for thing in posed.things if thing.region_id in names]
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
