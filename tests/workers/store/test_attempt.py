"""Which scene a worker was at when it died, by the note in its attempt's folder."""

import dataclasses
import hashlib

import pytest

from schemas.dataset.commit import Span
from schemas.dataset.layout import MAX_SCENE, STAGING, commit_path, range_table_path
from schemas.dataset.tables import TABLES
from schemas.errors import RunError
from schemas.scene.scene import SceneOutput, encoded_file
from tests.made_up_scenes import attempt_at, failed_scene, made_scene, scene, terms, with_shapes
from workers.store.attempt import attempts_at, begin_attempt, blamed_scene, retry_of_attempt
from workers.store.commit import committed_files, read_record
from workers.store.local import LocalStage, LocalStore
from workers.store.manifest import decode_table

pytestmark = pytest.mark.usefixtures("unflushed")


def changed(output: SceneOutput, **changes) -> SceneOutput:
    return dataclasses.replace(output, **changes)


def test_a_winner_publishes_every_file_and_leaves_no_staging(store, tmp_path):
    result = attempt_at(store, 0, 4).commit()
    assert result.won
    for scene_id in range(4):
        for file in scene(scene_id).files:
            assert (tmp_path / file.path).read_bytes() == file.data
    assert sorted(entry.key for entry in store.files(STAGING)) == []
    assert read_record(store, 0) == result.record


def test_a_record_names_every_file_with_its_size_and_digest_and_the_rows_of_every_table(store, tmp_path):
    record = attempt_at(store, 0, 4).commit().record
    named = {entry.path: (entry.bytes, entry.sha256) for entry in committed_files(store, record)}
    files = [path for path in tmp_path.rglob("*") if path.is_file() and "_commits" not in path.parts]
    on_disk = {str(path.relative_to(tmp_path)): path.read_bytes() for path in files}
    assert named == {name: (len(data), hashlib.sha256(data).hexdigest()) for name, data in on_disk.items()}
    for table in TABLES:
        path = range_table_path(0, table)
        assert decode_table(table, on_disk[path], path).num_rows == record.tables[table]
    assert [(mark.scene_id, mark.outcome) for mark in record.scenes] == [(i, "made") for i in range(4)]


def test_the_rows_of_a_range_are_sorted_whatever_their_order_in_a_scene(store):
    def shuffled(scene_id):
        output = made_scene(scene_id)
        return changed(output, rows={table: rows[::-1] for table, rows in output.rows.items()})

    mine = attempt_at(store, 0, 4, make=shuffled).commit().record
    path = range_table_path(0, "objects")
    rows = decode_table("objects", store.read(path), path)
    keys = list(zip(*(rows.column(name).to_pylist() for name in ("pose_id", "role", "region_id")), strict=True))
    assert keys == sorted(keys)
    again = attempt_at(store, 0, 4)
    assert again.commit().conflict is None
    other = attempt_at(LocalStore(store.root / "b"), 0, 4).commit().record
    views = range_table_path(0, "views")
    assert {mine.files[-1].path, other.files[-1].path} == {views}
    assert mine.files[-1] == other.files[-1]


def test_outside_its_folder_nothing_changes_before_the_commit(store, tmp_path):
    attempt_at(store, 0, 4)
    outside = [path for path in tmp_path.rglob("*") if path.is_file() and STAGING not in path.parts]
    assert outside == []


def test_attempts_at_one_range_never_share_a_folder(store):
    names = {begin_attempt(store, Span(start=0, stop=2), terms()).name for _ in range(20)}
    assert len(names) == 20
    assert {retry_of_attempt(name) for name in names} == {0}
    retry = begin_attempt(store, Span(start=0, stop=2, retry=3, scenes=(1,)), terms())
    assert retry_of_attempt(retry.name) == 3
    assert retry_of_attempt("something") is None


def without(output: SceneOutput, table: str) -> SceneOutput:
    return changed(output, rows={**output.rows, table: []})


BROKEN = {
    "no row that says how it went": (without(made_scene(0), "scenes"), "0 rows in scenes and 0 in failures"),
    "made and failed": (
        changed(made_scene(0), rows={**made_scene(0).rows, **failed_scene(0).rows}),
        "1 rows in scenes and 1 in failures",
    ),
    "failed with views": (
        changed(failed_scene(0), rows={**made_scene(0).rows, **failed_scene(0).rows, "scenes": []}),
        "failed and has rows in views, objects, assets",
    ),
    "failed with files": (changed(failed_scene(0), files=made_scene(0).files), "disagree about"),
    "an unknown table": (changed(made_scene(0), rows={**made_scene(0).rows, "extra": []}), "unknown tables: extra"),
    "rows of another scene": (
        changed(made_scene(0), rows={**made_scene(0).rows, "views": made_scene(1).rows["views"]}),
        "rows of another scene in views",
    ),
    "a file that no row names": (
        changed(made_scene(0), files=(*made_scene(0).files, encoded_file("mug/RGB99999.png", b"x"))),
        "disagree about mug/RGB99999.png",
    ),
    "a row that names no file": (changed(made_scene(0), files=made_scene(0).files[1:]), "disagree about"),
    "other bytes than its row says": (
        changed(made_scene(0), files=(encoded_file(made_scene(0).files[0].path, b"other"), *made_scene(0).files[1:])),
        "sizes, digests",
    ),
    "a path twice": (changed(made_scene(0), files=(*made_scene(0).files, made_scene(0).files[0])), "path twice"),
    "an unknown kind of failure": (
        changed(failed_scene(0), rows={"failures": [{**failed_scene(0).rows["failures"][0], "kind": "odd"}]}),
        "unknown kind 'odd'",
    ),
    "another scene": (made_scene(1), r"scene 1 came, .* awaits \(0,\)"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_scene_is_refused_that_has(store, what):
    output, message = BROKEN[what]
    attempt = begin_attempt(store, Span(start=0, stop=2), terms())
    with pytest.raises(ValueError, match=message):
        attempt.add_scene(output)


@pytest.mark.parametrize(
    "path",
    [
        "/etc/passwd",
        "../out.png",
        "mug/../../x.png",
        "_staging/x.png",
        ".hidden",
        "mug//x.png",
        "mug\\x.png",
        "mug/a\nb.png",
    ],
)
def test_a_scene_cannot_write_outside_its_place(store, path):
    attempt = begin_attempt(store, Span(start=0, stop=2), terms())
    with pytest.raises(ValueError, match="is not a path that a scene may write"):
        attempt.add_scene(changed(made_scene(0), files=(encoded_file(path, b"x"),)))
    assert {path.name for path in store.root.iterdir()} == {"manifest", STAGING}


def test_a_range_that_lacks_a_scene_is_not_committed(store):
    attempt = begin_attempt(store, Span(start=0, stop=2), terms())
    attempt.add_scene(made_scene(0))
    with pytest.raises(ValueError, match=r"lacks scenes \[1\]"):
        attempt.commit()
    assert store.size(commit_path(0)) is None


def test_a_shape_that_two_scenes_share_is_written_once_and_must_be_the_same(store):
    attempt = attempt_at(store, 0, 4)
    record = attempt.commit().record
    shapes = [entry.path for entry in committed_files(store, record) if entry.path.startswith("assets/")]
    assert len(shapes) == len(set(shapes)) < 4 + 1
    other = begin_attempt(store, Span(start=4, stop=8), terms())
    first, again = made_scene(4), made_scene(5)
    shape = next(file.path for file in first.files if file.path.startswith("assets/"))
    other.add_scene(first)
    files = [file for file in again.files if not file.path.startswith("assets/")]
    with pytest.raises(ValueError, match="written twice with different bytes"):
        other.add_scene(changed(again, files=(*files, encoded_file(shape, b"other"))))


def test_one_asset_described_in_two_ways_within_a_range_is_refused(store):
    def described_by_scene(scene_id):
        output = made_scene(scene_id)
        rows = [{**row, "split": "test" if scene_id else "train"} for row in output.rows["assets"]]
        return changed(output, rows={**output.rows, "assets": rows})

    with pytest.raises(ValueError, match="assets: two rows have the key instance_id = table-0"):
        attempt_at(store, 0, 2, make=described_by_scene).commit()


def test_a_loser_touches_nothing_and_agrees_where_it_made_the_same(store, tmp_path):
    first = attempt_at(store, 0, 4)
    second = attempt_at(store, 0, 4)
    winner = first.commit().record
    before = {
        path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file() and STAGING not in path.parts
    }
    lost = second.commit()
    assert not lost.won
    assert lost.record == winner
    assert lost.conflict is None
    after = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    assert after == before


def test_a_loser_that_made_other_bytes_says_where_and_names_both_fingerprints(store):
    attempt_at(store, 0, 4, terms(fingerprint="stack-a")).commit()
    other = attempt_at(store, 0, 4, terms(fingerprint="stack-b"), lambda i: made_scene(i, salt="!" if i == 2 else ""))
    conflict = other.commit().conflict
    assert "at scene 2:" in conflict
    assert "stack-a" in conflict
    assert "stack-b" in conflict


def test_a_loser_with_another_shape_says_so(store):
    attempt_at(store, 0, 2).commit()

    def other_shape(scene_id):
        return with_shapes(made_scene(scene_id), lambda data: data + b"!")

    assert "assets/" in attempt_at(store, 0, 2, make=other_shape).commit().conflict


@pytest.mark.parametrize("order", [1, -1], ids=["the killed one loses", "the killed one wins"])
def test_a_scene_that_was_killed_in_one_attempt_is_no_conflict(store, order):
    def killed(scene_id):
        return failed_scene(scene_id, "environmental") if scene_id == 1 else made_scene(scene_id)

    makers = [made_scene, killed][::order]
    attempt_at(store, 0, 4, make=makers[0]).commit()
    assert attempt_at(store, 0, 4, make=makers[1]).commit().conflict is None


def test_attempts_with_other_ends_are_compared_over_the_scenes_they_share(store):
    attempt_at(store, 0, 4).commit()
    assert attempt_at(store, 0, 2).commit().conflict is None
    assert "scene 1:" in attempt_at(store, 0, 2, make=lambda i: made_scene(i, salt="!" * i)).commit().conflict


def test_an_attempt_that_was_swept_without_a_winner_says_who_may_have_done_it(store):
    attempt = begin_attempt(store, Span(start=0, stop=2), terms())
    attempt.add_scene(made_scene(0))
    store.revoke(f"{STAGING}/0000000000/{attempt.name}")
    attempt.begin_scene(1)
    attempt.add_scene(made_scene(1))
    assert attempt.fenced
    with pytest.raises(RunError, match="swept before it could commit: another coordinator"):
        attempt.commit()
    assert store.size(commit_path(0)) is None


def test_an_abandoned_attempt_leaves_nothing(store):
    attempt = attempt_at(store, 0, 4, terms(layout="tar"))
    attempt.abandon()
    assert not list(store.files(STAGING))


def test_a_scene_is_blamed_from_its_beginning_until_the_commit(store):
    attempt = begin_attempt(store, Span(start=0, stop=2), terms(), "label")
    assert "label" in attempt.name
    assert attempts_at(store, 0) == [attempt.name]
    assert blamed_scene(store, 0, attempt.name) is None
    attempt.begin_scene(0)
    assert blamed_scene(store, 0, attempt.name) == 0
    attempt.add_scene(made_scene(0))
    attempt.begin_scene(1)
    assert blamed_scene(store, 0, attempt.name) == 1
    attempt.add_scene(made_scene(1))
    attempt.commit()
    assert blamed_scene(store, 0, attempt.name) is None
    assert attempts_at(store, 0) == []


def test_a_worker_that_dies_while_it_commits_blames_no_scene(store, monkeypatch):
    attempt = attempt_at(store, 0, 4)
    assert blamed_scene(store, 0, attempt.name) == 3

    class Died(BaseException):
        pass

    def dies(stage):
        raise Died

    monkeypatch.setattr(LocalStage, "flush", dies)
    with pytest.raises(Died):
        attempt.commit()
    assert attempts_at(store, 0) == [attempt.name]
    assert blamed_scene(store, 0, attempt.name) is None


def test_a_range_that_is_known_to_have_no_scene_in_progress_is_not_told_so_again(store, monkeypatch):
    attempt = attempt_at(store, 0, 4)
    attempt.end_scenes()
    assert blamed_scene(store, 0, attempt.name) is None
    write, written = LocalStage.write, []
    monkeypatch.setattr(LocalStage, "write", lambda stage, path, data: (written.append(path), write(stage, path, data)))
    assert attempt.commit().won
    assert written and "_current" not in written


def test_a_shorter_note_replaces_a_longer_one_in_place(store):
    attempt = begin_attempt(store, Span(start=0, stop=MAX_SCENE), terms())
    note = store.root / f"{STAGING}/0000000000/{attempt.name}/_current"
    attempt.begin_scene(MAX_SCENE)
    before = note.stat()
    assert blamed_scene(store, 0, attempt.name) == MAX_SCENE
    attempt.begin_scene(7)
    assert blamed_scene(store, 0, attempt.name) == 7
    assert (note.stat().st_ino, note.stat().st_size) == (before.st_ino, before.st_size)


def test_a_note_is_not_written_where_the_folder_was_swept(store):
    attempt = begin_attempt(store, Span(start=0, stop=2), terms())
    attempt.begin_scene(0)
    store.revoke(f"{STAGING}/0000000000/{attempt.name}")
    attempt.begin_scene(1)
    assert attempt.fenced
    assert not (store.root / f"{STAGING}/0000000000/{attempt.name}").exists()


@pytest.mark.parametrize("torn", [b"", b"{", b"[1]", b'{"scene_id": "x"}'])
def test_a_torn_note_blames_nobody(store, torn):
    attempt = begin_attempt(store, Span(start=0, stop=2), terms())
    (store.root / f"{STAGING}/0000000000/{attempt.name}/_current").write_bytes(torn)
    assert blamed_scene(store, 0, attempt.name) is None
