"""A stand-in for Ray's job API, queues with made-up jobs, and a world whose drivers work and are watched for doubles."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from schemas.errors import MachineError, VersoError
from schemas.queue import JobRequest, submission_id
from services.queue.drivers import Ending, drive
from services.queue.queue import Queue, make_queue
from services.queue.supervise import Driver, Drivers, Rules, Supervisor


class FakeDrivers(Drivers):
    """Knows what was handed over; a test says what becomes of it."""

    def __init__(self) -> None:
        self.known: dict[str, Driver] = {}
        self.stopped: list[str] = []
        self.logs: dict[str, str] = {}
        self.handed_over: list[str] = []
        self.answers = True

    def states(self) -> dict[str, Driver]:
        self._answer()
        return dict(self.known)

    def hand_over(self, submission: str, words: Sequence[str]) -> None:
        self._answer()
        if submission not in self.known:
            self.known[submission] = Driver("running")
            self.handed_over.append(submission)

    def stop(self, submission: str) -> None:
        self._answer()
        self.stopped.append(submission)

    def log(self, submission: str) -> str | None:
        self._answer()
        return self.logs.get(submission, f"log of {submission}\n") if submission in self.known else None

    def close(self) -> bool:
        return False

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


DIES = "dies"
"""In the name of a job: its first driver ends without a word."""

WORK_TICKS = 3
AT_ONCE = 2


class Killed(BaseException):
    """The end of a supervisor's process."""


@dataclass
class World(FakeDrivers):
    """Ray with drivers that work. `effect` is called before and after whatever a supervisor does to the world."""

    queue: Queue
    ticks: int = 0
    effect: Callable[[], None] = lambda: None
    working: dict[str, int] = field(default_factory=dict)
    """Drivers that began, and the tick at which they end."""
    began: Counter = field(default_factory=Counter)
    """By submission id."""
    most_at_once: int = 0

    def __post_init__(self) -> None:
        super().__init__()

    def submit(self, job: str, **changes: Any) -> None:
        assert self.queue.put_request(request_of(job, **changes))

    def supervisor(self, say: Callable[[str], None] = lambda line: None) -> Supervisor:
        queue = Queue(self.queue.store)
        original = queue.append

        def append(*arguments: Any, **fields: Any) -> Any:
            self.effect()
            added = original(*arguments, **fields)
            self.effect()
            return added

        vars(queue)["append"] = append
        return Supervisor(queue, self, Rules(AT_ONCE, ["verso"]), say, lambda: 1000.0 * self.ticks)

    def hand_over(self, submission: str, words: Sequence[str]) -> None:
        self.effect()
        super().hand_over(submission, words)
        self.effect()

    def stop(self, submission: str) -> None:
        self.effect()
        super().stop(submission)
        if self.known.get(submission) == Driver("running"):
            self.known[submission] = Driver("over")
            self.working.pop(submission, None)
        self.effect()

    def tick(self) -> None:
        """Lets the drivers work for a while."""
        self.ticks += 1
        for submission in [one for one, state in self.known.items() if state == Driver("running")]:
            self._work(submission)
        folders = Counter(self.queue.read(one[6:15]).request.out for one in self.working)
        assert set(folders.values()) <= {1}, "two drivers in one folder"
        self.most_at_once = max(self.most_at_once, len(self.working))

    def _work(self, submission: str) -> None:
        job, attempt = submission[6:15], int(submission[16:])
        if submission not in self.working:
            self._begin(submission, job, attempt)
        elif self.ticks >= self.working[submission]:
            name = self.queue.read(job).request.name
            if not (DIES in name and attempt == 1):
                self.queue.append(job, "ended", attempt, code=0)
            del self.working[submission]
            self.known[submission] = Driver("over")

    def _begin(self, submission: str, job: str, attempt: int) -> None:
        """As `drive` does; a driver that is refused ends at once."""
        try:
            drive(self.queue, job, attempt, self._stay)
        except VersoError:
            self.known[submission] = Driver("over")
        except Killed:
            self.began[submission] += 1
            self.working[submission] = self.ticks + WORK_TICKS

    @staticmethod
    def _stay(request: object) -> Ending:
        raise Killed  # out of `drive` after it has begun, as if it went on in a process of its own

    def restart(self) -> None:
        """The head is gone and comes back: nothing runs, and nothing is known."""
        self.known.clear()
        self.working.clear()

    def states_of_jobs(self) -> dict[str, str]:
        return {job: self.queue.read(job).state for job in self.queue.ids()}

    def is_running(self, job: str) -> bool:
        view = self.queue.read(job)
        return self.known.get(submission_id(job, view.attempt)) == Driver("running") and view.began
