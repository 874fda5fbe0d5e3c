"""Queues in folders and buckets: a job's state after its events, what is refused, and what several writers may not do."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.errors import CorruptError, InputError
from schemas.queue import MARK_FILE, JobEvent, events_folder, request_path
from services.queue.queue import RESTARTS, JobView, Queue, apply, fold, make_queue, open_queue
from tests.kit.faults import in_threads
from tests.kit.queue_world import ids, queue_of, request_of
from tests.kit.s3_server import Bucket, s3_server
from workers.store.objects import ObjectStore
from workers.store.store import event_path

A, B = ids(2)


@pytest.fixture(params=["folder", "bucket"])
def queue(request, tmp_path):
    if request.param == "folder":
        yield queue_of(tmp_path / "q", request_of(A))
        return
    with s3_server(Bucket()) as client:
        made = Queue(ObjectStore(client, "s3://mine"))
        assert made.put_request(request_of(A))
        yield made


def test_a_job_and_its_events_are_read_as_they_were_stored_and_none_that_does_not_apply(queue):
    assert queue.ids() == [A]
    assert not queue.put_request(request_of(A, name="another"))
    for kind, attempt in (("started", 1), ("began", 1), ("died", 1), ("started", 2)):
        assert queue.append(A, kind, attempt) is not None
    assert queue.append(A, "started", 2) is None
    fresh = Queue(queue.store).read(A)
    assert fresh.request == request_of(A)
    assert (fresh.state, fresh.attempt, fresh.deaths, fresh.events) == ("running", 2, 1, 4)
    with pytest.raises(InputError, match=f"^[^\n]* has no job {B}: `verso jobs` lists[^\n]*$"):
        queue.read(B)


def test_the_share_is_what_was_said_last_and_logs_are_kept_once_from_their_end(queue):
    assert queue.share() == 1
    queue.put_share(3)
    assert queue.share() == 3
    queue.store.put("share.json", b"{torn")
    assert queue.share() == 1
    queue.put_log(A, 1, "x" * (2 << 20) + "end")
    queue.put_log(A, 1, "again")
    kept = queue.read_log(A, 1)
    assert kept.endswith("end") and len(kept) == 1 << 20
    assert queue.read_log(A, 2) is None


def test_a_damaged_job_is_told_by_file_and_leaves_the_others_alone(tmp_path):
    event = events_folder(A)
    for number, (key, data, words) in enumerate(
        [
            (request_path(A), b"{", "was not written by this program"),
            (request_path(A), b'{"queue": 2}', "is newer than this program"),
            (request_path(A), b'{"queue": 1, "id": "j1"}', "was not written by this program"),
            (request_path(A), None, "is the request of another job"),
            (event_path(event, 0), b"[]", "was not written by this program"),
            (event_path(event, 3), b"{}", "lacks an event"),
            (event_path(event, 0), b"x" * (2 << 20), "no more are read"),
            (request_path(A), Path.mkdir, "is a folder"),
            (request_path(A), os.mkfifo, "is a pipe"),
            (event_path(event, 0), os.mkfifo, "is a pipe"),
            (request_path(A), lambda place: place.symlink_to("/dev/zero"), "is a device"),
        ]
    ):
        queue = queue_of(tmp_path / str(number), request_of(A), request_of(B))
        if callable(data):
            place = tmp_path / str(number) / key
            place.parent.mkdir(exist_ok=True)
            place.unlink(missing_ok=True)
            data(place)
        else:
            queue.store.put(key, queue.store.read(request_path(B)) if data is None else data)
        views, faults = queue.read_all(queue.ids())
        assert [view.request.id for view in views] == [B]
        assert words in faults[A] and key.rpartition("/")[0] in faults[A] and "\n" not in faults[A]
        with pytest.raises(CorruptError):
            queue.append(A, "cancel")


def test_a_new_or_an_empty_folder_becomes_a_queue_and_stays_one_also_where_many_make_it(tmp_path):
    in_threads(*[lambda: make_queue(str(tmp_path / "new"))] * 8)
    assert open_queue(str(tmp_path / "new")).ids() == []
    assert {path.name for path in (tmp_path / "new").iterdir()} == {MARK_FILE, "_staging"}
    mark = (tmp_path / "new" / MARK_FILE).read_bytes()
    make_queue(str(tmp_path / "new"))
    assert (tmp_path / "new" / MARK_FILE).read_bytes() == mark


def test_what_is_no_queue_is_refused_with_one_line(tmp_path):
    letter = tmp_path / "letters" / "to_mother.txt"
    letter.parent.mkdir()
    letter.write_text("dear")
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("x")
    for opener, name, words in [
        (open_queue, "nowhere", "there is no such folder"),
        (open_queue, "letters", f"holds no {MARK_FILE}"),
        (open_queue, "empty", f"holds no {MARK_FILE}"),
        (open_queue, "file", "there is no such folder"),
        (make_queue, "letters", "to_mother.txt"),
        (make_queue, "nowhere/deep", "there is no folder"),
        (make_queue, "file", "Not a directory"),
    ]:
        with pytest.raises(InputError, match=words) as caught:
            opener(str(tmp_path / name))
        assert "\n" not in str(caught.value) and "--queue" in str(caught.value)
    assert list(letter.parent.iterdir()) == [letter]


# ------------------------------------------------------------------------------------------- a job after its events


def event(kind: str, attempt: int = 0, code: int = 0) -> JobEvent:
    told = {"code": code} if kind == "ended" else {}
    return JobEvent(kind=kind, attempt=attempt, at=0.0, nonce="0" * 32, **told)


def after(events: str) -> JobView:
    """The job after events written `kind` or `kind:attempt` or `ended:attempt:code`."""
    words = (word.split(":") for word in events.split())
    return fold(request_of(A), [event(kind, *map(int, numbers)) for kind, *numbers in words])


STATES = {
    "": "queued",
    "cancel": "cancelled",
    "started:1": "running",
    "started:1 began:1": "running",
    "started:1 began:1 ended:1:0": "done",
    "started:1 began:1 ended:1:1": "failed",
    "started:1 began:1 ended:1:2": "failed",
    "started:1 began:1 died:1": "queued",
    "started:1 died:1 started:2 began:2 ended:2:0": "done",
    "started:1 began:1 busy:1": "waiting",
    "started:1 began:1 busy:1 started:2 began:2": "running",
    "started:1 cancel": "cancelling",
    "started:1 began:1 cancel stopped:1": "cancelled",
    "started:1 began:1 stopped:1": "queued",
    "started:1 began:1 cancel died:1": "cancelled",
    "started:1 began:1 cancel busy:1": "cancelled",
    "started:1 began:1 cancel ended:1:1": "cancelled",
    "started:1 began:1 cancel ended:1:0": "done",
    "started:1 died:1 cancel": "cancelled",
}
LATE = [
    ("cancel", "started:1"),
    ("started:1", "started:1 ended:1:0"),
    ("started:1 began:1", "started:2 began:1"),
    ("started:1 cancel", "began:1"),
    ("started:1 died:1 started:2", "began:1"),
    ("started:1 began:1 died:1 started:2", "ended:1:0"),
    ("started:1 began:1 died:1", "died:1 stopped:1"),
    ("started:1 began:1 ended:1:0", "died:1 cancel"),
    ("started:1 began:1 cancel", "cancel"),
]
"""Events, and others that come too late after them."""


def test_the_state_after_events_and_that_those_that_come_too_late_change_nothing_but_the_count():
    assert {events: after(events).state for events in STATES} == STATES
    for events, late in LATE:
        before = after(events)
        for one in late.split():
            now = after(f"{events} {one}")
            assert now.events == before.events + 1
            for name in ("state", "attempt", "began", "deaths"):
                assert getattr(now, name) == getattr(before, name), (events, one)


def test_a_job_is_taken_up_again_three_times_and_then_lost_but_waiting_for_a_folder_is_no_death():
    deaths = [" ".join(f"started:{n} died:{n}" for n in range(1, last + 1)) for last in range(1, RESTARTS + 2)]
    assert [after(words).state for words in deaths] == ["queued", "queued", "queued", "lost"]
    assert after(f"{deaths[-1]} started:5").state == "lost"
    waited = after(" ".join(f"started:{n} began:{n} busy:{n}" for n in range(1, 9)))
    assert (waited.state, waited.deaths, waited.attempt) == ("waiting", 0, 8)


KINDS = st.sampled_from(["started", "began", "busy", "ended", "died", "stopped", "cancel"])


@given(st.lists(st.tuples(KINDS, st.integers(1, 3), st.sampled_from([0, 1, 2])), max_size=14))
def test_whatever_comes_an_ended_job_stays_as_it_is_and_attempts_only_count_up(events):
    view = JobView(request_of(A))
    for kind, attempt, code in events:
        following = apply(view, event(kind, 0 if kind == "cancel" else attempt, code))
        assert following == view or not view.ended
        assert view.attempt <= following.attempt <= view.attempt + 1
        assert following.deaths <= following.attempt
        view = following
