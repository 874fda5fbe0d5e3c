"""What `verso jobs` shows."""

import pytest

from schemas.errors import CorruptError
from schemas.queue import submission_id
from services.queue.listing import follow_logs, format_rows, header, list_jobs, read_logs
from tests.datasets import make_dataset
from tests.kit.queue_world import FakeDrivers, ids, queue_of, request_of

A, B, C, D = ids(4)


def test_a_row_for_each_job_in_the_order_of_its_turn(tmp_path):
    made, _ = make_dataset(tmp_path / "made")
    queue = queue_of(
        tmp_path / "q",
        request_of(A, submitted=1.0, scenes=2),
        request_of(B, submitted=2.0, out=made.name, scenes=9),
        request_of(C, submitted=3.0, priority=5),
        request_of(D, submitted=4.0, out=made.name, priority=1),
    )
    for job in (A, B):
        queue.append(job, "started", 1)
        queue.append(job, "began", 1)
    queue.append(A, "ended", 1, code=1, note="50 % of the scenes failed", scenes=2)
    rows = list_jobs(queue, 64.0)
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


def test_a_damaged_job_has_a_row_that_says_so(tmp_path):
    queue = queue_of(tmp_path / "q", request_of(A))
    queue.store.put(f"jobs/{A}/request.json", b"{")
    (row,) = list_jobs(queue)
    assert (row.id, row.state) == (A, "unreadable")
    with pytest.raises(CorruptError):
        queue.read(A)


(A_test_logs,) = ids(1)


def test_the_kept_copy_comes_before_ray_and_is_there_without_it(tmp_path):
    queue, drivers, said = queue_of(tmp_path / "q", request_of(A_test_logs)), FakeDrivers(), []
    for event in ("started:1", "died:1", "started:2", "began:2"):
        kind, _, attempt = event.partition(":")
        queue.append(A_test_logs, kind, int(attempt))
    queue.put_log(A_test_logs, 1, "first\n")
    drivers.hand_over(submission_id(A_test_logs, 2), "verso", {})
    assert read_logs(queue, drivers, queue.read(A_test_logs), said.append) == {
        1: "first\n",
        2: f"log of verso-{A_test_logs}-2\n",
    }
    assert said == []
    drivers.answers = False
    assert read_logs(queue, drivers, queue.read(A_test_logs), said.append) == {1: "first\n"}
    assert said == ["attempt 2: no copy of its log is in the queue yet, and Ray's job API does not answer"]


def test_following_shows_each_line_once_over_a_death_until_the_end(tmp_path):
    queue, drivers = queue_of(tmp_path / "q", request_of(A_test_logs)), FakeDrivers()
    first, second = submission_id(A_test_logs, 1), submission_id(A_test_logs, 2)

    def write(submission: str, text: str) -> None:
        drivers.logs[submission] = drivers.logs.get(submission, "") + text

    script = iter(
        [
            lambda: (queue.append(A_test_logs, "started", 1), drivers.hand_over(first, "", {}), write(first, "one\n")),
            lambda: write(first, "two\n"),
            lambda: (
                write(first, "three\n"),
                queue.append(A_test_logs, "died", 1),
                queue.append(A_test_logs, "started", 2),
            ),
            lambda: (drivers.hand_over(second, "", {}), write(second, "four\n"), queue.append(A_test_logs, "began", 2)),
            lambda: (write(second, "five\n"), queue.append(A_test_logs, "ended", 2, code=0)),
        ]
    )
    shown = "".join(follow_logs(queue, drivers, A_test_logs, print, lambda seconds: next(script)()))
    assert shown == f"{header(1)}one\ntwo\nthree\n{header(2)}four\nfive\n"
