"""Queues in folders and buckets: what is refused, and what several writers at once may not do."""

import itertools
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.errors import CorruptError, InputError
from schemas.queue import MARK_FILE, JobEvent, events_folder, request_path
from services.queue.queue import RESTARTS, JobView, Queue, apply, fold, make_queue, open_queue
from tests.kit.queue_world import ids, queue_of, request_of
from tests.kit.s3_server import Bucket, s3_server
from workers.store.events import event_path
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore

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


def test_a_job_is_read_as_it_was_stored(queue):
    assert queue.ids() == [A]
    assert queue.read(A).request == request_of(A)
    assert not queue.put_request(request_of(A, name="another"))


def test_events_are_kept_in_their_order_and_folded(queue):
    for kind, attempt in (("started", 1), ("began", 1), ("died", 1), ("started", 2)):
        assert queue.append(A, kind, attempt) is not None
    fresh = Queue(queue.store).read(A)
    assert (fresh.state, fresh.attempt, fresh.deaths, fresh.events) == ("running", 2, 1, 4)


def test_of_many_writers_at_once_one_decides(queue):
    won: list[int] = []
    start = threading.Barrier(8)

    def contend(number: int) -> None:
        own = Queue(queue.store)
        start.wait()
        if own.append(A, "started", 1) is not None:
            won.append(number)

    threads = [threading.Thread(target=contend, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1
    assert queue.read(A).events == 1


def test_an_event_that_does_not_apply_is_not_stored(queue):
    queue.append(A, "cancel")
    assert queue.append(A, "started", 1) is None
    assert queue.read(A).events == 1


def test_the_share_is_what_was_said_last(queue):
    assert queue.share() == 1
    queue.put_share(3)
    assert queue.share() == 3
    queue.store.put("share.json", b"{torn")
    assert queue.share() == 1


def test_logs_are_kept_once_and_from_their_end(queue):
    queue.put_log(A, 1, "x" * (2 << 20) + "end")
    queue.put_log(A, 1, "again")
    kept = queue.read_log(A, 1)
    assert kept.endswith("end") and len(kept) == 1 << 20
    assert queue.read_log(A, 2) is None


def test_an_unknown_id_is_told_in_one_line(queue):
    with pytest.raises(InputError, match=f"^[^\n]* has no job {B}: `verso jobs` lists[^\n]*$"):
        queue.read(B)


@pytest.mark.parametrize(
    ("key", "data", "words"),
    [
        (request_path(A), b"{", "is damaged"),
        (request_path(A), b'{"queue": 2}', "is newer than this program"),
        (request_path(A), b'{"queue": 1, "id": "j1"}', "was not written by this program"),
        (event_path(events_folder(A), 0), b"[]", "was not written by this program"),
        (event_path(events_folder(A), 3), b"{}", "lacks an event"),
        (event_path(events_folder(A), 0), b"x" * (2 << 20), "should have less"),
    ],
)
def test_a_damaged_job_is_told_by_file_and_leaves_the_others_alone(tmp_path, key, data, words):
    queue = queue_of(tmp_path / "q", request_of(A), request_of(B))
    queue.store.put(key, data)
    views, faults = queue.read_all(queue.ids())
    assert [view.request.id for view in views] == [B]
    assert words in faults[A] and key.rpartition("/")[0] in faults[A] and "\n" not in faults[A]
    with pytest.raises(CorruptError):
        queue.append(A, "cancel")


def test_a_request_in_the_place_of_another_is_refused(tmp_path):
    queue = queue_of(tmp_path / "q", request_of(A), request_of(B))
    queue.store.put(request_path(A), queue.store.read(request_path(B)))
    with pytest.raises(CorruptError, match="is the request of another job"):
        queue.read(A)


def test_a_new_or_an_empty_folder_becomes_a_queue_and_stays_one(tmp_path):
    make_queue(str(tmp_path / "new"))
    assert open_queue(str(tmp_path / "new")).ids() == []
    assert {path.name for path in (tmp_path / "new").iterdir()} == {MARK_FILE, "_staging"}
    mark = (tmp_path / "new" / MARK_FILE).read_bytes()
    make_queue(str(tmp_path / "new"))
    assert (tmp_path / "new" / MARK_FILE).read_bytes() == mark


def test_many_who_make_one_queue_at_once_all_get_it(tmp_path):
    faults: list[Exception] = []

    def make() -> None:
        try:
            make_queue(str(tmp_path / "q"))
        except Exception as error:
            faults.append(error)

    threads = [threading.Thread(target=make) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert faults == []
    assert open_queue(str(tmp_path / "q")).ids() == []


def test_a_queue_that_another_makes_between_two_looks_is_taken(tmp_path, monkeypatch):
    make_queue(str(tmp_path / "q"))
    asked = []

    def absent_at_first(store, key):
        asked.append(key)
        return None if len(asked) == 1 else real(store, key)

    real = LocalStore.size
    monkeypatch.setattr(LocalStore, "size", absent_at_first)
    assert make_queue(str(tmp_path / "q")).ids() == []
    assert asked[0] == MARK_FILE


def test_what_is_no_queue_is_refused_with_one_line(tmp_path):
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "to_mother.txt").write_text("dear")
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
        assert "\n" not in str(caught.value)
        assert "--queue" in str(caught.value)
    assert list((tmp_path / "letters").iterdir()) == [Path(tmp_path / "letters" / "to_mother.txt")]


REQUEST = request_of("j00000001")


def event(kind: str, attempt: int = 0, **fields: object) -> JobEvent:
    code = {"code": 0} if kind == "ended" and "code" not in fields else {}
    return JobEvent(kind=kind, attempt=attempt, at=0.0, nonce="0" * 32, **code, **fields)


def after(*words: str) -> JobView:
    """The job after events written `kind` or `kind:attempt` or `ended:attempt:code`."""
    events = []
    for word in words:
        kind, *numbers = word.split(":")
        fields = {"code": int(numbers[1])} if len(numbers) > 1 else {}
        events.append(event(kind, int(numbers[0]) if numbers else 0, **fields))
    return fold(REQUEST, events)


@pytest.mark.parametrize(
    ("events", "state"),
    [
        ("", "queued"),
        ("cancel", "cancelled"),
        ("started:1", "running"),
        ("started:1 began:1", "running"),
        ("started:1 began:1 ended:1:0", "done"),
        ("started:1 began:1 ended:1:1", "failed"),
        ("started:1 began:1 ended:1:2", "failed"),
        ("started:1 began:1 died:1", "queued"),
        ("started:1 died:1 started:2 began:2 ended:2:0", "done"),
        ("started:1 began:1 busy:1", "waiting"),
        ("started:1 began:1 busy:1 started:2 began:2", "running"),
        ("started:1 cancel", "cancelling"),
        ("started:1 began:1 cancel stopped:1", "cancelled"),
        ("started:1 began:1 cancel died:1", "cancelled"),
        ("started:1 began:1 cancel busy:1", "cancelled"),
        ("started:1 began:1 cancel ended:1:1", "cancelled"),
        ("started:1 began:1 cancel ended:1:0", "done"),
        ("started:1 died:1 cancel", "cancelled"),
    ],
)
def test_the_state_after_these_events(events, state):
    assert after(*events.split()).state == state


@pytest.mark.parametrize(
    ("events", "late"),
    [
        ("cancel", "started:1"),
        ("started:1", "started:1"),
        ("started:1 began:1", "started:2"),
        ("started:1 began:1", "began:1"),
        ("started:1 cancel", "began:1"),
        ("started:1", "ended:1:0"),
        ("started:1 died:1 started:2", "began:1"),
        ("started:1 began:1 died:1 started:2", "ended:1:0"),
        ("started:1 began:1 died:1", "died:1"),
        ("started:1 began:1 ended:1:0", "died:1"),
        ("started:1 began:1 ended:1:0", "cancel"),
        ("started:1 began:1", "stopped:1"),
        ("started:1 began:1 cancel", "cancel"),
    ],
)
def test_an_event_that_comes_too_late_changes_nothing_but_the_count(events, late):
    before = after(*events.split())
    now = after(*events.split(), late)
    assert now.events == before.events + 1
    assert (now.state, now.attempt, now.began, now.deaths) == (
        before.state,
        before.attempt,
        before.began,
        before.deaths,
    )


def test_a_job_is_taken_up_again_three_times_and_then_lost():
    words: list[str] = []
    states = []
    for attempt in range(1, RESTARTS + 2):
        words += [f"started:{attempt}", f"died:{attempt}"]
        states.append(after(*words).state)
    assert states == ["queued", "queued", "queued", "lost"]
    assert after(*words, "started:5").state == "lost"


def test_waiting_for_a_folder_is_no_death():
    words = list(itertools.chain.from_iterable((f"started:{n}", f"began:{n}", f"busy:{n}") for n in range(1, 9)))
    assert (after(*words).state, after(*words).deaths, after(*words).attempt) == ("waiting", 0, 8)


def test_a_job_claims_its_folder_from_its_first_attempt_to_its_end():
    assert [
        after(*events.split()).claims_folder
        for events in ("", "started:1", "started:1 died:1", "started:1 began:1 busy:1")
    ] == [False, True, True, True]
    assert not after("started:1", "began:1", "ended:1:1").claims_folder


KINDS = st.sampled_from(["started", "began", "busy", "ended", "died", "stopped", "cancel"])


@given(st.lists(st.tuples(KINDS, st.integers(1, 3), st.sampled_from([0, 1, 2])), max_size=14))
def test_whatever_comes_an_ended_job_stays_as_it_is_and_attempts_only_count_up(events):
    view = JobView(REQUEST)
    for kind, attempt, code in events:
        one = event(kind, 0 if kind == "cancel" else attempt, **({"code": code} if kind == "ended" else {}))
        following = apply(view, one)
        assert following == view or not view.ended
        assert view.attempt <= following.attempt <= view.attempt + 1
        assert following.deaths <= following.attempt
        view = following


def test_names_of_events_sort_as_their_numbers():
    folder = events_folder("j00000001")
    assert sorted(event_path(folder, number) for number in (10, 9, 100)) == [
        event_path(folder, number) for number in (9, 10, 100)
    ]
