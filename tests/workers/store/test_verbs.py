"""The verbs of a store, which a folder and object stores answer alike, and what is made of them: events, calls ahead."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections import deque

import obstore
import pytest
from obstore.store import HTTPStore, MemoryStore, S3Store
from obstore.store import LocalStore as FolderStore

from schemas.dataset.layout import STAGING, TEMPORARY
from schemas.errors import CorruptError, MachineError, OutputError, RunError
from tests.kit.s3_server import Bucket, s3_server
from workers.store.attempt import sweep
from workers.store.events import Events
from workers.store.file_system import remove_abandoned, temporary_folder
from workers.store.local import LocalStore, open_store
from workers.store.objects import ObjectStore
from workers.store.store import Store, is_live, map_ahead, retry_if_swept, stat_all

KEY = "manifest/_commits/a.json"


@pytest.fixture(params=["disk", "memory", "folder", "s3"])
def store(request, tmp_path):
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
        yield made


def test_files_are_put_listed_moved_and_removed(store):
    for key in ("mug/b.png", "mug/a.png", "mug/patches/a.png", "mugs/c.png"):
        store.put(key, b"12")
    store.put("mugs/c.png", b"123")
    assert {one.key: one.bytes for one in store.files("mug")} == {
        "mug/a.png": 2,
        "mug/b.png": 2,
        "mug/patches/a.png": 2,
    }
    assert {one.key for one in store.files("mug", sizes=False)} == {"mug/a.png", "mug/b.png", "mug/patches/a.png"}
    assert {"mug/a.png", "mugs/c.png"} < {one.key for one in store.files("")}
    assert store.names("mug") == ["a.png", "b.png", "patches"] and store.children("mug") == ["patches"]
    found = store.stat("mugs/c.png")
    assert (found.key, found.bytes, store.size("mugs/c.png")) == ("mugs/c.png", 3, 3)
    assert set(stat_all(store, ["mug/patches", "none"], ["mugs/c.png", "mug/none"])) == {
        "mug/patches/a.png",
        "mugs/c.png",
    }
    store.move("mug/a.png", "new/folder/a.png")
    assert store.read("new/folder/a.png") == b"12"
    for missing in (lambda: store.read("mug/a.png"), lambda: store.move("mug/a.png", "new/folder/a.png")):
        with pytest.raises(FileNotFoundError):
            missing()
    assert store.read("new/folder/a.png") == b"12"
    assert store.stat("mug/a.png") is store.size("mug/a.png") is None
    for _ in range(2):  # what is gone already need not be removed
        store.remove("mug/b.png")
        store.remove_tree("mug")
        store.remove_empty("mug")
    assert not list(store.files("mug")) and store.names("nothing") == store.children("nothing") == []
    assert store.size("mugs/c.png") == 3


def test_of_many_threads_that_put_one_key_exactly_one_wins(store):
    assert store.put_if_absent(KEY, b"first") and not store.put_if_absent(KEY, b"second")
    assert store.read(KEY) == b"first"
    won, gate = [], threading.Barrier(6)

    def put(number):
        gate.wait()
        won.extend((key, number) for key in range(10) if store.put_if_absent(f"x/{key}", str(number).encode()))

    threads = [threading.Thread(target=put, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(key for key, _ in won) == list(range(10))
    assert all(store.read(f"x/{key}") == str(number).encode() for key, number in won)
    assert not list(store.files(TEMPORARY))


def test_a_stage_writes_until_it_is_revoked_and_then_commits_no_more(store):
    stage = store.stage("_staging/0/a")
    stage.write("deep/er/x.png", b"x")
    with stage.stream("mug/y.tar") as file:
        file.write(b"1")
        file.write(b"2")
    with contextlib.suppress(ZeroDivisionError), stage.stream("mug/z.tar") as file:
        file.write(b"1" if store.root is None else b"")
        raise ZeroDivisionError
    stage.flush()
    assert is_live(store, "_staging/0/a")
    assert (store.read("_staging/0/a/deep/er/x.png"), store.read("_staging/0/a/mug/y.tar")) == (b"x", b"12")
    assert not store.size("_staging/0/a/mug/z.tar")
    assert stage.put_if_absent("manifest/_commits/b.json", b"record")
    assert store.revoke("_staging/0/a") == store.revoke("_staging/0/nobody") == (store.root is not None)
    assert not is_live(store, "_staging/0/a")
    with pytest.raises(FileNotFoundError):
        stage.put_if_absent(KEY, b"record")
    assert store.size(KEY) is None
    for path in ("z.png", "mug/z.png", "new/z.png") if store.root is not None else ():
        with pytest.raises(FileNotFoundError):
            stage.write(path, b"z")


def test_finished_files_replace_what_was_known_to_be_there(store):
    with store.scratch("merge") as folder:
        (folder / "new.csv").write_bytes(b"new")
        first = store.replace(folder / "new.csv", "a/t.csv")
        (folder / "newer.csv").write_bytes(b"newer")
        store.replace(folder / "newer.csv", "a/t.csv", first)
        assert store.read("a/t.csv") == b"newer"
        (folder / "late.csv").write_bytes(b"late")
        if store.root is None and store.name != "folder://bucket":  # that client knows no condition but absence
            with pytest.raises(RunError, match=r"a/t.csv was replaced"):
                store.replace(folder / "late.csv", "a/t.csv", first)
        assert store.withdraw("a/t.csv", folder) == (store.root is not None)
        assert (store.size("a/t.csv") is None) == (store.root is not None)
    assert not folder.exists() and not list(store.files(STAGING))


def test_a_scratch_folder_in_use_on_a_disk_is_taken_away_by_the_next(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    with store.scratch("merge") as older, store.scratch("merge") as newer:
        assert newer.is_dir() and not older.exists()
        with pytest.raises(FileNotFoundError):
            store.withdraw("none", older)


def test_of_writers_who_decide_on_what_they_read_each_number_has_one(store):
    """A counter: every writer adds the number of events that it saw, and none may be lost or be given twice."""
    logs = [Events(store, "jobs/j/events") for _ in range(4)]
    assert logs[0].read() == [] and logs[0].append(lambda before: None) is None

    def count(log):
        for _ in range(5):
            log.append(lambda before: json.dumps([len(before), id(log)]).encode() if len(before) < 15 else None)

    threads = [threading.Thread(target=count, args=(log,)) for log in logs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    events = [json.loads(event) for event in Events(store, "jobs/j/events").read()]
    assert [number for number, _ in events] == list(range(15))
    assert logs[0].append(lambda before: b"x") == [*logs[1].read()]
    store.remove("jobs/j/events/00000003.json")
    with pytest.raises(CorruptError, match=r"jobs/j/events lacks an event, or holds what is none"):
        logs[0].read()


@pytest.mark.parametrize("threads", [1, 3])
def test_calls_ahead_keep_their_order_their_number_and_the_place_of_an_error(threads, tmp_path):
    store = LocalStore(tmp_path)
    store.at_once = threads
    begun, taken, lead, lock = [], deque(), [], threading.Lock()

    def work(item):
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


@pytest.mark.parametrize("losses", [0, 1, 2, 3])
def test_a_step_whose_file_was_swept_is_tried_three_times(losses):
    left = [FileNotFoundError()] * losses

    def step():
        if left:
            raise left.pop()
        return "done"

    with pytest.raises(FileNotFoundError) if losses == 3 else contextlib.nullcontext():
        assert retry_if_swept(step) == "done"
    assert not left


@pytest.mark.parametrize("what", ["probe", "put"])
def test_what_a_coordinator_at_work_sweeps_away_is_written_again(tmp_path, monkeypatch, what):
    store, bucket = LocalStore(tmp_path), ObjectStore(MemoryStore(), "memory://")
    store.prepare()
    swept = []

    def once(place, real):
        def call(*arguments, **named):
            if place is bucket:
                done = real(*arguments, **named)
            if not swept:
                swept.append(sweep(place))
            return done if place is bucket else real(*arguments, **named)

        return call

    monkeypatch.setattr(os, "link", once(store, os.link))
    store.prepare() if what == "probe" else store.put_if_absent(KEY, b"data")
    assert swept and (what == "probe" or store.read(KEY) == b"data")
    swept.clear()
    monkeypatch.setattr(obstore, "put", once(bucket, obstore.put))
    bucket.prepare()
    assert swept


def test_a_url_opens_an_object_store_and_anything_else_a_folder(tmp_path):
    code = f"import sys; from workers.store.local import open_store; open_store({str(tmp_path)!r})"
    subprocess.run([sys.executable, "-c", f"{code}; sys.exit('obstore' in sys.modules)"], check=True)
    assert isinstance(open_store(str(tmp_path)), LocalStore) and not list(tmp_path.iterdir())
    opened = open_store("s3://bucket/a/dataset")
    assert isinstance(opened, ObjectStore) and opened.name == "s3://bucket/a/dataset"
    assert opened._bucket.prefix == "a/dataset"
    for url in ("s3://", "ftp://host/x", "az://c/x"):
        with pytest.raises(OutputError, match="is not an object store that can be opened"):
            open_store(url)


def test_a_place_that_cannot_keep_a_dataset_is_refused_by_name(tmp_path):
    (tmp_path / "file").write_text("in the way")
    nobody = S3Store(
        "bucket",
        endpoint="http://127.0.0.1:1",
        region="us-east-1",
        skip_signature=True,
        client_options={"allow_http": True},
        retry_config={"max_retries": 0},
    )
    with s3_server(Bucket(conditional="ignored")) as bucket:
        for place, told in (
            (LocalStore(tmp_path / "file" / "out"), "file/out cannot be written"),
            (
                ObjectStore(bucket, "s3://mine"),
                r"s3://mine does not refuse a second put .* Use a store with conditional puts",
            ),
            (ObjectStore(HTTPStore("http://127.0.0.1:1/"), "http://web"), "http://web does not refuse a second put"),
            (ObjectStore(nobody, "s3://nobody"), "s3://nobody cannot be written"),
        ):
            with pytest.raises(OutputError, match=told):
                place.prepare()


def test_a_store_that_stops_answering_is_told_by_name(monkeypatch):
    def fails(*_, **__):
        raise obstore.exceptions.GenericError("no route to host\nDebug source: ...")

    monkeypatch.setattr(obstore, "put", fails)
    with pytest.raises(MachineError, match=r"^mug/a in memory://mine: no route to host$"):
        ObjectStore(MemoryStore(), "memory://mine").put("mug/a", b"")


HOLD = """
import sys, time
from workers.store.file_system import temporary_folder
with temporary_folder("test") as folder:
    (folder / "rows").write_bytes(b"12")
    print(folder, flush=True)
    time.sleep(600)
"""


def test_a_temporary_folder_is_kept_while_its_process_lives_and_goes_after_it_was_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen([sys.executable, "-c", HOLD], stdout=subprocess.PIPE, text=True, env=environment) as holder:
        folder = holder.stdout.readline().strip()
        remove_abandoned("test")
        assert os.listdir(folder) == ["rows"]
        holder.send_signal(signal.SIGKILL)
    young, old = tmp_path / "verso-test-a", tmp_path / "verso-test-b"
    for made in (young, old):  # without their lock: just being made, or left long ago
        made.mkdir()
    os.utime(old, (0, 0))
    assert os.path.isdir(folder)
    with temporary_folder("test") as mine:
        assert not os.path.isdir(folder) and os.listdir(mine) == []
    assert list(tmp_path.iterdir()) == [young]
