"""An attempt at a range: what it writes, what it refuses, how it loses, and which scene is blamed when its worker dies."""

import dataclasses
import hashlib

import pytest

from schemas.dataset.commit import Span
from schemas.dataset.layout import MAX_SCENE, STAGING, commit_path, range_table_path
from schemas.dataset.tables import TABLES
from schemas.errors import RunError
from schemas.scene.scene import SceneOutput, encoded_file
from tests.made_up_scenes import attempt_at, failed_scene, made_scene, scene, terms, with_shapes
from workers.store.attempt import attempts_at, begin_attempt, blamed_scene
from workers.store.commit import committed_files, read_record
from workers.store.local import LocalStage
from workers.store.manifest import decode_table

pytestmark = pytest.mark.usefixtures("unflushed")


def changed(output: SceneOutput, **changes) -> SceneOutput:
    return dataclasses.replace(output, **changes)


def begun(store, stop: int = 2, label: str = ""):
    return begin_attempt(store, Span(start=0, stop=stop), terms(), label)


def refuses(message: str, call, *arguments) -> None:
    with pytest.raises(ValueError, match=message):
        call(*arguments)


def test_a_winner_publishes_every_file_with_its_digest_and_rows_and_leaves_no_staging(store, tmp_path):
    attempt = attempt_at(store, 0, 4)
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and STAGING not in path.parts]
    result = attempt.commit()
    assert result.won and read_record(store, 0) == result.record and not list(store.files(STAGING))
    made = {file.path: file.data for scene_id in range(4) for file in scene(scene_id).files}
    named = {entry.path: (entry.bytes, entry.sha256) for entry in committed_files(store, result.record)}
    tables = {range_table_path(0, table): table for table in TABLES}
    assert named.keys() == {*made, *tables}
    for path, entry in named.items():
        data = (tmp_path / path).read_bytes()
        assert entry == (len(data), hashlib.sha256(data).hexdigest()) and made.get(path, data) == data
        if path in tables:
            assert decode_table(tables[path], data, path).num_rows == result.record.tables[tables[path]]
    assert [(mark.scene_id, mark.outcome) for mark in result.record.scenes] == [(i, "made") for i in range(4)]


def test_the_rows_of_a_range_are_sorted_whatever_their_order_in_a_scene(store):
    def shuffled(scene_id):
        output = made_scene(scene_id)
        return changed(output, rows={table: rows[::-1] for table, rows in output.rows.items()})

    attempt_at(store, 0, 4, make=shuffled).commit()
    path = range_table_path(0, "objects")
    rows = decode_table("objects", store.read(path), path)
    keys = list(zip(*(rows.column(name).to_pylist() for name in ("pose_id", "role", "region_id")), strict=True))
    assert keys == sorted(keys)
    assert attempt_at(store, 0, 4).commit().conflict is None


def test_a_scene_that_breaks_the_schema_or_disagrees_with_its_files_is_refused_and_writes_nothing(store):
    made, failed = made_scene(0), failed_scene(0)
    rows, first = made.rows, made.files[0]
    (failure,) = failed.rows["failures"]
    for output, message in (
        (changed(made, rows={**rows, "scenes": []}), r"ended as \[\], with rows"),
        (changed(made, rows={**rows, **failed.rows}), r"ended as \[.made., .intrinsic.\]"),
        (
            changed(failed, rows={**rows, **failed.rows, "scenes": []}),
            r"ended as \[.intrinsic.\], with rows {.views.: 4",
        ),
        (changed(failed, files=made.files), "disagree about"),
        (changed(made, rows={**rows, "extra": []}), "unknown tables: extra"),
        (changed(made, rows={**rows, "views": made_scene(1).rows["views"]}), "no row of another scene"),
        (changed(made, files=(*made.files, encoded_file("mug/RGB99999.png", b"x"))), "about mug/RGB99999.png"),
        (changed(made, files=made.files[1:]), "disagree about"),
        (changed(made, files=(encoded_file(first.path, b"other"), *made.files[1:])), f"disagree about {first.path}"),
        (changed(made, files=(*made.files, first)), "path twice"),
        (changed(failed, rows={"failures": [{**failure, "kind": "odd"}]}), r"ended as \[.odd.\]"),
        (made_scene(1), r"scene 1 came, .* awaits \(0,\)"),
    ):
        refuses(message, begun(store).add_scene, output)
    outside = ("/etc/passwd", "../out.png", "mug/../../x.png", "_staging/x.png", ".hidden")
    for path in (*outside, "mug//x.png", "mug\\x.png", "mug/a\nb.png"):
        output = changed(made, files=(encoded_file(path, b"x"),))
        refuses("is not a path that a scene may write", begun(store).add_scene, output)
    assert {path.name for path in store.root.iterdir()} == {"manifest", STAGING}


def test_a_range_that_lacks_a_scene_or_holds_what_is_not_its_own_is_not_committed(store):
    lacking = begun(store)
    lacking.add_scene(made_scene(0))
    refuses(r"lacks scenes \[1\]", lacking.commit)

    def described_by_scene(scene_id):
        output = made_scene(scene_id)
        rows = [{**row, "split": "test" if scene_id else "train"} for row in output.rows["assets"]]
        return changed(output, rows={**output.rows, "assets": rows})

    two_ways = attempt_at(store, 0, 2, make=described_by_scene)
    refuses("assets: two rows have the key instance_id = table-0", two_ways.commit)

    def of_other_poses(scene_id):
        output = made_scene(scene_id + 4)
        rows = {
            table: [{**row, "scene_id": scene_id} if "scene_id" in row else row for row in rows]
            for table, rows in output.rows.items()
        }
        return changed(output, scene_id=scene_id, rows=rows)

    foreign = attempt_at(store, 0, 4, terms(pairs_per_scene=1), make=of_other_poses)
    refuses("is not a file of the range from scene 0", foreign.commit)
    assert store.size(commit_path(0)) is None


def test_a_shape_that_two_scenes_share_is_written_once_and_must_be_the_same(store):
    record = attempt_at(store, 0, 4).commit().record
    shapes = [entry.path for entry in committed_files(store, record) if entry.path.startswith("assets/")]
    assert len(shapes) == len(set(shapes)) < 4 + 1
    other = begin_attempt(store, Span(start=4, stop=8), terms())
    first, again = made_scene(4), made_scene(5)
    shape = next(file.path for file in first.files if file.path.startswith("assets/"))
    other.add_scene(first)
    files = [file for file in again.files if not file.path.startswith("assets/")]
    output = changed(again, files=(*files, encoded_file(shape, b"other")))
    refuses("written twice with different bytes", other.add_scene, output)


def killed(scene_id):
    return failed_scene(scene_id, "environmental") if scene_id == 1 else made_scene(scene_id)


def test_a_loser_that_made_other_bytes_says_where_and_names_both_fingerprints(store):
    """A scene that was killed in one of two attempts is no conflict, and only the scenes that both have are compared."""
    whole = attempt_at(store, 0, 4, terms(fingerprint="stack-a"), made_scene).commit().record
    final = {entry.key: store.stat(entry.key) for entry in store.files("") if not entry.key.startswith(STAGING)}

    def conflict(make, start=0, stop=4):
        return attempt_at(store, start, stop, terms(fingerprint="stack-b"), make).commit().conflict

    message = conflict(lambda i: made_scene(i, salt="!" if i == 2 else ""))
    assert "at scene 2:" in message and "stack-a" in message and "stack-b" in message and whole.attempt in message
    assert "assets/" in conflict(lambda i: with_shapes(made_scene(i), lambda data: data + b"!"))
    assert "scene 1:" in conflict(lambda i: made_scene(i, salt="!" * i), stop=2)
    assert conflict(made_scene, stop=2) is conflict(killed) is None
    assert {entry.key: store.stat(entry.key) for entry in store.files("")} == final, "a loser touches nothing"
    attempt_at(store, 4, 8, make=lambda i: failed_scene(i, "environmental")).commit()
    assert conflict(made_scene, 4, 8) is None


def test_an_attempt_that_was_swept_without_a_winner_writes_no_more_and_says_who_may_have_done_it(store):
    attempt = begun(store)
    attempt.begin_scene(0)
    attempt.add_scene(made_scene(0))
    store.revoke(f"{STAGING}/0000000000/{attempt.name}")
    attempt.begin_scene(1)
    attempt.add_scene(made_scene(1))
    assert attempt.fenced and not (store.root / f"{STAGING}/0000000000/{attempt.name}").exists()
    with pytest.raises(RunError, match="swept before it could commit: another coordinator"):
        attempt.commit()
    assert store.size(commit_path(0)) is None


def test_a_scene_is_blamed_from_its_beginning_until_the_commit(store):
    attempt = begun(store, label="label")
    assert "label" in attempt.name and attempts_at(store, 0) == [attempt.name]
    assert blamed_scene(store, 0, attempt.name) is None
    for scene_id in (0, 1):
        attempt.begin_scene(scene_id)
        assert blamed_scene(store, 0, attempt.name) == scene_id
        attempt.add_scene(made_scene(scene_id))
    attempt.commit()
    assert blamed_scene(store, 0, attempt.name) is None and attempts_at(store, 0) == []


def test_a_worker_that_dies_while_it_commits_blames_no_scene_and_is_not_told_so_twice(store, monkeypatch):
    attempt, noted = attempt_at(store, 0, 4), attempt_at(store, 0, 4)
    assert blamed_scene(store, 0, attempt.name) == 3
    noted.end_scenes()

    class Died(BaseException):
        pass

    def dies(stage):
        raise Died

    with monkeypatch.context() as patch:
        patch.setattr(LocalStage, "flush", dies)
        with pytest.raises(Died):
            attempt.commit()
    assert attempts_at(store, 0) == sorted((attempt.name, noted.name))
    assert blamed_scene(store, 0, attempt.name) is blamed_scene(store, 0, noted.name) is None
    write, written = LocalStage.write, []
    monkeypatch.setattr(LocalStage, "write", lambda stage, path, data: (written.append(path), write(stage, path, data)))
    assert noted.commit().won
    assert written and "_current" not in written


def test_a_note_replaces_a_longer_one_in_place_and_a_torn_one_blames_nobody(store):
    attempt = begun(store, stop=MAX_SCENE)
    note = store.root / f"{STAGING}/0000000000/{attempt.name}/_current"
    places = set()
    for scene_id in (MAX_SCENE, 7):
        attempt.begin_scene(scene_id)
        assert blamed_scene(store, 0, attempt.name) == scene_id
        places.add((note.stat().st_ino, note.stat().st_size))
    assert len(places) == 1
    for torn in (b"", b"{", b"[1]", b'{"scene_id": "x"}'):
        note.write_bytes(torn)
        assert blamed_scene(store, 0, attempt.name) is None
