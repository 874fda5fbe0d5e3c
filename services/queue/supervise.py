"""The supervisor of a queue: the one process that gives drivers to Ray. It may be killed at any moment, and run twice.

What it does next is decided by pure functions, from the states of all jobs and what Ray says of their drivers.
"""

import contextlib
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final, Literal, NamedTuple, Protocol

from schemas.errors import CorruptError, InUseError, MachineError, RunError
from schemas.queue import submission_id
from services.queue.queue import JobView, Queue
from services.run.lock import Lock, hold_lock


class Driver(NamedTuple):
    """A driver as Ray's job API knows it: it waits or runs, or it has ended in any way; and Ray's words for that."""

    state: Literal["running", "over"]
    said: str = ""


class Drivers(Protocol):
    """Where drivers run. Every method raises MachineError where it does not answer."""

    def states(self) -> dict[str, Driver]:
        """By submission id: the drivers that are known."""

    def hand_over(self, submission: str, words: Sequence[str]) -> None:
        """Starts a driver, which is a command line, unless one of this submission id is known already."""

    def stop(self, submission: str) -> None:
        """Asks for the end of a driver; returns at once."""

    def log(self, submission: str) -> str | None:
        """What a driver and its commands wrote so far; None where it is not known."""

    def close(self) -> bool:
        """At the end of their supervisor: whether all of them were ended with it; others go on."""


PAUSES_S: Final = (10.0, 60.0, 300.0)
"""Before a job is taken up again after its first, second and third death."""

BUSY_PAUSE_S: Final = 30.0
"""Before a driver looks again whether another run has left the output folder."""

Deed = Literal["start", "hand over", "stop", "note death", "note stop"]
"""start: decide on a new attempt. hand over: give the driver of the decided attempt to Ray. stop: ask Ray to end it."""


@dataclass(frozen=True)
class Action:
    """One thing to do about one job."""

    deed: Deed
    job: str
    attempt: int
    note: str = ""


def tend_drivers(views: Sequence[JobView], drivers: Mapping[str, Driver]) -> list[Action]:
    """What to do about jobs that have a driver, or should have one; `drivers` by submission id, as Ray knows them."""
    actions = []
    for view in views:
        job, attempt = view.request.id, view.attempt
        driver = drivers.get(submission_id(job, attempt))
        runs = driver is not None and driver.state == "running"
        if not view.held or (runs and view.state != "cancelling"):
            continue
        if view.state == "cancelling":
            actions.append(Action("stop" if runs else "note stop", job, attempt))
        elif driver is not None:
            said = f" ({driver.said})" if driver.said else ""
            actions.append(Action("note death", job, attempt, f"its driver ended without telling how{said}"))
        elif view.began:
            actions.append(Action("note death", job, attempt, "Ray does not know its driver any more"))
        else:  # the supervisor was killed in between, or Ray forgot it
            actions.append(Action("hand over", job, attempt))
    return actions


def choose_starts(
    views: Sequence[JobView], at_once: int, is_due: Callable[[JobView], bool] = lambda view: True
) -> list[Action]:
    """The jobs whose turn it is, by priority and then by age, while fewer than `at_once` have a driver.

    A job waits while another that began earlier in its output folder has not ended. `is_due` tells whether a pause is over.
    """
    room = at_once - sum(view.held for view in views)
    taken = {view.request.out for view in views if view.claims_folder}
    chosen: list[Action] = []
    for view in sorted((view for view in views if view.state in ("queued", "waiting")), key=turn):
        is_free = view.claims_folder or view.request.out not in taken
        if len(chosen) < room and is_free and is_due(view):
            taken.add(view.request.out)
            chosen.append(Action("start", view.request.id, view.attempt + 1))
    return chosen


def turn(view: JobView) -> tuple[int, float, str]:
    """Sorts jobs by their turn."""
    return -view.request.priority, view.request.submitted, view.request.id


def pause_of(view: JobView) -> float:
    """Seconds that a job rests before it is taken up again."""
    if view.state == "waiting":
        return BUSY_PAUSE_S
    return PAUSES_S[min(view.deaths, len(PAUSES_S)) - 1] if view.deaths else 0.0


def waiting_for_folder(views: Sequence[JobView]) -> Collection[str]:
    """Ids of queued jobs whose output folder another job works in."""
    taken = {view.request.out: view.request.id for view in views if view.claims_folder}
    return {
        view.request.id
        for view in views
        if view.state == "queued" and taken.get(view.request.out, view.request.id) != view.request.id
    }


EVERY_S: Final = 2.0
"""Between two looks at the queue and at Ray."""


@dataclass(frozen=True)
class Rules:
    """At most `at_once` drivers; `command` are the words that start Verso on the cluster's head."""

    at_once: int
    command: Sequence[str]
    until_empty: bool = False
    """Whether to end once every job of the queue has."""


class Supervisor:
    """Looks at a queue and at Ray's drivers again and again, and does what is to be done.

    Before anything is done it is decided in storage, and what was decided and not done is found by the next look: a kill
    at any place loses nothing. What was decided by another in the meantime is not decided again.
    """

    def __init__(
        self, queue: Queue, drivers: Drivers, rules: Rules, say: Callable[[str], None], clock: Callable[[], float]
    ) -> None:
        self._queue = queue
        self._drivers = drivers
        self._rules = rules
        self._say = say
        self._clock = clock
        self._settled: set[str] = set()
        """Ended jobs whose logs are kept, or gone."""
        self._seen: dict[str, tuple[int, float]] = {}
        """By job: how many events it had, and when that was seen first."""
        self._kept: set[str] = set()
        """Drivers whose logs are in the queue, or could not be had."""
        self._waited_for: set[str] = set()
        """Jobs that had not ended at some look."""
        self.is_empty = False
        """Whether the last look saw no job but ended ones, with their logs kept."""
        self._share = 0
        self._fails = False
        """Whether the last look did."""
        self._say_once = cache(say)

    def look(self, require_held: Callable[[], None] = lambda: None) -> None:
        """One round. Where storage or Ray does not answer, that is told, and waited for.

        `require_held` raises RunError where another supervisor took over.
        """
        self.is_empty = False
        try:
            require_held()
            self._look()
        except (MachineError, OSError) as error:
            if not self._fails:
                self._say(f"{error}; it is asked again and again")
            self._fails = True
        else:
            if self._fails:
                self._say("all answer again")
            self._fails = False

    def _look(self) -> None:
        views, faults = self._queue.read_all(job for job in self._queue.ids() if job not in self._settled)
        known = self._drivers.states()
        for job, fault in faults.items():
            self._say_once(f"job {job} is left alone: {fault}")
        self._do_all(tend_drivers(views, known))
        self._keep_logs(views, known)
        left = [view.request.id for view in views if not view.ended]
        self._do_all(choose_starts(self._queue.read_all(left)[0], self._rules.at_once, self._is_due))
        self._tell_share(left)
        self._waited_for |= {*left}
        self.is_empty = self._settled >= {view.request.id for view in views}

    def failures(self) -> list[str]:
        """Ids of the jobs that failed, or were lost, while they were looked after."""
        views, _ = self._queue.read_all(self._waited_for)
        return sorted(view.request.id for view in views if view.state in ("failed", "lost"))

    def note_ends(self) -> None:
        """Notes that all drivers were stopped: their jobs wait for the next supervisor, and no death is counted."""
        views, _ = self._queue.read_all(self._queue.ids())
        for view in views:
            if view.held:
                self._keep_log(view.request.id, view.attempt)
                self._queue.append(view.request.id, "stopped", view.attempt)

    def _do_all(self, actions: Sequence[Action]) -> None:
        """Does one thing after another; what fails is told, and done by the next look."""
        for action in actions:
            try:
                self._do(action)
            except (MachineError, CorruptError, OSError) as error:
                self._say_once(f"job {action.job}: {error}")

    def _do(self, action: Action) -> None:
        """Does one thing, if nobody else has made it needless."""
        job, attempt = action.job, action.attempt
        if action.deed == "start":
            view = self._queue.append(job, "started", attempt)
            if view is not None:
                self._say(f"job {job} ({view.request.name}): attempt {attempt} begins")
                self._hand_over(view)
        elif action.deed == "hand over":
            view = self._queue.read(job)
            if view.state == "running" and view.attempt == attempt and not view.began:
                self._hand_over(view)
        elif action.deed == "stop":
            self._drivers.stop(submission_id(job, attempt))
        elif action.deed == "note stop":
            if self._queue.append(job, "stopped", attempt) is not None:
                self._say(f"job {job}: cancelled; what it committed is kept")
        elif (view := self._queue.append(job, "died", attempt, note=action.note)) is not None:
            then = f"is taken up again in {pause_of(view):g} s" if not view.ended else f"is {view.state}"
            self._say(f"job {job}, attempt {attempt}: {action.note}; it {then}")

    def _hand_over(self, view: JobView) -> None:
        """Gives the driver of a decided attempt to Ray."""
        job, attempt = view.request.id, view.attempt
        words = [*self._rules.command, "drive", job, str(attempt), "--queue", self._queue.name]
        self._drivers.hand_over(submission_id(job, attempt), words)

    def _keep_logs(self, views: Sequence[JobView], known: Mapping[str, Driver]) -> None:
        """Copies the logs of drivers that are over into the queue, while Ray still has them."""
        states = {submission: driver.state for submission, driver in known.items()}
        for view in views:
            job = view.request.id
            for attempt in range(1, view.attempt + 1):
                submission = submission_id(job, attempt)
                if states.get(submission) == "over" and submission not in self._kept:
                    self._keep_log(job, attempt)
            if view.ended and states.get(submission_id(job, view.attempt)) != "running":
                self._settled.add(job)

    def _keep_log(self, job: str, attempt: int) -> None:
        submission = submission_id(job, attempt)
        self._kept.add(submission)
        try:
            if not self._queue.has_log(job, attempt):
                self._queue.put_log(job, attempt, self._drivers.log(submission) or "")
        except (MachineError, OSError) as error:
            self._say_once(f"job {job}, attempt {attempt}: its log is not kept: {error}")

    def _is_due(self, view: JobView) -> bool:
        """Whether a job's pause is over; it is counted from when its last event was seen, by this machine's clock."""
        events, since = self._seen.get(view.request.id, (-1, 0.0))
        if events != view.events:
            since = self._clock()
            self._seen[view.request.id] = (view.events, since)
        return self._clock() - since >= pause_of(view)

    def _tell_share(self, ids: Sequence[str]) -> None:
        """Tells the drivers among how many the cluster is shared, where that has changed."""
        running = max(1, sum(view.held for view in self._queue.read_all(ids)[0]))
        if running != self._share:
            self._queue.put_share(running)
            self._share = running


def supervise(
    queue: Queue, place: contextlib.AbstractContextManager[Drivers], rules: Rules, say: Callable[[str], None]
) -> list[str]:
    """Looks after a queue until it is interrupted, or empty where the rules say so; `place` is entered once the queue is held.

    Ids of the jobs that failed meanwhile. Raises RunError where another supervisor does, or took over.
    """
    with hold_queue(queue) as lock, place as drivers:
        supervisor = Supervisor(queue, drivers, rules, say, time.monotonic)
        try:
            while True:
                supervisor.look(lock.require_held)
                if rules.until_empty and supervisor.is_empty:
                    return supervisor.failures()
                time.sleep(EVERY_S)
        finally:
            if drivers.close():
                supervisor.note_ends()


@contextlib.contextmanager
def hold_queue(queue: Queue) -> Iterator[Lock]:
    """Holds the queue's lock while the context lasts. Raises RunError naming the supervisor that has it."""
    with contextlib.ExitStack() as stack:
        try:
            lock = stack.enter_context(hold_lock(queue.store))
        except InUseError as error:
            raise RunError(f"another supervisor works here: {error.place} is in use by {error.by}") from error
        yield lock
