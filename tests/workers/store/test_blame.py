"""Which scene a worker was at when it died, by the note in its attempt's folder."""

import pytest

from schemas.dataset.commit import Span
from schemas.dataset.layout import MAX_SCENE, STAGING
from tests.made_up_scenes import attempt_at, made_scene, terms
from workers.store.attempt import attempts_at, begin_attempt, blamed_scene
from workers.store.local import LocalStage


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
