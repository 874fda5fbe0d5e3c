"""The authors' layout, read back by a reader that knows nothing but its description (tests/services/export/authors_loader.py)."""

import csv

import cv2
import numpy as np
import pytest

from services.export.source import in_units
from tests.datasets import make_dataset
from tests.services.export.authors_loader import load_pairs, load_several
from tests.services.export.exported import export_to, source_image, source_poses, source_rows
from workers.store.images import encode_png

WORDS = {"rgb": "RGB", "depth": "depth", "segment": "segment"}


@pytest.fixture(scope="module")
def exported(files, tmp_path_factory):
    folder = tmp_path_factory.mktemp("mirror") / "new"
    result = export_to(files, folder, "mirror-recon")
    return folder, result.manifest


def source_ids(folder):
    """Pose id in the dataset by (category, even id)."""
    with (folder / "pairs.csv").open() as file:
        return {(row["category"], int(row["id"])): int(row["pose_id"]) for row in csv.DictReader(file)}


def loaded(folder):
    """(category, pose id in the dataset, pair) of every pair, as the authors' loader gives it."""
    ids = source_ids(folder)
    categories = sorted({category for category, _ in ids})
    pairs = [(category, pair) for category in categories for pair in load_pairs(folder / category)]
    return [(category, ids[category, pair.front.number], pair) for category, pair in pairs]


def test_the_authors_loader_pairs_every_view(files, exported):
    folder, manifest = exported
    pairs, poses = loaded(folder), source_poses(files.root)
    assert len(pairs) == 8 == manifest["pairs"] and manifest["pairs_left_out"] == 0 and manifest["left_out"] == {}
    assert manifest["views"] == {key: 2 * [one[0] for one in pairs].count(key) for key in ("box", "can")}
    for _, source, pair in pairs:
        for pose, number in ((pair.front, source), (pair.back, source + 1)):
            np.testing.assert_allclose(pose.T_world_cam, poses[number], atol=1e-6)
            assert np.sin(pose.pitch) == pytest.approx(-pose.T_world_cam[2, 2])
            assert np.tan(pose.yaw) == pytest.approx(pose.T_world_cam[1, 2] / pose.T_world_cam[0, 2])


def test_depths_masks_and_colours_are_those_of_the_dataset(files, exported):
    for category, source, pair in loaded(exported[0]):
        for name, word in WORDS.items():
            for number in (0, 1):
                stored = source_image(files.root, category, word, source + number)
                np.testing.assert_array_equal(pair.images[f"{name}{number}"], stored)
            for number, side in enumerate(("yaw0", "yaw-179")):
                stored = source_image(files.root, f"{category}/patches", word, source + number)
                np.testing.assert_array_equal(pair.images[f"{name}In0{side}obj0"], stored)
        for name, word in (("rgbProj0", "RGBprojected"), ("depthProj0", "depthProjected")):
            np.testing.assert_array_equal(pair.images[name], source_image(files.root, category, word, source))
            patch = source_image(files.root, f"{category}/patches", word, source)
            np.testing.assert_array_equal(pair.images[f"{name}yaw-179obj0"], patch)


def test_the_first_object_is_the_table_and_the_last_one_the_pairs_own(files, exported):
    rows = {(row["pose_id"], row["role"], row["region_id"]): row for row in source_rows(files.root, "objects")}
    for category, source, pair in loaded(exported[0]):
        for pose, role, number in ((pair.front, "input", source), (pair.back, "mirror", source + 1)):
            table, thing = pose.objects[0], pose.objects[-1]
            assert (table.category, thing.category) == ("table", category) and len(pose.objects) == 2
            for one, region in ((table, 2), (thing, 3)):
                row = rows[number, role, region]
                assert (one.instance, one.region, one.centre) == (row["instance_id"], region, (row["u"], row["v"]))
                np.testing.assert_allclose(one.T_cam_obj.ravel(), row["T_cam_obj"], atol=1e-6)


def test_the_map_of_distances_is_that_of_each_pixel_to_the_nearest_of_the_object(exported):
    _, _, pair = loaded(exported[0])[0]
    height, width = pair.images["distIn0yaw0obj0"].shape
    rows, columns = np.nonzero(pair.images["segment0"] == 3)
    u, v = pair.front.objects[-1].centre
    expected = np.empty((height, width))
    for row, column in np.ndindex(height, width):
        expected[row, column] = np.hypot(rows - (v - height // 2 + row), columns - (u - width // 2 + column)).min()
    assert np.abs(pair.images["distIn0yaw0obj0"] - expected).max() <= 0.5 + 1e-3
    assert expected.max() > 3 and (expected == 0).any()


def test_every_object_of_several_is_read_as_the_authors_class_for_several_objects_reads(pile, tmp_path):
    manifest = export_to(pile, tmp_path / "new", "mirror-recon").manifest
    bodies = {row["scene_id"]: row["bodies"] for row in source_rows(pile.root, "scenes")}
    read, lost = [], manifest["pairs"] * 3
    for category in sorted(manifest["views"]):
        with (tmp_path / "new" / "pairs.csv").open() as file:
            scenes = [int(row["scene_id"]) for row in csv.DictReader(file) if row["category"] == category]
        for one in load_several(tmp_path / "new" / category):
            body = bodies[scenes[one.number // 2]][one.place]
            assert (one.front.instance, one.front.region) == (body["instance_id"], body["region_id"])
            assert one.back.instance == one.front.instance
            for name, at in (("segmentInyaw0", one.front), ("segmentInyaw-179", one.back)):
                height, width = one.images[name].shape  # the object is in the middle of its own patch
                (u, v), whole = at.centre, one.images["segment" if at is one.front else "segment_back"]
                crop = whole[v - height // 2 : v + height // 2, u - width // 2 : u + width // 2]
                np.testing.assert_array_equal(one.images[name], crop)
                assert (crop == at.region).any()
            read.append(one)
            lost -= 1
    assert len(read) == manifest["objects"] > manifest["pairs"] and len({one.place for one in read}) == 3
    assert bool(lost) == bool(manifest["not_exported"]) and (
        not lost or f"{lost} object" in manifest["not_exported"][0]
    )


def test_captures_are_paired_too(captures, tmp_path):
    manifest = export_to(captures, tmp_path / "new", "mirror-recon").manifest
    pairs = list(load_pairs(tmp_path / "new" / "mug"))
    assert len(pairs) == manifest["pairs"] >= 2 and len(pairs) + manifest["pairs_left_out"] == 4


def test_a_pair_that_lacks_an_image_is_left_out_and_counted(tmp_path):
    store, _ = make_dataset(
        tmp_path / "out", scenes=2, categories=["can"], images={"patch": {"width": 120, "height": 110}}
    )
    manifest = export_to(store, tmp_path / "new", "mirror-recon").manifest
    assert (manifest["pairs"], manifest["pairs_left_out"]) == (0, 2)
    assert all(one.startswith("no patch of the ") for one in manifest["left_out"])
    lines = (tmp_path / "new" / "left_out.csv").read_text().splitlines()
    assert lines[0] == "scene_id,pose_id,reason"
    assert [line.split(",")[:2] for line in lines[1:]] == [["0", "0"], ["1", "2"]]


def test_depth_in_other_units_is_converted_to_the_nearest_unit():
    depth = np.array([[0, 1000, 1500, 65535]], np.uint16)
    converted = cv2.imdecode(np.frombuffer(in_units(encode_png(depth), 1000.0, 5000.0), np.uint8), cv2.IMREAD_UNCHANGED)
    assert converted.tolist() == [[0, 5000, 7500, 0]]
