"""d_z: the distance from the input camera to the pivot of the mirror camera, along the optical axis."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.errors import ViewError
from schemas.job.cameras import Mirror
from schemas.job.images import Images
from schemas.scene.region import REGION_FIRST_OBJECT
from workers.geometry.stored_depth import dequantise_depth


def object_distance(depth: NDArray[np.uint16], region: NDArray[np.uint8], images: Images, mirror: Mirror) -> float:
    """`front_distance` of the object in a stored view; converts only the object's pixels to metres."""
    return front_distance(dequantise_depth(depth[region >= REGION_FIRST_OBJECT], images), np.True_, mirror)


def front_distance(depth_m: Array, object_pixels: NDArray[np.bool_] | np.bool_, mirror: Mirror) -> float:
    """d_z: distance to the object's front surface along the optical axis, metres, from its stored depth.

    A low percentile by default, because the nearest pixel is noisy. Raises ViewError where no pixel of the object has
    depth.
    """
    z = depth_m[object_pixels & (depth_m > 0.0)]
    if z.size == 0:
        raise ViewError("object_not_seen", "the input view has no depth pixel of the object: narrow start.offset_m")
    if mirror.pivot_depth == "nearest":
        return float(z.min())
    if mirror.pivot_depth == "median":
        return float(np.median(z))
    return float(np.percentile(z, mirror.percentile))
