import json

import pytest

from schemas.dataset.layout import STAGING, commit_path
from schemas.errors import CommitConflict, CorruptError, OutputError
from tests.made_up_scenes import attempt_at, made_scene, terms, with_shapes
from tests.stored_images import iter_records
from workers.store.commit import (
    check_published,
    commit_names,
    decode_record,
    encode_record,
    publish,
    read_committed,
    read_record,
    read_summary,
)
from workers.store.local import LocalStore

pytestmark = pytest.mark.usefixtures("unflushed")


def test_a_record_reads_back_as_it_was_and_always_has_the_same_bytes(store):
    record = attempt_at(store, 0, 4).commit().record
    data = store.read(commit_path(0))
    assert decode_record(data, "x") == record
    assert encode_record(decode_record(data, "x")) == data
    assert json.loads(data)["span"] == {"start": 0, "stop": 4, "retry": 0, "scenes": []}


def test_a_summary_says_what_the_record_says(store):
    attempt_at(store, 4, 8).commit()  # scene 5 fails
    summary = read_summary(store, 4)
    assert (summary.start, summary.stop, summary.retry) == (4, 8, 0)
    assert (summary.made, summary.failed) == (3, ((5, "intrinsic"),))


def test_every_altered_byte_of_a_record_is_found(store):
    attempt_at(store, 0, 2).commit()
    data = store.read(commit_path(0))
    for position in range(0, len(data), 5):
        damaged = bytearray(data)
        damaged[position] ^= 1
        with pytest.raises((CorruptError, OutputError)):
            decode_record(bytes(damaged), "manifest/_commits/0.json")


@pytest.mark.parametrize("damage", [b"", b"{", b"null", b"[]", b'{"a": 1}', b"\x00\x01", b'{"kind": "verso-commit"}'])
def test_a_foreign_record_is_refused_by_name(store, damage):
    (store.root / commit_path(0)).write_bytes(damage)
    for read in (lambda: read_record(store, 0), lambda: read_summary(store, 0), lambda: list(iter_records(store))):
        with pytest.raises(CorruptError, match=r"manifest/_commits/0000000000\.json"):
            read()


def test_a_torn_record_is_refused_by_name(store):
    attempt_at(store, 0, 2).commit()
    data = store.read(commit_path(0))
    (store.root / commit_path(0)).write_bytes(data[: len(data) // 2])
    with pytest.raises(CorruptError, match=r"0000000000.json is torn"):
        read_record(store, 0)


def test_a_record_of_a_newer_version_is_refused_and_one_with_more_keys_is_read(store):
    record = attempt_at(store, 0, 2).commit().record
    newer = record.model_copy(update={"schema_version": 2})
    with pytest.raises(OutputError, match="schema_version 2, and this program reads up to 1: install a newer"):
        decode_record(encode_record(newer), "x")

    class More(type(record)):
        colour: str = "red"

    more = More(**record.model_dump())
    assert b"colour" in encode_record(more)
    assert decode_record(encode_record(more), "x") == record


def test_a_record_under_another_name_is_refused(store):
    attempt_at(store, 0, 2).commit()
    (store.root / commit_path(0)).rename(store.root / commit_path(2))
    with pytest.raises(CorruptError, match=r"0000000002.json holds the record of another range"):
        read_record(store, 2)
    with pytest.raises(CorruptError, match=r"0000000002.json holds the record of another range"):
        read_summary(store, 2)


@pytest.mark.parametrize(
    "name", ["notes.txt", "0.json", "00000000000.json", "0000000000.retry-0.json", "sub/0000000000.json"]
)
def test_a_file_that_is_no_commit_is_told_by_name(store, name):
    path = store.root / "manifest/_commits" / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("{}")
    with pytest.raises(CorruptError, match=name):
        commit_names(store)


def test_commits_are_listed_by_number_with_retries_after_their_range(store):
    for key in (commit_path(20), commit_path(3, 2), commit_path(3), commit_path(3, 10), commit_path(10**10)):
        store.write_whole(key, b"")
    assert [(start, retry) for start, retry, _ in commit_names(store)] == [
        (3, 0),
        (3, 2),
        (3, 10),
        (20, 0),
        (10**10, 0),
    ]


def test_what_is_decided_is_published_by_anyone_any_number_of_times(store, undecided, tmp_path):
    assert not (tmp_path / "manifest/_ranges/0000000000").exists()
    for _ in range(3):
        publish(LocalStore(tmp_path), undecided)
        check_published(store, undecided)
    assert not list(store.files(STAGING))


def test_what_is_decided_can_be_read_before_it_is_published_and_after(store, undecided):
    entry = undecided.files[0]
    before = read_committed(store, undecided, entry.path)
    store.fence(f"{STAGING}/0000000000/{undecided.attempt}")
    assert read_committed(store, undecided, entry.path) == before
    publish(store, undecided)
    assert read_committed(store, undecided, entry.path) == before
    store.remove(entry.path)
    with pytest.raises(CorruptError, match=f"{entry.path} is committed and missing"):
        read_committed(store, undecided, entry.path)


def test_a_file_that_is_nowhere_is_told_by_name(store, undecided):
    entry = undecided.files[3]
    store.remove(f"{STAGING}/0000000000/{undecided.attempt}/{entry.path}")
    with pytest.raises(CorruptError, match=f"{entry.path} is named by a commit and is neither staged nor published"):
        publish(store, undecided)
    assert list(store.files(STAGING)), "what is left must not be swept away"


def test_a_staged_file_of_the_wrong_size_is_not_published(store, undecided):
    entry = undecided.files[3]
    store.write_whole(f"{STAGING}/0000000000/{undecided.attempt}/{entry.path}", b"short")
    with pytest.raises(CorruptError, match=f"{entry.path} has 5 bytes, and its commit says {entry.bytes}"):
        publish(store, undecided)
    assert store.size(entry.path) is None


def test_a_published_file_of_the_wrong_size_is_told_by_name(store, undecided):
    publish(store, undecided)
    store.write_whole(undecided.files[3].path, b"short")
    with pytest.raises(CorruptError, match=f"{undecided.files[3].path} has 5 bytes"):
        check_published(store, undecided)


def another_shape(scene_id: int):
    return with_shapes(made_scene(scene_id), lambda data: data + b"!")


def test_a_shape_that_another_range_published_stays_and_one_of_another_size_is_a_conflict(store):
    attempt_at(store, 0, 12).commit()
    shapes = {entry.key: store.modified(entry.key) for entry in store.files("assets")}
    attempt_at(store, 12, 24).commit()
    assert {key: store.modified(key) for key in shapes} == shapes
    with pytest.raises(CommitConflict, match=r"assets/.*stack-a: two attempts at one shape differ"):
        attempt_at(store, 24, 36, make=another_shape).commit()


def test_where_stacks_are_mixed_the_first_shape_stays(store):
    mixed = terms(fingerprint_mode="record")
    attempt_at(store, 0, 12, mixed, made_scene).commit()
    before = {entry.key: entry.bytes for entry in store.files("assets")}
    attempt_at(store, 12, 24, mixed, another_shape).commit()
    after = {entry.key: entry.bytes for entry in store.files("assets")}
    assert before.items() <= after.items()
