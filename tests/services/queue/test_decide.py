"""Whose turn it is, and what becomes of drivers."""

from dataclasses import replace
from typing import Any

import pytest

from schemas.queue import submission_id
from services.queue.queue import JobState, JobView
from services.queue.supervise import PAUSES_S, Action, Driver, choose_starts, pause_of, tend_drivers, waiting_for_folder
from tests.kit.queue_world import request_of

A, B, C = "j0000000a", "j0000000b", "j0000000c"


def view(
    job: str, state: JobState = "queued", attempt: int = 0, began: bool = False, deaths: int = 0, **request: object
) -> JobView:
    return replace(JobView(request_of(job, **request)), state=state, attempt=attempt, began=began, deaths=deaths)


def started(*views: JobView, at_once: int = 2, **kwargs: Any) -> list[str]:
    return [action.job for action in choose_starts(views, at_once, **kwargs)]


def test_the_higher_priority_goes_first_and_then_the_older_job():
    jobs = [view(A, submitted=3.0), view(B, submitted=2.0), view(C, submitted=9.0, priority=1)]
    assert started(*jobs, at_once=3) == [C, B, A]
    assert started(*jobs) == [C, B]


def test_jobs_that_run_or_are_being_cancelled_take_their_places():
    assert started(view(A, "running", 1), view(B, "cancelling", 1), view(C)) == []
    assert started(view(A, "running", 1), view(B, "queued", 1, deaths=1), view(C)) == [B]


def test_a_second_job_of_one_folder_waits_until_the_first_has_ended():
    assert started(view(A, out="/o"), view(B, out="/o"), view(C)) == [A, C]
    for state in ("running", "cancelling", "queued", "waiting"):
        assert (
            started(view(A, state, 1, out="/o"), view(B, out="/o", priority=9), is_due=lambda one: one.attempt == 0)
            == []
        )
    assert started(view(A, "failed", 1, out="/o"), view(B, out="/o")) == [B]
    assert waiting_for_folder([view(A, "running", 1, out="/o"), view(B, out="/o"), view(C)]) == {B}


def test_a_pause_keeps_a_job_from_its_turn_and_no_other():
    assert started(view(A, "queued", 1, deaths=1), view(B), at_once=1, is_due=lambda one: one.deaths == 0) == [B]


def test_pauses_grow():
    assert [pause_of(view(A, "queued", n, deaths=n)) for n in range(4)] == [0.0, *PAUSES_S]
    assert list(PAUSES_S) == sorted(PAUSES_S)


@pytest.mark.parametrize(
    ("state", "began", "driver", "deed"),
    [
        ("running", False, None, "hand over"),
        ("running", False, "running", None),
        ("running", False, "over", "note death"),
        ("running", True, "running", None),
        ("running", True, "over", "note death"),
        ("running", True, None, "note death"),
        ("cancelling", True, "running", "stop"),
        ("cancelling", False, "running", "stop"),
        ("cancelling", True, "over", "note stop"),
        ("cancelling", True, None, "note stop"),
    ],
)
def test_what_is_done_about_a_driver(state, began, driver, deed):
    drivers = {submission_id(A, 2): Driver(driver)} if driver else {}
    done = tend_drivers([view(A, state, 2, began)], {submission_id(A, 1): Driver("over"), **drivers})
    assert [(one.deed, one.job, one.attempt) for one in done] == ([(deed, A, 2)] if deed else [])


def test_jobs_without_a_driver_are_left_alone():
    assert (
        tend_drivers([view(A), view(B, "done", 1), view(C, "waiting", 1)], {submission_id(B, 1): Driver("running")})
        == []
    )


def test_a_start_is_the_next_attempt():
    assert choose_starts([view(A, "queued", 2, deaths=2)], 1) == [Action("start", A, 3)]
