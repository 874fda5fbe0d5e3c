"""A queue looked after: turns, deaths, cancelling, and a supervisor that is killed, or not alone, at any step."""

import contextlib
import itertools
from dataclasses import replace
from typing import Any

import pytest

from schemas.errors import RunError
from schemas.queue import submission_id
from services.queue.queue import JobState, JobView, Queue, make_queue
from services.queue.supervise import (
    PAUSES_S,
    Action,
    Driver,
    Rules,
    choose_starts,
    hold_queue,
    pause_of,
    supervise,
    tend_drivers,
    waiting_for_folder,
)
from tests.kit.queue_world import AT_ONCE, DIES, Killed, World, ids, request_of
from tests.kit.s3_server import Bucket, s3_server
from workers.store.objects import ObjectStore

pytestmark = pytest.mark.usefixtures("unflushed")

PLAIN, DYING, CANCELLED, SECOND, LAST = ids(5)
A, B, C = ids(3)
MOST_TICKS = 60


def view(
    job: str, state: JobState = "queued", attempt: int = 0, began: bool = False, deaths: int = 0, **request: object
) -> JobView:
    return replace(JobView(request_of(job, **request)), state=state, attempt=attempt, began=began, deaths=deaths)


def started(*views: JobView, at_once: int = 2, **kwargs: Any) -> list[str]:
    return [action.job for action in choose_starts(views, at_once, **kwargs)]


def test_the_next_turn_is_by_priority_and_age_while_there_is_room_and_never_two_in_a_folder():
    jobs = [view(A, submitted=3.0), view(B, submitted=2.0), view(C, submitted=9.0, priority=1)]
    assert started(*jobs, at_once=3) == [C, B, A]
    assert started(*jobs) == [C, B]
    assert started(view(A, "running", 1), view(B, "cancelling", 1), view(C)) == []
    assert started(view(A, "running", 1), view(B, "queued", 1, deaths=1), view(C)) == [B]
    assert started(view(A, "queued", 1, deaths=1), view(B), at_once=1, is_due=lambda one: one.deaths == 0) == [B]
    assert choose_starts([view(A, "queued", 2, deaths=2)], 1) == [Action("start", A, 3)]
    assert started(view(A, out="/o"), view(B, out="/o"), view(C)) == [A, C]
    for state in ("running", "cancelling", "queued", "waiting"):
        first, second = view(A, state, 1, out="/o"), view(B, out="/o", priority=9)
        assert started(first, second, is_due=lambda one: one.attempt == 0) == []
    assert started(view(A, "failed", 1, out="/o"), view(B, out="/o")) == [B]
    assert waiting_for_folder([view(A, "running", 1, out="/o"), view(B, out="/o"), view(C)]) == {B}
    assert [pause_of(view(A, "queued", n, deaths=n)) for n in range(4)] == [0.0, *PAUSES_S] == sorted([0.0, *PAUSES_S])


def test_a_supervisor_that_is_asked_to_ends_with_the_last_job_and_names_those_that_failed(tmp_path, monkeypatch):
    world = World(make_queue(str(tmp_path / "q")))
    for job in (A, B, C):
        world.submit(job)
    assert world.queue.append(C, "cancel") is not None  # before anybody looked: it ended, and waits for nobody

    def pass_time(seconds: float) -> None:
        assert world.ticks < MOST_TICKS
        world.tick()
        if world.queue.read(B).began:
            world.queue.append(B, "ended", 1, code=1)

    monkeypatch.setattr("services.queue.supervise.time.sleep", pass_time)
    rules = Rules(1, ["verso"], until_empty=True)
    assert supervise(world.queue, contextlib.nullcontext(world), rules, print) == [B]
    assert [world.queue.read(job).state for job in (A, B, C)] == ["done", "failed", "cancelled"]
    assert world.queue.has_log(A, 1) and world.queue.has_log(B, 1)
    assert supervise(world.queue, contextlib.nullcontext(world), rules, print) == []  # at once, where there is nothing


def test_what_is_done_about_a_driver():
    for state, began, driver, deed in [
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
        ("queued", False, None, None),
        ("done", True, "running", None),
        ("waiting", True, None, None),
    ]:
        drivers = {submission_id(A, 2): Driver(driver)} if driver else {}
        done = tend_drivers([view(A, state, 2, began)], {submission_id(A, 1): Driver("over"), **drivers})
        assert [(one.deed, one.job, one.attempt) for one in done] == ([(deed, A, 2)] if deed else [])


# ------------------------------------------------------------------------------------------- a world of five jobs


def world_of(folder, queue: Queue | None = None) -> World:
    """Five jobs: one plain, one whose first driver dies, one to be cancelled while it runs, two of one folder."""
    folder.mkdir(exist_ok=True)
    world = World(queue or make_queue(str(folder / "q")))
    world.submit(PLAIN, priority=2)
    world.submit(DYING, priority=2, name=f"{DIES}-once", submitted=2.0)
    world.submit(CANCELLED, priority=1)
    world.submit(SECOND, out="/out/both", submitted=3.0)
    world.submit(LAST, out="/out/both", submitted=4.0)
    return world


def play(world: World, look) -> None:
    """Until every job has ended: looks, work, and a cancel as soon as that job runs."""
    for _ in range(MOST_TICKS):
        look()
        world.tick()
        if world.is_running(CANCELLED) and world.queue.read(CANCELLED).state == "running":
            world.queue.append(CANCELLED, "cancel")
        if all(world.queue.read(job).ended for job in world.queue.ids()):
            look()
            return
    raise AssertionError(world.states_of_jobs())


def check_ends(world: World) -> None:
    ends = {PLAIN: "done", DYING: "done", CANCELLED: "cancelled", SECOND: "done", LAST: "done"}
    assert world.states_of_jobs() == ends
    assert set(world.began.values()) == {1}  # no attempt began twice
    assert world.began[submission_id(DYING, 1)] == 1
    assert world.queue.read(DYING).deaths == 1
    assert world.most_at_once <= AT_ONCE
    for job in ends:
        assert all(world.queue.has_log(job, attempt) for attempt in range(1, world.queue.read(job).attempt + 1))


def at_each_step(tmp_path, happens) -> None:
    """Plays the world once for each of its effects; `happens(world, supervisors)` at this effect; the last one looks."""
    whole, effects, said = world_of(tmp_path / "whole"), list[int](), list[str]()
    whole.effect = lambda: effects.append(whole.ticks)
    supervisor = whole.supervisor(said.append)
    supervisor.look()
    assert whole.queue.share() == 2
    play(whole, supervisor.look)
    check_ends(whole)
    assert whole.handed_over.index(submission_id(SECOND, 1)) < whole.handed_over.index(submission_id(LAST, 1))
    assert f"job {DYING}, attempt 1: its driver ended without telling how; it is taken up again in 10 s" in said
    assert f"job {CANCELLED}: cancelled; what it committed is kept" in said
    assert whole.queue.share() == 1 and len(effects) > 20
    for step in range(len(effects)):
        world = world_of(tmp_path / str(step))
        supervisors = [world.supervisor()]
        left = itertools.chain(itertools.repeat(False, step), [True], itertools.repeat(False))

        def effect(world=world, supervisors=supervisors, left=left) -> None:
            if next(left):
                happens(world, supervisors)

        def look(world=world, supervisors=supervisors) -> None:
            try:
                supervisors[-1].look()
            except Killed:
                supervisors.append(world.supervisor())

        world.effect = effect
        play(world, look)
        assert not next(left), step
        check_ends(world)


@pytest.mark.minute
def test_a_supervisor_killed_at_any_step_loses_nothing_and_starts_nothing_twice(tmp_path):
    def die(world, supervisors) -> None:
        raise Killed

    at_each_step(tmp_path, die)


@pytest.mark.minute
def test_a_second_supervisor_that_acts_in_the_middle_of_any_step_or_in_turn_doubles_nothing(tmp_path):
    at_each_step(tmp_path, lambda world, supervisors: world.supervisor().look())
    world = world_of(tmp_path / "in turn")
    turns = itertools.cycle([world.supervisor().look, world.supervisor().look])
    play(world, lambda: next(turns)())
    check_ends(world)


@pytest.mark.minute
def test_a_head_that_comes_back_and_knows_nothing_costs_an_attempt_and_no_job(tmp_path):
    for tick in range(1, 12):
        world = world_of(tmp_path / str(tick))
        supervisor, ticks = world.supervisor(), itertools.count()

        def look(world=world, supervisor=supervisor, ticks=ticks, tick=tick) -> None:
            if next(ticks) == tick:
                world.restart()
            supervisor.look()

        play(world, look)
        ends = world.states_of_jobs()
        assert ends.pop(CANCELLED) == "cancelled"
        assert set(ends.values()) == {"done"}
        assert set(world.began.values()) == {1}


def test_while_ray_does_not_answer_nothing_is_decided_and_that_is_told_once(tmp_path):
    world, said = world_of(tmp_path), []
    supervisor = world.supervisor(said.append)
    supervisor.look()
    world.tick()
    told, before = list(said), world.states_of_jobs()
    world.answers = False
    for _ in range(5):
        supervisor.look()
    assert world.states_of_jobs() == before
    assert said == [*told, "Ray's job API does not answer; it is asked again and again"]
    world.answers = True
    supervisor.look()
    assert said[len(told) + 1] == "all answer again"
    play(world, supervisor.look)


def test_a_dead_driver_is_followed_by_another_after_a_pause_and_by_none_after_three_more(tmp_path):
    world, clock = World(make_queue(str(tmp_path / "q"))), [0.0]
    world.submit(PLAIN)
    supervisor = world.supervisor()
    supervisor._clock = lambda: clock[0]
    supervisor.look()
    world.end(PLAIN, 1)
    supervisor.look()
    for clock[0], attempts in ((9.0, 1), (10.0, 2)):
        supervisor.look()
        assert world.queue.read(PLAIN).attempt == attempts
    for _ in range(40):
        clock[0] += 1000.0
        supervisor.look()
        world.known = dict.fromkeys(world.known, Driver("over"))
    assert world.queue.read(PLAIN).state == "lost"
    assert len(world.handed_over) == 4


def test_a_cancelled_job_that_waits_never_starts_and_a_damaged_one_is_told_once_and_stops_no_other(tmp_path):
    world, said = world_of(tmp_path), []
    world.queue.append(DYING, "cancel")
    world.queue.store.put(f"jobs/{LAST}/request.json", b"{")
    supervisor = world.supervisor(said.append)
    for _ in range(30):
        supervisor.look()
        world.tick()
    assert [world.queue.read(job).state for job in (PLAIN, DYING)] == ["done", "cancelled"]
    assert not any(DYING in one for one in world.handed_over)
    assert sum(f"job {LAST} is left alone" in line for line in said) == 1


def test_a_second_supervisor_is_refused_by_name(tmp_path):
    world = world_of(tmp_path)
    refused = pytest.raises(RunError, match=r"^another supervisor works here: .* by process \d+ on")
    with hold_queue(world.queue), refused, hold_queue(world.queue):
        pass


@pytest.mark.minute
def test_five_jobs_come_to_their_ends_in_a_bucket_that_fails_one_request_in_ten(tmp_path):
    bucket = Bucket()
    bucket.share, bucket.faults = 0.1, ("500", "503", "503 when done", "reset", "reset when done")
    with s3_server(bucket) as client:
        world = world_of(tmp_path, Queue(ObjectStore(client, "s3://mine")))
        play(world, world.supervisor().look)
        check_ends(world)
    assert bucket.requests["fault"] > 20
    events = [key for key in bucket.objects if "/events/" in key]
    assert len(events) > 15
    assert {bucket.puts[key] for key in events} == {1}
