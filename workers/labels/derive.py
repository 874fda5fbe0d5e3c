"""What follows from rendered views: the projected view, patches, labels, agreement. Pure."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.job.job import Images, Job, Patch
from schemas.job.sensor import Distortion
from schemas.scene.camera import Camera
from schemas.scene.scene import REGION_FIRST_OBJECT, Agreement, ObjectLabel, View
from workers.geometry.camera import image_coordinates, project
from workers.geometry.distortion import distort
from workers.geometry.frames import invert
from workers.geometry.normals import facing_cosine, is_smooth
from workers.geometry.pixels import Extent, count_filled, gather_colours
from workers.geometry.projection import Projected, forward_project, in_frame, reproject_pixels, sample_inverse_depth
from workers.geometry.stored_depth import quantise_depth

FEWEST_POINTS = 50
"""With fewer co-visible pixels an agreement is not worth a figure."""

FACING = 0.1
"""A surface whose normal is more than 84 degrees from the mirror camera counts as turned away."""

HIDDEN_M = 0.01
"""A carried point this far behind what the mirror camera sees is hidden, and not in disagreement."""

SMOOTH_INPUT_M = 0.002
SMOOTH_MIRROR_M = 0.001
"""Depth that bends by more from one pixel to the next (some 4.8 mm apart in the input view, 2.5 mm in the mirror's) has an
edge there: a sphere of 35 mm bends by 0.7 and 0.2 mm."""

SCENE_STRIDE = 8
"""Floor and table have hundreds of times the pixels that their median needs."""


def derive_projected(
    source: View, mirror: Camera, images: Images, lens: Distortion | None = None
) -> tuple[NDArray[np.uint8] | None, NDArray[np.uint16]]:
    """RGB [H, W, 3] uint8 and depth [H, W] uint16 of the stored input cloud seen from the mirror camera; holes 0.

    RGB is None where the source has none.
    """
    projected = carry_depth(source, mirror, images)
    if source.rgb is None:
        return None, quantise_depth(projected.depth_m, images)
    if lens is not None:
        rgb = np.zeros((*projected.depth_m.shape, 3), np.uint8)
        seen = projected.source >= 0
        rgb[seen] = colours_of(source, projected.source[seen], lens)
        return rgb, quantise_depth(projected.depth_m, images)
    return gather_colours(source.rgb, projected.source), quantise_depth(projected.depth_m, images)


def colours_of(source: View, pixels: NDArray[np.integer], lens: Distortion | None) -> NDArray[np.uint8]:
    """[N, 3] uint8: stored colours of depth pixels (flat indices).

    Behind a lens a depth pixel's colour is that of the RGB pixel that its centre is drawn in, black outside the picture.
    """
    assert source.rgb is not None
    if lens is None:
        return source.rgb.reshape(-1, 3)[pixels]
    k = source.camera.intrinsics
    rows, columns = np.divmod(pixels, k.width)
    u, v = distort(columns + 0.5, rows + 0.5, lens, k)
    inside = in_frame(u, v, k)
    colours = np.zeros((len(pixels), 3), np.uint8)
    colours[inside] = source.rgb[np.floor(v[inside]).astype(np.int64), np.floor(u[inside]).astype(np.int64)]
    return colours


def carry_depth(source: View, target: Camera, images: Images) -> Projected:
    """The stored input cloud in another camera, with the job's splat and hidden-point removal."""
    depth, units = source.depth, images.depth_units_per_m
    if images.projection.hidden_point_removal and source.region is not None:
        # A point whose surface faces away from the new camera is the back of something nearer to it.
        everywhere = np.arange(depth.size)
        facing = facing_cosine(depth, source.region, everywhere, source.camera, target.position, units)
        depth = np.where(np.nan_to_num(facing, nan=-1.0).reshape(depth.shape) > 0.0, depth, np.uint16(0))
    return forward_project(depth, source.camera, target, images.projection.splat, units)


def projection_shares(projected: NDArray[np.uint16], mirror: NDArray[np.uint16], images: Images) -> tuple[float, float]:
    """Share of pixels that the projection fills, and of those the share that lies behind what the mirror camera sees."""
    filled, hidden = count_filled(projected, mirror, HIDDEN_M * images.depth_units_per_m)
    return filled / projected.size, hidden / max(1, filled)


def crop_box(label: ObjectLabel, camera: Camera, patch: Patch) -> tuple[slice, slice] | None:
    """(rows, columns) of the crop centred on the object's image coordinates.

    None where it would leave the image, and where the view does not see the object.
    """
    if label.u < 0 or label.pixels == 0:
        return None
    left, top = label.u - patch.width // 2, label.v - patch.height // 2
    right, bottom = left + patch.width, top + patch.height
    if left < 0 or top < 0 or right > camera.intrinsics.width or bottom > camera.intrinsics.height:
        return None
    return slice(top, bottom), slice(left, right)


def label_region(
    thing: tuple[int, str, str, Array],
    camera: Camera,
    extent: Extent,
    count_alone: Callable[[], int],
) -> ObjectLabel:
    """The label of one thing (region id, category, instance id, T_world_obj [4, 4]) in one view, from its mask's extent.

    `count_alone` counts its own unoccluded pixels, also outside the frame; it is asked only where any is seen.
    """
    region_id, category, instance_id, T_world_obj = thing
    T_cam_obj = invert(camera.T_world_cam) @ T_world_obj
    u, v = image_coordinates(T_cam_obj, camera.intrinsics)
    pixels = extent.pixels
    alone = count_alone() if pixels else 1
    share = pixels / max(alone, pixels, 1)
    return ObjectLabel(region_id, category, instance_id, T_cam_obj, u, v, extent.bbox_xywh, pixels, share)


def agree_across(source: View, mirror: View, images: Images, bound_mm: float, first_object: int) -> Agreement:
    """Carry the stored input depth into the mirror view and compare it with the stored mirror depth.

    Interpolated bilinearly in 1/z among four pixels of one region. A pixel counts as co-visible where its surface
    faces the mirror camera too, its own region is there in the mirror view, and it does not lie `HIDDEN_M` behind; and
    only where each image shows one smooth surface, judged by itself: across the rim of a mug, a pixel or two wide, there
    is nothing to interpolate.
    Every pixel of an object is compared, and of the rest one in `SCENE_STRIDE` squared.
    """
    assert source.region is not None and mirror.region is not None
    units = images.depth_units_per_m
    pixels = _sample_pixels(source.region, first_object)
    facing = facing_cosine(source.depth, source.region, pixels, source.camera, mirror.camera.position, units)
    smooth = is_smooth(source.depth, source.region, pixels, SMOOTH_INPUT_M, units)
    index = pixels[(np.nan_to_num(facing, nan=-1.0) > FACING) & smooth]
    points = reproject_pixels(source.depth, index, source.camera, mirror.camera, units)
    keep = points[:, 2] > 0.0
    points, index = points[keep], index[keep]
    u, v = project(points, mirror.camera.intrinsics)
    inside = in_frame(u, v, mirror.camera.intrinsics)
    points, index, u, v = points[inside], index[inside], u[inside], v[inside]
    seen, region = sample_inverse_depth(mirror.depth, mirror.region, u, v, units)
    seen = np.where(_smooth_around(mirror.depth, mirror.region, u, v, units), seen, 0.0)
    own = source.region.ravel()[index]
    both = (seen > 0.0) & (region == own) & (points[:, 2] < seen + HIDDEN_M)
    difference_mm = np.abs(points[both, 2] - seen[both]) * 1e3
    of_object = difference_mm[own[both] >= first_object]
    enough = len(of_object) >= FEWEST_POINTS
    return Agreement(
        median_mm=float(np.median(of_object)) if enough else None,
        share=float((of_object <= bound_mm).mean()) if enough else None,
        points=len(of_object),
        scene_median_mm=float(np.median(difference_mm)) if len(difference_mm) >= FEWEST_POINTS else None,
    )


def compare_views(job: Job, first: View, mirror: View) -> Agreement:
    """How well an input and a mirror view agree, by the job's bound."""
    return agree_across(first, mirror, job.images, job.check.mirror_agreement_mm, REGION_FIRST_OBJECT)


def _sample_pixels(region: NDArray[np.uint8], first_object: int) -> NDArray[np.int64]:
    """Flat indices, ascending: every pixel of an object, and a grid over everything else."""
    chosen = region >= first_object
    chosen[::SCENE_STRIDE, ::SCENE_STRIDE] = True
    return np.flatnonzero(chosen)


def _smooth_around(
    depth: NDArray[np.uint16], region: NDArray[np.uint8], u: Array, v: Array, units_per_m: float
) -> NDArray[np.bool_]:
    """[N] bool: whether the four pixels about each image coordinate see one smooth surface."""
    height, width = depth.shape
    column = np.clip(np.floor(u - 0.5).astype(np.int64), 0, width - 2)
    row = np.clip(np.floor(v - 0.5).astype(np.int64), 0, height - 2)
    smooth = np.ones(len(u), bool)
    for step in (0, 1, width, width + 1):
        smooth &= is_smooth(depth, region, row * width + column + step, SMOOTH_MIRROR_M, units_per_m)
    return smooth
