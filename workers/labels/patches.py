"""Patches: the crop of an image about each object. Pure."""

import numpy as np

from schemas.job.images import Patch
from schemas.scene.camera import Camera
from schemas.scene.view import ObjectLabel, View


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


def patch_object_fraction(view: View, label: ObjectLabel, patch: Patch) -> float | None:
    """Share of an object's patch that is the object; None where there is no patch."""
    box = crop_box(label, view.camera, patch)
    if box is None or view.region is None:
        return None
    region = view.region[box]
    return float(np.count_nonzero(region == label.region_id) / region.size)
