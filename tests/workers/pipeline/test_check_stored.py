"""Labels derived again from stored images and rows: a healthy pair passes, and each kind of wrong value is told."""

import copy

import numpy as np
import pytest

from services.job.record import require_job
from services.read.dataset_reader import file_reader, iter_stored, read_image
from tests.datasets import make_dataset
from workers.scene.check_stored import check_stored_pair, check_stored_scene


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """(job, row of scenes, rows of views by role, rows of objects, images by path) of one pair with two objects."""
    store, _ = make_dataset(tmp_path_factory.mktemp("pair"), scenes=1, objects_per_scene=2)
    (found,) = iter_stored(store)
    ((views, objects),) = found.pairs(0)
    read = file_reader(store.read, found)
    images = {file["path"]: read_image(read, file["path"]) for view in views.values() for file in view["files"]}
    return require_job(store).job, found.scene(0), views, objects, images


@pytest.fixture
def pair(stored):
    """A copy that a test may change."""
    return [stored[0], *copy.deepcopy(stored[1:])]


def faults_of(pair) -> str:
    job, scene, views, objects, images = pair
    faults = [*check_stored_scene(scene), *check_stored_pair(job, views, objects, scene, images.__getitem__)]
    return "\n".join(faults)


def test_a_healthy_pair_has_no_faults(pair):
    assert faults_of(pair) == ""


def test_a_scene_without_a_column_that_captures_alone_may_lack_is_told(pair):
    pair[1]["bodies"] = None
    (told,) = check_stored_scene(pair[1])
    assert told.endswith("bodies are missing")


@pytest.mark.parametrize(
    ("column", "value", "told"),
    [
        ("T_world_obj", [0.0] * 16, "T_world_obj is"),
        ("hover_gap_mm", 99.0, "hover_gap_mm is 99.0, its bodies give"),
        ("support_margin_mm", -1.0, "support_margin_mm is -1.0"),
    ],
)
def test_columns_of_a_scene_that_disagree_with_its_bodies_are_told(pair, column, value, told):
    pair[1][column] = value
    assert told in faults_of(pair)


@pytest.mark.parametrize(
    ("column", "change", "told"),
    [
        ("pixels", lambda value: value + 1, "region 3: the mask has"),
        ("bbox_xywh", lambda box: [*box[:3], box[3] + 1], "region 3: the mask's box is"),
        ("u", lambda value: value + 1, "T_cam_obj projects to another pixel"),
        ("T_cam_obj", lambda T: [*T[:3], T[3] + 1e-9, *T[4:]], "T_cam_obj does not follow from"),
        ("visible_fraction", lambda _: 1.5, "visible_fraction 1.5 is no share"),
        ("patch_object_fraction", lambda _: 0.123, "of its patch, objects says 0.123"),
    ],
)
def test_a_wrong_label_is_told(pair, column, change, told):
    row = next(row for row in pair[3] if row["role"] == "input" and row["region_id"] == 3)
    row[column] = change(row[column])
    assert told in faults_of(pair)


@pytest.mark.parametrize(
    ("role", "column", "change", "told"),
    [
        ("aligned", "T_world_cam", lambda T: [*T[:3], T[3] + 1e-9, *T[4:]], "(aligned): T_world_cam does not follow"),
        ("mirror", "T_world_cam", lambda T: [*T[:3], T[3] + 1e-9, *T[4:]], "(mirror): T_world_cam does not follow"),
        ("mirror", "d_z_m", lambda d: d + 1e-9, "the input depth gives"),
        ("mirror", "mirror_agreement", lambda _: {"median_mm": 0.1, "share": 0.5}, "the two views agree to"),
        ("projected", "projected_filled_share", lambda s: s + 1e-9, "the shares filled and hidden are"),
        ("input", "files", lambda files: files[1:], "should be there, or should not"),
    ],
)
def test_a_wrong_view_is_told(pair, role, column, change, told):
    pair[2][role][column] = change(pair[2][role][column])
    assert told in faults_of(pair)


def changed(image: np.ndarray) -> np.ndarray:
    pixels = image.copy()
    pixels[40:44, 60:64] = 7
    return pixels


@pytest.mark.parametrize(
    ("content", "change", "told"),
    [
        ("/RGBprojected", changed, "projects to other images"),
        ("/depthProjected", changed, "projects to other images"),
        ("/segment", changed, "the mask has regions [7] that objects lacks"),
        ("/depth", lambda depth: depth[:-1], "and must be uint16 (120, 160)"),
        ("/RGB", lambda rgb: rgb.astype(np.uint16), "and must be uint8 (120, 160, 3)"),
        ("patches/RGB", lambda rgb: rgb + 1, "is not the crop of its image"),
    ],
)
def test_a_wrong_image_is_told(pair, content, change, told):
    path = next(path for path in pair[4] if content in path and path.count("/") == 1 + content.count("patches/"))
    pair[4][path] = change(pair[4][path])
    assert told in faults_of(pair)


def test_depth_where_nothing_was_hit_is_told(pair):
    mask = next(path for path in pair[4] if "/segment0" in path and "patches" not in path)
    pair[4][mask][:2] = 0
    assert "depth where the mask says that nothing was hit" in faults_of(pair)
