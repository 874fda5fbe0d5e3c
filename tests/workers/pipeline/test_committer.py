"""One range is committed while the next is made; errors and order, with made ranges that write nothing."""

import threading

import pytest

from schemas.dataset.shard import JobChange
from schemas.errors import MachineError
from workers.shard.run_shard import Committer

CHANGE = JobChange(before="a", after="b")


class Made:
    """A range whose commit waits until it is let go, and returns its number, or raises."""

    def __init__(self, number: int, events: list[str], error: Exception | None = None) -> None:
        self.number, self.events, self.error = number, events, error
        self.let_go = threading.Event()

    def commit(self, job_change: JobChange | None) -> int:
        assert job_change is CHANGE
        self.events.append(f"begin {self.number}")
        assert self.let_go.wait(60.0)
        self.events.append(f"end {self.number}")
        if self.error is not None:
            raise self.error
        return self.number


def test_a_commit_is_under_way_until_the_next_begins():
    events: list[str] = []
    first, second = (Made(number, events) for number in (1, 2))
    with Committer(CHANGE) as committer:
        committer.begin(first)
        events.append("make 2")
        assert committer.reports == []
        first.let_go.set()
        second.let_go.set()
        committer.begin(second)
        assert committer.reports == [1]
        committer.wait()
    assert committer.reports == [1, 2]
    assert events.index("end 1") < events.index("begin 2")
    assert events.index("make 2") < events.index("end 1"), "the thread that makes ranges did not wait"


def test_an_error_of_a_commit_is_raised_before_the_next_begins():
    events: list[str] = []
    first, second = Made(1, events, MachineError("the disk is full")), Made(2, events)
    first.let_go.set()
    with Committer(CHANGE) as committer:
        committer.begin(first)
        with pytest.raises(MachineError, match="the disk is full"):
            committer.begin(second)
    assert events == ["begin 1", "end 1"]


def test_an_error_of_the_last_commit_is_raised_too():
    made = Made(1, [], MachineError("the disk is full"))
    made.let_go.set()
    with Committer(CHANGE) as committer:
        committer.begin(made)
        with pytest.raises(MachineError, match="the disk is full"):
            committer.wait()


def test_no_commit_is_under_way_after_a_block_that_raised():
    events: list[str] = []
    made = Made(1, events)

    def fail() -> None:
        with Committer(CHANGE) as committer:
            committer.begin(made)
            threading.Timer(0.3, made.let_go.set).start()
            raise MachineError("the GPU is gone")

    with pytest.raises(MachineError, match="the GPU is gone"):
        fail()
    assert events == ["begin 1", "end 1"]


def test_without_a_commit_there_is_nothing_to_wait_for():
    with Committer(None) as committer:
        committer.wait()
    assert committer.reports == []
