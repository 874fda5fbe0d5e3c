"""No object of a training pair is in a test pair, and what the network may see holds nothing of the answer."""

import dataclasses

import numpy as np
import pytest
from mirror_depth import CHANNELS, CROP, SCALE_M, instances_of, make_example, pairs_of_split

from services.dataset.dataset import open_dataset
from services.dataset.view import View
from tests.datasets import make_dataset


@pytest.mark.minute
def test_no_instance_is_in_two_splits_also_where_a_scene_has_several_objects(few, tmp_path):
    sources = {"objects": [{"source": "procedural", "instances": 3}], "split": {"train": 0.6, "val": 0.1, "test": 0.3}}
    small = {"scenes": 16, "seed": 3, "objects_per_scene": 2, "categories": ["box", "can", "bowl", "jar"]}
    dataset = open_dataset(make_dataset(tmp_path, **small, assets=sources)[0].root)
    shown: dict[int, set[str]] = {}  # instances by pair, from the text file: even ids are pairs
    for words in map(str.split, (tmp_path / "objects.dat").read_text().splitlines()):
        if words[1] != "table" and int(words[0]) % 2 == 0:
            shown.setdefault(int(words[0]), set()).add(words[2])
    assert {pair.pose_id: instances_of(pair) for pair in dataset.pairs()} == shown
    chosen = {split: [pair.pose_id for pair in pairs_of_split(dataset, split)] for split in ("train", "val", "test")}
    seen = {split: set().union(*(shown[number] for number in ids)) for split, ids in chosen.items()}
    assert not seen["train"] & seen["test"] and not seen["train"] & seen["val"] and not seen["val"] & seen["test"]
    assert seen["train"] and seen["test"]
    mixed = set(shown) - {number for ids in chosen.values() for number in ids}
    assert mixed, "no scene mixes the splits: the test would not see a leak"
    single = open_dataset(few.root)  # of one object: each pair is in exactly one split
    for splits in (None, single.splits(), held := single.splits(held_out=["box"])):
        ids = [pair.pose_id for split in ("train", "val", "test") for pair in pairs_of_split(single, split, splits)]
        assert sorted(ids) == [pair.pose_id for pair in single.pairs()]
    assert all(held[pair.instance_id] == "test" for pair in single.pairs() if pair.category == "box")


@pytest.fixture(scope="module")
def examples(pairs):
    return [make_example(pair) for pair in pairs]


def test_features_hold_nothing_of_the_mirror_view(pairs, examples, monkeypatch):
    for name in ("rgb", "depth", "depth_m", "segment"):
        real = getattr(View, name)

        def blind(self, real=real):
            return np.zeros_like(real(self)) if self.role != "input" else real(self)

        monkeypatch.setattr(View, name, blind)
    for pair, seen in zip(pairs, examples, strict=True):
        bare = dataclasses.replace(pair.mirror, objects=())
        unlabelled = dataclasses.replace(pair, views={"input": pair.input, "mirror": bare})
        again = make_example(unlabelled)
        for name in ("features", "background", "middle_m"):
            assert np.array_equal(getattr(again, name), getattr(seen, name))
        assert not again.mask.any()


def test_an_example_has_the_shape_that_it_says_and_the_planes_of_the_truth(examples):
    for one in examples:
        assert one.features.shape == (CHANNELS, *CROP) and np.isfinite(one.features).all()
        assert one.mask.any()
        beside = ~one.mask & (one.depth > 0)
        error = np.abs(one.background - one.depth)[beside]
        assert np.median(error) < 2e-4 and (error < 0.002).mean() > 0.8


def test_what_the_network_sees_of_the_projection_is_the_truth_where_both_cameras_see_a_solid_object(pairs, examples):
    boxes = [(pair, one) for pair, one in zip(pairs, examples, strict=True) if pair.category == "box"]  # walls are thin
    assert boxes
    for pair, one in boxes:
        match = pair.correspondence(back=True)
        window = tuple(slice(at, at + size) for at, size in zip(one.corner, CROP, strict=True))
        both = one.mask & match.visible[window] & (one.features[2] > 0)
        seen_m = one.middle_m + SCALE_M * one.features[0]
        assert both.any() and np.median(np.abs(seen_m - one.depth)[both]) < 0.004
