"""The images that a view leaves, their names, and their bytes."""

import dataclasses
import hashlib

import numpy as np
import pytest

from schemas.job.views import Images, Patch
from schemas.scene.view import Camera, Intrinsics, ObjectLabel, Pair, View
from workers.scene.rows import encode_view, image_boxes, object_labels
from workers.store.images import decode_png

IMAGES = Images(patch=Patch(width=16, height=8))
CAMERA = Camera(Intrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0), np.eye(4))
RNG = np.random.default_rng(0)


def label(region_id: int, category: str, u: int = 32, v: int = 24) -> ObjectLabel:
    return ObjectLabel(region_id, category, "instance", np.eye(4), u, v, (0, 0, 1, 1), 1, 1.0)


def view_of(*labels: ObjectLabel) -> View:
    rgb = RNG.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    depth = RNG.integers(0, 9000, (48, 64)).astype(np.uint16)
    return View("input", 6, 6, CAMERA, rgb, depth, np.full((48, 64), 3, np.uint8), labels)


def boxes_of(view: View, pair: Pair):
    objects = object_labels(view, pair)
    return image_boxes(view, objects, objects[0].category, IMAGES.patch)


@pytest.fixture
def view() -> View:
    return view_of(label(2, "table"), label(3, "mug"))


def paths(view: View, pair: Pair) -> list[str]:
    return [path for path, _, _ in boxes_of(view, pair)]


def test_every_image_and_patch_reads_back_as_what_the_view_holds_with_its_digest(view):
    files = {file.path: file for file in encode_view(view, Pair(1.0, view, None), IMAGES)}
    names = ("RGB", "depth", "segment")
    assert files.keys() == {f"mug/{folder}{name}00006.png" for name in names for folder in ("", "patches/")}
    for name, pixels in zip(names, (view.rgb, view.depth, view.region), strict=True):
        assert np.array_equal(decode_png(files[f"mug/{name}00006.png"].data), pixels)
        assert np.array_equal(decode_png(files[f"mug/patches/{name}00006.png"].data), pixels[20:28, 24:40])
    for file in files.values():
        assert file.sha256 == hashlib.sha256(file.data).hexdigest()


def test_a_view_without_colour_leaves_no_rgb_image(view):
    blind = dataclasses.replace(view, rgb=None)
    assert paths(blind, Pair(1.0, blind, None)) == [
        path for path in paths(view, Pair(1.0, view, None)) if "RGB" not in path
    ]


def test_a_projected_view_has_the_patches_of_the_mirror_views_objects_and_no_mask(view):
    mirror = dataclasses.replace(view, role="mirror", pose_id=7, labels=(label(3, "mug", u=20),))
    projected = dataclasses.replace(view, role="projected", region=None, labels=())
    pair = Pair(1.0, view, None, mirror, projected)
    assert object_labels(projected, pair) == list(mirror.labels)
    boxes = {path: box for path, _, box in boxes_of(projected, pair)}
    assert boxes == {
        "mug/RGBprojected00006.png": None,
        "mug/patches/RGBprojected00006.png": (slice(20, 28), slice(12, 28)),
        "mug/depthProjected00006.png": None,
        "mug/patches/depthProjected00006.png": (slice(20, 28), slice(12, 28)),
    }


def test_of_several_objects_each_has_its_numbered_patch_unless_it_would_leave_the_image():
    view = view_of(label(3, "mug"), label(4, "can", u=2), label(5, "jar", u=40))
    assert [path for path in paths(view, Pair(1.0, view, None)) if "patches/depth" in path] == [
        "mug/patches/depth00006obj0.png",
        "mug/patches/depth00006obj2.png",
    ]
