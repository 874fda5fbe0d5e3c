"""States of a job as its events come, in order and out of it."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.queue import JobEvent
from services.queue.queue import RESTARTS, JobView, apply, fold
from tests.kit.queue_world import request_of

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
