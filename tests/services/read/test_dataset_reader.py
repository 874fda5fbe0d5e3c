"""Stored ranges, scenes and pairs, from files and from tars."""

import numpy as np
import pytest

from schemas.errors import CorruptError, InputError
from services.read.dataset_reader import choose_evenly, choose_scenes, file_reader, find_scene, iter_stored, read_image
from tests.datasets import make_dataset


def test_scenes_are_chosen_evenly_and_by_seed():
    ids = list(range(100, 300))
    chosen = choose_evenly(ids, 8, 5)
    assert len(set(chosen)) == 8
    assert set(np.diff(chosen)) == {25}
    assert chosen == choose_evenly(tuple(ids), 8, 5) != choose_evenly(ids, 8, 6)
    assert choose_evenly(ids, 500, 5) == ids
    assert choose_evenly([], 3, 5) == []


@pytest.fixture(scope="module", params=["files", "tar"])
def store(request, tmp_path_factory):
    changes = {"output": {"layout": request.param}, "pairs_per_scene": 2}
    return make_dataset(tmp_path_factory.mktemp(request.param), **changes)[0]


def test_a_scene_is_found_with_its_pairs(store):
    assert choose_scenes(store, 9, 0) == [0, 1]
    stored = find_scene(store, 1)
    assert stored.scene(1)["scene_id"] == 1 and stored.scene(7) is None
    pairs = list(stored.pairs(1))
    assert [views["input"]["pose_id"] for views, _ in pairs] == [4, 6]
    for views, objects in pairs:
        assert set(views) == {"input", "aligned", "mirror", "projected"}
        assert {row["pose_id"] for row in objects} == {views["input"]["pose_id"], views["mirror"]["pose_id"]}
        assert {row["region_id"] for row in objects} == {2, 3}
    with pytest.raises(InputError, match="scene 2 is not in"):
        find_scene(store, 2)


def test_every_committed_image_is_read_from_either_layout(store):
    for stored in iter_stored(store):
        read = file_reader(store.read, stored)
        paths = [file["path"] for row in stored.rows["views"] for file in row["files"]]
        assert len(paths) >= 4 * 11
        assert all(read_image(read, path).size for path in paths)
        with pytest.raises(CorruptError, match="mug/RGB99999"):
            read("mug/RGB99999.png")


def test_bytes_that_are_no_image_are_refused_by_name(store):
    with pytest.raises(CorruptError, match=r"a\.png"):
        read_image(lambda _: b"no png", "a.png")
