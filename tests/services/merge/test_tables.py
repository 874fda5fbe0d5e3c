import dataclasses
import weakref

import pyarrow as pa
import pyarrow.dataset as ds
import pytest

from schemas.dataset.tables import SCHEMAS, SORT_KEYS, TABLES
from schemas.errors import CorruptError
from services.merge import reading
from services.merge import tables as merge_tables
from services.merge.merge import merge
from tests.made_up_datasets import FIRST, STOP, dataset_at, plain_rows
from tests.made_up_scenes import failed_scene, made_scene, scene
from workers.store.manifest import table_of_rows

pytestmark = pytest.mark.usefixtures("unflushed")


@pytest.mark.parametrize("table", [table for table in TABLES if table != "timings"])
def test_pyarrow_reads_every_row_once_with_the_schema_and_the_category(merged, table):
    store, _ = merged
    data = ds.dataset(store.root / "manifest" / table, partitioning="hive")
    schema = SCHEMAS[table]
    assert {field.name: field.type for field in data.schema} == {field.name: field.type for field in schema}
    rows = data.to_table().select(schema.names).to_pylist()
    rows.sort(key=lambda row: tuple(row[key] for key in SORT_KEYS[table]))
    assert rows == plain_rows(table)


def test_rows_within_a_category_are_in_order(merged):
    store, _ = merged
    for table in TABLES:
        for folder in (store.root / "manifest" / table).iterdir():
            rows = pa.concat_tables(
                [pa.parquet.read_table(path, partitioning=None) for path in sorted(folder.iterdir())]
            )
            keys = list(zip(*(rows.column(key).to_pylist() for key in SORT_KEYS[table]), strict=True))
            assert keys == sorted(set(keys))


def test_a_table_without_rows_still_opens_with_its_schema(tmp_path):
    merge(dataset_at(tmp_path, 0, 4), 0, 4)  # no scene of these fails
    data = ds.dataset(tmp_path / "manifest/failures", partitioning="hive")
    assert data.count_rows() == 0
    assert {field.name: field.type for field in data.schema} == {f.name: f.type for f in SCHEMAS["failures"]}


def test_a_dataset_in_which_everything_failed_still_opens(tmp_path):
    merge(dataset_at(tmp_path, 0, 4, make=failed_scene), 0, 4)
    for table in TABLES:
        data = ds.dataset(tmp_path / "manifest" / table, partitioning="hive")
        assert data.schema.field("category").type == pa.string()
        assert data.count_rows() == (4 if table in ("failures", "timings") else 0)
    assert (tmp_path / "objects.dat").read_text() == ""


def test_the_digest_does_not_depend_on_the_size_of_merged_files(merged, tmp_path, monkeypatch):
    for name, value in (("ROWS_PER_FILE", 10), ("ROWS_PER_GROUP", 7)):
        monkeypatch.setattr(merge_tables, name, value)
    monkeypatch.setattr(reading, "ROWS_PER_BLOCK", 3)
    assert merge(dataset_at(tmp_path), FIRST, STOP) == merged[1]
    files = sorted((tmp_path / "manifest/views").glob("*/*.parquet"))
    assert max(pa.parquet.read_metadata(path).num_rows for path in files) == 10
    again = ds.dataset(tmp_path / "manifest/views", partitioning="hive").to_table()
    assert again.num_rows == merged[1].rows["views"]


@pytest.mark.parametrize("order", [[3, 4, 4], [4, 3], [3, 7, 6]], ids=["twice", "backwards", "across blocks"])
@pytest.mark.parametrize("block", [1, 2, 3])
def test_rows_that_come_twice_or_out_of_order_are_refused(tmp_path, block, order):
    table = merge_tables.MergedTable("scenes", tmp_path)
    rows = table_of_rows("scenes", [made_scene(scene_id).rows["scenes"][0] for scene_id in order])

    def add_all():
        for start in range(0, len(order), block):
            table.add(rows.slice(start, block))

    with pytest.raises(CorruptError, match=r"scenes: the key \(scene_id\) = .* comes after .* the ranges do not join"):
        add_all()


def test_scenes_whose_pose_ids_collide_are_refused(tmp_path):
    def colliding(scene_id):
        output = scene(scene_id)
        views = [{**row, "pose_id": row["pose_id"] % 8} for row in output.rows.get("views", [])]
        return dataclasses.replace(output, rows={**output.rows, "views": views})

    with pytest.raises(CorruptError, match="views: the key"):
        merge(dataset_at(tmp_path, 0, 8, make=colliding), 0, 8)


def test_rows_that_there_are_not_are_not_kept(tmp_path):
    table = merge_tables.MergedTable("failures", tmp_path)
    rows = SCHEMAS["failures"].empty_table()
    kept = weakref.ref(rows)
    table.add(rows)
    del rows
    assert kept() is None
