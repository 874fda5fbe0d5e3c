"""A queue looked after: turns, deaths, cancelling, and a supervisor that is killed, or not alone, at any step."""

import itertools
import shlex
import subprocess

import pytest

from schemas.errors import RunError
from schemas.queue import submission_id
from services.queue.queue import Queue, make_queue
from services.queue.supervise import Driver, build_entrypoint, hold_queue
from tests.kit.faults import unflushed
from tests.kit.queue_world import AT_ONCE, DIES, Killed, World, ids
from tests.kit.s3_server import Bucket, s3_server
from workers.store.objects import ObjectStore

__all__ = ["unflushed"]
pytestmark = pytest.mark.usefixtures("unflushed")

PLAIN, DYING, CANCELLED, SECOND, LAST = ids(5)
MOST_TICKS = 60


def world_of(folder, queue: Queue | None = None) -> World:
    """Five jobs: one plain, one whose first driver dies, one to be cancelled while it runs, two of one folder."""
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
    assert world.states_of_jobs() == {
        PLAIN: "done",
        DYING: "done",
        CANCELLED: "cancelled",
        SECOND: "done",
        LAST: "done",
    }
    assert set(world.began.values()) == {1}  # no attempt began twice
    assert world.began[submission_id(DYING, 1)] == 1
    assert world.queue.read(DYING).deaths == 1
    assert world.most_at_once <= AT_ONCE
    for job in (PLAIN, DYING, CANCELLED, SECOND, LAST):
        assert all(world.queue.has_log(job, attempt) for attempt in range(1, world.queue.read(job).attempt + 1))


def test_five_jobs_come_to_their_ends(tmp_path):
    world, said = world_of(tmp_path), []
    play(world, world.supervisor(said.append).look)
    check_ends(world)
    assert world.handed_over == [
        submission_id(*one) for one in [(PLAIN, 1), (DYING, 1), (CANCELLED, 1), (DYING, 2), (SECOND, 1), (LAST, 1)]
    ] or world.handed_over.index(submission_id(SECOND, 1)) < world.handed_over.index(submission_id(LAST, 1))
    assert f"job {DYING}, attempt 1: its driver ended without telling how; it is taken up again in 10 s" in said
    assert f"job {CANCELLED}: cancelled; what it committed is kept" in said
    assert world.queue.share() == 1


def count_effects(folder) -> int:
    world, effects = world_of(folder), []
    world.effect = lambda: effects.append(world.ticks)
    play(world, world.supervisor().look)
    return len(effects)


def test_a_supervisor_killed_at_any_step_loses_nothing_and_starts_nothing_twice(tmp_path):
    (tmp_path / "whole").mkdir()
    steps = count_effects(tmp_path / "whole")
    assert steps > 20
    for step in range(steps):
        (tmp_path / str(step)).mkdir()
        world = world_of(tmp_path / str(step))
        left = itertools.chain(itertools.repeat(False, step), [True], itertools.repeat(False))

        def die_once(left=left) -> None:
            if next(left):
                raise Killed

        world.effect = die_once
        supervisors = [world.supervisor()]

        def look(world=world, supervisors=supervisors) -> None:
            try:
                supervisors[-1].look()
            except Killed:
                supervisors.append(world.supervisor())

        play(world, look)
        assert len(supervisors) == 2, step
        check_ends(world)


def test_a_second_supervisor_that_acts_in_the_middle_of_any_step_of_the_first_doubles_nothing(tmp_path):
    (tmp_path / "whole").mkdir()
    for step in range(count_effects(tmp_path / "whole")):
        (tmp_path / str(step)).mkdir()
        world = world_of(tmp_path / str(step))
        first, second = world.supervisor(), world.supervisor()
        left = itertools.chain(itertools.repeat(False, step), [True], itertools.repeat(False))

        def interfere(left=left, second=second) -> None:
            if next(left):
                second.look()

        world.effect = interfere
        play(world, first.look)
        assert not next(left)
        check_ends(world)


def test_two_supervisors_that_look_in_turn_double_nothing(tmp_path):
    world = world_of(tmp_path)
    turns = itertools.cycle([world.supervisor().look, world.supervisor().look])
    play(world, lambda: next(turns)())
    check_ends(world)


@pytest.mark.parametrize("tick", range(1, 12))
def test_a_head_that_comes_back_and_knows_nothing_costs_an_attempt_and_no_job(tmp_path, tick):
    world = world_of(tmp_path)
    supervisor = world.supervisor()
    ticks = itertools.count()

    def look() -> None:
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
    told = list(said)
    world.answers = False
    before = world.states_of_jobs()
    for _ in range(5):
        supervisor.look()
    assert world.states_of_jobs() == before
    assert said == [*told, "Ray's job API does not answer; it is asked again and again"]
    world.answers = True
    supervisor.look()
    assert said[len(told) + 1] == "all answer again"
    play(world, supervisor.look)


def test_a_job_whose_drivers_always_die_is_lost_after_three_more_tries(tmp_path):
    world = World(make_queue(str(tmp_path / "q")))
    world.submit(PLAIN)
    supervisor = world.supervisor()
    for _ in range(40):
        supervisor.look()
        world.ticks += 1
        for submission in world.known:
            world.known[submission] = Driver("over")
    assert world.queue.read(PLAIN).state == "lost"
    assert len(world.handed_over) == 4


def test_a_pause_is_kept(tmp_path):
    world = World(make_queue(str(tmp_path / "q")))
    world.submit(PLAIN)
    clock = [0.0]
    supervisor = world.supervisor()
    supervisor._clock = lambda: clock[0]
    supervisor.look()
    world.end(PLAIN, 1)
    supervisor.look()
    for seconds, attempts in ((9.0, 1), (10.0, 2)):
        clock[0] = seconds
        supervisor.look()
        assert world.queue.read(PLAIN).attempt == attempts


def test_a_cancelled_job_that_waits_never_starts(tmp_path):
    world = world_of(tmp_path)
    world.queue.append(PLAIN, "cancel")
    play(world, world.supervisor().look)
    assert world.queue.read(PLAIN).state == "cancelled"
    assert not any(PLAIN in one for one in world.handed_over)


def test_a_damaged_job_is_told_once_and_stops_no_other(tmp_path):
    world, said = world_of(tmp_path), []
    world.queue.store.put(f"jobs/{LAST}/request.json", b"{")
    supervisor = world.supervisor(said.append)
    for _ in range(30):
        supervisor.look()
        world.tick()
    assert world.queue.read(PLAIN).state == "done"
    assert sum(f"job {LAST} is left alone" in line for line in said) == 1


def test_the_share_follows_the_number_of_jobs_that_run(tmp_path):
    world = world_of(tmp_path)
    supervisor = world.supervisor()
    supervisor.look()
    assert world.queue.share() == 2
    play(world, supervisor.look)
    assert world.queue.share() == 1


@pytest.mark.parametrize("place", ["/q", "/it's $(touch x) `touch x`; touch x", "/a\nb&&touch x", 's3://b/ü "x"'])
def test_the_entrypoint_gives_the_shell_nothing_to_do(place, tmp_path):
    told = subprocess.run(
        build_entrypoint(["/opt/my verso", "-P"], place, PLAIN, 3).replace("'/opt/my verso'", "printf '%s\\0'"),
        shell=True,
        cwd=tmp_path,
        capture_output=True,
        check=True,
    )
    assert told.stdout.decode().split("\0")[:-1] == ["-P", "drive", PLAIN, "3", "--queue", place]
    assert list(tmp_path.iterdir()) == []
    assert shlex.split(build_entrypoint(["verso"], place, PLAIN, 3))[0] == "verso"


def test_a_second_supervisor_is_refused_by_name(tmp_path):
    world = world_of(tmp_path)
    refused = pytest.raises(RunError, match=r"^another supervisor works here: .* by process \d+ on")
    with hold_queue(world.queue), refused, hold_queue(world.queue):
        pass


def test_five_jobs_come_to_their_ends_in_a_bucket_that_fails_one_request_in_ten(tmp_path):
    bucket = Bucket()
    bucket.share, bucket.faults = 0.1, ("500", "503", "503 when done", "reset", "reset when done")
    with s3_server(bucket) as client:
        store = ObjectStore(client, "s3://mine")
        world = world_of(tmp_path, Queue(store))
        play(world, world.supervisor().look)
        check_ends(world)
    assert bucket.requests["fault"] > 20
    events = [key for key in bucket.objects if "/events/" in key]
    assert len(events) > 15
    assert {bucket.puts[key] for key in events} == {1}
