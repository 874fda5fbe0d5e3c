"""Shards, read back with the webdataset package, and with nothing but tarfile."""

import io
import json
import tarfile

import cv2
import numpy as np
import pytest

from tests.exported import export_to, source_image, source_poses, source_rows

WORDS = {
    "input": ("RGB", "depth", "segment", 0),
    "aligned": ("RGBaligned", "depthAligned", "segmentAligned", 0),
    "mirror": ("RGB", "depth", "segment", 1),
    "projected": ("RGBprojected", "depthProjected", None, 0),
}


@pytest.fixture(scope="module")
def exported(files, tmp_path_factory):
    folder = tmp_path_factory.mktemp("webdataset") / "new"
    return folder, export_to(files, folder, "webdataset", shard_mb=0).manifest


def samples_of(folder):
    """Members by key, as WebDataset groups them: up to the first point of the name."""
    samples = {}
    for path in sorted(folder.glob("*.tar")):
        with tarfile.open(path) as archive:
            for member in archive:
                key, _, name = member.name.partition(".")
                samples.setdefault((path.name.rpartition("-")[0], key), {})[name] = archive.extractfile(member).read()
    return samples


def test_every_pair_is_a_sample_with_the_pixels_and_poses_of_the_dataset(files, exported):
    folder, manifest = exported
    samples, poses = samples_of(folder), source_poses(files.root)
    assert len(samples) == 8 == manifest["pairs"] and manifest["pairs_left_out"] == 0
    for (split, key), sample in samples.items():
        pose_id, told = int(key), json.loads(sample["json"])
        depths = np.load(io.BytesIO(sample["depth.npz"]))
        assert told["pose_id"] == pose_id and told["split"] == split
        for role, (rgb, depth, segment, more) in WORDS.items():

            def source(word, more=more, told=told, pose_id=pose_id):
                return source_image(files.root, told["category"], word, pose_id + more)

            pixels = cv2.imdecode(np.frombuffer(sample[f"{role}.rgb.png"], np.uint8), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(pixels[..., ::-1], source(rgb))
            np.testing.assert_array_equal(depths[role], source(depth))
            if segment:
                region = cv2.imdecode(np.frombuffer(sample[f"{role}.region.png"], np.uint8), cv2.IMREAD_UNCHANGED)
                np.testing.assert_array_equal(region, source(segment))
        for role, more in (("input", 0), ("mirror", 1)):
            T = np.reshape(told["views"][role]["T_world_cam"], (4, 4))
            np.testing.assert_allclose(T, poses[pose_id + more], atol=1e-6)


def test_splits_are_those_of_the_objects_and_shards_are_bounded(files, exported):
    folder, manifest = exported
    split = {row["instance_id"]: row["split"] for row in source_rows(files.root, "assets")}
    for (name, _), sample in samples_of(folder).items():
        assert split[json.loads(sample["json"])["instance_id"]] == name
    assert sum(manifest["samples"].values()) == 8
    shards = list(folder.glob("*.tar"))
    assert len(shards) == sum(manifest["shards"].values()) == 4  # full after each scene


def test_small_shards_hold_the_same_samples_as_one_and_captures_are_samples_too(files, captures, tmp_path, exported):
    export_to(files, tmp_path / "one", "webdataset")
    assert samples_of(tmp_path / "one") == samples_of(exported[0])
    assert export_to(captures, tmp_path / "new", "webdataset").manifest["pairs"] == 4
    for sample in samples_of(tmp_path / "new").values():
        assert set(np.load(io.BytesIO(sample["depth.npz"]))) == {"input", "mirror", "projected"}


# The package leaves it to the garbage collector to close the shards that it opened.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
def test_the_webdataset_package_reads_every_sample(files, exported):
    webdataset = pytest.importorskip("webdataset")
    folder, _ = exported
    urls = [str(path) for path in sorted(folder.glob("*.tar"))]
    read = list(webdataset.WebDataset(urls, shardshuffle=False, empty_check=False).decode("rgb8"))
    assert sorted(int(one["__key__"]) for one in read) == [0, 2, 4, 6, 8, 10, 12, 14]
    for one in read:
        category, pose_id = one["json"]["category"], one["json"]["pose_id"]
        np.testing.assert_array_equal(one["input.rgb.png"], source_image(files.root, category, "RGB", pose_id))
        region = source_image(files.root, category, "segment", pose_id + 1)
        np.testing.assert_array_equal(one["mirror.region.png"][..., 0], region)
        depth = source_image(files.root, category, "depthProjected", pose_id)
        np.testing.assert_array_equal(one["depth.npz"]["projected"], depth)
