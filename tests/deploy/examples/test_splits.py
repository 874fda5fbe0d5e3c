"""No object of a training pair is in a test pair."""

import pytest
from splits import instances_of, pairs_of_split

from services.dataset.dataset import open_dataset
from tests.datasets import make_dataset


@pytest.fixture(scope="module")
def piles(tmp_path_factory):
    """Two objects in a scene, of few instances, so that scenes share them."""
    few = {"objects": [{"source": "procedural", "instances": 3}], "split": {"train": 0.6, "val": 0.1, "test": 0.3}}
    changes = {
        "scenes": 16,
        "seed": 3,
        "objects_per_scene": 2,
        "categories": ["box", "can", "bowl", "jar"],
        "assets": few,
    }
    return make_dataset(tmp_path_factory.mktemp("piles"), **changes)[0]


def objects_by_pair(root) -> dict[int, set[str]]:
    """Instances that each pair shows, from the text file: even ids are pairs."""
    found: dict[int, set[str]] = {}
    for words in map(str.split, (root / "objects.dat").read_text().splitlines()):
        if words[1] != "table" and int(words[0]) % 2 == 0:
            found.setdefault(int(words[0]), set()).add(words[2])
    return found


def test_no_instance_is_in_two_splits_also_where_a_scene_has_several_objects(piles):
    shown = objects_by_pair(piles.root)
    dataset = open_dataset(piles.root)
    chosen = {split: [pair.pose_id for pair in pairs_of_split(dataset, split)] for split in ("train", "val", "test")}
    seen = {split: set().union(*(shown[number] for number in ids)) for split, ids in chosen.items()}
    assert not seen["train"] & seen["test"] and not seen["train"] & seen["val"] and not seen["val"] & seen["test"]
    assert seen["train"] and seen["test"]
    mixed = set(shown) - {number for ids in chosen.values() for number in ids}
    assert mixed, "no scene mixes the splits: the test would not see a leak"


def test_every_instance_of_a_pair_is_listed(piles):
    shown = objects_by_pair(piles.root)
    for pair in open_dataset(piles.root).pairs():
        assert instances_of(pair) == shown[pair.pose_id]


def test_single_objects_are_each_in_exactly_one_split(few):
    dataset = open_dataset(few.root)
    ids = [pair.pose_id for split in ("train", "val", "test") for pair in pairs_of_split(dataset, split)]
    assert sorted(ids) == [pair.pose_id for pair in dataset.pairs()]
