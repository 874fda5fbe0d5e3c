"""Parquet with embedded images, read back with pyarrow alone, and with the `datasets` package, offline."""

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml

from schemas.dataset.tables import SCHEMAS
from services.export.huggingface import card_text
from tests.exported import export_to, source_image, source_poses, source_rows

WORDS = {
    "input": {"rgb": "RGB", "depth": "depth", "region": "segment"},
    "aligned": {"rgb": "RGBaligned", "depth": "depthAligned", "region": "segmentAligned"},
    "mirror": {"rgb": "RGB", "depth": "depth", "region": "segment"},
    "projected": {"rgb": "RGBprojected", "depth": "depthProjected"},
}


@pytest.fixture(scope="module")
def exported(files, tmp_path_factory):
    folder = tmp_path_factory.mktemp("huggingface") / "new"
    return folder, export_to(files, folder, "huggingface", shard_mb=0).manifest


def rows_of(folder):
    return [row for path in sorted(folder.glob("data/*.parquet")) for row in pq.read_table(path).to_pylist()]


def check_pixels(files, row, decode):
    for role, kind, word in ((role, *one) for role, words in WORDS.items() for one in words.items()):
        stored = source_image(files.root, row["category"], word, row["pose_id"] + (role == "mirror"))
        pixels = decode(row[f"{role}_{kind}"])
        assert pixels.shape == stored.shape
        np.testing.assert_array_equal(pixels, stored)


def decode_bytes(cell):
    pixels = cv2.imdecode(np.frombuffer(cell["bytes"], np.uint8), cv2.IMREAD_UNCHANGED)
    return pixels[..., ::-1] if pixels.ndim == 3 else pixels


def test_every_pair_is_a_row_with_the_pixels_and_poses_of_the_dataset(files, exported):
    folder, manifest = exported
    rows, poses = rows_of(folder), source_poses(files.root)
    assert sorted(row["pose_id"] for row in rows) == [0, 2, 4, 6, 8, 10, 12, 14]
    assert (manifest["pairs"], manifest["pairs_left_out"], sum(manifest["rows"].values())) == (8, 0, 8)
    objects = source_rows(files.root, "objects")
    for row in rows:
        check_pixels(files, row, decode_bytes)
        for role, number in (("input", row["pose_id"]), ("mirror", row["pose_id"] + 1)):
            T = np.reshape(row[f"{role}_view"]["T_world_cam"], (4, 4))
            np.testing.assert_allclose(T, poses[number], atol=1e-6)
            own = {(one["role"], one["region_id"]): one["T_cam_obj"] for one in row["objects"]}
            for one in objects:
                if (one["pose_id"], one["role"]) == (number, role):
                    np.testing.assert_allclose(own[role, one["region_id"]], one["T_cam_obj"], atol=1e-6)


def test_the_card_names_the_files_the_licence_and_every_column(exported):
    folder, manifest = exported
    _, head, body = (folder / "README.md").read_text().split("---\n", 2)
    told = yaml.safe_load(head)
    assert told["license"] == "cc0-1.0" and manifest["licences"] == ["CC0-1.0"]
    named = {entry["split"]: entry["path"] for entry in told["configs"][0]["data_files"]}
    assert named.keys() == manifest["rows"].keys()
    assert all(list(folder.glob(path)) for path in named.values())
    schema = pq.read_schema(next(folder.glob("data/*.parquet")))
    assert all(f"`{name}`" in body for name in schema.names)
    views = {field.name: field.type for field in schema.field("mirror_view").type}
    assert all(SCHEMAS["views"].field(name).type.equals(kind) for name, kind in views.items())
    assert {"T_world_cam", "cx_opencv", "depth_units_per_m"} <= views.keys()
    for licences, licence in ((["CC0-1.0", "ShapeNet"], "other"), ([], "cc0-1.0")):
        text = card_text("a: b", schema, {}, licences)
        head = yaml.safe_load(text.split("---\n")[1])
        assert (head["license"], head["pretty_name"], head["configs"][0]["data_files"]) == (licence, "a: b", [])
        assert ", ".join(licences) in text


def test_captures_are_rows_too(captures, tmp_path):
    assert export_to(captures, tmp_path / "new", "huggingface").manifest["pairs"] == 4
    assert all(row["mirror_rgb"]["bytes"] and "aligned_rgb" not in row for row in rows_of(tmp_path / "new"))


def test_the_datasets_package_reads_every_image(files, exported, tmp_path):
    datasets = pytest.importorskip("datasets")
    loaded = datasets.load_dataset(str(exported[0]), cache_dir=str(tmp_path / "cache"))
    assert {name: len(rows) for name, rows in loaded.items()} == exported[1]["rows"]
    for rows in loaded.values():
        assert isinstance(rows.features["input_depth"], datasets.Image)
        for row in rows:
            check_pixels(files, row, np.asarray)
