"""All commits of a dataset: ranges in order, the rows of retries, and the kept summary, which hides nothing when damaged."""

import itertools

import pyarrow as pa
import pytest

from schemas.dataset.commit import LEDGER_SCHEMA, CommitSummary, join_rows, rows_of
from schemas.dataset.layout import LEDGER_FILE, commit_path
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


def killed(*scenes):
    return lambda scene_id: failed_scene(scene_id, "environmental") if scene_id in scenes else scene(scene_id)


def starts(store, first, stop):
    return [records[0].span.start for records in iter_ranges(store, first, stop)]


def test_ranges_come_in_order_and_scenes_that_are_missing_or_too_many_are_named(store):
    def refused(first, stop, words, where=store):
        with pytest.raises(RunError, match=words):
            starts(where, first, stop)

    refused(0, 4, "scenes 0 to 3 are not committed", LocalStore(store.root / "none"))
    for start in (8, 0):
        attempt_at(store, start, start + 4).commit()
    refused(0, 12, "scenes 4 to 7 are not committed")
    attempt_at(store, 4, 8).commit()
    assert starts(store, 0, 12) == [0, 4, 8]
    refused(0, 20, "scenes 12 to 19 are not committed")
    refused(0, 4, "scene 7 is committed, outside the 0 to 3")
    refused(0, 7, "scene 7 is committed, outside the 0 to 6")
    refused(4, 8, "scene 0 is committed, outside the 4 to 7")


def test_the_rows_of_a_retry_replace_those_of_its_scenes_alone_also_where_it_failed_again(store):
    attempt_at(store, 0, 4, make=killed(1, 2, 3)).commit()
    attempt_at(store, 0, 4, make=killed(2), retry=1, scenes=(1, 2)).commit()
    attempt_at(store, 0, 4, make=made_scene, retry=2, scenes=(2,)).commit()
    attempt_at(store, 0, 4, make=failed_scene, retry=3, scenes=(3,)).commit()
    (records,) = iter_ranges(store, 0, 4)
    assert [record.span.retry for record in records] == [0, 1, 2, 3]
    for table, scenes in (("scenes", [0, 1, 2]), ("failures", [3]), ("timings", [0, 1, 2, 3])):
        assert range_rows(store, records, table).column("scene_id").to_pylist() == scenes
    assert range_rows(store, records, "failures").column("kind").to_pylist() == ["intrinsic"]


@pytest.fixture
def filled(store):
    """Four ranges and a retry: scenes 5 and 16 fail, 1 and 2 were killed, and 2 is made by the retry."""
    attempt_at(store, 0, 4, make=killed(1, 2)).commit()
    again = {"retry": 1, "scenes": (1, 2)}
    attempt_at(store, 0, 4, make=lambda i: failed_scene(i) if i == 1 else made_scene(i), **again).commit()
    for start in (4, 8, 16):
        attempt_at(store, start, start + 4, terms(fingerprint=f"stack-{start}")).commit()
    return store


def test_the_ledger_holds_a_row_for_each_commit_and_what_retries_changed(filled, tmp_path):
    summary = read_summary(filled, 4)
    assert (summary.start, summary.stop, summary.retry, summary.fingerprint) == (4, 8, 0, "stack-4")
    assert (summary.made, summary.failed) == (3, ((5, "intrinsic", "left_table"),))
    ledger = list_commits(filled)
    spans = list(zip(ledger.start.tolist(), ledger.stop.tolist(), ledger.retry.tolist(), strict=True))
    assert spans == [(0, 4, 0), (0, 4, 1), (4, 8, 0), (8, 12, 0), (16, 20, 0)]
    assert ledger.rows.schema == LEDGER_SCHEMA and ledger.rows.column("made").to_pylist() == [2, 1, 3, 4, 3]
    assert ledger.ranges.tolist() == [[0, 4], [4, 8], [8, 12], [16, 20]] and ledger.committed == 16
    assert ledger.failures.select(["start", "scene_id", "kind", "reason"]).to_pylist() == [
        {"start": start, "scene_id": scene_id, "kind": "intrinsic", "reason": "left_table"}
        for start, scene_id in ((0, 1), (4, 5), (16, 16))
    ]
    assert ledger.fingerprints == ["stack-16", "stack-4", "stack-8", "stack-a"]
    assert [ledger.count(row) for row in range(5)] == [4, 2, 4, 4, 4]
    none = list_commits(LocalStore(tmp_path / "none"))
    assert (none.committed, none.fingerprints, none.ranges.tolist(), none.failures.num_rows) == (0, [], [], 0)


def test_what_is_kept_is_not_read_again_and_what_is_new_is(filled, monkeypatch):
    whole = list_commits(filled)
    assert whole.unkept.tolist() == [0, 1, 2, 3, 4]
    save_rows(filled, whole.rows)
    attempt_at(filled, 12, 16).commit()
    read, real = [], module.require_record
    monkeypatch.setattr(module, "_SAMPLES", 1)
    monkeypatch.setattr(module, "require_record", lambda *which: (read.append(which[1:]), real(*which))[1])
    again = list_commits(filled)
    assert read == [(0, 0), (12, 0)]
    assert again.unkept.tolist() == [4] and again.lost == ()
    assert again.rows.to_pylist() == join_rows([whole.rows, rows_of([read_summary(filled, 12)])]).to_pylist()


def test_a_commit_that_is_gone_is_lost_and_hides_nothing(filled):
    save_rows(filled, list_commits(filled).rows)
    for key in (commit_path(4), commit_path(0, 1)):
        filled.remove(key)
    ledger = list_commits(filled)
    assert ledger.lost == ((0, 1), (4, 0))
    assert ledger.ranges.tolist() == [[0, 4], [8, 12], [16, 20]]
    assert ledger.failures.column("scene_id").to_pylist() == [1, 2, 16]
    filled.remove_tree("manifest/_commits")
    assert len(list_commits(filled).lost) == 5
    attempt_at(filled, 0, 4, retry=1, scenes=(1,)).commit()
    with pytest.raises(CorruptError, match=r"retries \[1\] of the range from scene 0, and must have all from 0"):
        list_commits(filled)


def test_a_kept_summary_that_is_damaged_or_of_another_dataset_is_found_and_hides_nothing(filled):
    own = list_commits(filled).rows
    whole = own.to_pylist()
    assert read_kept_rows(filled) is None
    save_rows(filled, own)
    assert read_kept_rows(filled).to_pylist() == whole
    data = filled.read(LEDGER_FILE)
    for at in range(0, len(data), 41):
        for damaged in (data[:at], data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :]):
            filled.put(LEDGER_FILE, damaged)
            with pytest.raises(CorruptError, match="manifest/_ledger is damaged: remove it"):
                read_kept_rows(filled)
            assert list_commits(filled).rows.to_pylist() == whole, at
    rows = [row | {"job_digest": "k" * 64, "made": 0} for row in whole]
    foreign = [*rows, rows[-1] | {"start": 20, "stop": 24}]
    save_rows(filled, join_rows([pa.Table.from_pylist(foreign, LEDGER_SCHEMA)]))
    again = list_commits(filled)
    assert again.rows.to_pylist() == whole and again.lost == ()


def summary(number: int) -> CommitSummary:
    return CommitSummary(number * 4, number * 4 + 4, 0, 4, (), (), "stack", "job")


def test_the_keeper_writes_when_enough_has_come_and_at_the_end_and_a_full_disk_stops_it_not(store, monkeypatch):
    """By a fiftieth each time, so that all writing together is some fifty times the last."""
    monkeypatch.setattr(module, "SAVE_EACH", 8)
    written = []
    monkeypatch.setattr(module, "save_rows", lambda store, rows: written.append(rows.num_rows))
    keeper = LedgerKeeper(store, list_commits(store))
    for number in range(2_000):
        keeper.add([summary(number)])
    keeper.close()
    assert written[0] == 8 and written[-1] == 2_000
    assert len(written) < 150 and sum(written) < 60 * 2_000
    assert all(later - earlier <= max(8, 0.03 * later) for earlier, later in itertools.pairwise(written))
    keeper.close()
    assert written[-2] < 2_000, "nothing new, nothing written"

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
