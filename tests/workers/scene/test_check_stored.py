"""Labels derived again from stored images and rows: a healthy pair passes, and each kind of wrong value is told."""

import copy

import numpy as np
import pytest

from services.job.record import require_job
from services.read.dataset_reader import committed_reader, file_reader, find_scene
from tests.datasets import make_dataset
from workers.scene.check_stored import check_stored_pair, check_stored_scene
from workers.store.images import decode_png


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """(job, row of scenes, rows of views by role, rows of objects, images by path) of one pair with two objects."""
    store, _ = make_dataset(tmp_path_factory.mktemp("pair"), scenes=1, objects_per_scene=2)
    scene = find_scene(store, 0)
    ((views, objects),) = scene.pairs(0)
    read = file_reader(committed_reader(store, scene.records), scene.records)
    images = {
        file["path"]: decode_png(read(file["path"]), file["path"]) for view in views.values() for file in view["files"]
    }
    return require_job(store).job, scene.scene(0), views, objects, images


@pytest.fixture
def told(stored):
    """The faults of a pair with one value changed: `told(change)`, where `change` alters (scene, views, objects, images)."""

    def faults(change=lambda *_: None) -> str:
        scene, views, objects, images = copy.deepcopy(stored[1:])
        change(scene, views, objects, images)
        found = check_stored_pair(stored[0], views, objects, scene, images.__getitem__)
        return "\n".join([*check_stored_scene(scene), *found])

    return faults


def nudged(T):
    return [*T[:3], T[3] + 1e-9, *T[4:]]


def test_a_healthy_pair_has_no_faults_and_a_scene_that_lacks_what_captures_alone_may_is_told(told, stored):
    assert told() == ""
    (fault,) = check_stored_scene(stored[1] | {"bodies": None})
    assert fault.endswith("bodies: missing")


def test_a_wrong_column_of_a_scene_a_label_or_a_view_is_told(told):
    for column, value, words in (
        ("T_world_obj", [0.0] * 16, "T_world_obj is"),
        ("hover_gap_mm", 99.0, "hover_gap_mm is 99.0, its bodies give"),
        ("support_margin_mm", -1.0, "support_margin_mm is -1.0"),
    ):
        assert words in told(lambda scene, *_, column=column, value=value: scene.update({column: value}))
    for body, column, change, words in (
        (1, "T_world_obj", nudged, "T_cam_obj does not follow"),
        (1, "penetration_mm", lambda mm: mm + 1.0, "penetration_mm is"),
        (0, "instance_id", lambda _: "another", "instance_id is"),
        (1, "region_id", lambda _: 9, "bodies have the regions"),
    ):

        def wrong_body(scene, *_, body=body, column=column, change=change):
            scene["bodies"][body][column] = change(scene["bodies"][body][column])

        assert words in told(wrong_body)
    for column, change, words in (
        ("pixels", lambda value: value + 1, "region 3: the mask has"),
        ("bbox_xywh", lambda box: [*box[:3], box[3] + 1], "region 3: the mask's box is"),
        ("u", lambda value: value + 1, "T_cam_obj projects to another pixel"),
        ("T_cam_obj", nudged, "T_cam_obj does not follow from"),
        ("visible_fraction", lambda _: 1.5, "visible_fraction 1.5 is no share"),
        ("patch_object_fraction", lambda _: 0.123, "of its patch, objects says 0.123"),
    ):

        def wrong_label(scene, views, objects, images, column=column, change=change):
            row = next(row for row in objects if row["role"] == "input" and row["region_id"] == 3)
            row[column] = change(row[column])

        assert words in told(wrong_label)
    for role, column, change, words in (
        ("aligned", "T_world_cam", nudged, "(aligned): T_world_cam does not follow"),
        ("mirror", "T_world_cam", nudged, "(mirror): T_world_cam does not follow"),
        ("mirror", "d_z_m", lambda d: d + 1e-9, "the input depth gives"),
        ("mirror", "mirror_agreement", lambda _: {"median_mm": 0.1, "share": 0.5}, "the two views agree to"),
        ("projected", "projected_filled_share", lambda s: s + 1e-9, "the shares filled and hidden are"),
        ("input", "files", lambda files: files[1:], "should be there, or should not"),
    ):

        def wrong_view(scene, views, objects, images, role=role, column=column, change=change):
            views[role][column] = change(views[role][column])

        assert words in told(wrong_view)


def painted(value, *place):
    def paint(image: np.ndarray) -> np.ndarray:
        pixels = image.copy()
        pixels[place] = value
        return pixels

    return paint


def test_a_wrong_image_is_told(told):
    spot = painted(7, slice(40, 44), slice(60, 64))
    for content, change, words in (
        ("/RGBprojected", spot, "projects to other images"),
        ("/depthProjected", spot, "projects to other images"),
        ("/segment0", spot, "the mask has regions [7] that objects lacks"),
        ("/segment0", painted(0, slice(2)), "depth where the mask says that nothing was hit"),
        ("/depth0", lambda depth: depth[:-1], "and must be uint16 (120, 160)"),
        ("/RGB0", lambda rgb: rgb.astype(np.uint16), "and must be uint8 (120, 160, 3)"),
        ("patches/RGB0", lambda rgb: rgb + 1, "is not the crop of its image"),
    ):

        def wrong_image(scene, views, objects, images, content=content, change=change):
            path = next(p for p in images if content in p and ("patches" in p) == ("patches" in content))
            images[path] = change(images[path])

        assert words in told(wrong_image)
