"""Targets on the page: each image that is stored has its picture."""

import io
import re

import cv2
import numpy as np
import pytest
from PIL import Image

from schemas.scene.view import MODALITIES, Modality
from services.look.pictures import (
    OBJECT_REGIONS,
    picture_of_codes,
    picture_of_silhouettes,
    series_of,
    show_scenes,
    view_pictures,
)
from services.look.sheets import compare_html, sheets_html
from services.read.dataset_reader import find_scene
from tests.services.look.conftest import address, scene

LAYERS, DEPTHS = ("layer1", "layer2", "back"), ("layer1_00000", "layer2_00000", "back00000")


def decoded(picture) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(picture.data)).convert("RGB")).astype(int)


@pytest.fixture(scope="module")
def shown_targets(targets):
    return show_scenes(targets, [0])[0][0]


def test_sixteen_bits_are_shown_as_colours_and_a_silhouette_as_an_outline_over_what_hides_it():
    codes = np.array([[[0, 32768, 65535], [255, 256, 0x1234]]], np.uint16)
    assert decoded(picture_of_codes(codes, "")).tolist() == [[[0, 128, 255], [0, 1, 0x12]]]
    masks = np.zeros((2, 60, 80), np.uint8)
    masks[0, 20:40, 20:60] = masks[1, :30, 50:] = 255
    seen = decoded(picture_of_silhouettes(masks, np.full((60, 80, 3), 200, np.uint8), ""))
    for (row, column), color in (((20, 30), OBJECT_REGIONS[0]), ((30, 30), (200,) * 3), ((29, 70), OBJECT_REGIONS[1])):
        assert np.abs(seen[row, column] - color).max() < 40  # JPEG of a line
    assert np.abs(seen[8, 70] - 200).max() < 12 and np.abs(seen[0, 70] - 200).max() < 12  # it goes on outside the image


def test_every_image_that_a_view_stores_has_its_picture(targets, shown_targets):
    views, _ = next(find_scene(targets, 0).pairs(0))
    for role in ("input", "mirror"):
        files = [file["path"] for file in views[role]["files"]]
        whole = [path for path in files if "/patches/" not in path]
        own = [name for name in shown_targets.pictures if name.startswith(f"{role} ")]
        kinds = {name.split(" ")[1] for name in own}
        assert len([name for name in own if not name.endswith(" patch")]) == len(whole) - 1 == 13  # one amodal of two
        assert {*("rgb", "depth", "region", "normals", "coordinates", "albedo", "amodal"), *LAYERS} < kinds
    stem = targets.root / "mug"
    for name, file in (("mirror normals", "normals00001"), ("input coordinates patch", "patches/coordinates00000obj0")):
        stored = cv2.imread(str(stem / f"{file}.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
        assert stored.dtype == np.uint16 and np.array_equal(decoded(shown_targets.pictures[name]), stored >> 8)
    depth = np.stack([cv2.imread(str(stem / f"{name}.png"), cv2.IMREAD_UNCHANGED) for name in DEPTHS]) / 5000.0
    low, high = np.percentile(depth[depth > 0], (1, 99))
    words = [shown_targets.pictures[f"input {kind}"].words for kind in LAYERS]
    assert words == [f"input view, {one}, {low:.2f} to {high:.2f} m" for one in ("layer 1", "layer 2", "back")]


def test_a_new_modality_is_painted_and_compared_by_its_row_alone(monkeypatch):
    for new in (
        Modality("flow", "flow", "uint16", 3, target="normals"),
        Modality("rim", "rim", "uint16", target="albedo"),
    ):
        monkeypatch.setitem(MODALITIES, new.name, new)
    flow, rim = np.full((4, 4, 3), 0x8000, np.uint16), np.full((4, 4), 5000, np.uint16)
    pictures = view_pictures("input", {"flow": flow, "rim": rim}, 5000.0)
    assert (decoded(pictures["input flow"]) == 128).all() and pictures[
        "input rim"
    ].words == "input view, rim, 1.00 to 1.00 m"
    html = compare_html([scene(3, "box", ("input rim", "mirror rim", "input rgb"))])
    assert re.findall(r'data-kind="([^"]*)"', html) == ["rim"]


def test_images_of_one_target_share_a_button_and_a_slider_and_without_targets_the_page_has_neither(shown_targets):
    assert series_of(MODALITIES)["layers"][-2:] == ("layer16", "back")
    html = compare_html([shown_targets])
    buttons = dict(re.findall(r'data-kind="([^"]*)" aria-pressed="\w+">([^<]*)<', html))
    assert buttons["layer1 layer2 back"] == "layers" and buttons["normals"] == "normals" and buttons["rgb"] == "RGB"
    assert buttons["layer1_region layer2_region back_region"] == "regions of layers"
    assert 'id="wipe-member"' in html and 'id="wipe-close"' in html
    sheet = sheets_html([shown_targets], address)
    assert sorted(re.findall(r'data-name="([^"]*)"', sheet)) == sorted(shown_targets.pictures)
    assert sheet.count('class="cells targets"') == 3 and "<details>" in sheet
    plain = [scene(3, "box", ("input rgb", "mirror rgb", "input rgb patch", "mirror rgb patch"))]
    html = compare_html(plain)
    assert re.findall(r'data-kind="([^"]*)"', html) == ["rgb"]
    assert "wipe-member" not in html and "wipe-close" not in html and "targets" not in sheets_html(plain, address)
