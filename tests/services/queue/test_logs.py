"""A job's log: from Ray while it lives, from the queue afterwards."""

from schemas.queue import submission_id
from services.queue.listing import follow_logs, header, read_logs
from tests.kit.queue_world import FakeDrivers, ids, queue_of, request_of

(A,) = ids(1)


def test_the_kept_copy_comes_before_ray_and_is_there_without_it(tmp_path):
    queue, drivers, said = queue_of(tmp_path / "q", request_of(A)), FakeDrivers(), []
    for event in ("started:1", "died:1", "started:2", "began:2"):
        kind, _, attempt = event.partition(":")
        queue.append(A, kind, int(attempt))
    queue.put_log(A, 1, "first\n")
    drivers.hand_over(submission_id(A, 2), "verso", {})
    assert read_logs(queue, drivers, queue.read(A), said.append) == {1: "first\n", 2: f"log of verso-{A}-2\n"}
    assert said == []
    drivers.answers = False
    assert read_logs(queue, drivers, queue.read(A), said.append) == {1: "first\n"}
    assert said == ["attempt 2: no copy of its log is in the queue yet, and Ray's job API does not answer"]


def test_following_shows_each_line_once_over_a_death_until_the_end(tmp_path):
    queue, drivers = queue_of(tmp_path / "q", request_of(A)), FakeDrivers()
    first, second = submission_id(A, 1), submission_id(A, 2)

    def write(submission: str, text: str) -> None:
        drivers.logs[submission] = drivers.logs.get(submission, "") + text

    script = iter(
        [
            lambda: (queue.append(A, "started", 1), drivers.hand_over(first, "", {}), write(first, "one\n")),
            lambda: write(first, "two\n"),
            lambda: (write(first, "three\n"), queue.append(A, "died", 1), queue.append(A, "started", 2)),
            lambda: (drivers.hand_over(second, "", {}), write(second, "four\n"), queue.append(A, "began", 2)),
            lambda: (write(second, "five\n"), queue.append(A, "ended", 2, code=0)),
        ]
    )
    shown = "".join(follow_logs(queue, drivers, A, print, lambda seconds: next(script)()))
    assert shown == f"{header(1)}one\ntwo\nthree\n{header(2)}four\nfive\n"
