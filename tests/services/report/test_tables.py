import shutil

import obstore
import pyarrow as pa
import pyarrow.dataset as ds
import pytest

from schemas.dataset.layout import SUCCESS_FILE
from services.look import collect as module
from services.look.collect import choose_spread, open_tables
from services.look.report import read_report
from tests.datasets import make_dataset
from tests.made_up_scenes import attempt_at
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore

COLUMNS = {"views": ("pose_id", "role", "category", "visible_fraction"), "scenes": ("scene_id", "category", "skipped")}


def rows_of(tables, name: str) -> list[dict]:
    parts = list(tables.batches(name, COLUMNS[name]))
    assert all(part.column_names == list(COLUMNS[name]) for part in parts)
    rows = [row for part in parts for row in part.to_pylist()]
    return sorted(rows, key=lambda row: tuple(map(str, row.values())))


@pytest.fixture
def unfinished(shown, tmp_path) -> LocalStore:
    shutil.copytree(shown.root, tmp_path / "copy")
    (tmp_path / "copy" / SUCCESS_FILE).unlink()
    return LocalStore(tmp_path / "copy")


@pytest.mark.parametrize("name", COLUMNS)
def test_a_finished_and_an_unfinished_dataset_give_the_rows_that_pyarrow_reads(shown, unfinished, name):
    read = ds.dataset(f"{shown.root}/manifest/{name}", partitioning="hive").to_table(columns=list(COLUMNS[name]))
    expected = sorted(read.to_pylist(), key=lambda row: tuple(map(str, row.values())))
    assert rows_of(open_tables(shown), name) == expected
    assert rows_of(open_tables(unfinished), name) == expected


def test_only_the_sizes_of_files_are_read(shown):
    rows = next(open_tables(shown).batches("views", ("files",)))
    (field,) = rows.schema.field("files").type.value_type
    assert field.name == "bytes"


def test_columns_of_captures_are_null_in_a_dataset_of_scenes(shown):
    rows = next(open_tables(shown).batches("scenes", ("scene_id", "capture")))
    assert rows.column("capture").null_count == rows.num_rows > 0
    assert pa.types.is_struct(rows.schema.field("capture").type)


def test_of_many_ranges_that_are_not_merged_some_are_read_evenly(tmp_path, monkeypatch, unflushed):
    store = LocalStore(tmp_path)
    store.prepare()
    for start in range(0, 24, 2):
        attempt_at(store, start, start + 2).commit()
    monkeypatch.setattr(module, "MOST_RANGES", 3)
    tables = open_tables(store)
    assert tables.sampled
    assert [start for start, _ in tables.ranges] == [0, 12, 22]
    assert {row["scene_id"] // 2 * 2 for row in rows_of(tables, "scenes")} == {0, 12, 22}


def test_an_empty_folder_has_no_rows(tmp_path):
    assert list(open_tables(LocalStore(tmp_path)).batches("scenes", ("scene_id",))) == []


def test_a_spread_has_both_ends():
    assert choose_spread(range(10), 4) == [0, 3, 6, 9]
    assert choose_spread(range(3), 4) == [0, 1, 2]
    assert choose_spread(range(9), 1) == [0]


@pytest.mark.parametrize("finished", [True, False])
def test_a_bucket_with_tars_gives_a_report_of_the_same_figures(tmp_path, finished):
    changes = {"scenes": 2, "categories": ["box"], "output": {"layout": "tar"}}
    local, _ = make_dataset(tmp_path / "packed", **changes)
    if not finished:
        (local.root / SUCCESS_FILE).unlink()
    memory = obstore.store.MemoryStore()
    for path in local.root.rglob("*"):
        if path.is_file():
            obstore.put(memory, str(path.relative_to(local.root)), path.read_bytes())
    there, here = (read_report(store, 2) for store in (ObjectStore(memory, "memory://sets"), local))
    assert there.figures.files == here.figures.files > 0
    assert [pictures_of(one) for one in there.sample.scenes] == [pictures_of(one) for one in here.sample.scenes]


def pictures_of(scene):
    return scene.scene_id, {name: picture.name for name, picture in scene.pictures.items()}
