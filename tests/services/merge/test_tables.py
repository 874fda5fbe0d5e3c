import csv
import dataclasses
import math
import urllib.parse
import weakref

import pyarrow as pa
import pyarrow.dataset as ds
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.dataset.tables import SCHEMAS, SORT_KEYS, TABLES
from schemas.errors import CorruptError
from services.merge import reading
from services.merge import tables as merge_tables
from services.merge.merge import merge
from services.merge.tables import escaped, object_lines, shortest
from tests.made_up_datasets import FIRST, STOP, dataset_at, plain_rows
from tests.made_up_scenes import failed_scene, fails, made_scene, scene
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


ROLE_ORDER = ["input", "aligned", "mirror", "projected"]


def test_cam_poses_has_two_rows_a_pair_that_read_back_to_the_same_doubles(merged):
    store, _ = merged
    with open(store.root / "camPoses.csv", newline="") as file:
        header, *rows = csv.reader(file)
    assert header == ["id", "parent_id", *(f"T{i}{j}" for i in range(4) for j in range(4))]
    views = [row for row in plain_rows("views") if row["role"] in ("input", "mirror")]
    assert [[int(row[0]), int(row[1])] for row in rows] == [[view["pose_id"], view["parent_id"]] for view in views]
    assert [int(row[0]) for row in rows] == [i for s in range(FIRST, STOP) if not fails(s) for i in (2 * s, 2 * s + 1)]
    for row, view in zip(rows, views, strict=True):
        numbers = list(map(float, row[2:]))
        assert numbers == view["T_world_cam"]
        assert math.copysign(1, numbers[12]) == -1  # -0.0 is kept


def test_cameras_has_every_camera_in_order_with_both_conventions(merged):
    store, _ = merged
    with open(store.root / "cameras.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    views = sorted(plain_rows("views"), key=lambda view: (view["pose_id"], ROLE_ORDER.index(view["role"])))
    assert len(rows) == len(views)
    for row, view in zip(rows, views, strict=True):
        assert row["role"] == view["role"]
        for name in (
            "pose_id",
            "parent_id",
            "width",
            "height",
            "fx",
            "cx",
            "cy",
            "cx_opencv",
            "cy_opencv",
            "depth_units_per_m",
        ):
            assert float(row[name]) == view[name]
        assert [float(row[f"T{i}{j}"]) for i in range(4) for j in range(4)] == view["T_world_cam"]


def test_objects_has_a_line_for_everything_in_a_pose_table_included(merged):
    store, _ = merged
    lines = (store.root / "objects.dat").read_text().splitlines()
    objects = [row for row in plain_rows("objects") if row["role"] in ("input", "mirror")]
    assert len(lines) == len(objects)
    for line, row in zip(lines, objects, strict=True):
        pose, category, instance, region, u, v, *matrix = line.split(" ")
        assert (int(pose), category, instance, int(region)) == tuple(
            row[key] for key in ("pose_id", "category", "instance_id", "region_id")
        )
        assert (int(u), int(v)) == (row["u"], row["v"])
        assert list(map(float, matrix)) == row["T_cam_obj"]
    assert {line.split(" ")[1] for line in lines} >= {"table"}


@pytest.mark.parametrize("name", ["blue mug", "50%", "a\tb", "non\u00a0breaking", "line\nend", "plain-name_1.2"])
def test_a_name_with_spaces_is_one_word_and_can_be_had_back(name):
    row = {**made_scene(3).rows["objects"][0], "instance_id": name}
    (line,) = object_lines(pa.Table.from_pylist([row], schema=SCHEMAS["objects"])).decode().splitlines(keepends=True)
    words = line.removesuffix("\n").split()
    assert len(words) == 22
    assert urllib.parse.unquote(words[2]) == name
    assert (escaped(name) == name) == (name == "plain-name_1.2")


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False)))
def test_every_double_is_written_as_python_writes_it(numbers):
    edges = [0.0, -0.0, 1.0, 1e-4, 9.999e-5, 1e10, 9999999999.999998, 1e15, 1e16, 5e-324, 1.7976931348623157e308]
    for values in (numbers, numbers + edges):
        assert shortest(pa.array(values, pa.float64())).to_pylist() == list(map(repr, values))
