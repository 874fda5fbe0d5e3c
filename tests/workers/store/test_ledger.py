import itertools

import pyarrow as pa
import pytest

from schemas.dataset.commit import LEDGER_SCHEMA, CommitSummary, join_rows, rows_of
from schemas.dataset.layout import LEDGER_FILE, STAGING, commit_path, range_table_path
from schemas.dataset.tables import TABLES
from schemas.errors import CorruptError, MachineError, RunError
from tests.made_up_scenes import attempt_at, failed_scene, made_scene, scene, terms
from workers.store import ledger as module
from workers.store.ledger import (
    LedgerKeeper,
    iter_ranges,
    list_commits,
    range_rows,
    read_kept_rows,
    read_summary,
    save_rows,
)
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


def test_a_summary_says_what_the_record_says(store):
    attempt_at(store, 4, 8).commit()  # scene 5 fails
    summary = read_summary(store, 4)
    assert (summary.start, summary.stop, summary.retry) == (4, 8, 0)
    assert (summary.made, summary.failed) == (3, ((5, "intrinsic", "left_table"),))
    assert summary.fingerprint == "stack-a"


@pytest.fixture
def filled(store):
    """Four ranges and a retry: scenes 5 and 16 fail, 1 and 2 were killed, and 2 is made by the retry."""
    killed = {1, 2}
    attempt_at(store, 0, 4, make=lambda i: failed_scene(i, "environmental") if i in killed else made_scene(i)).commit()
    attempt_at(
        store, 0, 4, retry=1, scenes=(1, 2), make=lambda i: failed_scene(i) if i == 1 else made_scene(i)
    ).commit()
    for start in (4, 8, 16):
        attempt_at(store, start, start + 4, terms(fingerprint=f"stack-{start}")).commit()
    return store


def reading(monkeypatch) -> list[tuple[int, int]]:
    """The records that are read from now on."""
    read: list[tuple[int, int]] = []
    whole = module.require_record

    def noting(store, start, retry=0):
        read.append((start, retry))
        return whole(store, start, retry)

    monkeypatch.setattr(module, "require_record", noting)
    return read


def test_the_ledger_holds_a_row_for_each_commit_and_what_retries_changed(filled):
    ledger = list_commits(filled)
    assert list(zip(ledger.start.tolist(), ledger.stop.tolist(), ledger.retry.tolist(), strict=True)) == [
        *((0, 4, 0), (0, 4, 1)),
        *((4, 8, 0), (8, 12, 0), (16, 20, 0)),
    ]
    assert ledger.rows.schema == LEDGER_SCHEMA
    assert ledger.rows.column("made").to_pylist() == [2, 1, 3, 4, 3]
    assert ledger.ranges.tolist() == [[0, 4], [4, 8], [8, 12], [16, 20]]
    assert ledger.committed == 16
    assert ledger.failures.select(["start", "scene_id", "kind", "reason"]).to_pylist() == [
        {"start": 0, "scene_id": 1, "kind": "intrinsic", "reason": "left_table"},
        {"start": 4, "scene_id": 5, "kind": "intrinsic", "reason": "left_table"},
        {"start": 16, "scene_id": 16, "kind": "intrinsic", "reason": "left_table"},
    ]
    assert ledger.fingerprints == ["stack-16", "stack-4", "stack-8", "stack-a"]
    assert [ledger.count(row) for row in range(5)] == [4, 2, 4, 4, 4]


def test_an_empty_ledger_has_everything_too(store):
    ledger = list_commits(store)
    assert (ledger.committed, ledger.fingerprints, ledger.ranges.tolist()) == (0, [], [])
    assert ledger.failures.num_rows == 0


def test_what_is_kept_is_not_read_again_and_what_is_new_is(filled, monkeypatch):
    whole = list_commits(filled)
    assert whole.unkept.tolist() == [0, 1, 2, 3, 4]
    save_rows(filled, whole.rows)
    attempt_at(filled, 12, 16).commit()
    monkeypatch.setattr(module, "_SAMPLES", 1)
    read = reading(monkeypatch)
    again = list_commits(filled)
    assert read == [(0, 0), (12, 0)]
    assert again.unkept.tolist() == [4]
    assert again.rows.to_pylist() == join_rows([whole.rows, rows_of([read_summary(filled, 12)])]).to_pylist()
    assert again.lost == ()


def test_a_commit_that_is_gone_is_lost_and_hides_nothing(filled):
    save_rows(filled, list_commits(filled).rows)
    for key in (commit_path(4), commit_path(0, 1)):
        filled.remove(key)
    ledger = list_commits(filled)
    assert ledger.lost == ((0, 1), (4, 0))
    assert ledger.ranges.tolist() == [[0, 4], [8, 12], [16, 20]]
    assert ledger.failures.column("scene_id").to_pylist() == [1, 2, 16]


def test_where_every_commit_is_gone_each_is_lost(filled):
    save_rows(filled, list_commits(filled).rows)
    filled.remove_tree("manifest/_commits")
    assert len(list_commits(filled).lost) == 5


def test_every_cut_and_flip_of_the_kept_summary_is_found_and_hides_nothing(filled):
    whole = list_commits(filled).rows.to_pylist()
    assert read_kept_rows(filled) is None
    save_rows(filled, list_commits(filled).rows)
    assert read_kept_rows(filled).to_pylist() == whole
    data = filled.read(LEDGER_FILE)
    for at in range(0, len(data), 41):
        for damaged in (data[:at], data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :]):
            filled.put(LEDGER_FILE, damaged)
            with pytest.raises(CorruptError, match="manifest/_ledger is damaged: remove it"):
                read_kept_rows(filled)
            assert list_commits(filled).rows.to_pylist() == whole, at


def test_a_summary_of_another_dataset_is_not_used(filled, tmp_path):
    own = list_commits(filled)
    rows = own.rows.to_pylist()
    for row in rows:
        row["job_digest"], row["made"] = "k" * 64, 0
    save_rows(filled, join_rows([pa.Table.from_pylist([*rows, {**rows[-1], "start": 20, "stop": 24}], LEDGER_SCHEMA)]))
    again = list_commits(filled)
    assert again.rows.to_pylist() == own.rows.to_pylist()
    assert again.lost == ()
    filled.put(LEDGER_FILE, b"")
    assert list_commits(filled).rows.num_rows == 5


def test_a_missing_retry_is_told_by_name(filled):
    filled.remove(commit_path(0))
    with pytest.raises(CorruptError, match=r"retries \[1\] of the range from scene 0, and must have all from 0"):
        list_commits(filled)


def summary(number: int) -> CommitSummary:
    return CommitSummary(number * 4, number * 4 + 4, 0, 4, (), (), "stack", "job")


def test_the_keeper_writes_when_enough_has_come_and_at_the_end(store, monkeypatch):
    """By a fiftieth each time, so that all writing together is some fifty times the last."""
    monkeypatch.setattr(module, "SAVE_EACH", 8)
    written = []
    monkeypatch.setattr(module, "save_rows", lambda store, rows: written.append(rows.num_rows))
    keeper = LedgerKeeper(store, list_commits(store))
    for number in range(2_000):
        keeper.add([summary(number)])
    keeper.close()
    assert written[0] == 8
    assert written[-1] == 2_000
    assert len(written) < 150
    assert sum(written) < 60 * 2_000
    assert all(later - earlier <= max(8, 0.03 * later) for earlier, later in itertools.pairwise(written))
    keeper.close()
    assert written[-2] < 2_000, "nothing new, nothing written"


def test_a_full_disk_stops_no_keeper(store, monkeypatch):
    def full(store, rows):
        raise MachineError("the disk is full")

    keeper = LedgerKeeper(store, list_commits(store))
    keeper.add([summary(0)])
    monkeypatch.setattr(module, "save_rows", full)
    keeper.close()
    assert store.size(LEDGER_FILE) is None


def test_what_a_keeper_wrote_is_what_the_records_say(filled):
    keeper = LedgerKeeper(filled, list_commits(filled))
    attempt_at(filled, 12, 16).commit()
    keeper.add([read_summary(filled, 12), read_summary(filled, 0)])
    keeper.close()
    kept = list_commits(filled)
    assert kept.unkept.size == 0
    filled.remove(LEDGER_FILE)
    assert kept.rows.to_pylist() == list_commits(filled).rows.to_pylist()
