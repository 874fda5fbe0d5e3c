"""The merged files: tables that pyarrow reads, the article's text files, and the card beside them; and ranges on their way in."""

import contextlib
import csv
import math
import urllib.parse
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.dataset as ds
import pytest
from obstore.store import MemoryStore

from schemas.dataset.commit import Span
from schemas.dataset.layout import range_table_path
from schemas.dataset.tables import SCHEMAS, SORT_KEYS, TABLES
from schemas.errors import CorruptError
from schemas.job.assets import Assets, LibrarySource, MeshLimits, ProceduralSource
from services.merge import merge as merge_module
from services.merge import reading
from services.merge import tables as merge_tables
from services.merge.merge import merge
from services.merge.reading import SharedRows, check_published, merge_folder, read_ranges, stored_sizes
from services.merge.tables import describe_sources, escaped, object_lines
from tests.made_up_datasets import FIRST, STOP, dataset_at, plain_rows
from tests.made_up_scenes import attempt_at, failed_scene, fails, made_scene, terms
from workers.assets.catalogue import Catalogue
from workers.assets.library.table import PLAIN, Library, Row
from workers.store.attempt import begin_attempt
from workers.store.local import LocalStore
from workers.store.manifest import table_of_rows
from workers.store.objects import ObjectStore

pytestmark = pytest.mark.usefixtures("unflushed")


def types_of(schema: pa.Schema) -> dict[str, pa.DataType]:
    return {field.name: field.type for field in schema}


def test_pyarrow_reads_every_row_once_with_the_schema_and_the_category(merged):
    for table, schema in SCHEMAS.items():
        data = ds.dataset(merged[0].root / "manifest" / table, partitioning="hive")
        assert types_of(data.schema) == types_of(schema)
        rows = data.to_table().select(schema.names).to_pylist()
        rows.sort(key=lambda row, table=table: tuple(row[key] for key in SORT_KEYS[table]))
        assert table == "timings" or rows == plain_rows(table)
        for folder in (merged[0].root / "manifest" / table).iterdir():
            parts = [pa.parquet.read_table(path, partitioning=None) for path in sorted(folder.iterdir())]
            keys = [pa.concat_tables(parts).column(key).to_pylist() for key in SORT_KEYS[table]]
            assert list(zip(*keys, strict=True)) == sorted(set(zip(*keys, strict=True)))


def test_tables_without_rows_still_open_with_their_schema(tmp_path):
    merge(dataset_at(tmp_path / "none", 0, 4), 0, 4)  # no scene of these fails
    merge(dataset_at(tmp_path / "all", 0, 4, make=failed_scene), 0, 4)
    for name, table in [("none", "failures"), *(("all", table) for table in TABLES)]:
        data = ds.dataset(tmp_path / name / "manifest" / table, partitioning="hive")
        assert types_of(data.schema) == types_of(SCHEMAS[table])
        assert data.count_rows() == (4 if name == "all" and table in ("failures", "timings") else 0)
    assert (tmp_path / "all" / "objects.dat").read_text() == ""


def test_the_digest_does_not_depend_on_the_size_of_merged_files(merged, tmp_path, monkeypatch):
    for name, value in (("ROWS_PER_FILE", 10), ("ROWS_PER_GROUP", 7)):
        monkeypatch.setattr(merge_tables, name, value)
    monkeypatch.setattr(merge_module, "ROWS_PER_BLOCK", 3)
    assert merge(dataset_at(tmp_path), FIRST, STOP) == merged[1]
    files = sorted((tmp_path / "manifest/views").glob("*/*.parquet"))
    assert max(pa.parquet.read_metadata(path).num_rows for path in files) == 10
    again = ds.dataset(tmp_path / "manifest/views", partitioning="hive").to_table()
    assert again.num_rows == merged[1].rows["views"]


def test_rows_that_come_twice_or_out_of_order_are_refused(tmp_path):
    for order in ([3, 4, 4], [4, 3], [3, 7, 6]):
        rows = table_of_rows("scenes", [made_scene(scene_id).rows["scenes"][0] for scene_id in order])
        for block in (1, 2, 3):
            table = merge_tables.MergedTable("scenes", tmp_path)
            pieces = (table.add(rows.slice(start, block)) for start in range(0, len(order), block))
            with pytest.raises(CorruptError, match=r"scenes: the key \(\d,\) comes after .* the ranges do not join"):
                list(pieces)


def test_cam_poses_has_two_rows_a_pair_that_read_back_to_the_same_doubles(merged):
    with open(merged[0].root / "camPoses.csv", newline="") as file:
        header, *rows = csv.reader(file)
    assert header == ["id", "parent_id", *(f"T{i}{j}" for i in range(4) for j in range(4))]
    views = [row for row in plain_rows("views") if row["role"] in ("input", "mirror")]
    assert [[int(row[0]), int(row[1])] for row in rows] == [[view["pose_id"], view["parent_id"]] for view in views]
    assert [int(row[0]) for row in rows] == [i for s in range(FIRST, STOP) if not fails(s) for i in (2 * s, 2 * s + 1)]
    for row, view in zip(rows, views, strict=True):
        numbers = list(map(float, row[2:]))
        assert numbers == view["T_world_cam"]
        assert math.copysign(1, numbers[12]) == -1  # -0.0 is kept


def test_a_name_with_spaces_is_one_word_and_can_be_had_back():
    for name in ("blue mug", "50%", "a\tb", "non\u00a0breaking", "line\nend", "plain-name_1.2"):
        row = {**made_scene(3).rows["objects"][0], "instance_id": name}
        (line,) = object_lines(pa.Table.from_pylist([row], schema=SCHEMAS["objects"])).decode().splitlines(True)
        words = line.removesuffix("\n").split()
        assert len(words) == 22
        assert urllib.parse.unquote(words[2]) == name
        assert (escaped(name) == name) == (name == "plain-name_1.2")


def test_the_card_names_every_source_with_its_licence_and_what_was_left_out_of_it_or_is_doubtful():
    bad = Row("a.obj", category="mug", use=False, reason="no_faces", why="has no triangles")
    rows = [Row(f"{name}.glb", category="mug", licence="MIT", shape_up="y", sure=True) for name in "dcba"]
    rows[1] = replace(rows[1], mended=(PLAIN,))
    library = Library(Path("/l"), Path("/meshes"), MeshLimits(), (bad, replace(bad, path="b.obj", why="..."), *rows))
    assets = Assets(
        objects=(LibrarySource(source="library", folder="l"), ProceduralSource(source="procedural", seed=7))
    )
    catalogue = Catalogue(assets, (library, None), (None,), "d" * 64)
    objects, seeded, table, left_out, plain = describe_sources(catalogue)
    assert objects == "objects, weight 1: library l, licences MIT (4)"
    assert seeded == "objects, weight 1: made from seed 7, licence CC0-1.0"
    assert table.startswith("tables, weight 1: made from seed")
    assert left_out == "left out of /meshes: 2 no_faces; a.obj (no_faces: has no triangles); b.obj (no_faces: ...)"
    assert plain == f"/meshes: 1 of 4 shapes: {PLAIN} (c.glb)"
    again, line = catalogue.describe_doubts()
    assert again == plain
    doubts = "/meshes: files stand on another axis than `up` says: a.glb on y, b.glb on y, c.glb on y and 1 more"
    assert line.startswith(doubts) and "change `up` in its table" in line
    assert Catalogue(Assets(), (None,), (None,), "d" * 64).describe_doubts() == []


# ---------------------------------------------------------------------------------------------- ranges on their way in


def test_ranges_come_in_order_with_every_row_and_a_table_that_is_altered_or_missing_is_told_by_name(tmp_path):
    store = dataset_at(tmp_path)
    ranges = list(read_ranges(store, FIRST, STOP))
    assert [read.records[0].span.start for read in ranges] == [*range(FIRST, STOP, 4)]
    for table in set(TABLES) - {"timings", "assets"}:
        tables = [read.rows[table] for read in ranges if table in read.rows]
        assert [row for rows in tables for row in rows.to_pylist()] == plain_rows(table)
    path = tmp_path / range_table_path(FIRST + 4, "views")
    path.write_bytes(path.read_bytes()[::-1])
    for words in ("does not", "is committed"):
        with pytest.raises(CorruptError, match=f"{path.relative_to(tmp_path)} {words}"):
            list(read_ranges(store, FIRST, STOP))
        path.unlink(missing_ok=True)


@pytest.mark.parametrize(
    ("moved", "failed", "wrong"),
    [({7: 9}, {}, 4), ({7: 8, 8: 7}, {}, 4), ({}, {9: 9}, 8), ({}, {5: 9}, 4)],
    ids=["of another range", "swapped", "twice", "twice, in two ranges"],
)
def test_a_range_that_does_not_hold_each_scene_once_is_refused(tmp_path, moved, failed, wrong):
    """Ids were changed, and rows of failures added, after the scenes were checked."""
    store = LocalStore(tmp_path)
    store.prepare()
    for start in (4, 8):
        attempt = begin_attempt(store, Span(start=start, stop=start + 4), terms(first_scene=4))
        for scene_id in attempt.span.scene_ids:
            output = made_scene(scene_id, images=())
            attempt.add_scene(output)
            row = output.rows["scenes"][0] | {"scene_id": moved.get(scene_id, scene_id)}
            attempt._rows["scenes"][-1] = table_of_rows("scenes", [row])
            if scene_id in failed:
                rows = failed_scene(failed[scene_id]).rows["failures"]
                attempt._rows["failures"][-1] = table_of_rows("failures", rows)
        attempt.commit()
    with pytest.raises(CorruptError, match=f"range from scene {wrong} do not hold each scene once"):
        list(read_ranges(store, 4, 12))


@pytest.mark.parametrize("place", ["files", "tar", "object store"])
def test_a_published_file_that_is_missing_or_cut_is_told_by_name(place, tmp_path):
    store = ObjectStore(MemoryStore(), "memory://") if place == "object store" else LocalStore(tmp_path / "out")
    store.prepare()
    layout = "files" if place == "files" else "tar"
    for start in (0, 4):
        attempt_at(store, start, start + 4, terms(layout=layout), made_scene).commit()

    def check_all():
        with merge_folder(store) as folder, stored_sizes(store, folder) as size_of:
            for read in read_ranges(store, 0, 8):
                check_published(read, size_of)

    check_all()
    for kind in (".png" if place == "files" else ".tar", ".glb", "failures.parquet"):
        key = [entry.key for entry in store.files("") if entry.key.endswith(kind)][-1]
        whole = store.read(key)
        store.put(key, b"cut")
        with pytest.raises(CorruptError, match=f"{key} has 3 bytes"):
            check_all()
        store.remove(key)
        with pytest.raises(CorruptError, match=f"{key} is named by a commit"):
            check_all()
        store.put(key, whole)
    check_all()


# ------------------------------------------------------------------------------------------- what ranges share


def test_more_files_than_fit_in_the_cache_come_back_sorted_and_are_not_sorted_when_read(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "CACHE_KIB", 64)
    with contextlib.closing(SharedRows(tmp_path)) as shared:
        shared.add_files((f"{i:05d}", f"{i:064d}") for i in reversed(range(20_000)))
        assert list(shared.files(mixed=False)) == [(f"{i:05d}", f"{i:064d}") for i in range(20_000)]
        assert (tmp_path / "shared.sqlite").stat().st_size > 64 << 10
        plans = [
            str(list(shared._db.execute(f"EXPLAIN QUERY PLAN {sql}"))) for sql in (reading._FILES, reading._ASSETS)
        ]
        assert not any("TEMP B-TREE" in plan for plan in plans)


def test_images_are_counted_and_named_once(tmp_path):
    with contextlib.closing(SharedRows(tmp_path)) as shared:
        output = made_scene(3)
        shared.add_images(pa.Table.from_pylist(output.rows["views"], schema=SCHEMAS["views"]))
        images = sorted(file.path for file in output.files if not file.path.startswith("assets/"))
        assert shared.images == len(images) and [path for path, _ in shared.files(mixed=False)] == images
        for path, again in (("mug/RGB99998.png", "aa"), ("mug/RGB99999.png", "bb")):
            shared.add_files([(path, "aa"), (path, again)])
            with pytest.raises(CorruptError, match=r"mug/RGB99998\.png belongs to two views"):
                list(shared.files(mixed=True))
