import csv
import dataclasses
import hashlib
import itertools
import json
import math
import urllib.parse

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
import pytest

from schemas.dataset.layout import STAGING
from schemas.dataset.tables import SCHEMAS, SORT_KEYS, TABLES
from schemas.errors import CommitConflict, CorruptError, RunError
from services.merge import tables as merge_tables
from services.merge.poses import escaped, object_lines
from services.merge.step import merge, read_success, reopen
from tests.made_up_scenes import attempt_at, failed_scene, fails, made_scene, scene, terms, with_shapes
from workers.store.local import LocalStore
from workers.store.manifest import table_of_rows

pytestmark = pytest.mark.usefixtures("unflushed")

FIRST, STOP = 3, 30
ROLE_ORDER = ["input", "aligned", "mirror", "projected"]


def dataset_at(root, first=FIRST, stop=STOP, size=4, layout="files", order=1, make=scene) -> LocalStore:
    """A folder with every range committed and nothing merged."""
    store = LocalStore(root)
    store.prepare()
    lines = [*range(first, stop, size), stop]
    for start, end in list(itertools.pairwise(lines))[::order]:
        attempt_at(store, start, end, terms(layout=layout, range_size=size, first_scene=first), make).commit()
    return store


def plain_rows(table: str, first=FIRST, stop=STOP, make=scene) -> list[dict]:
    """The rows that the dataset must hold, from the scenes themselves."""
    rows = [row for scene_id in range(first, stop) for row in make(scene_id).rows.get(table, ())]
    unique = {tuple(row[key] for key in SORT_KEYS[table]): row for row in rows}
    return [unique[key] for key in sorted(unique)]


@pytest.fixture(scope="module")
def merged(tmp_path_factory):
    store = dataset_at(tmp_path_factory.mktemp("merged"))
    return store, merge(store, FIRST, STOP)


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
    (line,) = object_lines(pa.Table.from_pylist([row], schema=SCHEMAS["objects"]))
    words = line.removesuffix("\n").split()
    assert len(words) == 22
    assert urllib.parse.unquote(words[2]) == name
    assert (escaped(name) == name) == (name == "plain-name_1.2")


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


def test_the_digest_does_not_depend_on_the_size_of_merged_files(merged, tmp_path, monkeypatch):
    for name, value in (("ROWS_PER_FILE", 10), ("ROWS_PER_GROUP", 7), ("ROWS_PER_BLOCK", 3)):
        monkeypatch.setattr(merge_tables, name, value)
    assert merge(dataset_at(tmp_path), FIRST, STOP) == merged[1]
    files = sorted((tmp_path / "manifest/views").glob("*/*.parquet"))
    assert max(pa.parquet.read_metadata(path).num_rows for path in files) == 10
    again = ds.dataset(tmp_path / "manifest/views", partitioning="hive").to_table()
    assert again.num_rows == merged[1].rows["views"]


@pytest.mark.parametrize("order", [[3, 4, 4], [4, 3], [3, 7, 6]], ids=["twice", "backwards", "across blocks"])
def test_rows_that_come_twice_or_out_of_order_are_refused(tmp_path, monkeypatch, order):
    monkeypatch.setattr(merge_tables, "ROWS_PER_BLOCK", 2)
    table = merge_tables.MergedTable("scenes", tmp_path)

    def add_all():
        for scene_id in order:
            table.add(table_of_rows("scenes", made_scene(scene_id).rows["scenes"]))
        table.finish(["mug"])

    with pytest.raises(CorruptError, match=r"scenes: the key \(scene_id\) = .* comes after .* the ranges do not join"):
        add_all()
    table.close()


def test_scenes_whose_pose_ids_collide_are_refused(tmp_path):
    def colliding(scene_id):
        output = scene(scene_id)
        views = [{**row, "pose_id": row["pose_id"] % 8} for row in output.rows.get("views", [])]
        return dataclasses.replace(output, rows={**output.rows, "views": views})

    with pytest.raises(CorruptError, match="views: the key"):
        merge(dataset_at(tmp_path, 0, 8, make=colliding), 0, 8)


def test_a_dataset_extended_twice_has_the_digest_of_one_made_at_once(merged, tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    from services.run.range_planner import committed_ranges, list_commits, plan_ranges

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
    reopen(store)
    assert not (tmp_path / "_SUCCESS").exists()


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
    store.write_whole(image, b"cut")
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


def test_a_commit_that_arrives_during_the_merge_is_noticed(tmp_path, monkeypatch):
    store = dataset_at(tmp_path, 0, 8)
    from services.merge import step as module

    def late(store, files):
        attempt_at(store, 8, 12).commit()

    monkeypatch.setattr(module, "_install", late)
    with pytest.raises(RunError, match="committed while they were merged"):
        merge(store, 0, 8)
    assert read_success(store) is None
