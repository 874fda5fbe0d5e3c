"""Commit records and the publishing of what they name; a record, a listing or a file that is damaged is told by name."""

import copy
import hashlib
import json
import re

import pytest

from schemas.dataset.commit import FileEntry
from schemas.dataset.layout import RANGES, STAGING, commit_path, range_table_path
from schemas.errors import CommitConflict, CorruptError, OutputError
from tests.kit.faults import check_published
from tests.kit.stored_images import iter_records
from tests.made_up_scenes import attempt_at, made_scene, terms, with_shapes
from workers.store.attempt import sweep
from workers.store.commit import (
    commit_names,
    commits_digest,
    committed_files,
    decode_record,
    encode_record,
    is_sealed,
    publish,
    read_committed,
    read_record,
    seal,
)
from workers.store.ledger import range_rows, read_summary
from workers.store.local import LocalStore
from workers.store.manifest import encode_table, table_of_rows

pytestmark = pytest.mark.usefixtures("unflushed")


def test_a_record_reads_back_as_it_was_always_has_the_same_bytes_and_grows_by_sixteen_characters_a_scene(store):
    record = attempt_at(store, 0, 4, make=made_scene).commit().record
    data = store.read(commit_path(0))
    assert decode_record(data, "x") == record and encode_record(record) == data
    raw = json.loads(data)
    assert (raw["schema_version"], raw["span"]) == (1, {"start": 0, "stop": 4, "retry": 0, "scenes": []})
    assert all(entry.path.startswith("manifest/_ranges/") for entry in record.files)
    attempt_at(store, 20, 36, make=made_scene).commit()
    large = len(store.read(commit_path(20)))
    assert large < 2048 and large - len(data) < 12 * 16 + 50


def test_every_altered_byte_of_a_record_is_found_and_a_foreign_torn_or_misplaced_one_is_told_by_name(store):
    record = attempt_at(store, 0, 2).commit().record
    data, path = store.read(commit_path(0)), store.root / commit_path(0)
    for position in range(0, len(data), 5):
        damaged = bytearray(data)
        damaged[position] ^= 1
        with pytest.raises((CorruptError, OutputError)):
            decode_record(bytes(damaged), "manifest/_commits/0.json")
    torn = (data[: len(data) // 2], b"", b"{", b"null", b"[]", b'{"a": 1}', b"\x00\x01", b'{"kind": "verso-commit"}')
    for damaged in torn:
        path.write_bytes(damaged)
        for read in (lambda: read_record(store, 0), lambda: read_summary(store, 0), lambda: list(iter_records(store))):
            with pytest.raises(CorruptError, match=r"manifest/_commits/0000000000\.json"):
                read()
    path.unlink()
    (store.root / commit_path(2)).write_bytes(data)
    for one in (read_record, read_summary):
        with pytest.raises(CorruptError, match=r"0000000002.json holds the record of another range"):
            one(store, 2)
    newer = encode_record(record.model_copy(update={"schema_version": 2}))
    with pytest.raises(OutputError, match="schema_version 2, and this program reads up to 1: install a newer"):
        decode_record(newer, "x")

    class More(type(record)):
        colour: str = "red"

    more = encode_record(More(**record.model_dump()))
    assert b"colour" in more and decode_record(more, "x") == record


def test_every_flipped_bit_and_every_cut_breaks_the_seal_of_a_text():
    text, marks = "key: 5\nname: kubek żółty\n", ("<!-- ", " -->\n")
    data = seal(text, *marks)
    assert data.startswith(text.encode()) and data.count(b"\n") == 3 and is_sealed(data, *marks)
    assert is_sealed(seal(text, "seal: "), "seal: ") and not is_sealed(seal(text, "seal: "), "other: ")
    for at in range(8 * len(data)):
        changed = bytearray(data)
        changed[at // 8] ^= 1 << at % 8
        assert not is_sealed(bytes(changed), *marks)
    assert not any(is_sealed(data[:length], *marks) for length in range(len(data)))


def test_commits_are_listed_by_number_have_a_digest_and_what_is_none_is_told_by_name(store):
    order = [(3, 0), (3, 2), (3, 10), (20, 0), (10**10, 0)]
    keys = [commit_path(start, retry) for start, retry in order]
    for number, key in enumerate(reversed(keys)):
        store.put(key, b"x" * number)
    assert [(start, retry) for start, retry, _ in commit_names(store)] == order
    lines = "".join(f"{key} {4 - number}\n" for number, key in enumerate(keys))
    before = hashlib.sha256(lines.encode()).hexdigest()  # the lines that earlier versions hashed, in their order
    assert commits_digest(store) == before
    store.put(keys[0], b"longer")
    assert commits_digest(store) != before
    for name in (
        *("notes.txt", "0.json", "00000000000.json", "0000000000.retry-0.json", "sub/0000000000.json"),
        *("0000000000.json.x", "0000000000.retry-8192.json", "1000000000000001.json"),
        *("\u0660000000000.json", "-000000001.json", "+000000001.json"),
    ):
        store.put(f"manifest/_commits/{name}", b"{}")
        with pytest.raises(CorruptError, match=re.escape(f"manifest/_commits/{name} in ")):
            commit_names(store)
        store.remove(f"manifest/_commits/{name}")


def test_what_is_decided_is_read_and_published_by_anyone_any_number_of_times(store, undecided, tmp_path):
    entry = committed_files(store, undecided)[0]
    before = read_committed(store, undecided, entry.path)
    assert not (tmp_path / "manifest/_ranges/0000000000").exists()
    store.revoke(f"{STAGING}/0000000000/{undecided.attempt}")
    assert read_committed(store, undecided, entry.path) == before
    publish(LocalStore(tmp_path), undecided)
    assert not list(store.files(STAGING)) and read_committed(store, undecided, entry.path) == before
    store.remove(entry.path)
    with pytest.raises(CorruptError, match=f"{entry.path} is committed and missing"):
        read_committed(store, undecided, entry.path)


def test_a_file_that_is_nowhere_or_has_another_size_is_told_by_name_and_not_published(store, undecided):
    image = next(file for file in committed_files(store, undecided) if file.path.endswith(".png"))
    staged = f"{STAGING}/0000000000/{undecided.attempt}/{image.path}"
    whole = store.read(staged)

    def refused(words):
        with pytest.raises(CorruptError, match=f"{image.path} {words}"):
            publish(store, undecided)

    store.put(staged, b"short")
    refused(f"has 5 bytes, and its commit says {image.bytes}")
    assert store.size(image.path) is None
    store.remove(staged)
    refused("is named by a commit and is neither staged nor published")
    assert list(store.files(STAGING)), "what is left must not be swept away"
    store.put(staged, whole)
    publish(store, undecided)
    store.put(image.path, b"short")
    refused("has 5 bytes")


@pytest.mark.parametrize("layout", ["files", "tar"])
def test_after_a_death_at_any_rename_anyone_publishes_the_rest_and_a_winner_knows_its_files(store, layout, monkeypatch):
    """The tables say which images there are, and may be in place before the images are, or after."""
    known = []
    with monkeypatch.context() as patch:
        patch.setattr("workers.store.attempt.publish", lambda store, record, own: known.extend(own))
        record = attempt_at(store, 0, 2, terms(layout=layout)).commit().record
    whole = committed_files(store, record)
    assert any(entry.path.endswith(".glb") for entry in known) and tuple(known) == whole
    assert any(entry.path.endswith(".png") for entry in whole) == (layout == "files")
    move, left = store.move, [0]

    def dying(source, target):
        if left[0] == 0:
            raise KeyboardInterrupt
        left[0] -= 1
        move(source, target)

    monkeypatch.setattr(store, "move", dying)
    for target in [f"{RANGES}/0000000000/views.parquet", f"{RANGES}/0000000000/assets.parquet"]:
        move(f"{STAGING}/0000000000/{record.attempt}/{target}", target)
    for _ in whole[2:]:
        with pytest.raises(KeyboardInterrupt):
            publish(store, record)
        left[0] = 1
        assert committed_files(store, record) == whole
    publish(store, record)
    assert check_published(store, record) == whole
    seen = {str(path.relative_to(store.root)) for path in store.root.rglob("*") if path.is_file()}
    assert seen == {*(entry.path for entry in whole), commit_path(0)}


def test_a_table_that_lists_anothers_images_is_not_followed(store):
    """Rows name the images of a compact record: they are held to its range as the record itself is."""
    attempt_at(store, 0, 4).commit()
    record = attempt_at(store, 4, 8, make=made_scene).commit().record
    entries, whole = {entry.path: entry for entry in record.files}, range_rows(store, [record], "views").to_pylist()
    for path in ("../victim", "mug/RGB00000.png", "mug/RGB00000.png\n", "manifest/_commits/0000000000.json"):
        rows = copy.deepcopy(whole)
        rows[0]["files"][0]["path"] = path
        data = encode_table(table_of_rows("views", rows))
        key = range_table_path(4, "views")
        store.put(key, data)
        entries[key] = FileEntry(path=key, bytes=len(data), sha256=hashlib.sha256(data).hexdigest())
        forged = record.model_copy(update={"files": tuple(entries.values())})
        with pytest.raises(CorruptError, match=f"{key} (lists|cannot be read)") as error:
            publish(store, forged)
        assert str(error.value).isprintable()


def test_a_shape_that_another_range_published_stays_and_one_of_another_size_is_a_conflict_unless_stacks_are_mixed(
    store,
):
    def another_shape(scene_id):
        return with_shapes(made_scene(scene_id), lambda data: data + b"!")

    attempt_at(store, 0, 12, make=made_scene).commit()
    shapes = {entry.key: store.stat(entry.key) for entry in store.files("assets")}
    attempt_at(store, 12, 24).commit()
    mixed = terms(fingerprint_mode="record")
    attempt_at(store, 36, 48, mixed, another_shape).commit()
    assert {key: store.stat(key) for key in shapes} == shapes
    with pytest.raises(CommitConflict, match=r"assets/.*stack-a: two attempts at one shape differ"):
        attempt_at(store, 24, 36, make=another_shape).commit()


def test_sweeping_publishes_winners_drops_losers_and_temporary_files_and_leaves_the_undecided(store, undecided):
    lost, open_range, dead = (attempt_at(store, start, start + 4) for start in (0, 4, 8))
    store.put("manifest/_commits/.probe-1", b"")
    store.put(f"{STAGING}/_tmp/.x", b"")
    assert sweep(store, fenced=[(8, dead.name)]) == [lost.name, dead.name]
    check_published(store, undecided)
    assert {entry.key.split("/")[2] for entry in store.files(STAGING)} == {open_range.name}
    assert [key for _, _, key in commit_names(store)] == [entry.key for entry in store.files("manifest/_commits")]
    assert open_range.commit().won
    retry = attempt_at(store, 0, 4, retry=1, scenes=(2,))
    assert sweep(store) == [] and retry.commit().won, "a retry is no loser of its range"
    store.put(f"{STAGING}/0000000000/mine/notes.txt", b"")
    with pytest.raises(CorruptError, match=f"{STAGING}/0000000000/mine is not an attempt"):
        sweep(store)
