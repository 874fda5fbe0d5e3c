import contextlib
import json

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.dataset.tables import SCHEMAS
from schemas.errors import CommitConflict, CorruptError, MachineError
from services.merge import shared as module
from services.merge.shared import SharedRows, explain_full_disk, open_scratch
from tests.made_up_scenes import made_scene

NAMES = st.text(st.characters(blacklist_categories=["Cs"]), max_size=4)
SHAPE = "assets/mug/a.glb"


@pytest.fixture
def shared(tmp_path):
    rows = SharedRows(tmp_path)
    yield rows
    rows.close()


@given(st.dictionaries(NAMES, NAMES, max_size=60))
def test_files_come_back_sorted_by_the_bytes_of_their_paths(tmp_path_factory, files):
    shared = SharedRows(tmp_path_factory.mktemp("shared"))
    shared.add_files(files.items())
    expected = sorted(files.items(), key=lambda pair: pair[0].encode())
    assert list(shared.files(mixed=False)) == expected
    assert list(shared.files(mixed=False)) == expected
    shared.close()


def test_more_files_than_fit_in_the_cache_come_back_sorted(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "CACHE_KIB", 64)
    shared = SharedRows(tmp_path)
    for number in range(0, 20_000, 100):
        shared.add_files((f"{19_999 - i:05d}", f"{i:064d}") for i in range(number, number + 100))
    assert list(shared.files(mixed=False)) == [(f"{19_999 - i:05d}", f"{i:064d}") for i in reversed(range(20_000))]
    assert (tmp_path / "shared.sqlite").stat().st_size > 64 << 10
    shared.close()


def test_the_images_of_views_are_counted_and_listed(shared):
    output = made_scene(3)
    shared.add_images(pa.Table.from_pylist(output.rows["views"], schema=SCHEMAS["views"]))
    shared.add_images(SCHEMAS["views"].empty_table())
    images = [file.path for file in output.files if not file.path.startswith("assets/")]
    assert shared.images == len(images)
    assert [path for path, _ in shared.files(mixed=False)] == sorted(images)


@pytest.mark.parametrize("again", ["aa", "bb"])
@pytest.mark.parametrize("mixed", [False, True])
def test_an_image_named_twice_is_refused(shared, again, mixed):
    shared.add_files([("mug/RGB00000.png", "aa")])
    shared.add_files([("mug/RGB00000.png", again)])
    with pytest.raises(CorruptError, match=r"mug/RGB00000\.png belongs to two views"):
        list(shared.files(mixed))


def test_a_shape_that_ranges_share_is_listed_once_and_has_one_digest(shared):
    shared.add_files([(SHAPE, "bb"), (SHAPE, "bb")])
    assert list(shared.files(mixed=False)) == [(SHAPE, "bb")]
    shared.add_files([(SHAPE, "aa")])
    with pytest.raises(CommitConflict, match="two digests by one stack: aa, bb"):
        list(shared.files(mixed=False))
    assert list(shared.files(mixed=True)) == [(SHAPE, "aa")]


def rows_of(*splits: str) -> pa.Table:
    row = made_scene(0).rows["assets"][0]
    return pa.Table.from_pylist([{**row, "split": split} for split in splits], schema=SCHEMAS["assets"])


def test_an_asset_comes_back_once_as_it_was_and_must_be_the_same_in_every_range(shared):
    shared.add_assets(rows_of("train", "train"))
    assert pa.concat_tables(shared.assets(mixed=False)).equals(rows_of("train"))
    shared.add_assets(rows_of("test"))
    with pytest.raises(CommitConflict, match="is described differently by two ranges"):
        list(shared.assets(mixed=False))
    (found,) = pa.concat_tables(shared.assets(mixed=True)).to_pylist()
    assert json.dumps(found) == min(json.dumps(row) for row in rows_of("train", "test").to_pylist())


def test_a_full_disk_is_explained(shared):
    shared._db.execute("PRAGMA max_page_count = 4")
    with pytest.raises(MachineError, match=r"could not write its files: .* full; free some space"):
        shared.add_files((f"{i:05d}", f"{i:064d}") for i in range(1000))


def test_nothing_is_sorted_when_it_is_read(shared):
    asked = []
    shared._db.set_trace_callback(asked.append)
    list(shared.files(mixed=False))
    list(shared.assets(mixed=False))
    shared._db.set_trace_callback(None)
    assert len(asked) == 2
    for sql in asked:
        assert "TEMP B-TREE" not in str(list(shared._db.execute(f"EXPLAIN QUERY PLAN {sql}")))


def test_a_full_table_is_explained(tmp_path):
    with contextlib.closing(open_scratch(tmp_path / "a.sqlite", "CREATE TABLE rows (text TEXT)")) as table:
        table.execute("PRAGMA max_page_count = 4")
        with pytest.raises(MachineError, match=r"the merge could not write its files: .* full"), explain_full_disk():
            table.executemany("INSERT INTO rows VALUES (?)", ((f"{i:0100d}",) for i in range(1000)))


def test_a_folder_that_is_gone_is_explained(tmp_path):
    with pytest.raises(MachineError, match="unable to open"), explain_full_disk():
        open_scratch(tmp_path / "none" / "a.sqlite", "CREATE TABLE rows (text TEXT)")
