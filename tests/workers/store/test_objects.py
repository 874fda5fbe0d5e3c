import contextlib

import obstore
import pytest
from obstore.store import HTTPStore, MemoryStore, S3Store
from obstore.store import LocalStore as FolderStore

from schemas.dataset.commit import Span
from schemas.dataset.layout import STAGING
from schemas.errors import MachineError, OutputError, RunError
from services.merge.merge import merge, read_success
from services.read.query import query
from services.read.status import read_status
from services.run.lock import Beat, hold_lock, read_holder
from services.run.range_planner import committed_ranges, plan_ranges
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
    for start, end in plan_ranges(0, stop, 4, committed_ranges(list_commits(store))):
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


def test_the_other_layout_is_refused(store):
    with pytest.raises(OutputError, match=r"needs output.layout: tar; the job says files"):
        begin_attempt(store, Span(start=0, stop=2), terms())


def test_the_lock_is_held_taken_over_and_given_back(store):
    beat = Beat(0.1, 3)
    with hold_lock(store, beat=beat), pytest.raises(RunError, match="is in use"), hold_lock(store, beat=beat):
        pass
    assert read_holder(store) is None


def sizes_of(place, folder: str) -> dict[str, int]:
    return {one.key: one.bytes for one in place.files(folder)}


def test_files_and_folders_are_listed_as_on_a_disk(store, tmp_path):
    disk = LocalStore(tmp_path / "disk")
    disk.prepare()
    for place in (store, disk):
        for key in ("mug/b.png", "mug/a.png", "mug/patches/a.png", "mugs/c.png"):
            place.put(key, b"12")
    assert sizes_of(store, "mug") == sizes_of(disk, "mug")
    assert store.children("mug") == disk.children("mug") == ["patches"]
    assert store.children("nothing") == disk.children("nothing") == []
    assert store.size("mug/none") is disk.size("mug/none") is None
    assert store.stat("mug/none") is None
    for place in (store, disk):
        place.remove("mug/none")
        with pytest.raises(FileNotFoundError):
            place.read("mug/none")
        with pytest.raises(FileNotFoundError):
            place.move("mug/none", "mug/d")
        place.remove_tree("mug")
    assert list(store.files("mug")) == list(disk.files("mug")) == []
    assert store.size("mugs/c.png") == 2


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


def test_a_store_that_ignores_the_condition_is_refused_by_name():
    with (
        s3_server(Bucket(conditional="ignored")) as bucket,
        pytest.raises(
            OutputError, match=r"s3://mine does not refuse a second put .* Use a store with conditional puts"
        ),
    ):
        ObjectStore(bucket, "s3://mine").prepare()


def test_a_store_without_conditional_puts_is_refused_by_name():
    with pytest.raises(OutputError, match=r"http://web does not refuse a second put"):
        ObjectStore(HTTPStore("http://127.0.0.1:1/"), "http://web").prepare()


def test_a_store_that_does_not_answer_is_refused_by_name():
    nobody = S3Store(
        "bucket",
        endpoint="http://127.0.0.1:1",
        region="us-east-1",
        skip_signature=True,
        client_options={"allow_http": True},
        retry_config={"max_retries": 0},
    )
    with pytest.raises(OutputError, match="s3://nobody cannot be written"):
        ObjectStore(nobody, "s3://nobody").prepare()


def test_a_record_whose_answer_was_lost_is_known_as_our_own():
    held = Bucket()
    with s3_server(held) as bucket:
        store = ObjectStore(bucket, "s3://mine")
        attempt = attempt_at(store, 0, 2, TAR, make_pair)
        held.lose_answers_of = "_commits"
        result = attempt.commit()
        assert held.lose_answers_of == ""
        assert result.won
        check_published(store, result.record)


def make_pair(scene_id):
    return made_scene(scene_id)


def test_a_store_that_stops_answering_is_told_by_name(monkeypatch):
    store = ObjectStore(MemoryStore(), "memory://mine")

    def fails(*_, **__):
        raise obstore.exceptions.GenericError("no route to host\nDebug source: ...")

    monkeypatch.setattr(obstore, "put", fails)
    with pytest.raises(MachineError, match=r"^mug/a in memory://mine: no route to host$"):
        store.put("mug/a", b"")


def test_a_probe_that_is_swept_by_a_coordinator_at_work_is_made_again(monkeypatch):
    store = ObjectStore(MemoryStore(), "memory://")
    real, swept = obstore.put, []

    def put(*arguments, **named):
        done = real(*arguments, **named)
        if not swept:
            swept.append(sweep(store))
        return done

    monkeypatch.setattr(obstore, "put", put)
    store.prepare()
    assert swept
