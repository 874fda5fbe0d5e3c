import dataclasses
import hashlib
import json

import pytest

from schemas.dataset.layout import STAGING
from schemas.errors import CommitConflict, CorruptError, RunError
from services.merge.merge import merge, read_success
from tests.made_up_datasets import FIRST, STOP, dataset_at
from tests.made_up_scenes import attempt_at, made_scene, terms, with_shapes
from workers.store.local import LocalStore

pytestmark = pytest.mark.usefixtures("unflushed")


def test_success_names_the_digest_of_every_merged_file(merged):
    store, result = merged
    success = json.loads((store.root / "_SUCCESS").read_text())
    assert success["digest"] == result.digest
    assert success["schema_version"] == 1
    assert {"camPoses.csv", "cameras.csv", "objects.dat"} < success["files"].keys()
    on_disk = {str(path.relative_to(store.root)) for path in (store.root / "manifest").glob("[a-z]*/*/*.parquet")}
    assert {name for name in success["files"] if name.startswith("manifest/")} == on_disk
    for name, file in success["files"].items():
        data = (store.root / name).read_bytes()
        assert (file["bytes"], file["sha256"]) == (len(data), hashlib.sha256(data).hexdigest())
    assert success["scenes"] == {"made": 24, "intrinsic": 3, "environmental": 0}
    assert success["images"] == 24 * 22


def test_merging_again_changes_nothing(tmp_path):
    store = dataset_at(tmp_path)
    first = merge(store, FIRST, STOP)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    assert merge(store, FIRST, STOP) == first
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("lost", ["camPoses.csv", "manifest/views/category=mug/part-00000.parquet", "_SUCCESS"])
def test_what_was_lost_of_a_merge_is_made_again(tmp_path, lost):
    store = dataset_at(tmp_path)
    first = merge(store, FIRST, STOP)
    (tmp_path / lost).unlink()
    assert merge(store, FIRST, STOP) == first
    assert (tmp_path / lost).exists()


def test_stale_merged_files_are_taken_away(tmp_path):
    store = dataset_at(tmp_path)
    stale = tmp_path / "manifest/views/category=old/part-00007.parquet"
    stale.parent.mkdir(parents=True)
    stale.write_bytes(b"torn")
    merge(store, FIRST, STOP)
    assert not stale.parent.exists()
    assert not list(store.files(STAGING))


def test_a_torn_success_does_not_count(tmp_path):
    store = dataset_at(tmp_path)
    first = merge(store, FIRST, STOP)
    (tmp_path / "_SUCCESS").write_bytes((tmp_path / "_SUCCESS").read_bytes()[:100])
    assert read_success(store) is None
    assert merge(store, FIRST, STOP) == first


def test_a_gap_is_refused_and_nothing_is_merged(tmp_path):
    store = dataset_at(tmp_path, 0, 8)
    with pytest.raises(RunError, match="scenes 8 to 11 are not committed"):
        merge(store, 0, 12)
    assert not (tmp_path / "camPoses.csv").exists()
    assert not (tmp_path / "manifest/views").exists()
    assert not list(store.files(STAGING))


def test_an_image_that_is_missing_or_cut_is_told_by_name(tmp_path):
    store = dataset_at(tmp_path, 0, 8)
    image = made_scene(1).files[0].path
    store.put(image, b"cut")
    with pytest.raises(CorruptError, match=f"{image} has 3 bytes"):
        merge(store, 0, 8)
    store.remove(image)
    with pytest.raises(CorruptError, match=f"{image} is named by a commit"):
        merge(store, 0, 8)


def own_description(scene_id):
    output = made_scene(scene_id)
    rows = [{**row, "split": "test" if scene_id >= 4 else "train"} for row in output.rows["assets"]]
    return dataclasses.replace(output, rows={**output.rows, "assets": rows})


def own_shape(scene_id):
    return with_shapes(made_scene(scene_id), lambda data: data[::-1] if scene_id >= 4 else data)


@pytest.mark.parametrize("make", [own_description, own_shape])
def test_two_ranges_of_one_stack_that_make_one_asset_differently_are_a_conflict(tmp_path, make):
    store = dataset_at(tmp_path, 0, 8, make=make)
    with pytest.raises(CommitConflict, match=r"differently|two digests"):
        merge(store, 0, 8)
    assert read_success(store) is None


@pytest.mark.parametrize("make", [own_description, own_shape])
def test_two_stacks_that_make_one_asset_differently_are_merged_where_a_mix_is_allowed(tmp_path, make):
    store = LocalStore(tmp_path)
    store.prepare()
    for start, name in ((0, "stack-a"), (4, "stack-b")):
        attempt_at(store, start, start + 4, terms(fingerprint=name, fingerprint_mode="record"), make).commit()
    assert merge(store, 0, 8).complete
    assert json.loads((tmp_path / "_SUCCESS").read_text())["fingerprints"] == ["stack-a", "stack-b"]
