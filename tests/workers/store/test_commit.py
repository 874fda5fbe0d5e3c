"""The seal of a text file: any change of any byte breaks it."""

import copy
import dataclasses
import hashlib
import json
import random
import re

import pytest

from schemas.dataset.commit import FileEntry
from schemas.dataset.layout import RANGES, STAGING, commit_path, range_table_path
from schemas.errors import CommitConflict, CorruptError, OutputError
from tests.damage import cut, flip
from tests.kit.faults import check_published
from tests.made_up_scenes import attempt_at, made_scene, terms, with_shapes
from tests.stored_images import iter_records
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
from workers.store.ledger import read_range_table, read_summary
from workers.store.local import LocalStore
from workers.store.manifest import encode_table, table_of_rows

pytestmark = pytest.mark.usefixtures("unflushed")


def test_a_record_reads_back_as_it_was_and_always_has_the_same_bytes(store):
    record = attempt_at(store, 0, 4).commit().record
    data = store.read(commit_path(0))
    assert decode_record(data, "x") == record
    assert encode_record(decode_record(data, "x")) == data
    assert json.loads(data)["schema_version"] == 1
    assert json.loads(data)["span"] == {"start": 0, "stop": 4, "retry": 0, "scenes": []}


def test_a_record_is_small_and_grows_by_sixteen_characters_a_scene(store):
    """The whole record of 16 scenes with all their images and shapes."""
    record = attempt_at(store, 40, 44).commit().record
    assert all(entry.path.startswith("manifest/_ranges/") for entry in record.files)
    small = len(store.read(commit_path(attempt_at(store, 0, 4, make=made_scene).commit().record.span.start)))
    large = len(store.read(commit_path(attempt_at(store, 20, 36, make=made_scene).commit().record.span.start)))
    assert large < 2048
    assert large - small < 12 * 16 + 50


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


TEXT = "key: 5\nname: kubek żółty\n"


def test_a_sealed_text_is_whole_and_its_text_is_kept():
    data = seal(TEXT, "seal: ")
    assert data.startswith(TEXT.encode()) and data.count(b"\n") == 3
    assert is_sealed(data, "seal: ")
    assert not is_sealed(data, "other: ")


def test_every_flipped_bit_and_every_cut_breaks_the_seal():
    data = seal(TEXT, "<!-- ", " -->\n")
    assert is_sealed(data, "<!-- ", " -->\n")
    for at in range(8 * len(data)):
        changed = bytearray(data)
        changed[at // 8] ^= 1 << at % 8
        assert not is_sealed(bytes(changed), "<!-- ", " -->\n")
    assert not any(is_sealed(data[:length], "<!-- ", " -->\n") for length in range(len(data)))


def test_the_damage_of_tests_changes_what_it_damages():
    chance = random.Random(3)
    for damage in (flip, cut):
        assert all(damage(TEXT.encode(), chance) != TEXT.encode() for _ in range(50))


def test_a_record_under_another_name_is_refused(store):
    attempt_at(store, 0, 2).commit()
    (store.root / commit_path(0)).rename(store.root / commit_path(2))
    with pytest.raises(CorruptError, match=r"0000000002.json holds the record of another range"):
        read_record(store, 2)
    with pytest.raises(CorruptError, match=r"0000000002.json holds the record of another range"):
        read_summary(store, 2)


@pytest.mark.parametrize(
    "name",
    [
        *(
            "notes.txt",
            "0.json",
            "00000000000.json",
            "0000000000.retry-0.json",
            "sub/0000000000.json",
            "0000000000.json.x",
        ),
        *(
            "0000000000.retry-8192.json",
            "1000000000000001.json",
            "\u0660000000000.json",
            "-000000001.json",
            "+000000001.json",
        ),
    ],
)
def test_a_file_that_is_no_commit_is_told_by_name(store, name):
    path = store.root / "manifest/_commits" / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("{}")
    with pytest.raises(CorruptError, match=re.escape(f"manifest/_commits/{name} in ")):
        commit_names(store)


def test_commits_are_listed_by_number_with_retries_after_their_range(store):
    for key in (commit_path(20), commit_path(3, 2), commit_path(3), commit_path(3, 10), commit_path(10**10)):
        store.put(key, b"")
    assert [(start, retry) for start, retry, _ in commit_names(store)] == [
        (3, 0),
        (3, 2),
        (3, 10),
        (20, 0),
        (10**10, 0),
    ]


def test_the_digest_of_the_commits_tells_sets_of_them_apart_and_is_as_it_was(store):
    """The lines that earlier versions hashed, in their order."""
    keys = [commit_path(start, retry) for start, retry in [(3, 0), (3, 2), (3, 10), (20, 0), (10**10, 0)]]
    for number, key in enumerate(reversed(keys)):
        store.put(key, b"x" * number)
    lines = "".join(f"{key} {4 - number}\n" for number, key in enumerate(keys))
    assert commits_digest(store) == hashlib.sha256(lines.encode()).hexdigest()
    store.put(keys[0], b"longer")
    assert commits_digest(store) != hashlib.sha256(lines.encode()).hexdigest()


def test_what_is_decided_is_published_by_anyone_any_number_of_times(store, undecided, tmp_path):
    assert not (tmp_path / "manifest/_ranges/0000000000").exists()
    for _ in range(3):
        publish(LocalStore(tmp_path), undecided)
        check_published(store, undecided)
    assert not list(store.files(STAGING))


def test_what_is_decided_can_be_read_before_it_is_published_and_after(store, undecided):
    entry = committed_files(store, undecided)[0]
    before = read_committed(store, undecided, entry.path)
    store.revoke(f"{STAGING}/0000000000/{undecided.attempt}")
    assert read_committed(store, undecided, entry.path) == before
    publish(store, undecided)
    assert read_committed(store, undecided, entry.path) == before
    store.remove(entry.path)
    with pytest.raises(CorruptError, match=f"{entry.path} is committed and missing"):
        read_committed(store, undecided, entry.path)


def test_a_file_that_is_nowhere_is_told_by_name(store, undecided):
    entry = next(file for file in committed_files(store, undecided) if file.path.endswith(".png"))
    store.remove(f"{STAGING}/0000000000/{undecided.attempt}/{entry.path}")
    with pytest.raises(CorruptError, match=f"{entry.path} is named by a commit and is neither staged nor published"):
        publish(store, undecided)
    assert list(store.files(STAGING)), "what is left must not be swept away"


def test_a_staged_file_of_the_wrong_size_is_not_published(store, undecided):
    entry = next(file for file in committed_files(store, undecided) if file.path.endswith(".png"))
    store.put(f"{STAGING}/0000000000/{undecided.attempt}/{entry.path}", b"short")
    with pytest.raises(CorruptError, match=f"{entry.path} has 5 bytes, and its commit says {entry.bytes}"):
        publish(store, undecided)
    assert store.size(entry.path) is None


def test_a_published_file_of_the_wrong_size_is_told_by_name(store, undecided):
    publish(store, undecided)
    image = committed_files(store, undecided)[-1].path
    store.put(image, b"short")
    with pytest.raises(CorruptError, match=f"{image} has 5 bytes"):
        publish(store, undecided)


@pytest.mark.parametrize("layout", ["files", "tar"])
def test_after_a_death_at_any_rename_anyone_publishes_the_rest(store, layout, monkeypatch):
    """The tables say which images there are, and may be in place before the images are, or after."""
    with monkeypatch.context() as patch:
        patch.setattr("workers.store.attempt.publish", lambda *_: None)
        record = attempt_at(store, 0, 2, terms(layout=layout)).commit().record
    whole = committed_files(store, record)
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
    found = {str(path.relative_to(store.root)) for path in store.root.rglob("*") if path.is_file()}
    assert found == {*(entry.path for entry in whole), commit_path(0)}


def test_a_table_that_lists_anothers_images_is_not_followed(store):
    """Rows name the images of a compact record: they are held to its range as the record itself is."""
    attempt_at(store, 0, 4).commit()
    record = attempt_at(store, 4, 8, make=made_scene).commit().record
    entries, whole = {entry.path: entry for entry in record.files}, read_range_table(store, record, "views").to_pylist()
    for path in ("../victim", "mug/RGB00000.png", "mug/RGB00000.png\n", "manifest/_commits/0000000000.json"):
        rows = copy.deepcopy(whole)
        rows[0]["files"][0]["path"] = path
        data = encode_table(table_of_rows("views", rows))
        key = range_table_path(4, "views")
        store.put(key, data)
        entries[key] = FileEntry(path=key, bytes=len(data), sha256=hashlib.sha256(data).hexdigest())
        forged = record.model_copy(update={"files": tuple(entries.values())})
        with pytest.raises(CorruptError, match=f"{key} (lists|cannot be read)") as told:
            publish(store, forged)
        assert str(told.value).isprintable()


def another_shape(scene_id: int):
    return with_shapes(made_scene(scene_id), lambda data: data + b"!")


def test_a_shape_that_another_range_published_stays_and_one_of_another_size_is_a_conflict(store):
    attempt_at(store, 0, 12).commit()
    shapes = {entry.key: store.stat(entry.key) for entry in store.files("assets")}
    attempt_at(store, 12, 24).commit()
    assert {key: store.stat(key) for key in shapes} == shapes
    with pytest.raises(CommitConflict, match=r"assets/.*stack-a: two attempts at one shape differ"):
        attempt_at(store, 24, 36, make=another_shape).commit()


def test_where_stacks_are_mixed_the_first_shape_stays(store):
    mixed = terms(fingerprint_mode="record")
    attempt_at(store, 0, 12, mixed, made_scene).commit()
    before = {entry.key: entry.bytes for entry in store.files("assets")}
    attempt_at(store, 12, 24, mixed, another_shape).commit()
    after = {entry.key: entry.bytes for entry in store.files("assets")}
    assert before.items() <= after.items()


@pytest.mark.parametrize("layout", ["files", "tar"])
def test_a_winner_knows_its_files_as_anyone_reads_them_from_its_commit(store, layout, monkeypatch):
    known = []
    monkeypatch.setattr("workers.store.attempt.publish", lambda store, record, own: known.extend(own))
    record = attempt_at(store, 0, 4, terms(layout=layout)).commit().record
    assert any(entry.path.endswith(".glb") for entry in known)
    assert tuple(known) == committed_files(store, record)


def test_an_image_of_another_range_is_refused_before_the_decision(store):
    def of_other_poses(scene_id):
        output = made_scene(scene_id + 4)
        rows = {
            table: [{**row, "scene_id": scene_id} if "scene_id" in row else row for row in rows]
            for table, rows in output.rows.items()
        }
        return dataclasses.replace(output, scene_id=scene_id, rows=rows)

    attempt = attempt_at(store, 0, 4, terms(pairs_per_scene=1), make=of_other_poses)
    with pytest.raises(ValueError, match="is not a file of the range from scene 0"):
        attempt.commit()
    assert read_record(store, 0) is None


def test_sweeping_publishes_winners_drops_losers_and_leaves_the_undecided(store, undecided):
    lost = attempt_at(store, 0, 4)
    open_range = attempt_at(store, 4, 8)
    dead = attempt_at(store, 8, 12)
    assert sweep(store, fenced=[(8, dead.name)]) == [lost.name, dead.name]
    check_published(store, undecided)
    assert {entry.key.split("/")[2] for entry in store.files(STAGING)} == {open_range.name}
    assert open_range.commit().won


def test_a_retry_of_a_committed_range_is_not_swept_as_its_loser(store):
    attempt_at(store, 0, 4).commit()
    retry = attempt_at(store, 0, 4, retry=1, scenes=(2,))
    assert sweep(store) == []
    assert retry.commit().won


def test_sweeping_leaves_what_is_not_ours_and_says_so(store):
    store.put(f"{STAGING}/0000000000/mine/notes.txt", b"")
    with pytest.raises(CorruptError, match=f"{STAGING}/0000000000/mine is not an attempt"):
        sweep(store)


def test_temporary_files_of_the_dead_are_swept(store):
    store.put("manifest/_commits/.probe-1", b"")
    store.put(f"{STAGING}/_tmp/.x", b"")
    sweep(store)
    assert not list(store.files("manifest/_commits"))
    assert not list(store.files(STAGING))
