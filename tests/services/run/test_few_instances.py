"""Datasets of few instances, which scenes share: the same bytes however they are made, each shape stored once."""

from typing import Any

import pytest

import workers.assets.catalogue
from schemas.errors import JobError
from services.dataset.dataset import open_dataset
from services.job.job_file import validate_job
from services.read.query import query
from services.read.replay import replay_scene
from tests.datasets import SMALL, faults_of, make_dataset, overlaid, run_here
from workers.assets.catalogue import Catalogue, InstanceRef, open_cache

pytestmark = pytest.mark.minute

FEW: dict[str, Any] = {
    "scenes": 8,
    "categories": ["box", "can"],
    "assets": {
        "objects": [{"source": "procedural", "instances": 3}],
        "tables": [{"source": "procedural", "instances": 1}],
        "split": {"train": 0.5, "val": 0.1, "test": 0.4},
    },
    "run": {"range_size": 4},
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Eight scenes of at most three boxes and three cans on one table."""
    return make_dataset(tmp_path_factory.mktemp("few"), **FEW)


@pytest.fixture
def nothing_cached(monkeypatch):
    monkeypatch.setattr(workers.assets.catalogue, "_cache", open_cache(2**28))


def test_each_instance_is_stored_once_and_its_id_is_category_seed_and_index(made):
    store, _ = made
    listed = {row["instance_id"] for row in query(store, "select instance_id from assets").to_pylist()}
    used = {row["instance_id"] for row in query(store, "select instance_id from scenes").to_pylist()}
    assert listed == {"table-0-000000", *used}
    assert 2 < len(used) < 8
    assert used < {f"{name}-0-00000{index}" for name in ("box", "can") for index in range(3)}
    assert {path.stem for path in (store.root / "assets").rglob("*.glb")} == listed
    assert faults_of(store) == []


@pytest.mark.parametrize("range_size", [1, 3, 8])
def test_ranges_of_any_size_give_the_same_digest(made, tmp_path, nothing_cached, range_size):
    assert make_dataset(tmp_path, **{**FEW, "run": {"range_size": range_size}})[1] == made[1]


def test_an_extended_dataset_is_the_one_that_was_made_at_once(made, tmp_path, nothing_cached):
    make_dataset(tmp_path, **{**FEW, "scenes": 3})
    assert run_here(validate_job(overlaid(SMALL, FEW), "test"), tmp_path)[1] == made[1]


def test_a_scene_replays_to_the_byte_without_the_scenes_before_it(made, nothing_cached):
    assert replay_scene(made[0], 7).differences == ()


def test_shapes_are_made_once(tmp_path, nothing_cached, monkeypatch):
    loaded: list[tuple[str, InstanceRef]] = []
    load = Catalogue.load
    monkeypatch.setattr(Catalogue, "load", lambda self, ref: loaded.append((self.digest, ref)) or load(self, ref))
    make_dataset(tmp_path, **FEW)
    assert 0 < len(loaded) == len(set(loaded))


def test_scenes_of_held_out_instances_are_found_by_a_query_and_share_none_with_the_others(made):
    store, _ = made
    sql = "select instance_id from scenes where instance_id {} (select instance_id from assets where split = 'train')"
    train, held_out = (query(store, sql.format(word)).to_pylist() for word in ("in", "not in"))
    assert len(train) + len(held_out) == 8
    assert train and held_out
    assert not {row["instance_id"] for row in train} & {row["instance_id"] for row in held_out}
    pairs = open_dataset(store.root).pairs()
    assert {pair.instance_id for pair in pairs} == {row["instance_id"] for row in (*train, *held_out)}


@pytest.mark.parametrize("value", [0, -3, 10**13, 1.5, "few"])
def test_a_number_of_instances_that_cannot_be_is_told_by_its_key(value):
    changes = {"assets": {"objects": [{"source": "procedural", "instances": value}]}}
    with pytest.raises(JobError, match=r"assets\.objects\.0\.(procedural\.)?instances") as told:
        validate_job(overlaid(SMALL, changes), "test")
    assert str(told.value).count("instances") == 1
