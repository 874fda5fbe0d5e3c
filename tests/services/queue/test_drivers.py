"""Drivers and what people see of them: one attempt at a job, Ray's job API where it is absent, rows and logs."""

import socket

import pytest

from schemas.errors import CorruptError, InUseError, MachineError, OutputError, RunError
from schemas.queue import submission_id
from services.queue.drivers import EVERY_S, Ending, RayDrivers, drive, sharing_of
from services.queue.listing import follow_logs, format_rows, header, list_jobs, read_logs
from tests.kit.queue_world import FakeDrivers, ids, queue_of, request_of
from tests.made_up_datasets import dataset_at

A, B, C, D = ids(4)


@pytest.fixture
def queue(tmp_path):
    made = queue_of(tmp_path / "q", request_of(A))
    made.append(A, "started", 1)
    return made


def test_an_address_where_nothing_answers_is_told_in_one_line():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{unused.getsockname()[1]}"
        drivers, one = RayDrivers(address), submission_id(A, 1)
        for ask in (drivers.states, lambda: drivers.stop(one), lambda: drivers.log(one)):
            told = f"^--address {address}: Ray's job API does not answer there[^\n]*$"
            with pytest.raises(MachineError, match=told):
                ask()


def test_a_driver_gets_the_request_and_tells_its_end(queue):
    asked = []

    def work(request):
        asked.append(request)
        assert queue.read(A).began
        return Ending(0, scenes=8, digest="d" * 64)

    assert drive(queue, A, 1, work) == 0
    view = queue.read(A)
    assert asked == [request_of(A)]
    assert (view.state, view.scenes, view.digest) == ("done", 8, "d" * 64)


IN_USE = InUseError("/out/a is in use by process 7 on host: wait", "/out/a", "process 7 on host")


@pytest.mark.parametrize(
    ("error", "state", "said"),
    [
        (OutputError("belongs to another job\nkeys"), "failed", "belongs to another job keys"),
        (CorruptError("torn"), "failed", "torn"),
        (RunError("1 %"), "failed", "1 %"),
        (KeyboardInterrupt(), "running", ""),
        (SystemExit(1), "running", ""),
        (OSError("no route"), "running", ""),
        (ZeroDivisionError(), "running", ""),
        (IN_USE, "waiting", str(IN_USE)),
    ],
)
def test_what_a_command_says_is_an_end_a_folder_in_use_is_waited_for_and_a_bug_counts_as_a_death(
    queue, error, state, said
):
    def work(request):
        raise error

    with pytest.raises(type(error)):
        drive(queue, A, 1, work)
    view = queue.read(A)
    assert (view.state, view.note, view.deaths, view.began) == (state, said, 0, True)
    assert view.code == (error.exit_code if state == "failed" else None)


def test_a_driver_whose_turn_it_is_not_does_nothing(tmp_path):
    for number, before in enumerate(["began:1", "cancel", "died:1", "died:1 started:2"]):
        queue = queue_of(tmp_path / str(number), request_of(A))
        for word in f"started:1 {before}".split():
            kind, _, attempt = word.partition(":")
            queue.append(A, kind, int(attempt or 0))
        events = queue.read(A).events
        with pytest.raises(RunError, match=f"job {A} is .*there is nothing to do for attempt 1"):
            drive(queue, A, 1, lambda request: pytest.fail("it worked"))
        assert queue.read(A).events == events


def test_the_share_is_read_every_few_seconds_and_survives_a_store_that_fails(tmp_path):
    queue, now = queue_of(tmp_path / "q"), [0.0]
    sharing = sharing_of(queue, lambda: now[0])
    seen = []
    for now[0], told in ((0.0, 2), (EVERY_S - 0.1, 3), (EVERY_S, 3), (2 * EVERY_S, 4), (3 * EVERY_S, None)):
        if told is None:
            (tmp_path / "q" / "share.json").unlink()
            (tmp_path / "q" / "share.json").mkdir()  # reading it raises
        else:
            queue.put_share(told)
        seen.append(sharing())
    assert seen == [2, 2, 3, 4, 4]


def test_a_row_for_each_job_in_the_order_of_its_turn_also_of_a_damaged_one(tmp_path):
    made = dataset_at(tmp_path / "made", 0, 2)
    queue = queue_of(
        tmp_path / "q",
        request_of(A, submitted=1.0, scenes=2),
        request_of(B, submitted=2.0, out=made.name, scenes=9),
        request_of(C, submitted=3.0, priority=5),
        request_of(D, submitted=4.0, out=made.name, priority=1),
        request_of("j0000000f"),
    )
    queue.store.put("jobs/j0000000f/request.json", b"{")
    for job in (A, B):
        queue.append(job, "started", 1)
        queue.append(job, "began", 1)
    queue.append(A, "ended", 1, code=1, note="50 % of the scenes failed", scenes=2)
    *rows, damaged = list_jobs(queue, 64.0)
    assert (damaged.id, damaged.state) == ("j0000000f", "unreadable")
    assert [(row.id, row.state, row.attempts, row.scenes_done, row.scenes_asked, row.age_s) for row in rows] == [
        (B, "running", 1, 2, 9, 62.0),
        (C, "queued", 0, 0, 8, 61.0),
        (D, "waiting", 0, 0, 8, 60.0),
        (A, "failed", 1, 2, 2, 63.0),
    ]
    lines = format_rows(rows)
    assert lines[0].split() == ["id", "name", "priority", "state", "attempts", "scenes", "age", "out"]
    assert lines[1].split() == [B, "mugs", "0", "running", "1", "2/9", "1", "min", made.name]
    assert "waiting for its folder" in lines[3]
    assert lines[5] == "    50 % of the scenes failed"


def test_the_kept_copy_of_a_log_comes_before_ray_and_is_there_without_it(queue):
    drivers, said = FakeDrivers(), []
    for kind, attempt in (("died", 1), ("started", 2), ("began", 2)):
        queue.append(A, kind, attempt)
    queue.put_log(A, 1, "first\n")
    drivers.hand_over(submission_id(A, 2), ["verso"])
    both = {1: "first\n", 2: f"log of verso-{A}-2\n"}
    assert read_logs(queue, drivers, queue.read(A), said.append) == both
    assert said == []
    drivers.answers = False
    assert read_logs(queue, drivers, queue.read(A), said.append) == {1: "first\n"}
    assert said == ["attempt 2: no copy of its log is in the queue yet, and Ray's job API does not answer"]


def test_following_shows_each_line_once_over_a_death_until_the_end(queue):
    drivers = FakeDrivers()
    first, second = submission_id(A, 1), submission_id(A, 2)

    def write(submission: str, text: str) -> None:
        drivers.logs[submission] = drivers.logs.get(submission, "") + text

    script = iter(
        [
            lambda: (drivers.hand_over(first, []), write(first, "one\n")),
            lambda: write(first, "two\n"),
            lambda: (write(first, "three\n"), queue.append(A, "died", 1), queue.append(A, "started", 2)),
            lambda: (drivers.hand_over(second, []), write(second, "four\n"), queue.append(A, "began", 2)),
            lambda: (write(second, "five\n"), queue.append(A, "ended", 2, code=0)),
        ]
    )
    shown = "".join(follow_logs(queue, drivers, A, print, lambda seconds: next(script)()))
    assert shown == f"{header(1)}one\ntwo\nthree\n{header(2)}four\nfive\n"
