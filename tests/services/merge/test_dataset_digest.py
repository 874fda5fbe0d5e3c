"""The digest of whole datasets: what it depends on, and what not."""

import dataclasses
import hashlib
import json

import numpy as np
import pyarrow.dataset as ds
import pytest

from schemas.dataset.tables import TABLES
from services.merge.merge import merge, read_success
from tests.made_up_datasets import FIRST, STOP, dataset_at
from tests.made_up_scenes import attempt_at, failed_scene, made_scene, scene, with_shapes
from workers.store.local import LocalStore

pytestmark = pytest.mark.usefixtures("unflushed")


def test_the_digest_is_what_its_definition_says(merged):
    store, result = merged
    success = json.loads((store.root / "_SUCCESS").read_text())
    files = {file.path: file.data for i in range(FIRST, STOP) for file in scene(i).files}
    files |= {name: (store.root / name).read_bytes() for name in ("camPoses.csv", "cameras.csv", "objects.dat")}
    text = "verso dataset 1\n" + "".join(f"{table} {success['tables'][table]}\n" for table in TABLES[:5])
    for name in sorted(files, key=str.encode):
        text += f"{name}\n{hashlib.sha256(files[name]).hexdigest()}\n"
    assert result.digest == hashlib.sha256(text.encode()).hexdigest()


@pytest.mark.parametrize(
    "how",
    [
        {"size": 1},
        {"size": 7},
        {"size": 100},
        {"order": -1},
        {"layout": "tar"},
        {"layout": "tar", "size": 5, "order": -1},
    ],
    ids=str,
)
def test_the_digest_does_not_depend_on_ranges_order_layout_or_attempts(merged, tmp_path, how):
    assert merge(dataset_at(tmp_path, **how), FIRST, STOP) == merged[1]


def test_a_dataset_extended_twice_has_the_digest_of_one_made_at_once(merged, tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    from services.run.range_planner import committed_ranges, plan_ranges
    from workers.store.ledger import list_commits

    for stop in (9, 10, STOP):
        for start, end in plan_ranges(FIRST, stop, 4, committed_ranges(list_commits(store))):
            attempt_at(store, start, end).commit()
        result = merge(store, FIRST, stop)
        assert result.complete
    assert result == merged[1]
    assert ds.dataset(tmp_path / "manifest/views", partitioning="hive").count_rows() == result.rows["views"]


def test_a_dataset_whose_killed_scenes_were_retried_has_the_digest_of_one_without_kills(merged, tmp_path):
    def killed(scene_id):
        return failed_scene(scene_id, "environmental") if scene_id in (7, 8, 20) else scene(scene_id)

    store = dataset_at(tmp_path, make=killed)
    first = merge(store, FIRST, STOP)
    assert (first.complete, first.scenes["environmental"]) == (False, 3)
    assert read_success(store) is None
    assert first.digest != merged[1].digest
    attempt_at(store, 7, 11, retry=1, scenes=(7, 8)).commit()
    attempt_at(store, 19, 23, retry=1, scenes=(20,)).commit()
    assert merge(store, FIRST, STOP) == merged[1]


def changed_image(scene_id):
    output = scene(scene_id)
    if scene_id != 12:
        return output
    return made_scene(12, salt="!")


def changed_row(scene_id):
    output = scene(scene_id)
    if scene_id != 12:
        return output
    rows = [{**row, "support_margin_mm": np.nextafter(row["support_margin_mm"], 99)} for row in output.rows["scenes"]]
    return dataclasses.replace(output, rows={**output.rows, "scenes": rows})


def changed_shape(scene_id):
    return with_shapes(scene(scene_id), lambda data: data[::-1])


def changed_failure(scene_id):
    if scene_id != 16:
        return scene(scene_id)
    output = failed_scene(scene_id)
    return dataclasses.replace(output, rows={"failures": [{**output.rows["failures"][0], "detail": "it slid"}]})


@pytest.mark.parametrize("make", [changed_image, changed_row, changed_shape, changed_failure])
def test_the_digest_tells(merged, tmp_path, make):
    assert merge(dataset_at(tmp_path, make=make), FIRST, STOP).digest != merged[1].digest
