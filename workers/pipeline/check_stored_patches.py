"""Patches derived again from what is stored: the full images, the rows and the job."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.dataset.layout import PixelKind, file_pose_id, image_path, patch_index, patch_path, stored_images
from schemas.job.job import Job
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.view import View
from workers.labels.derive import crop_box

Row = Mapping[str, Any]
ReadImage = Callable[[str], NDArray]


def check_patches(view: View, labelled: View, job: Job, read: ReadImage, row: Row) -> list[str]:
    """Patches are crops of the images, and are there exactly where the crop stays inside and the object is seen.

    `labelled` is the view whose labels say where objects are: the mirror's for a projected view, else the view itself.
    """
    pixels: dict[PixelKind, NDArray | None] = {"rgb": view.rgb, "depth": view.depth, "region": view.region}
    listed = {file["path"] for file in row["files"]}
    number = file_pose_id(view.role, view.parent_id)
    faults, expected = [], set()
    for image in stored_images(view.role, job):
        expected.add(image_path(row["category"], image.content, number))
        full = pixels[image.pixels]
        for index, box in _boxes(labelled, job):
            path = patch_path(row["category"], image.content, number, index)
            expected.add(path)
            if path in listed and full is not None and not np.array_equal(read(path), full[box]):
                faults.append(f"{path}: is not the crop of its image")
    if expected != listed:
        faults.append(
            f"pose {view.pose_id} ({view.role}): files {sorted(expected ^ listed)} should be there, or should not"
        )
    return faults


def _boxes(labelled: View, job: Job) -> Iterator[tuple[int | None, tuple[slice, slice]]]:
    """The number in a patch's name, and its crop, for every object that has one."""
    labels = [label for label in labelled.labels if label.region_id >= REGION_FIRST_OBJECT]
    for label in labels:
        box = crop_box(label, labelled.camera, job.images.patch)
        if box is not None:
            yield patch_index(label.region_id, len(labels)), box
