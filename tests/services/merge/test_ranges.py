"""Ranges on their way into a merge: their rows, the files that they name, and what they share."""

import contextlib

import pyarrow as pa
import pytest
from obstore.store import MemoryStore

from schemas.dataset.commit import Span
from schemas.dataset.layout import range_table_path
from schemas.dataset.tables import SCHEMAS, TABLES
from schemas.errors import CorruptError
from services.merge import reading
from services.merge.reading import SharedRows, check_published, merge_folder, read_ranges, stored_sizes
from tests.made_up_datasets import FIRST, STOP, dataset_at, plain_rows
from tests.made_up_scenes import attempt_at, failed_scene, made_scene, terms
from workers.store.attempt import begin_attempt
from workers.store.local import LocalStore
from workers.store.manifest import table_of_rows
from workers.store.objects import ObjectStore

pytestmark = pytest.mark.usefixtures("unflushed")


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
