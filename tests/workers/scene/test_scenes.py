"""One scene from its steps to its files and rows, and what a worker process holds; effects are proven in tests/effects."""

import dataclasses
import hashlib
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from schemas.base import set_key
from schemas.errors import ViewError
from schemas.job.job import Job
from schemas.job.views import Images, Patch
from schemas.scene.view import Camera, Intrinsics, ObjectLabel, Pair, View
from tests.effects.scenes import Made, Setting, make
from tests.workers.render.random_scenes import built_in_assets
from workers.scene.context import open_worker
from workers.scene.rows import encode_view, image_boxes, object_labels, timing_row
from workers.stopwatch import Stopwatch
from workers.store.images import decode_png
from workers.store.manifest import table_of_rows

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def three() -> Made:
    """One pair of three objects."""
    return make(Setting({"objects_per_scene": 3}))


UNSEEN = (
    ({"cameras.orbit.aim_m": [1.5, 1.5]}, "does not show the object, .*: narrow start.offset_m, or aim the cameras"),
    (
        {"images.depth_range_m": [0.2, 1.0]},
        r"\d+ pixels in the input view, all nearer .* images.depth_range_m \[0.2, 1\]",
    ),
    (
        {"sensor.depth_noise.range_m": [0.5, 1.5]},
        r"\d+ pixels in the input view, [12]\.\d+ to 2\.\d+ m away, and sensor.depth_noise measures from 0.5 to 1.5 m: ",
    ),
    (
        {
            "sensor.depth_noise.edge_px": 8,
            "sensor.depth_noise.edge_dropout": 1.0,
            "sensor.depth_noise.grazing_deg": 0.01,
        },
        "leaves none of them depth",
    ),
)


@pytest.mark.parametrize(("keys", "words"), UNSEEN, ids=[next(iter(keys)) for keys, _ in UNSEEN])
def test_a_scene_whose_input_has_no_depth_of_the_object_says_why(keys, words):
    changes = dict[str, Any]()
    for key, value in keys.items():
        set_key(changes, key, value)
    with pytest.raises(ViewError, match=words) as caught:
        make(Setting(changes))
    assert caught.value.reason == "object_not_seen"


# ---------------------------------------------------------------------------------------------- rows


def test_a_projected_view_has_no_object_columns_and_the_table_no_patch(three):
    projected = next(row for row in three.rows["views"] if row["role"] == "projected")
    assert projected["object_pixels"] is projected["visible_fraction"] is projected["patch_object_fraction"] is None
    shares = [(row["region_id"] == 2, row["patch_object_fraction"]) for row in three.rows["objects"]]
    assert {share for is_table, share in shares if is_table} == {None} and any(share for _, share in shares)


def test_stages_and_effects_add_up_also_of_a_block_that_raises_and_a_row_has_their_seconds():
    ticks = iter([0.0, 0.0, 1.0, 10.0, 12.0, 13.0, 20.0, 23.0])
    watch = Stopwatch(now=lambda: next(ticks))
    with watch.effect("mirror"):
        for _ in range(2):
            with watch.stage("render", "projection"):
                pass
    with pytest.raises(ValueError, match="broken"), watch.stage("check"):
        raise ValueError("broken")
    assert watch.seconds == {"render": 3.0, "check": 3.0}
    assert watch.effects == {"projection": 3.0, "mirror": 13.0}
    (row,) = table_of_rows("timings", [timing_row(3, "mug", watch)]).to_pylist()
    assert row["total_s"] == 6.0 and {effect["name"]: effect["seconds"] for effect in row["effects"]} == watch.effects
    total = Stopwatch({"render": 1.0})
    total.add(watch)
    assert total.seconds == {"render": 4.0, "check": 3.0}


# ---------------------------------------------------------------------------------------------- image files

IMAGES = Images(patch=Patch(width=16, height=8))
CAMERA = Camera(Intrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0), np.eye(4))


def label(region_id: int, category: str, u: int = 32) -> ObjectLabel:
    return ObjectLabel(region_id, category, "instance", np.eye(4), u, 24, (0, 0, 1, 1), 1, 1.0)


def view_of(*labels: ObjectLabel) -> View:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    depth = rng.integers(0, 9000, (48, 64)).astype(np.uint16)
    return View("input", 6, 6, CAMERA, rgb, depth, np.full((48, 64), 3, np.uint8), labels)


def boxes_of(view: View, pair: Pair | None = None) -> dict:
    objects = object_labels(view, pair or Pair(1.0, view))
    return {path: box for path, _, box in image_boxes(view, objects, objects[0].category, IMAGES.patch)}


def test_every_image_and_patch_reads_back_as_what_the_view_holds_with_its_digest():
    view = view_of(label(2, "table"), label(3, "mug"))
    files = {file.path: file for file in encode_view(view, Pair(1.0, view), IMAGES)}
    names = ("RGB", "depth", "segment")
    assert files.keys() == {f"mug/{folder}{name}00006.png" for name in names for folder in ("", "patches/")}
    for name, pixels in zip(names, (view.rgb, view.depth, view.region), strict=True):
        assert np.array_equal(decode_png(files[f"mug/{name}00006.png"].data), pixels)
        assert np.array_equal(decode_png(files[f"mug/patches/{name}00006.png"].data), pixels[20:28, 24:40])
    assert all(file.sha256 == hashlib.sha256(file.data).hexdigest() for file in files.values())
    assert list(boxes_of(dataclasses.replace(view, rgb=None))) == [path for path in boxes_of(view) if "RGB" not in path]


# ---------------------------------------------------------------------------------------------- a worker process

FAULTS = """
import resource, sys
import numpy as np
from workers.scene.context import keep_freed_memory
if sys.argv[1] == "keep":
    keep_freed_memory()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(50):
    arrays = [np.ones(size) for size in 8 * [900_000]]
    del arrays
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.minute
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_images_made_again_and_again_do_not_fault_in_new_pages():
    def faults(how: str) -> int:
        run = [sys.executable, "-c", FAULTS, how]
        return int(subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=True).stdout)

    assert faults("keep") < 0.2 * faults("leave")


def test_opencv_of_a_worker_has_one_thread():
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        open_worker(Job(name="t"), built_in_assets())
        assert cv2.getNumThreads() == 1
    finally:
        cv2.setNumThreads(before)
