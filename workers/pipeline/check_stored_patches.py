"""Check of stored patches: each is a crop of its image, and exists where the job and the labels call for it."""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from schemas.dataset.codec import Row
from schemas.dataset.layout import PixelKind, file_pose_id, image_path, patch_index, patch_path, stored_images
from schemas.job.job import Job
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.view import View
from workers.labels.patches import crop_box

ReadImage = Callable[[str], NDArray]


def check_patches(view: View, labelled: View, job: Job, read: ReadImage, row: Row) -> list[str]:
    """Patches that are not the crop of their image, and files that are missing or too many, a sentence each.

    `labelled` is the view that holds the labels: the mirror view for a projected one, else the view itself.
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
    """(number in the patch's name, crop) of every object that has a patch."""
    labels = [label for label in labelled.labels if label.region_id >= REGION_FIRST_OBJECT]
    for label in labels:
        box = crop_box(label, labelled.camera, job.images.patch)
        if box is not None:
            yield patch_index(label.region_id, len(labels)), box
