import contextlib

import obstore
import pytest
from obstore.store import LocalStore as FolderStore
from obstore.store import MemoryStore

from schemas.dataset.commit import Span
from schemas.dataset.layout import STAGING
from schemas.errors import OutputError, RunError
from services.merge.merge import merge, read_success
from services.read.query import query
from services.read.status import read_status
from services.run.lock import Beat, hold_lock, read_holder
from services.run.range_planner import plan_ranges
from tests.kit.faults import check_published
from tests.kit.s3_server import Bucket, s3_server
from tests.made_up_scenes import attempt_at, made_scene, scene, terms
from tests.stored_images import iter_records, read_images
from workers.store.attempt import attempts_at, begin_attempt, blamed_scene, sweep
from workers.store.commit import publish, read_record
from workers.store.ledger import list_commits
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore

pytestmark = pytest.mark.usefixtures("unflushed")

TAR = terms(layout="tar")
STOP = 10


@pytest.fixture(params=["memory", "folder", "s3"])
def store(request, tmp_path):
    with contextlib.ExitStack() as stack:
        if request.param == "memory":
            bucket = MemoryStore()
        elif request.param == "folder":
            bucket = FolderStore(tmp_path / "bucket", mkdir=True)
        else:
            bucket = stack.enter_context(s3_server(Bucket()))
        store = ObjectStore(bucket, f"{request.param}://bucket")
        store.prepare()
        yield store


def make_all(store, settings=TAR, make=scene, stop=STOP) -> str:
    """What a coordinator with one worker does."""
    sweep(store, fenced=None)
    for start, end in plan_ranges(0, stop, 4, list_commits(store).ranges):
        attempt_at(store, start, end, settings, make).commit()
    return merge(store, 0, stop).digest


def on_disk(root, make=scene, stop=STOP) -> str:
    store = LocalStore(root)
    store.prepare()
    return make_all(store, terms(), make, stop)


def test_a_dataset_there_has_the_digest_of_one_on_a_disk_and_answers_questions(store, tmp_path):
    assert make_all(store) == on_disk(tmp_path / "disk")
    assert not list(store.files(STAGING))
    made = [i for i in range(STOP) if i != 5]
    assert query(store, "select scene_id from scenes order by 1").column(0).to_pylist() == made
    status = read_status(store, 0, STOP)
    assert (status.made, status.failed, status.missing) == (9, {"intrinsic: left_table": 1}, 0)
    images = {
        file.path: file.data for i in range(STOP) for file in scene(i).files if not file.path.startswith("assets/")
    }
    assert {p: d for record in iter_records(store) for p, d in read_images(store, record)} == images
    before = sorted(store.files(""))
    assert make_all(store) == read_success(store)["digest"]
    assert sorted(store.files("")) == before


def test_a_running_dataset_answers_questions(store):
    attempt_at(store, 0, 4, TAR).commit()
    busy = attempt_at(store, 4, 8, TAR)
    busy.begin_scene(7)
    assert query(store, "select count(*) from views").column(0).to_pylist() == [16]
    assert attempts_at(store, 4) == [busy.name]
    assert blamed_scene(store, 4, busy.name) == 7
    assert [one.scene_id for one in read_status(store, 0, 8).running] == [7]


def test_one_of_two_attempts_wins_and_the_other_leaves_nothing(store):
    with pytest.raises(OutputError, match=r"needs output.layout: tar; the job says files"):
        begin_attempt(store, Span(start=0, stop=2), terms())
    first, second = attempt_at(store, 0, 4, TAR), attempt_at(store, 0, 4, TAR)
    assert first.commit().won
    lost = second.commit()
    assert (lost.won, lost.conflict) == (False, None)
    assert lost.record == read_record(store, 0)
    check_published(store, lost.record)
    assert not list(store.files(STAGING))


def test_an_attempt_that_was_swept_does_not_commit_and_its_files_stay_until_another_has(store):
    attempt = attempt_at(store, 0, 4, TAR)
    assert sweep(store, fenced=[(0, attempt.name)]) == []
    assert attempts_at(store, 0) == []
    assert list(store.files(STAGING))
    with pytest.raises(RunError, match="swept before it could commit"):
        attempt.commit()
    assert read_record(store, 0) is None
    dead = attempt_at(store, 0, 4, TAR)
    sweep(store, fenced=None)
    assert attempt_at(store, 0, 4, TAR).commit().won
    assert dead.name in sweep(store)
    assert not list(store.files(STAGING))


def test_the_lock_is_held_taken_over_and_given_back(store):
    beat = Beat(0.1, 3)
    with hold_lock(store, beat=beat), pytest.raises(RunError, match="is in use"), hold_lock(store, beat=beat):
        pass
    assert read_holder(store) is None


def test_a_rename_that_was_ended_half_way_is_done_again(monkeypatch):
    store = ObjectStore(MemoryStore(), "memory://")
    with monkeypatch.context() as patch:
        patch.setattr("workers.store.attempt.publish", lambda *_: None)
        record = attempt_at(store, 0, 4, TAR).commit().record
    entry = record.files[-1]
    obstore.copy(store._bucket, f"{STAGING}/0000000000/{record.attempt}/{entry.path}", entry.path)
    publish(store, record)
    check_published(store, record)
    assert not list(store.files(STAGING))


def test_a_record_whose_answer_was_lost_is_known_as_our_own():
    held = Bucket()
    with s3_server(held) as bucket:
        store = ObjectStore(bucket, "s3://mine")
        attempt = attempt_at(store, 0, 2, TAR, made_scene)
        held.lose_answers_of = "_commits"
        result = attempt.commit()
        assert held.lose_answers_of == ""
        assert result.won
        check_published(store, result.record)
