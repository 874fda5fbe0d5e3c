"""Datasets from the job file to the merged files and back: of several objects, of few instances, and with less in them."""

import csv
import re
from typing import Any

import pytest

import workers.assets.catalogue
from schemas.dataset.codec import Row
from schemas.errors import InputError
from services.bench.command import refuse_unmatched
from services.dataset.dataset import open_dataset
from services.job.job_file import validate_job
from services.read.query import query
from services.read.replay import replay_scene
from services.read.scene_geometry import posed_scene
from tests.datasets import SMALL, faults_of, images_of, make_dataset, overlaid, run_here
from workers.assets.catalogue import Catalogue, InstanceRef, open_cache
from workers.store.local import LocalStore


def rows(store: LocalStore, sql: str) -> list[Row]:
    return query(store, sql).to_pylist()


# ------------------------------------------------------------------------------------------------ several objects


@pytest.mark.minute
def test_a_scene_that_has_one_object_by_chance_is_the_scene_of_a_job_with_one(tmp_path):
    """Of a range of counts: the same images, under names without `obj`. All are checked against cast rays."""
    six = {"scenes": 6, "categories": ["box", "camera", "bottle"], "check": {"raycast_share": 1.0}}
    ranged, _ = make_dataset(tmp_path / "ranged", **six, objects_per_scene=[1, 3])
    counts = [len(row["bodies"]) for row in rows(ranged, "select bodies from scenes order by scene_id")]
    assert set(counts) == {1, 2, 3}
    assert faults_of(ranged) == []
    before, after = images_of(make_dataset(tmp_path / "single", **six)[0]), images_of(ranged)

    def of_scene(images: dict[str, bytes], scene_id: int) -> dict[str, bytes]:
        ids = {f"{2 * scene_id:05d}", f"{2 * scene_id + 1:05d}"}
        return {path: data for path, data in images.items() if re.findall(r"\d{5}", path)[0] in ids}

    for scene_id, count in enumerate(counts):
        own = of_scene(after, scene_id)
        assert any("obj" in path for path in own) == (count > 1)
        assert count > 1 or own == of_scene(before, scene_id)


# ------------------------------------------------------------------------------------------------ few instances

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
def few(tmp_path_factory) -> tuple[LocalStore, str]:
    """Eight scenes of at most three boxes and three cans on one table."""
    return make_dataset(tmp_path_factory.mktemp("few"), **FEW)


@pytest.fixture
def nothing_cached(monkeypatch):
    monkeypatch.setattr(workers.assets.catalogue, "_cache", open_cache(2**28))


@pytest.mark.minute
def test_each_instance_is_stored_once_and_those_held_out_share_no_scene_with_the_others(few):
    store, _ = few
    listed = {row["instance_id"] for row in rows(store, "select instance_id from assets")}
    used = {row["instance_id"] for row in rows(store, "select instance_id from scenes")}
    assert listed == {"table-0-000000", *used}
    assert 2 < len(used) < 8
    assert used < {f"{name}-0-00000{index}" for name in ("box", "can") for index in range(3)}
    assert {path.stem for path in (store.root / "assets").rglob("*.glb")} == listed
    assert faults_of(store) == []
    sql = "select instance_id from scenes where instance_id {} (select instance_id from assets where split = 'train')"
    train, held_out = ([row["instance_id"] for row in rows(store, sql.format(word))] for word in ("in", "not in"))
    assert len(train) + len(held_out) == 8 and train and held_out and not set(train) & set(held_out)
    assert {pair.instance_id for pair in open_dataset(store.root).pairs()} == {*train, *held_out}


@pytest.mark.minute
@pytest.mark.usefixtures("nothing_cached")
def test_shapes_are_made_once_and_are_the_same_in_ranges_of_any_size_in_an_extension_and_in_a_replay(
    few, tmp_path, monkeypatch
):
    assert replay_scene(few[0], 7).differences == (), "without the scenes before it"
    monkeypatch.setattr(workers.assets.catalogue, "_cache", open_cache(2**28))
    loaded: list[tuple[str, InstanceRef]] = []
    load = Catalogue.load
    with monkeypatch.context() as patch:
        patch.setattr(Catalogue, "load", lambda self, ref: loaded.append((self.digest, ref)) or load(self, ref))
        assert make_dataset(tmp_path / "8", **{**FEW, "run": {"range_size": 8}})[1] == few[1]
    assert 0 < len(loaded) == len(set(loaded))
    assert make_dataset(tmp_path / "3", **{**FEW, "run": {"range_size": 3}})[1] == few[1]
    make_dataset(tmp_path / "grown", **{**FEW, "scenes": 3})
    assert run_here(validate_job(overlaid(SMALL, FEW), "test"), tmp_path / "grown")[1] == few[1]
    one = {"objects": [{"source": "procedural", "instances": 1}]}
    store, _ = make_dataset(tmp_path / "one", scenes=1, objects_per_scene=3, categories=["mug"], assets=one)
    assert faults_of(store) == []
    (row,) = rows(store, "select bodies from scenes")
    assert len({body["instance_id"] for body in row["bodies"]}) == 1
    assert rows(store, "select count(*) as n from assets where category = 'mug'") == [{"n": 1}]
    names = posed_scene(store, 0).graph.nodes_geometry
    assert len({name.partition("/")[0] for name in names if name.startswith("mug ")}) == 3


# ------------------------------------------------------------------------------------------------ switches

ROLES = {"input", "aligned", "mirror", "projected"}
NO_DEPTH = {"cameras": {"depth": {"enabled": False}}}
NO_PROJECTION = {"images": {"projection": {"enabled": False}}}
NO_MIRROR = {"cameras": {"mirror": {"enabled": False}}, **NO_PROJECTION}
SWITCHES: dict[str, Any] = {
    "depth_camera": (NO_DEPTH, {"aligned"}, ("aligned", "Aligned"), "| input, mirror, projected |"),
    "projection": (NO_PROJECTION, {"projected"}, ("projected", "Projected"), "| input, aligned, mirror |"),
    "mirror": (NO_MIRROR, {"mirror", "projected"}, ("projected", "Projected"), "| input, aligned |"),
    "rgb": ({"render": {"rgb": False}}, set(), ("RGB",), "; without RGB |"),
}
"""By the effect: what is switched off, the roles that go, words that no file's name may have then, and what the card says."""


@pytest.fixture(scope="module")
def full(tmp_path_factory) -> LocalStore:
    return make_dataset(tmp_path_factory.mktemp("full"))[0]


def check_merged_files(full: LocalStore, store: LocalStore, gone: set[str]) -> None:
    """They have the lines of the cameras that are there, and only these."""
    for name in ("cameras.csv", "camPoses.csv", "objects.dat"):
        before, after = ((each.root / name).read_text().splitlines() for each in (full, store))
        words = [re.split("[ ,]", line) for line in before]  # the first is a pose, in cameras.csv the third a role
        there = [
            w[2] not in gone if name == "cameras.csv" else "mirror" not in gone or w[0][-1] not in "13579"
            for w in words
        ]
        assert after == [line for line, kept in zip(before, there, strict=True) if kept]
    with open(store.root / "camPoses.csv") as file:
        assert [int(row["id"]) for row in csv.DictReader(file)] == ([0, 1, 2, 3] if "mirror" not in gone else [0, 2])


@pytest.mark.parametrize("name", SWITCHES)
def test_what_a_job_switches_off_is_not_there_and_nothing_else_changes(full, name, tmp_path):
    changes, gone, words, views = SWITCHES[name]
    store, _ = make_dataset(tmp_path, **changes)
    assert faults_of(store) == []
    before, after = images_of(full), images_of(store)
    assert after and not [path for path in after if any(word in path for word in words)]
    assert after == {path: before[path] for path in after}
    files = rows(full, "select role, unnest(files).path as path from views")
    lost = {row["path"] for row in files if row["role"] in gone or (name == "rgb" and "RGB" in row["path"])}
    assert before.keys() - after.keys() == lost
    for sql in (
        "select * exclude (files) from views order by pose_id, role",
        "select * from objects order by pose_id, role, region_id",
    ):
        expected = [row for row in rows(full, sql) if row["role"] not in gone]
        assert rows(store, sql) == expected
        assert sql.startswith("select * from") or {row["role"] for row in expected} == ROLES - gone
    check_merged_files(full, store, gone)
    for row in rows(store, "select effects, skipped from scenes"):
        assert name not in row["effects"]
        assert any(skip["effect"] == name and skip["why"].endswith("is false") for skip in row["skipped"])
    assert all(name in row["effects"] for row in rows(full, "select effects from scenes"))
    card = (store.root / "DATASET.md").read_text().splitlines()
    assert views in next(line for line in card if line.startswith("| views of each pair"))
    with pytest.raises(InputError, match="compares whole pairs"):
        refuse_unmatched(validate_job({"name": "t", **changes}, "t"))
    assert replay_scene(store, 1).differences == ()
    (store.root / "job.yaml").write_text((full.root / "job.yaml").read_text())
    assert faults_of(store), "its job says one thing and its rows say another"
