"""The verbs of a store, which a folder and object stores answer alike, and what is made of them."""

import contextlib
import os
import threading
from collections import deque
from functools import partial

import obstore
import pytest
from obstore.store import HTTPStore, MemoryStore, S3Store
from obstore.store import LocalStore as FolderStore

from schemas.dataset.commit import Span
from schemas.dataset.layout import STAGING, TEMPORARY
from schemas.errors import CorruptError, MachineError, OutputError, RunError
from services.job.record import read_success
from services.merge.merge import merge
from services.read.query import query
from services.read.status import read_status
from services.run.lock import Beat, hold_lock, read_holder
from services.run.range_planner import plan_ranges
from tests.kit.faults import check_published, in_threads
from tests.kit.s3_server import Bucket, s3_server
from tests.kit.stored_images import iter_records, read_images
from tests.made_up_scenes import attempt_at, scene, terms
from workers.store.attempt import attempts_at, begin_attempt, blamed_scene, sweep
from workers.store.commit import read_record
from workers.store.ledger import list_commits
from workers.store.local import LocalStore, open_store
from workers.store.objects import ObjectStore
from workers.store.store import Events, Store, is_live, map_ahead, retry_if_swept, stat_all

pytestmark = pytest.mark.usefixtures("unflushed")

KEY = "manifest/_commits/a.json"
TAR = terms(layout="tar")
STOP = 10


@pytest.fixture(params=["disk", "memory", "folder", "s3"])
def place(request, tmp_path):
    with contextlib.ExitStack() as stack:
        made: Store
        if request.param == "disk":
            made = LocalStore(tmp_path / "out")
        elif request.param == "memory":
            made = ObjectStore(MemoryStore(), "memory://bucket")
        elif request.param == "folder":
            made = ObjectStore(FolderStore(tmp_path / "bucket", mkdir=True), "folder://bucket")
        else:
            made = ObjectStore(stack.enter_context(s3_server(Bucket())), "s3://bucket")
        made.prepare()
        assert not list(made.files("manifest")) and not list(made.files(STAGING)), "a probe leaves nothing behind"
        yield made


# ---------------------------------------------------------------------------------------------- verbs


def test_files_are_put_listed_moved_and_removed(place):
    for key in ("mug/b.png", "mug/a.png", "mug/patches/a.png", "mugs/c.png"):
        place.put(key, b"12")
    place.put("mugs/c.png", b"123")
    whole = {"mug/a.png": 2, "mug/b.png": 2, "mug/patches/a.png": 2}
    assert {one.key: one.bytes for one in place.files("mug")} == whole
    assert {one.key for one in place.files("mug", sizes=False)} == whole.keys()
    assert {"mug/a.png", "mugs/c.png"} < {one.key for one in place.files("")}
    assert place.names("mug") == ["a.png", "b.png", "patches"] and place.children("mug") == ["patches"]
    seen = place.stat("mugs/c.png")
    assert (seen.key, seen.bytes, place.size("mugs/c.png")) == ("mugs/c.png", 3, 3)
    with place.open("mugs/c.png") as file:
        assert (file.read(2), file.read(), file.tell()) == (b"12", b"3", 3)
    both = {"mug/patches/a.png", "mugs/c.png"}
    assert set(stat_all(place, ["mug/patches", "none"], ["mugs/c.png", "mug/none"])) == both
    place.move("mug/a.png", "new/folder/a.png")
    for missing in (place.read, place.open, lambda key: place.move(key, "new/folder/a.png")):
        with pytest.raises(FileNotFoundError):
            missing("mug/a.png")
    assert place.read("new/folder/a.png") == b"12"
    assert place.stat("mug/a.png") is place.size("mug/a.png") is None
    for _ in range(2):  # what is gone already need not be removed
        place.remove("mug/b.png")
        place.remove_tree("mug")
        place.remove_empty("mug")
    assert not list(place.files("mug")) and place.names("nothing") == place.children("nothing") == []
    assert place.size("mugs/c.png") == 3


def test_of_many_threads_that_put_one_key_exactly_one_wins(place):
    assert place.put_if_absent(KEY, b"first") and not place.put_if_absent(KEY, b"second")
    assert place.read(KEY) == b"first"
    won = []

    def put(number):
        won.extend((key, number) for key in range(10) if place.put_if_absent(f"x/{key}", str(number).encode()))

    in_threads(*(partial(put, number) for number in range(6)))
    assert sorted(key for key, _ in won) == list(range(10))
    assert all(place.read(f"x/{key}") == str(number).encode() for key, number in won)
    assert not list(place.files(TEMPORARY))


def test_a_stage_writes_until_it_is_revoked_and_then_commits_no_more(place):
    on_disk = isinstance(place, LocalStore)
    stage = place.stage("_staging/0/a")
    stage.write("deep/er/x.png", b"x")
    with stage.stream("mug/y.tar") as file:
        file.write(b"1")
        file.write(b"2")
    with contextlib.suppress(ZeroDivisionError), stage.stream("mug/z.tar") as file:
        file.write(b"" if on_disk else b"1")
        raise ZeroDivisionError
    stage.flush()
    assert is_live(place, "_staging/0/a")
    assert (place.read("_staging/0/a/deep/er/x.png"), place.read("_staging/0/a/mug/y.tar")) == (b"x", b"12")
    assert not place.size("_staging/0/a/mug/z.tar")
    assert stage.put_if_absent("manifest/_commits/b.json", b"record")
    assert place.revoke("_staging/0/a") == place.revoke("_staging/0/nobody") == on_disk
    assert not is_live(place, "_staging/0/a")
    with pytest.raises(FileNotFoundError):
        stage.put_if_absent(KEY, b"record")
    assert place.size(KEY) is None
    for path in ("z.png", "mug/z.png", "new/z.png") if on_disk else ():
        with pytest.raises(FileNotFoundError):
            stage.write(path, b"z")


def test_finished_files_replace_what_was_known_to_be_there(place):
    on_disk = isinstance(place, LocalStore)
    with place.scratch("merge") as folder:
        for name in ("new", "newer", "late"):
            (folder / name).write_bytes(name.encode())
        first = place.replace(folder / "new", "a/t.csv")
        place.replace(folder / "newer", "a/t.csv", first)
        assert place.read("a/t.csv") == b"newer"
        if place.name in ("memory://bucket", "s3://bucket"):  # the others know no condition but absence
            with pytest.raises(RunError, match=r"a/t.csv was replaced"):
                place.replace(folder / "late", "a/t.csv", first)
        assert place.withdraw("a/t.csv", folder) == on_disk
        assert (place.size("a/t.csv") is None) == on_disk
    assert not folder.exists() and not list(place.files(STAGING))
    if on_disk:  # a folder in use is taken away by the next
        with place.scratch("merge") as older, place.scratch("merge") as newer:
            assert newer.is_dir() and not older.exists()
            with pytest.raises(FileNotFoundError):
                place.withdraw("none", older)


def test_of_writers_who_decide_on_what_they_read_each_number_has_one(place):
    """A counter: every writer adds the number of events that it saw, and none may be lost or be given twice."""
    logs = [Events(place, "jobs/j/events") for _ in range(4)]
    assert logs[0].read() == [] and logs[0].append(lambda before: None) is None

    def count(number):
        for _ in range(5):
            logs[number].append(lambda before: b"%d %d" % (len(before), number) if len(before) < 15 else None)

    in_threads(*(partial(count, number) for number in range(4)))
    events = Events(place, "jobs/j/events").read()
    assert [int(event.split()[0]) for event in events] == list(range(15))
    assert logs[0].append(lambda before: b"x") == logs[1].read()
    place.remove("jobs/j/events/00000003.json")
    with pytest.raises(CorruptError, match=r"jobs/j/events lacks an event, or holds what is none"):
        logs[0].read()


def test_calls_ahead_keep_their_order_their_number_and_the_place_of_an_error(store):
    for threads in (1, 3):
        store.at_once = threads
        begun, taken, lead, lock = [], deque(), [], threading.Lock()

        def work(item, begun=begun, taken=taken, lead=lead, lock=lock):
            with lock:
                begun.append(item)
                lead.append(len(begun) - len(taken))
            if item == 50:
                raise CorruptError("fifty")
            return item

        with pytest.raises(CorruptError, match="fifty"):
            taken.extend(map_ahead(store, work, range(99)))
        assert list(taken) == list(range(50))
        assert max(lead) <= (1 if threads == 1 else 2 * threads + 1)


def test_what_a_coordinator_at_work_sweeps_away_is_written_again(store, monkeypatch):
    for losses in range(4):
        left = [FileNotFoundError()] * losses

        def step(left=left):
            if left:
                raise left.pop()
            return "done"

        with pytest.raises(FileNotFoundError) if losses == 3 else contextlib.nullcontext():
            assert retry_if_swept(step) == "done"
        assert not left
    bucket, swept = ObjectStore(MemoryStore(), "memory://"), []

    def once(where, real, after):
        def call(*arguments, **named):
            done = real(*arguments, **named) if after else None
            if not swept:
                swept.append(sweep(where))
            return done if after else real(*arguments, **named)

        return call

    monkeypatch.setattr(os, "link", once(store, os.link, after=False))
    monkeypatch.setattr(obstore, "put", once(bucket, obstore.put, after=True))
    for write in (store.prepare, lambda: store.put_if_absent(KEY, b"data"), bucket.prepare):
        swept.clear()
        write()
        assert swept
    assert store.read(KEY) == b"data"


# ---------------------------------------------------------------------------------------------- places


def test_a_url_opens_an_object_store_and_anything_else_a_folder(tmp_path):
    assert isinstance(open_store(str(tmp_path)), LocalStore) and not list(tmp_path.iterdir())
    opened = open_store("s3://bucket/a/dataset")
    assert isinstance(opened, ObjectStore) and opened.name == "s3://bucket/a/dataset"
    assert opened._bucket.prefix == "a/dataset"
    for url in ("s3://", "ftp://host/x", "az://c/x"):
        with pytest.raises(OutputError, match="is not an object store that can be opened"):
            open_store(url)


def test_a_place_that_cannot_keep_a_dataset_or_stops_answering_is_refused_by_name(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    nowhere = {"allow_http": True}
    options = {"region": "us-east-1", "skip_signature": True, "retry_config": {"max_retries": 0}}
    nobody = S3Store("bucket", endpoint="http://127.0.0.1:1", client_options=nowhere, **options)
    for place, message in (
        (LocalStore(tmp_path / "file" / "out"), "file/out cannot be written"),
        (ObjectStore(HTTPStore("http://127.0.0.1:1/"), "http://web"), "http://web does not refuse a second put"),
        (ObjectStore(nobody, "s3://nobody"), "s3://nobody cannot be written"),
    ):
        with pytest.raises(OutputError, match=message):
            place.prepare()

    def fails(*_, **__):
        raise obstore.exceptions.GenericError("no route to host\nDebug source: ...")

    monkeypatch.setattr(obstore, "put", fails)
    with pytest.raises(MachineError, match=r"^mug/a in memory://mine: no route to host$"):
        ObjectStore(MemoryStore(), "memory://mine").put("mug/a", b"")
    with pytest.raises(OutputError, match=r"needs output.layout: tar; the job says files"):
        begin_attempt(ObjectStore(MemoryStore(), "memory://mine"), Span(start=0, stop=2), terms())


# ---------------------------------------------------------------------------------------------- datasets there


def make_all(place, settings=TAR) -> str:
    """What a coordinator with one worker does."""
    sweep(place, fenced=None)
    for start, end in plan_ranges(0, STOP, 4, list_commits(place).ranges):
        attempt_at(place, start, end, settings).commit()
    return merge(place, 0, STOP).digest


def test_a_dataset_has_the_digest_of_one_on_a_disk_and_answers_questions_while_it_grows(place, store):
    attempt_at(place, 0, 4, TAR).commit()
    busy = attempt_at(place, 4, 8, TAR)
    busy.begin_scene(7)
    assert query(place, "select count(*) from views").column(0).to_pylist() == [16]
    assert attempts_at(place, 4) == [busy.name] and blamed_scene(place, 4, busy.name) == 7
    assert [one.scene_id for one in read_status(place, 0, 8).running] == [7]
    busy.abandon()
    assert make_all(place) == make_all(store, terms())
    assert not list(place.files(STAGING))
    made = [i for i in range(STOP) if i != 5]
    assert query(place, "select scene_id from scenes order by 1").column(0).to_pylist() == made
    status = read_status(place, 0, STOP)
    assert (status.made, status.failed, status.missing) == (9, {"intrinsic: left_table": 1}, 0)
    whole = (file for i in range(STOP) for file in scene(i).files if not file.path.startswith("assets/"))
    images = {file.path: file.data for file in whole}
    for one in (place, store):
        assert {p: d for record in iter_records(one) for p, d in read_images(one, record)} == images
    before = sorted(place.files(""))
    assert make_all(place) == read_success(place)["digest"]
    assert sorted(place.files("")) == before
    beat = Beat(0.1, 3)
    with hold_lock(place, beat=beat), pytest.raises(RunError, match="is in use"), hold_lock(place, beat=beat):
        pass
    assert read_holder(place) is None


def test_one_of_two_attempts_wins_and_a_swept_one_does_not_commit(place):
    first, second = attempt_at(place, 0, 4, TAR), attempt_at(place, 0, 4, TAR)
    assert first.commit().won
    lost = second.commit()
    assert (lost.won, lost.conflict, lost.record) == (False, None, read_record(place, 0))
    check_published(place, lost.record)
    assert not list(place.files(STAGING))
    attempt, dead = attempt_at(place, 4, 8, TAR), attempt_at(place, 4, 8, TAR)
    kept = attempt.name not in sweep(place, fenced=[(4, attempt.name)])
    assert attempts_at(place, 4) == [dead.name]
    assert kept != isinstance(place, LocalStore) and bool(list(place.files(STAGING)))
    with pytest.raises(RunError, match="swept before it could commit"):
        attempt.commit()
    assert read_record(place, 4) is None
    sweep(place, fenced=None)
    assert attempt_at(place, 4, 8, TAR).commit().won
    assert (dead.name in sweep(place)) == kept, "a bucket keeps its files until another has committed the range"
    assert not list(place.files(STAGING))
    dead.abandon()
