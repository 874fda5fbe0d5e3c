"""Which images a view leaves, under which names, and their bytes. Pure."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from schemas.dataset.layout import PixelKind, file_pose_id, image_path, patch_index, patch_path, stored_images
from schemas.job.images import Patch
from schemas.job.job import Job
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.view import ObjectLabel, Pair, View
from workers.labels.derive import crop_box
from workers.store.images import encode_png

Files = list[tuple[str, bytes]]


def encode_view(view: View, pair: Pair, job: Job) -> Files:
    """The view's images and their patches as PNG, by path."""
    files: Files = []
    for path, kind, box in image_boxes(view, pair, job):
        pixels = _pixels(view, kind)
        part = pixels if box is None else np.ascontiguousarray(pixels[box])
        files.append((path, encode_png(part, job.images.png_level)))
    return files


def image_boxes(view: View, pair: Pair, job: Job) -> Iterator[tuple[str, PixelKind, tuple[slice, slice] | None]]:
    """Path, kind of pixels and crop (rows, columns; None for all) of each image of the view and of its patches."""
    objects = object_labels(view, pair)
    category, number = objects[0].category, file_pose_id(view.role, view.parent_id)
    for image in stored_images(view.role, job):
        yield image_path(category, image.content, number), image.pixels, None
        for label in objects:
            box = crop_box(label, view.camera, job.images.patch)
            if box is not None:
                index = patch_index(label.region_id, len(objects))
                yield patch_path(category, image.content, number, index), image.pixels, box


def _pixels(view: View, kind: PixelKind) -> NDArray:
    images: dict[str, NDArray | None] = {"rgb": view.rgb, "depth": view.depth, "region": view.region}
    pixels = images[kind]
    assert pixels is not None
    return pixels


def object_labels(view: View, pair: Pair) -> list[ObjectLabel]:
    """Labels of the objects alone, by region id; a projected view is seen by the mirror camera and has its labels."""
    seen = pair.mirror if view.role == "projected" else view
    assert seen is not None
    return [label for label in seen.labels if label.region_id >= REGION_FIRST_OBJECT]


def patch_object_fraction(view: View, label: ObjectLabel, patch: Patch) -> float | None:
    """Share of an object's patch that is the object; None where the patch was left out."""
    box = crop_box(label, view.camera, patch)
    if box is None or view.region is None:
        return None
    return float((view.region[box] == label.region_id).mean())
