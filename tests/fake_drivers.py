"""A stand-in for Ray's job API, and queues with made-up jobs."""

import shlex
from collections.abc import Mapping
from pathlib import Path

from schemas.errors import MachineError
from schemas.queue import JobRequest, submission_id
from services.queue.decide import Driver
from services.queue.ray_jobs import Drivers
from services.queue.store import Queue, make_queue


class FakeDrivers(Drivers):
    """Knows what was handed over; a test says what becomes of it."""

    def __init__(self) -> None:
        self.known: dict[str, Driver] = {}
        self.entrypoints: dict[str, list[str]] = {}
        self.stopped: list[str] = []
        self.logs: dict[str, str] = {}
        self.handed_over: list[str] = []
        self.answers = True

    def states(self) -> dict[str, Driver]:
        self._answer()
        return dict(self.known)

    def hand_over(self, submission: str, entrypoint: str, metadata: Mapping[str, str]) -> None:
        self._answer()
        if submission not in self.known:
            self.known[submission] = Driver("running")
            self.handed_over.append(submission)
            self.entrypoints[submission] = shlex.split(entrypoint)

    def stop(self, submission: str) -> None:
        self._answer()
        self.stopped.append(submission)

    def log(self, submission: str) -> str | None:
        self._answer()
        return self.logs.get(submission, f"log of {submission}\n") if submission in self.known else None

    def end(self, job: str, attempt: int) -> None:
        """The driver is over, whatever it told."""
        self.known[submission_id(job, attempt)] = Driver("over")

    def _answer(self) -> None:
        if not self.answers:
            raise MachineError("Ray's job API does not answer")


def request_of(job: str, **changes: object) -> JobRequest:
    made = JobRequest(id=job, name="mugs", text="name: mugs\n", folder="/", out=f"/out/{job}", scenes=8, submitted=1.0)
    return made.model_copy(update=changes)


def ids(count: int) -> list[str]:
    return [f"j{number:08x}" for number in range(1, count + 1)]


def queue_of(folder: Path, *requests: JobRequest) -> Queue:
    queue = make_queue(str(folder))
    for request in requests:
        assert queue.put_request(request)
    return queue
