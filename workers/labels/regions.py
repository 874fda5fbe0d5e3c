"""The label of each region of a rendered view, from its mask and the poses. Pure."""

from collections.abc import Callable

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


def label_regions(
    plan: ScenePlan,
    posed: PosedScene,
    camera: Camera,
    region: NDArray[np.uint8],
    count_unoccluded: Callable[[Placed, Camera], int],
) -> tuple[ObjectLabel, ...]:
    """Labels of the table and of every object in a mask [H, W], in order of region id.

    `count_unoccluded` counts the pixels of one thing alone, also outside the frame.
    """
    extents = measure_regions(region)
    names = {REGION_TABLE: ("table", plan.table.asset.instance_id)}
    names.update({start.region_id: (start.asset.category, start.asset.instance_id) for start in plan.objects})
    return tuple(
        label_region(thing, names[thing.region_id], camera, extents[thing.region_id], count_unoccluded)
        for thing in posed.things
        if thing.region_id in names
    )


def label_region(
    thing: Placed,
    name: tuple[str, str],
    camera: Camera,
    extent: Extent,
    count_unoccluded: Callable[[Placed, Camera], int],
) -> ObjectLabel:
    """The label of one thing in one view, `name` (category, instance id); unoccluded pixels are counted where any is seen."""
    T_cam_obj = invert(camera.T_world_cam) @ thing.T_world_shape
    u, v = image_coordinates(T_cam_obj, camera.intrinsics)
    pixels = extent.pixels
    unoccluded = count_unoccluded(thing, camera) if pixels else 1
    share = pixels / max(unoccluded, pixels, 1)
    return ObjectLabel(thing.region_id, *name, T_cam_obj, u, v, extent.bbox_xywh, pixels, share)
