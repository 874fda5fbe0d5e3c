import pytest

from schemas.dataset.layout import STAGING, range_table_path
from schemas.dataset.tables import TABLES
from schemas.errors import CorruptError, RunError
from tests.made_up_scenes import attempt_at, failed_scene, made_scene, scene
from workers.store.ledger import iter_ranges, range_rows
from workers.store.local import LocalStore

pytestmark = pytest.mark.usefixtures("unflushed")


@pytest.fixture
def store(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    return store


def killed(*scenes):
    return lambda scene_id: failed_scene(scene_id, "environmental") if scene_id in scenes else scene(scene_id)


def starts(store, first, stop):
    return [records[0].span.start for records in iter_ranges(store, first, stop)]


def test_ranges_come_in_order_and_end_where_asked(store):
    for start, stop in ((8, 10), (0, 4), (4, 8)):
        attempt_at(store, start, stop).commit()
    assert starts(store, 0, 10) == [0, 4, 8]


def test_scenes_that_nobody_committed_are_named(store):
    for start, stop in ((0, 4), (8, 12)):
        attempt_at(store, start, stop).commit()
    with pytest.raises(RunError, match="scenes 4 to 7 are not committed"):
        starts(store, 0, 12)
    with pytest.raises(RunError, match="scenes 0 to 3 are not committed"):
        starts(LocalStore(store.root / "none"), 0, 4)
    attempt_at(store, 4, 8).commit()
    with pytest.raises(RunError, match="scenes 12 to 19 are not committed"):
        starts(store, 0, 20)


def test_scenes_beyond_what_was_asked_are_named(store):
    for start, stop in ((0, 4), (4, 8)):
        attempt_at(store, start, stop).commit()
    with pytest.raises(RunError, match="scene 7 is committed, outside the 0 to 3"):
        starts(store, 0, 4)
    with pytest.raises(RunError, match="scene 7 is committed, outside the 0 to 6"):
        starts(store, 0, 7)
    with pytest.raises(RunError, match="scene 0 is committed, outside the 4 to 7"):
        starts(store, 4, 8)


def test_the_rows_of_a_retry_replace_those_of_its_scenes_alone(store):
    attempt_at(store, 0, 4, make=killed(1, 2, 3)).commit()
    attempt_at(store, 0, 4, make=killed(2), retry=1, scenes=(1, 2)).commit()
    attempt_at(store, 0, 4, make=made_scene, retry=2, scenes=(2,)).commit()
    (records,) = iter_ranges(store, 0, 4)
    assert [record.span.retry for record in records] == [0, 1, 2]
    assert range_rows(store, records, "scenes").column("scene_id").to_pylist() == [0, 1, 2]
    assert range_rows(store, records, "failures").column("scene_id").to_pylist() == [3]
    assert range_rows(store, records, "timings").column("scene_id").to_pylist() == [0, 1, 2, 3]


def test_a_range_that_was_retried_has_the_rows_of_one_that_never_failed(store, tmp_path):
    attempt_at(store, 4, 8, make=killed(4, 6)).commit()
    attempt_at(store, 4, 8, retry=1, scenes=(4, 6)).commit()
    (retried,) = iter_ranges(store, 4, 8)
    other = LocalStore(tmp_path / "other")
    other.prepare()
    attempt_at(other, 4, 8).commit()
    (whole,) = iter_ranges(other, 4, 8)
    for table in TABLES:
        if table not in ("timings", "assets"):
            assert range_rows(store, retried, table).equals(range_rows(other, whole, table)), table


def test_a_retry_that_failed_environmentally_again_replaces_the_first_failure(store):
    attempt_at(store, 0, 4, make=killed(1)).commit()
    attempt_at(store, 0, 4, make=lambda i: failed_scene(i, "intrinsic"), retry=1, scenes=(1,)).commit()
    (records,) = iter_ranges(store, 0, 4)
    assert range_rows(store, records, "failures").column("kind").to_pylist() == ["intrinsic"]


def test_a_damaged_or_missing_table_is_told_by_name(store):
    attempt_at(store, 0, 4).commit()
    (records,) = iter_ranges(store, 0, 4)
    path = range_table_path(0, "views")
    data = store.read(path)
    store.put(path, data[:-1] + b"X")
    with pytest.raises(CorruptError, match=f"{path} does not match the SHA-256 in its commit"):
        range_rows(store, records, "views")
    store.remove(path)
    with pytest.raises(CorruptError, match=f"{path} is committed and missing"):
        range_rows(store, records, "views")


def test_a_range_is_read_while_it_is_being_published(store, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("workers.store.attempt.publish", lambda *_: None)
        attempt_at(store, 0, 4).commit()
    (records,) = iter_ranges(store, 0, 4)
    assert list(store.files(STAGING))
    assert range_rows(store, records, "scenes").num_rows == 4
