"""Pictures, point clouds and meshes of stored scenes, and the parts of the page that show them."""

import base64
import io
import json
import re

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from schemas.errors import MachineError
from schemas.scene.view import MODALITIES, Modality
from services.dataset.dataset import open_dataset
from services.look import clouds as module
from services.look.clouds import Body, Cloud, Space, coarsen, pack_spaces, read_space, read_spaces
from services.look.pictures import (
    CHEQUERS,
    FIXED_REGIONS,
    GAP,
    MOST_WIDTH,
    OBJECT_REGIONS,
    ROUND_MS,
    choose_scenes,
    depth_span,
    picture_of_codes,
    picture_of_colour,
    picture_of_depth,
    picture_of_projection,
    picture_of_regions,
    picture_of_silhouettes,
    series_of,
    show_scenes,
    view_pictures,
)
from services.look.sections import space_html
from services.look.sheets import compare_html, sheets_html, strip_html
from services.read.dataset_reader import find_scene
from tests.services.look.conftest import HOSTILE, Handmade, address, scene

VIRIDIS_ENDS = ((253, 231, 37), (68, 1, 84))
"""The last and the first colour of viridis, as its authors published them."""


def decoded(picture) -> np.ndarray:
    image = Image.open(io.BytesIO(picture.data))
    assert image.size == (picture.width, picture.height)
    return np.asarray(image.convert("RGB")).astype(int)


def test_depth_is_bright_to_dark_viridis_regions_have_their_colours_and_what_is_projected_is_bright():
    depth = np.repeat([0.0, 1.0, 3.0], 32)[None].repeat(48, axis=0)
    shown = decoded(picture_of_depth(depth, (1.0, 3.0), "depth"))
    for column, color in ((8, (0, 0, 0)), (48, VIRIDIS_ENDS[0]), (88, VIRIDIS_ENDS[1])):
        assert np.abs(shown[24, column] - color).max() <= 6  # JPEG
    regions = np.repeat(np.arange(6, dtype=np.uint8), 4)[None].repeat(4, axis=0)
    shown = decoded(picture_of_regions(regions, "regions"))
    assert [tuple(shown[0, 4 * i]) for i in range(6)] == [*FIXED_REGIONS, *OBJECT_REGIONS[:3]]
    mirror = np.full((32, 64, 3), 200, np.uint8)
    projected = np.zeros_like(mirror)
    projected[:, 32:] = (20, 180, 60)
    shown = decoded(picture_of_projection(mirror, projected, "over"))
    assert np.abs(shown[16, 8] - 70).max() <= 3 and np.abs(shown[16, 56] - (20, 180, 60)).max() <= 6


def test_the_span_of_depth_leaves_out_what_is_unknown_and_rare_and_the_floor():
    low, high = depth_span(np.concatenate([np.zeros(50), np.linspace(1.0, 2.0, 1001)]))
    assert (round(low, 2), round(high, 2)) == (1.01, 1.99)
    assert depth_span(np.zeros(4)) == (0.0, 0.0)
    depth, regions = np.array([1.0, 1.5, 7.0, 7.5]), np.array([3, 2, 1, 1])
    low, high = depth_span(depth, regions)
    assert 1.0 <= low < high <= 1.5
    assert depth_span(depth, np.ones(4, int))[1] > 7.0


def test_a_large_picture_is_shrunk_and_its_address_holds_its_bytes():
    large = {
        "rgb": np.zeros((960, 1280, 3), np.uint8),
        "region": np.repeat(np.uint8([[3], [4]]), 480, 0).repeat(1280, 1),
    }
    shrunk = view_pictures("input", large, 5000.0)
    assert {(each.width, each.height) for each in shrunk.values()} == {(MOST_WIDTH, MOST_WIDTH * 3 // 4)}
    assert len(np.unique(decoded(shrunk["input region"]).reshape(-1, 3), axis=0)) == 2  # no region between two
    picture = picture_of_colour(np.zeros((12, 16, 3), np.uint8), "small")
    assert (picture.width, picture.height) == (16, 12)
    kind, _, data = picture.inline.partition(",")
    assert kind == "data:image/jpeg;base64" and base64.b64decode(data) == picture.data
    assert picture.name != picture_of_colour(np.full((12, 16, 3), 9, np.uint8), "small").name


def test_each_category_has_as_many_scenes_evenly_over_its_ids_and_at_least_one():
    def chosen(categories: list[str], scenes: int) -> list[int]:
        rows = [{"scene_id": 10 + i, "category": name} for i, name in enumerate(categories)]
        return choose_scenes(Handmade(scenes=rows), scenes)

    assert chosen(["mug", "box"] * 50, 6) == [11, 59, 109, 10, 58, 108]
    rare = ["mug"] * 30 + ["box"]
    assert len(chosen(rare, 6)) == 4 and 40 in chosen(rare, 6)
    assert chosen(rare, 1) == [40, 10] and chosen([], 4) == []


def test_a_scene_has_its_pictures_and_depth_is_counted_of_objects_alone(shown):
    scenes, _ = show_scenes(shown, [0, 3])
    assert [scene.scene_id for scene in scenes] == [0, 3]
    first = scenes[0]
    roles = {f"{role} {kind}" for role in ("input", "mirror") for kind in ("rgb", "depth", "region")}
    patches = {"input rgb patch", "mirror rgb patch"}
    assert set(first.pictures) == roles | {"over"} | patches and all(
        picture.data for picture in first.pictures.values()
    )
    assert 0.0 < first.visible["input"] <= 1.0 and 1.9 < first.d_z_m < 3.0
    crop = cv2.imread(str(shown.root / first.category / "patches" / "RGB00000.png"))[..., ::-1].astype(int)
    assert np.abs(decoded(first.pictures["input rgb patch"]) - crop).mean() < 12 and crop.std() > 12  # JPEG
    _, depth = show_scenes(shown, [0])
    assert 0 < depth["input"].count < 160 * 120 / 10 and depth["mirror"].count
    assert abs(depth["input"].percentile(0.02) - first.d_z_m) < 0.05


def test_sheets_and_the_slider_show_each_scene_that_has_the_pictures_and_no_markup_of_theirs():
    html = sheets_html([scene(3, "box"), scene(7, "mug")], address)
    assert re.findall(r'data-show="([^"]*)"', html) == ["", "box", "mug"]
    assert re.findall(r'data-name="([^"]*)"', html) == ["input rgb", "mirror rgb", "over"] * 2
    names = ("input rgb", "input rgb patch", "mirror rgb", "mirror rgb patch", "over")
    patches_first = re.findall(r'data-name="([^"]*)"', sheets_html([scene(3, "box", names)], address))
    assert patches_first == ["input rgb patch", "mirror rgb patch", "input rgb", "mirror rgb", "over"]
    assert html.count('src="/picture/') == 6 and "2 objects" in html
    assert "98% visible in the input view, d_z 2.346 m" in html
    assert "data-show" not in sheets_html([scene(3, "box")], address)
    assert "no scenes to show" in sheets_html([], address)
    html = compare_html([scene(3, "box"), scene(7, "mug", ("input rgb",))])
    assert re.findall(r'<option value="(\d+)"', html) == ["3"] and 'type="range"' in html
    assert compare_html([scene(7, "mug", ("input rgb",))]) == ""
    hostile = [scene(3, HOSTILE), scene(4, "mug")]
    assert "<script" not in sheets_html(hostile, address) + compare_html(hostile)


# ---------------------------------------------------------------------------------------------- named cameras


def test_a_camera_is_a_strip_of_its_views_over_chequers_and_a_ring_turns(studio):
    (pair, *_), (shown, *_) = open_dataset(studio.root).scene(0), show_scenes(studio, [0])[0]
    around, over, right = shown.cameras
    assert [(each.name, each.views, each.shown) for each in shown.cameras] == [
        ("around", 14, 12),
        ("over", 5, 5),
        ("right", 1, 1),
    ]
    assert over.turning is None and right.turning is None and around.turning is not None
    with Image.open(io.BytesIO(around.turning.data)) as moving:
        assert (moving.format, moving.n_frames, moving.size) == ("WEBP", 14, (64, 48))
        assert abs(14 * moving.info.get("duration", ROUND_MS // 14) - ROUND_MS) < 100
        moving.seek(9)
        last = np.asarray(moving.convert("RGB")).astype(int)
    view, strip = pair.views["around", 9], decoded(around.strips["around rgb"])
    covered, clear = view.alpha() == 255, view.alpha() == 0
    assert np.abs(last - view.rgb())[covered].mean() < 12 and strip.shape == (2 * (48 + GAP), 6 * (64 + GAP), 3)
    assert np.abs(strip[:48, :64] - pair.views["around", 0].rgb())[pair.views["around", 0].alpha() == 255].mean() < 12
    low, high = np.percentile(last[clear], (2, 98))  # but for what the compression smears over the edge
    assert min(CHEQUERS) - 12 < low < high < max(CHEQUERS) + 12
    assert set(over.strips) == {"over rgb", "over depth", "over region"}
    masks = [np.pad(view.segment(), ((0, GAP), (0, GAP))) for view in pair.views("over")]
    colors = np.array([*FIXED_REGIONS, *OBJECT_REGIONS])
    assert np.array_equal(decoded(over.strips["over region"]), colors[np.concatenate(masks, axis=1)])


def test_the_sheet_and_the_small_strip_show_named_cameras_and_whole_pictures_where_there_is_no_mirror(studio):
    (shown, *_), _ = show_scenes(studio, [0])
    html = sheets_html([shown], address)
    assert html.count('class="camera"') == 3 and html.count('data-name="turning"') == 1
    assert "around <span>12 of 14 views" in html and "over <span>5 views" in html and "right <span>1 view<" in html
    small = strip_html(shown, address)
    assert small.count("<img ") == 4 and address(shown.cameras[0].turning) in small
    assert strip_html(scene(3, "box"), address).count("<img ") == 2 and compare_html([shown]) == ""


def test_an_object_alone_is_seen_from_farther_away_with_the_named_cameras_and_its_shape_made_again_has_its_size(studio):
    space = read_space(studio, 0)
    assert {body.kind for body in space.bodies} == {"object"} and space.missing == "" and len(space.cameras) == 20
    vertices = np.concatenate([body.vertices for body in space.bodies])
    radius_m = np.linalg.norm(vertices, axis=1).max()
    assert radius_m == pytest.approx(1.0, abs=1e-5)
    (packed,) = json.loads(pack_spaces([space]))
    assert len(packed["cameras"]) == 20 and packed["far"] > 1.5 * radius_m
    card = studio.read("DATASET.md").decode()
    assert "| views of further cameras | around (14), over (5), right (1) |\n" in card and "Alpha is" in card
    assert "tables, weight" not in card and "each alone on nothing" in card
    (stored,) = studio.root.glob("assets/mug/*.glb")
    kept = stored.read_bytes()
    stored.unlink()
    try:
        again = np.concatenate([body.vertices for body in read_space(studio, 0).bodies])
    finally:
        stored.write_bytes(kept)
    np.testing.assert_allclose(np.ptp(again, axis=0), np.ptp(vertices, axis=0), atol=1e-5)


# ---------------------------------------------------------------------------------------------- targets

LAYERS, DEPTHS = ("layer1", "layer2", "back"), ("layer1_00000", "layer2_00000", "back00000")


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
        assert (
            len([name for name in own if not name.endswith(" patch")]) == len(whole) - 1 == 13 + (role == "mirror")
        )  # one amodal of two
        assert {*("rgb", "depth", "region", "normals", "coordinates", "albedo", "amodal"), *LAYERS} < kinds
        assert ("covisible" in kinds) == (role == "mirror")
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


# ---------------------------------------------------------------------------------------------- in space


@pytest.fixture(scope="module")
def space(shown):
    return read_space(shown, 1)


def test_clouds_and_meshes_are_those_of_the_pair_in_the_world(shown, space):
    (pair, *_) = open_dataset(shown.root).scene(1)
    assert [cloud.role for cloud in space.clouds] == ["input", "mirror"]
    for cloud in space.clouds:
        whole = pair.views[cloud.role].cloud("world", None)
        near = np.hypot(*(whole.points - space.target)[:, :2].T) < module.REACH_M
        assert len(cloud.points) == near.sum() > 500  # by region
        order = [np.lexsort(points.T) for points in (cloud.points, whole.points[near])]
        np.testing.assert_array_equal(cloud.points[order[0]], whole.points[near][order[1]])
        np.testing.assert_array_equal(cloud.colors[order[0]], whole.colours[near][order[1]])
    for region, kind in ((2, "table"), (3, "object")):
        corners = np.concatenate([body.vertices for body in space.bodies if body.kind == kind])
        np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], pair.mesh(region).bounds, atol=1e-6)


def test_of_too_many_points_those_of_objects_stay_and_a_mesh_of_too_many_faces_keeps_its_shape(
    shown, space, monkeypatch
):
    vertices = np.concatenate([body.vertices for body in space.bodies if body.kind == "object"])
    whole, thin = space.clouds[0].points, read_space(shown, 1, 500).clouds[0].points
    low, high = vertices.min(axis=0) + np.array([0, 0, 0.01]), vertices.max(axis=0) + 0.005
    of_object = [((points > low) & (points < high)).all(axis=1).sum() for points in (whole, thin)]
    assert len(thin) <= 500 < len(whole) and of_object[0] == of_object[1] > 10
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    monkeypatch.setattr(module, "MOST_FACES", 2_000)
    monkeypatch.setattr(module, "GRID_STEPS", 30)
    coarse = coarsen(Body("object", ball.vertices, ball.faces))
    assert 0 < len(coarse.faces) < len(ball.faces) / 2
    assert np.abs(np.linalg.norm(coarse.vertices, axis=1) - 0.1).max() < 0.2 / 30


def test_what_is_packed_is_what_is_shown(space):
    def numbers(text: str, kind: str) -> np.ndarray:
        return np.frombuffer(base64.b64decode(text), kind).reshape(-1, 3)

    (packed,) = json.loads(pack_spaces([space]))
    cloud = packed["clouds"][1]
    points = numbers(cloud["points"], "<i2") * packed["quantum"] + packed["target"]
    assert np.abs(points - space.clouds[1].points).max() < 1.1e-4
    assert np.array_equal(numbers(cloud["colors"], "u1"), space.clouds[1].colors)
    assert np.array_equal(numbers(packed["bodies"][0]["faces"], "<u4"), space.bodies[0].faces)


def test_several_scenes_may_be_chosen_in_space_with_fewer_points_each(shown, monkeypatch):
    monkeypatch.setattr(module, "MOST_SPACES", 2)
    monkeypatch.setattr(module, "FEWER_POINTS", 700)
    spaces = read_spaces(shown, [0, 1, 2, 3])
    assert [space.scene_id for space in spaces] == [0, 3]
    assert all(len(cloud.points) <= 700 for space in spaces for cloud in space.clouds)
    assert [one["scene"] for one in json.loads(pack_spaces(spaces))] == [0, 3]
    options = re.findall(r'<option value="(\d)" data-missing="">([^<]+)<', space_html(spaces, ""))
    assert options == [("0", f"{spaces[0].category}, scene 0"), ("1", f"{spaces[1].category}, scene 3")]
    assert len(read_spaces(shown, [1])[0].clouds[0].points) > 700


def test_the_view_in_space_has_a_switch_for_each_part_and_says_why_there_is_no_mesh(shown, monkeypatch):
    def gone(*_):
        raise MachineError("the files of the asset <folders> do not hold what they held")

    monkeypatch.setattr(module, "posed_scene", gone)
    found = read_space(shown, 1)
    assert len(found.clouds) == 2 and found.bodies == () and "asset <folders>" in found.missing
    cloud = Cloud("input", np.zeros((1, 3)), np.zeros((1, 3), np.uint8), 0.01, np.eye(4))
    body = Body("object", np.zeros((3, 3)), np.array([[0, 1, 2]]))
    for bodies, missing, parts in (((), found.missing, []), ((body,), "", ["mesh"])):
        html = space_html([Space(3, "box", np.zeros(3), (cloud,), bodies, missing)], "{}")
        assert re.findall(r'data-part="(\w+)"', html) == ["input", *parts, "cameras", "tint"]
        assert ("There is no mesh: the files of the asset &lt;folders&gt;" in html) == (not bodies)
    assert space_html((), "") == ""
