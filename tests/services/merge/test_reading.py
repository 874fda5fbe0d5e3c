import contextlib

import pytest
from obstore.store import MemoryStore

from schemas.dataset.commit import Span
from schemas.dataset.layout import range_table_path
from schemas.dataset.tables import TABLES
from schemas.errors import CorruptError
from services.merge import reading
from services.merge.reading import PublishedFiles, read_blocks
from tests.made_up_datasets import FIRST, STOP, dataset_at, plain_rows
from tests.made_up_scenes import attempt_at, failed_scene, made_scene, terms
from workers.store.attempt import begin_attempt
from workers.store.local import LocalStore
from workers.store.manifest import table_of_rows
from workers.store.objects import ObjectStore

pytestmark = pytest.mark.usefixtures("unflushed")


@pytest.mark.parametrize(("ranges", "rows"), [(1, 10**9), (3, 10**9), (10**9, 1), (10**9, 10**9)])
def test_blocks_hold_every_range_and_every_row_in_order(tmp_path, monkeypatch, ranges, rows):
    monkeypatch.setattr(reading, "RANGES_PER_BLOCK", ranges)
    monkeypatch.setattr(reading, "ROWS_PER_BLOCK", rows)
    blocks = list(read_blocks(dataset_at(tmp_path), FIRST, STOP))
    assert max(len(block.ranges) for block in blocks) == {1: 1, 3: 3}.get(ranges, 1 if rows == 1 else 7)
    assert [span.start for b in blocks for (r, *_) in b.ranges for span in [r.span]] == [*range(FIRST, STOP, 4)]
    for table in set(TABLES) - {"timings", "assets"}:
        assert [row for block in blocks for row in block.rows[table].to_pylist()] == plain_rows(table)


@pytest.mark.parametrize("harm", ["missing", "altered"])
def test_a_table_that_is_missing_or_altered_is_told_by_name(tmp_path, harm):
    store = dataset_at(tmp_path)
    path = tmp_path / range_table_path(FIRST + 4, "views")
    if harm == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[::-1])
    with pytest.raises(
        CorruptError, match=f"{path.relative_to(tmp_path)} {'is committed' if harm == 'missing' else 'does not'}"
    ):
        list(read_blocks(store, FIRST, STOP))


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
        list(read_blocks(store, 4, 12))


@pytest.fixture(params=["files", "tar", "object store"])
def store(request, tmp_path):
    """A place with two ranges, and its layout."""
    far = request.param == "object store"
    store = ObjectStore(MemoryStore(), "memory://") if far else LocalStore(tmp_path / "out")
    store.prepare()
    for start in (0, 4):
        layout = "files" if request.param == "files" else "tar"
        attempt_at(store, start, start + 4, terms(layout=layout), made_scene).commit()
    return store


def check_all(store, tmp_path):
    with contextlib.closing(PublishedFiles(store, tmp_path)) as published:
        for block in read_blocks(store, 0, 8):
            published.check(block)


def test_what_is_all_there_is_accepted(store, tmp_path):
    check_all(store, tmp_path)


@pytest.mark.parametrize("kind", [".png", ".tar", ".glb", "failures.parquet"])
@pytest.mark.parametrize("cut", [False, True], ids=["missing", "cut"])
def test_a_file_that_is_missing_or_cut_is_told_by_name(store, tmp_path, kind, cut):
    keys = [entry.key for entry in store.files("") if entry.key.endswith(kind)]
    if not keys:
        pytest.skip("not in this layout")
    if cut:
        store.put(keys[-1], b"cut")
    else:
        store.remove(keys[-1])
    with pytest.raises(CorruptError, match=f"{keys[-1]} {'has 3 bytes' if cut else 'is named by a commit'}"):
        check_all(store, tmp_path)
