"""Formats whose pairs share files, read back with nothing but tarfile or pyarrow, and with the packages that they are for."""

import io
import json
import tarfile

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh
import yaml

from schemas.dataset.layout import ARTICLE
from schemas.dataset.tables import SCHEMAS
from services.export.shards import card_text
from tests.services.export.exported import export_to, source_image, source_poses, source_rows

WORDS = {
    "input": {"rgb": "RGB", "depth": "depth", "region": "segment"},
    "aligned": {"rgb": "RGBaligned", "depth": "depthAligned", "region": "segmentAligned"},
    "mirror": {"rgb": "RGB", "depth": "depth", "region": "segment"},
    "projected": {"rgb": "RGBprojected", "depth": "depthProjected"},
}
POINTS = 64
POSE_IDS = [0, 2, 4, 6, 8, 10, 12, 14]


@pytest.fixture(scope="module")
def exported(files, tmp_path_factory):
    """(folder, manifest) by format; a shard ends after each scene."""
    place = tmp_path_factory.mktemp("sharded")
    names = ("webdataset", "huggingface")
    return {
        name: (place / name, export_to(files, place / name, name, shard_mb=0, points=POINTS).manifest) for name in names
    }


def check_pixels(files, category, pose_id, read):
    """`read(role, kind)` are the pixels that the dataset stores."""
    for role, kind, word in ((role, *one) for role, words in WORDS.items() for one in words.items()):
        stored = source_image(files.root, category, word, pose_id + (role == "mirror"))
        np.testing.assert_array_equal(read(role, kind), stored)


def decode(data):
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return pixels[..., ::-1] if pixels.ndim == 3 else pixels


def check_shapes(files, folder, instances):
    """Each shape is the stored one, and its points lie on it."""
    assert {path.stem for path in folder.glob("shapes/*/*.glb")} == set(instances)
    for path in folder.glob("shapes/*/*.glb"):
        assert path.read_bytes() == (files.root / "assets" / path.parent.name / path.name).read_bytes()
        drawn, mesh = np.load(path.with_suffix(".npz")), trimesh.load_mesh(path, process=False)
        assert drawn["points"].shape == drawn["normals"].shape == (POINTS, 3)
        nearest = trimesh.triangles.closest_point(
            np.tile(mesh.triangles, (8, 1, 1)), np.repeat(drawn["points"][:8], len(mesh.faces), axis=0)
        )
        gaps = np.linalg.norm(nearest - np.repeat(drawn["points"][:8], len(mesh.faces), axis=0), axis=1)
        assert gaps.reshape(8, -1).min(axis=1).max() < 1e-6
        np.testing.assert_allclose(np.linalg.norm(drawn["normals"], axis=1), 1.0, atol=1e-5)


def check_poses(files, pose_id, input_view, mirror_view):
    poses = source_poses(files.root)
    for view, number in ((input_view, pose_id), (mirror_view, pose_id + 1)):
        np.testing.assert_allclose(np.reshape(view["T_world_cam"], (4, 4)), poses[number], atol=1e-6)


# ------------------------------------------------------------------------------------------------ WebDataset


def samples_of(folder):
    """Members by key, as WebDataset groups them: up to the first point of the name."""
    samples = {}
    for path in sorted(folder.glob("*.tar")):
        with tarfile.open(path) as archive:
            for member in archive:
                key, _, name = member.name.partition(".")
                samples.setdefault((path.name.rpartition("-")[0], key), {})[name] = archive.extractfile(member).read()
    return samples


def test_every_pair_is_a_sample_with_the_pixels_poses_and_split_of_the_dataset(files, exported):
    folder, manifest = exported["webdataset"]
    samples = samples_of(folder)
    assert sorted(int(key) for _, key in samples) == POSE_IDS
    check_shapes(files, folder, [row["instance_id"] for row in source_rows(files.root, "assets")])
    assert (manifest["pairs"], manifest["pairs_left_out"], sum(manifest["samples"].values())) == (8, 0, 8)
    assert len(list(folder.glob("*.tar"))) == sum(manifest["shards"].values()) == 4  # full after each scene
    for (split, key), sample in samples.items():
        told, arrays = (
            json.loads(sample["json"]),
            {k: np.load(io.BytesIO(sample[f"{k}.npz"])) for k in ("depth", "region")},
        )
        assert (told["pose_id"], told["split"]) == (int(key), split)
        check_poses(files, int(key), told["views"]["input"], told["views"]["mirror"])

        def read(role, kind, sample=sample, arrays=arrays):
            return arrays[kind][role] if kind in arrays else decode(sample[f"{role}.{kind}.png"])

        check_pixels(files, told["category"], int(key), read)


def test_small_shards_hold_the_same_samples_as_one_and_captures_are_samples_too(files, captures, tmp_path, exported):
    export_to(files, tmp_path / "one", "webdataset", points=POINTS)
    assert samples_of(tmp_path / "one") == samples_of(exported["webdataset"][0])
    assert export_to(captures, tmp_path / "new", "webdataset").manifest["pairs"] == 4
    for sample in samples_of(tmp_path / "new").values():
        assert set(np.load(io.BytesIO(sample["depth.npz"]))) == {"input", "mirror", "projected"}
        assert set(np.load(io.BytesIO(sample["region.npz"]))) == {"input", "mirror"}
    assert [path.parent.name for path in (tmp_path / "new").glob("shapes/*/*")] == ["mug", "mug"]  # no board is stored


# The package leaves it to the garbage collector to close the shards that it opened.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize("decoder", ["rgb", "rgb8", "pil", "l"])
def test_the_webdataset_package_reads_every_sample_with_any_of_its_decoders(decoder, files, exported):
    webdataset = pytest.importorskip("webdataset")
    urls = [str(path) for path in sorted(exported["webdataset"][0].glob("*.tar"))]
    samples = list(webdataset.WebDataset(urls, shardshuffle=False, empty_check=False).decode(decoder))
    assert sorted(int(one["__key__"]) for one in samples) == POSE_IDS
    for one in samples:
        for role, kind, word in ((role, *each) for role, words in WORDS.items() for each in words.items()):
            number = one["json"]["pose_id"] + (role == "mirror")
            stored = source_image(files.root, one["json"]["category"], word, number)
            if kind != "rgb":
                assert one[f"{kind}.npz"][role].dtype == stored.dtype
                np.testing.assert_array_equal(one[f"{kind}.npz"][role], stored)
            elif decoder in ("rgb8", "pil"):
                np.testing.assert_array_equal(np.asarray(one[f"{role}.rgb.png"]), stored)
        assert 3 in one["region.npz"]["mirror"]


def test_image_targets_are_arrays_and_colours_pictures(heap, tmp_path):
    assert "coordinates_offset_m" in export_to(heap, tmp_path / "new", "webdataset").manifest["targets"]
    (sample,) = samples_of(tmp_path / "new").values()
    for kind, (role, word, stored) in targets_of(heap):
        read = (
            decode(sample[f"{role}.{kind}.png"])
            if kind == "albedo"
            else np.load(io.BytesIO(sample[f"{kind}.npz"]))[role]
        )
        assert read.dtype == stored.dtype, word
        np.testing.assert_array_equal(read, stored)
    told = json.loads(sample["json"])["views"]["mirror"]["objects"]
    assert all({"amodal_pixels", "coordinates_scale_m"} <= one.keys() for one in told if one["region_id"] > 2)


def targets_of(store):
    """(kind, (role, word in the file's name, pixels)) of every image target that is stored; of `amodal` [objects, H, W]."""
    words = {"normals": "normals", "coordinates": "coordinates", "albedo": "albedo", "back": "back"}
    words |= {"back_region": "backSegment", "layer2": "layer2_", "layer2_region": "layerSegment2_", "amodal": "amodal"}
    words |= {"covisible": "covisible"}
    (category,) = {path.parent.name for path in store.root.glob("*/RGB00000.png")}
    for role, ending, pose_id in (("input", "", 0), ("aligned", "Aligned", 0), ("mirror", "", 1)):
        for kind, word in words.items():
            if (role, kind) == ("input", "covisible"):
                continue
            numbers = [f"{pose_id:05d}obj{n}" for n in range(3)] if kind == "amodal" else [f"{pose_id:05d}"]
            files = [store.root / category / f"{word}{ending}{number}.png" for number in numbers]
            pixels = [decode(path.read_bytes()) for path in files]
            yield kind, (role, word, np.stack(pixels) if kind == "amodal" else pixels[0])


# ------------------------------------------------------------------------------------------------ Hugging Face


def rows_of(folder):
    return [row for path in sorted(folder.glob("data/*.parquet")) for row in pq.read_table(path).to_pylist()]


def test_every_pair_is_a_row_with_the_pixels_poses_and_objects_of_the_dataset(files, captures, exported, tmp_path):
    folder, manifest = exported["huggingface"]
    rows, objects = rows_of(folder), source_rows(files.root, "objects")
    check_shapes(files, folder, {one["instance_id"] for one in objects})
    assert sorted(row["pose_id"] for row in rows) == POSE_IDS
    assert (manifest["pairs"], manifest["pairs_left_out"], sum(manifest["rows"].values())) == (8, 0, 8)
    for row in rows:
        pose_id = row["pose_id"]
        check_pixels(
            files, row["category"], pose_id, lambda role, kind, row=row: decode(row[f"{role}_{kind}"]["bytes"])
        )
        check_poses(files, pose_id, row["input_view"], row["mirror_view"])
        own = {(one["role"], one["region_id"]): one["T_cam_obj"] for one in row["objects"]}
        for one in objects:
            if (one["pose_id"], one["role"]) in ((pose_id, "input"), (pose_id + 1, "mirror")):
                np.testing.assert_allclose(own[one["role"], one["region_id"]], one["T_cam_obj"], atol=1e-6)
    assert export_to(captures, tmp_path / "new", "huggingface").manifest["pairs"] == 4
    assert all(row["mirror_rgb"]["bytes"] and "aligned_rgb" not in row for row in rows_of(tmp_path / "new"))


def test_the_card_names_the_files_the_licence_and_every_column(exported):
    folder, manifest = exported["huggingface"]
    _, head, body = (folder / "README.md").read_text().split("---\n", 2)
    told = yaml.safe_load(head)
    assert told["license"] == "cc0-1.0" and manifest["licences"] == ["CC0-1.0"]
    named = {entry["split"]: entry["path"] for entry in told["configs"][0]["data_files"]}
    assert named.keys() == manifest["rows"].keys() and all(list(folder.glob(path)) for path in named.values())
    schema = pq.read_schema(next(folder.glob("data/*.parquet")))
    assert all(f"`{name}`" in body for name in schema.names)
    views = {field.name: field.type for field in schema.field("mirror_view").type}
    assert all(SCHEMAS["views"].field(name).type.equals(kind) for name, kind in views.items())
    assert {"T_world_cam", "cx_opencv", "depth_units_per_m"} <= views.keys()
    for licences, licence in ((["CC0-1.0", "ShapeNet"], "other"), ([], "cc0-1.0")):
        text = card_text("a: b", "", schema, {}, licences)
        head = yaml.safe_load(text.split("---\n")[1])
        assert (head["license"], head["pretty_name"], head["configs"][0]["data_files"]) == (licence, "a: b", [])
        assert ", ".join(licences) in text and ARTICLE in text


def test_the_datasets_package_reads_every_image(files, exported, tmp_path):
    datasets = pytest.importorskip("datasets")
    folder, manifest = exported["huggingface"]
    loaded = datasets.load_dataset(str(folder), cache_dir=str(tmp_path / "cache"))
    assert {name: len(rows) for name, rows in loaded.items()} == manifest["rows"]
    for rows in loaded.values():
        assert isinstance(rows.features["input_depth"], datasets.Image)
        for row in rows:
            images = {name: np.asarray(cell) for name, cell in row.items() if name.partition("_")[0] in WORDS}
            check_pixels(files, row["category"], row["pose_id"], lambda *names, of=images: of["_".join(names)])
    other = tmp_path / folder.name
    export_to(files, other, "huggingface", last_scene=0)
    loaded = datasets.load_dataset(str(other), cache_dir=str(tmp_path / "cache"))
    assert sum(len(rows) for rows in loaded.values()) == 2, "not what is kept of another folder of that name"


def test_targets_of_16_bits_keep_them_and_silhouettes_are_a_list(heap, files, exported, tmp_path):
    """Pillow, with which the package decodes images, makes 8 bits of 3 x 16: those columns are bytes."""
    datasets = pytest.importorskip("datasets")
    manifest = export_to(heap, tmp_path / "new", "huggingface").manifest
    (split,) = manifest["rows"]
    (row,) = datasets.load_dataset(str(tmp_path / "new"), split=split, cache_dir=str(tmp_path / "cache"))
    for kind, (role, word, stored) in targets_of(heap):
        cell = row[f"{role}_{kind}"]
        read = (
            decode(cell)
            if isinstance(cell, bytes)
            else np.asarray(cell)
            if kind != "amodal"
            else np.stack(list(map(np.asarray, cell)))
        )
        np.testing.assert_array_equal(read, stored, err_msg=word)
    assert row["objects"][1]["coordinates_scale_m"] > 0
    assert "bytes, because Pillow" in (tmp_path / "new" / "README.md").read_text()
    plain = pq.read_schema(next(exported["huggingface"][0].glob("data/*.parquet")))
    assert not any("amodal" in name or "normals" in name for name in plain.names)
    assert not any("amodal" in field.name for field in plain.field("objects").type.value_type)
