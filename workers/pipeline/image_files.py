"""The images that a view leaves, their names, and their bytes. Pure."""

from collections.abc import Iterator, Sequence

from numpy.typing import NDArray

from schemas.dataset.layout import IMAGES, PixelKind, image_path, patch_index, patch_path
from schemas.job.images import Images, Patch
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.scene import EncodedFile, encoded_file
from schemas.scene.view import ObjectLabel, Pair, View
from workers.labels.patches import crop_box
from workers.store.images import encode_png

Box = tuple[slice, slice]


def encode_view(view: View, pair: Pair, images: Images) -> tuple[EncodedFile, ...]:
    """The view's images and their patches as PNG."""
    files = []
    objects = object_labels(view, pair)
    for path, kind, box in image_boxes(view, objects, objects[0].category, images.patch):
        pixels = view_pixels(view, kind)
        assert pixels is not None
        files.append(encoded_file(path, encode_png(pixels if box is None else pixels[box], images.png_level)))
    return tuple(files)


def image_boxes(
    view: View, objects: Sequence[ObjectLabel], category: str, patch: Patch
) -> Iterator[tuple[str, PixelKind, Box | None]]:
    """Path, kind of pixels and crop (rows, columns; None for all) of each image that the view holds and of its patches.

    objects: the labels that have patches. `category` is the scene's.
    """
    boxes = [(patch_index(label.region_id, len(objects)), crop_box(label, view.camera, patch)) for label in objects]
    for image in IMAGES:
        if image.role != view.role or view_pixels(view, image.pixels) is None:
            continue
        yield image_path(category, image.content, view.pose_id), image.pixels, None
        for index, box in boxes:
            if box is not None:
                yield patch_path(category, image.content, view.pose_id, index), image.pixels, box


def view_pixels(view: View, kind: PixelKind) -> NDArray | None:
    """The array that images of a kind show; None where the view has none."""
    images: dict[PixelKind, NDArray | None] = {"rgb": view.rgb, "depth": view.depth, "region": view.region}
    return images[kind]


def object_labels(view: View, pair: Pair) -> list[ObjectLabel]:
    """Labels of the objects alone, by region id; a projected view is seen by the mirror camera and has its labels."""
    labelled = pair.mirror if view.role == "projected" else view
    assert labelled is not None
    return [label for label in labelled.labels if label.region_id >= REGION_FIRST_OBJECT]
